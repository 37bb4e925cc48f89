"""Where tests of the CUDA back end run its kernels: always on the CPU, and on a GPU where there is one."""

import pytest
import torch
from gpu_on_cpu.emulator import EmulatedLauncher, compiler_missing

from nurec_sim.errors import GpuError
from nurec_sim.render.gpu.launcher import CudaLauncher

ON_A_GPU = pytest.param("on a GPU", marks=pytest.mark.needs_gpu)
PLACES = ["on the CPU", ON_A_GPU] if torch.cuda.is_available() else ["on the CPU"]


def launcher_at(place):
    """A launcher; skips the test where there can be none."""
    if place == "on a GPU":
        try:
            return CudaLauncher()
        except GpuError as error:
            pytest.skip(str(error))
    if why := compiler_missing():
        pytest.skip(why)
    return EmulatedLauncher()
