"""What runs the kernels: a GPU through ``cuda-core``, or anything else that implements ``Launcher``.

The rest of this folder only sees tensors on ``Launcher.device`` and kernels by name, so tests run all of it without a
GPU (``tests/gpu_on_cpu``).
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Protocol

import numpy as np

from nurec_sim.errors import GpuError
from nurec_sim.render.gpu.compiler import cached_cubin, import_cuda_core, kernel_names
from nurec_sim.render.gpu.driver import check_driver

if TYPE_CHECKING:
    import torch

    Argument = torch.Tensor | np.generic | int | float | None
    """Tensors (None is a null pointer), ``int`` (32 bits), ``np.int64`` and ``float`` (32 bits)."""

THREADS = 256
"""Threads of a block, in every kernel."""


class Launcher(Protocol):
    """Runs kernels in the order in which they are launched."""

    device: torch.device

    def launch(self, kernel: str, grid: tuple[int, int], *arguments: Argument) -> None:
        """Run a kernel on ``grid`` blocks (x, y) of ``THREADS`` threads; nothing if there are none."""
        ...

    def upload(self, data: np.ndarray) -> torch.Tensor:
        """A copy on the device; does not wait for it."""
        ...

    def sort(self, keys: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Sorted keys and their places before; equal keys keep their order."""
        ...

    def running_sum(self, counts: torch.Tensor) -> torch.Tensor:
        """Running sums as int64."""
        ...

    def read(self, tensor: torch.Tensor) -> np.ndarray:
        """A copy on the host. Waits for the device; nothing else does."""
        ...


class TorchOperations:
    """What a ``Launcher`` does besides running kernels, by torch on any device."""

    device: torch.device

    def upload(self, data: np.ndarray) -> torch.Tensor:
        """See ``Launcher``."""
        import torch

        return torch.from_numpy(data).to(self.device)

    def sort(self, keys: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """See ``Launcher``."""
        import torch

        ordered, places = torch.sort(keys, stable=True)
        return ordered, places

    def running_sum(self, counts: torch.Tensor) -> torch.Tensor:
        """See ``Launcher``."""
        import torch

        return torch.cumsum(counts, 0, dtype=torch.int64)

    def read(self, tensor: torch.Tensor) -> np.ndarray:
        """See ``Launcher``."""
        return tensor.cpu().numpy()


class CudaLauncher(TorchOperations):
    """Runs kernels on a CUDA device, on torch's current stream.

    Args:
        device: such as ``cuda`` or ``cuda:1``.

    Raises:
        GpuError: no such device, a driver that is too old, or the extra ``gpu`` is missing.
    """

    def __init__(self, device: str = "cuda") -> None:
        check_driver()
        core = import_cuda_core()
        self.device = cuda_device(device)
        self._core = core
        self._device = core.Device(self.device.index)
        self._device.set_current()
        # One cubin holds all kernels of an architecture, so nothing is compiled on later starts.
        cubin = cached_cubin(architecture_of(self.device))
        try:
            code = core.ObjectCode.from_cubin(cubin)
            self._kernels = {name: code.get_kernel(name) for name in kernel_names()}
        except Exception as error:
            raise GpuError(f"{self.device} cannot load the kernels; its driver may be too old: {error}") from None

    def launch(self, kernel: str, grid: tuple[int, int], *arguments: Argument) -> None:
        """See ``Launcher``."""
        if min(grid) == 0:
            return
        self._device.set_current()  # the calling thread may be a new one
        config = self._core.LaunchConfig(grid=grid, block=THREADS)
        values = [as_scalar(argument, self.device) for argument in arguments]
        self._core.launch(_TorchStream(self.device), config, self._kernels[kernel], *values)

    def upload(self, data: np.ndarray) -> torch.Tensor:
        """See ``Launcher``; copies from pinned memory, because a copy from other memory waits for the device."""
        import torch

        return torch.from_numpy(data).pin_memory().to(self.device, non_blocking=True)


@functools.lru_cache
def shared_launcher(device: str) -> CudaLauncher:
    """The one launcher of a device that all renderers of this process share, so that kernels are loaded once.

    Raises:
        GpuError: see ``CudaLauncher``.
    """
    return CudaLauncher(device)


class _TorchStream:
    """Torch's current stream of a device, by the protocol of ``cuda-core``."""

    def __init__(self, device: torch.device) -> None:
        import torch

        self._handle = torch.cuda.current_stream(device).cuda_stream

    def __cuda_stream__(self) -> tuple[int, int]:
        return 0, self._handle


def as_scalar(argument: Argument, device: torch.device) -> np.generic:
    """What a kernel receives for an argument: an address, a 32-bit or a 64-bit integer, or a 32-bit float."""
    if argument is None:
        return np.uint64(0)
    if isinstance(argument, np.generic):
        return argument
    if isinstance(argument, int):
        return np.int32(argument)
    if isinstance(argument, float):
        return np.float32(argument)
    if argument.device != device or not argument.is_contiguous():
        raise ValueError(f"kernels need contiguous tensors on {device}, got one on {argument.device}")
    return np.uint64(argument.data_ptr())


def cuda_device(device: str) -> torch.device:
    """The device with its number.

    Raises:
        GpuError: it is not a CUDA device, or there is none.
    """
    import torch

    if torch.version.cuda is None:
        raise GpuError(
            f"no GPU: this torch ({torch.__version__}) was built without CUDA; install a CUDA build of torch"
        )
    if not torch.cuda.is_available():
        raise GpuError("no GPU: torch finds no CUDA device; the CUDA back end needs an NVIDIA GPU and its driver")
    asked = torch.device(device)
    count = torch.cuda.device_count()
    if asked.type != "cuda" or (asked.index or 0) >= count:
        raise GpuError(f"no GPU {device!r}; have {[f'cuda:{k}' for k in range(count)]}")
    return torch.device("cuda", torch.cuda.current_device() if asked.index is None else asked.index)


def architecture_of(device: torch.device) -> str:
    """Such as ``sm_90``."""
    import torch

    major, minor = torch.cuda.get_device_capability(device)
    return f"sm_{major}{minor}"
