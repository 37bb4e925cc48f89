"""Kernels compiled ahead, by a process beside the first reconstruction of an installation.

Numba compiles one kernel after the other, on one core: half of the time of a first ``lift``. Processes share what is
compiled through Numba's cache on disk. So another process draws a small scene at once, as reconstructions do in the
end, and then lifts a small log, by which it is soon ahead of the first one.
"""

from __future__ import annotations

import atexit
import subprocess
import sys
from pathlib import Path

from nurec_sim.compute.cores import usable_cores
from nurec_sim.render.cpu.blend.sweep import sweep_returns

MODULE = "nurec_sim.reconstruct.small_scene"
_started: list[subprocess.Popen] = []


def compile_ahead() -> None:
    """Starts the process, once, if kernels are not compiled yet and a core is free. It ends with this process."""
    if _started or usable_cores() < 2 or not _missing():
        return
    quiet = subprocess.DEVNULL
    _started.append(subprocess.Popen([sys.executable, "-m", MODULE], stdin=quiet, stdout=quiet, stderr=quiet))
    atexit.register(_stop, _started[0])


def _missing() -> bool:
    """Whether Numba's cache lacks the kernel that a reconstruction compiles last; without a cache it is never there."""
    folder = sweep_returns.stats.cache_path  # type: ignore[attr-defined]
    return bool(folder) and not any(Path(folder).glob(f"*.{sweep_returns.__qualname__}-*.nbi"))


def _stop(process: subprocess.Popen) -> None:
    process.kill()
    process.wait()
