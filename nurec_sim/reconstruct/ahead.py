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
from typing import IO

from nurec_sim.compute.cores import usable_cores
from nurec_sim.render.cpu.blend.sweep import sweep_returns

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

MODULE = "nurec_sim.reconstruct.small_scene"
_started: list[subprocess.Popen] = []
_locks: list[IO[bytes]] = []


def compile_ahead() -> None:
    """Starts the process, once, if kernels are not compiled yet and a core is free. It ends with this process."""
    folder = cache_folder()
    if usable_cores() < 2 or folder is None or compiled(folder) or not _only_one(folder):
        return
    quiet = subprocess.DEVNULL
    _started.append(subprocess.Popen([sys.executable, "-m", MODULE], stdin=quiet, stdout=quiet, stderr=quiet))
    atexit.register(_stop, _started[0])


def cache_folder() -> Path | None:
    """Where Numba keeps the kernel that a reconstruction compiles last; None if it cannot keep any."""
    path = sweep_returns.stats.cache_path  # type: ignore[attr-defined]
    return Path(path) if path else None


def compiled(folder: Path) -> bool:
    """Whether that kernel is there."""
    return any(folder.glob(f"*.{sweep_returns.__qualname__}-*.nbi"))


def _only_one(folder: Path) -> bool:
    """Whether no other process has begun; from now on none does until this one ends."""
    if fcntl is None:
        return not _started
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / "ahead.lock").open("ab")
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        return False
    _locks.append(lock)
    return True


def _stop(process: subprocess.Popen) -> None:
    process.kill()
    process.wait()
