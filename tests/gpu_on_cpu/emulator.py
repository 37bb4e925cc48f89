"""Runs the CUDA kernels on the CPU: g++ compiles the same sources against ``cuda_on_cpu.h``."""

import ctypes
import functools
import shutil
import subprocess
import tempfile
import threading
from pathlib import Path

import numpy as np
import torch

from nurec_sim.render.gpu.compiler import KERNEL_FOLDER, kernel_names, translation_unit
from nurec_sim.render.gpu.launcher import THREADS, TorchOperations, as_scalar
from nurec_sim.render.gpu.views import VIEW

HERE = Path(__file__).parent


class EmulatedLauncher(TorchOperations):
    """A ``Launcher`` whose device is the CPU; one kernel at a time."""

    device = torch.device("cpu")
    lock = threading.Lock()

    def __init__(self):
        self._library = _library()

    def launch(self, kernel, grid, *arguments):
        """See ``Launcher``."""
        if min(grid) == 0:
            return
        values = [np.array(as_scalar(argument, self.device)) for argument in arguments]
        pointers = (ctypes.c_void_p * len(values))(*(value.ctypes.data for value in values))
        with self.lock:
            getattr(self._library, f"emulate_{kernel}")(*grid, THREADS, pointers)


def compiler_missing():
    """Why the kernels cannot be run on this machine, or None."""
    return None if shutil.which("g++") else "no g++ to compile the CUDA kernels for the CPU"


@functools.cache
def _library():
    entries = "".join(
        f'extern "C" void emulate_{name}(int x, int y, int count, void** arguments) '
        f"{{ emulator::launch({name}, x, y, count, arguments); }}\n"
        for name in kernel_names()
    )
    folder = Path(tempfile.mkdtemp())
    try:
        source, library = folder / "kernels.cpp", folder / "kernels.so"
        source.write_text(f'#include "cuda_on_cpu.h"\n{translation_unit()}{entries}')
        options = ["-std=c++17", "-O2", "-fPIC", "-shared", "-U_FORTIFY_SOURCE", f"-DVIEW_BYTES={VIEW.itemsize}"]
        folders = [f"-I{KERNEL_FOLDER}", f"-I{HERE}"]
        subprocess.run(["g++", *options, *folders, str(source), "-o", str(library)], check=True)
        return ctypes.CDLL(str(library))
    finally:
        shutil.rmtree(folder)
