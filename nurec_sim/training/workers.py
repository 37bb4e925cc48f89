"""Setup of background worker processes of a training run: low priority, and ended with their parent."""

from __future__ import annotations

import os

from nurec_sim.compute.worker import follow_parent


def work_in_background(niceness: int) -> None:
    """Must be called first in a worker process.

    Lowers its priority, leaves Ctrl-C to the parent, and ends the process with its parent, even if that was killed.
    """
    follow_parent()
    os.nice(niceness)
    os.environ["LP_NUM_THREADS"] = "1"  # Mesa's software renderer would take every core
