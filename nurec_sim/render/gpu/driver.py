"""Whether there is a GPU driver, checked before anything heavy is imported."""

from __future__ import annotations

import ctypes
import sys

from nurec_sim.errors import GpuError


def check_driver() -> None:
    """Look for NVIDIA's driver, which takes no time where there is none.

    Raises:
        GpuError: it is not installed.
    """
    library = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    try:
        ctypes.CDLL(library)
    except OSError:
        raise GpuError(f"no GPU: there is no {library}; CUDA needs an NVIDIA GPU and its driver") from None
