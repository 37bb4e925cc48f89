"""Compiles the kernels with NVRTC, which needs neither a GPU nor a driver nor a CUDA toolkit, and keeps the result.

All kernels make one cubin per GPU architecture. It is kept in the user's cache folder under the digest of everything
that it depends on; a folder that cannot be read or written costs a compilation, nothing else.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import tempfile
from pathlib import Path

from nurec_sim.errors import GpuError
from nurec_sim.render.gpu.views import VIEW

KERNEL_FOLDER = Path(__file__).parent / "kernels"
PTXAS_OPTIONS = ("--warn-on-spills", "--warn-on-local-memory-usage")


def kernel_sources() -> list[Path]:
    """The files that hold kernels, in the order in which they are compiled."""
    return sorted(KERNEL_FOLDER.glob("*.cu"))


def kernel_names() -> list[str]:
    """Every kernel."""
    pattern = re.compile(r'extern "C" __global__ void.*?(\w+)\(const', re.DOTALL)
    return [name for path in kernel_sources() for name in pattern.findall(path.read_text())]


def translation_unit() -> str:
    """The program: all kernels, by inclusion."""
    return "".join(f'#include "{path.name}"\n' for path in kernel_sources())


def compile_cubin(architecture: str) -> tuple[bytes, str]:
    """Machine code of all kernels, and the compiler's log.

    Args:
        architecture: such as ``sm_90``.

    Raises:
        GpuError: the extra ``gpu`` is missing, or the compiler refuses.
    """
    core = import_cuda_core()
    options = core.ProgramOptions(
        arch=architecture,
        std="c++17",
        include_path=[str(KERNEL_FOLDER)],
        define_macro=[("VIEW_BYTES", str(VIEW.itemsize))],
        ptxas_options=list(PTXAS_OPTIONS),
    )
    log = _Log()
    try:
        code = core.Program(translation_unit(), "c++", options).compile("cubin", logs=log).code
    except Exception as error:
        raise GpuError(f"cannot compile the kernels for {architecture}: {error}") from None
    return bytes(code), "".join(log.parts).strip("\0 \n")


def cached_cubin(architecture: str, folder: Path | None = None) -> bytes:
    """``compile_cubin``, kept in a folder (``cache_folder()`` if None)."""
    path = (folder or cache_folder()) / f"{architecture}-{_digest(architecture)}.cubin"
    with contextlib.suppress(OSError):
        return path.read_bytes()
    cubin, _ = compile_cubin(architecture)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        # Written beside it and moved, so that no reader sees an incomplete file.
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(cubin)
        os.replace(file.name, path)
    return cubin


def cache_folder() -> Path:
    """Where cubins are kept: ``cubins`` in $NUREC_SIM_CACHE, or in ``nurec_sim`` of the user's cache folder."""
    chosen = os.environ.get("NUREC_SIM_CACHE")
    parent = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nurec_sim"
    return (Path(chosen) if chosen else parent) / "cubins"


def import_cuda_core():
    """The module ``cuda.core``.

    Raises:
        GpuError: the extra ``gpu`` is not installed.
    """
    try:
        import cuda.core
    except ImportError as error:
        raise GpuError(f"the CUDA back end needs the extra 'gpu': pip install 'nurec-sim[gpu]' ({error})") from None
    return cuda.core


def _digest(architecture: str) -> str:
    """Digest of all that a cubin depends on."""
    from cuda.bindings import nvrtc

    digest = hashlib.sha256()
    for path in sorted(KERNEL_FOLDER.iterdir()):
        digest.update(f"{path.name}\n".encode() + path.read_bytes())
    digest.update(repr((architecture, VIEW.itemsize, PTXAS_OPTIONS, nvrtc.nvrtcVersion()[1:])).encode())
    return digest.hexdigest()[:24]


class _Log:
    """Collects what the compiler writes."""

    def __init__(self) -> None:
        self.parts: list[str] = []

    def write(self, text: str) -> None:
        self.parts.append(text)
