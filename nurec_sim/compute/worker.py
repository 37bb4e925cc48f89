"""Setup of a worker process that lives as long as its parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading

PARENT_GONE = 3
"""Exit status of a worker whose parent ended first."""


def follow_parent() -> None:
    """Leaves Ctrl-C to the parent, and ends this process with it, even if it was killed. To be called first."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: multiprocessing.process.BaseProcess) -> None:
    parent.join()
    os._exit(PARENT_GONE)
