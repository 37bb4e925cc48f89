"""How processes that work in the background of a training behave: out of its way, and gone when it is gone."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading

PARENT_GONE = 3
"""Exit status of a worker whose parent ended without ending it first."""


def work_in_background(niceness: int) -> None:
    """To be called first in a worker process.

    It takes only the time that others leave, lets its parent alone answer Ctrl-C, and ends with it, even where the
    parent was killed.
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
