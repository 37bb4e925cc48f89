"""Setup of background worker processes of a training run: low priority, and ended with their parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading

PARENT_GONE = 3
"""Exit status of a worker whose parent ended first."""


def work_in_background(niceness: int) -> None:
    """Must be called first in a worker process.

    Lowers its priority, leaves Ctrl-C to the parent, and ends the process with its parent, even if that was killed.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(niceness)
    os.environ["LP_NUM_THREADS"] = "1"  # Mesa's software renderer would take every core
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: multiprocessing.process.BaseProcess) -> None:
    parent.join()
    os._exit(PARENT_GONE)
