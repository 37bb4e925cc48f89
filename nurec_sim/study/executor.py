"""Where the tasks of a study run. A task is a pure function of its argument that leaves its result on disk.

So results do not depend on the executor, on the number of workers, or on the order in which tasks end.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Protocol, TypeVar

from nurec_sim.compute.worker import follow_parent
from nurec_sim.errors import RunError

Task = TypeVar("Task")
Result = TypeVar("Result")
TICK_S = 1.0
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS")
"""Libraries that would otherwise take every core in every worker; LP is Mesa's software renderer."""


class Executor(Protocol):
    """Runs independent tasks."""

    @property
    def jobs(self) -> int:
        """How many run at a time."""
        ...

    def run(
        self, work: Callable[[Task], Result], tasks: Sequence[Task], tick: Callable[[], None]
    ) -> Iterator[tuple[Task, Result]]:
        """Tasks with their results, as they end.

        Args:
            work: a function of a module.
            tasks: its arguments; must be picklable.
            tick: called about once a second while waiting.

        Raises:
            RunError: a worker died.
        """
        ...


class LocalProcesses:
    """Worker processes on this machine, one task at a time and one thread of each library in each of them.

    Processes are new ones even for one worker: an OpenGL context must not survive a fork, and libraries read their
    number of threads when they are first loaded.
    """

    def __init__(self, jobs: int) -> None:
        if jobs < 1:
            raise RunError(f"the number of jobs must be 1 or more, got {jobs}")
        self.jobs = jobs

    def run(
        self, work: Callable[[Task], Result], tasks: Sequence[Task], tick: Callable[[], None]
    ) -> Iterator[tuple[Task, Result]]:
        """See ``Executor.run``."""
        if not tasks:
            return
        context, others = multiprocessing.get_context("spawn"), set(multiprocessing.active_children())
        pool = ProcessPoolExecutor(min(self.jobs, len(tasks)), mp_context=context, initializer=_begin)
        try:
            waiting = {pool.submit(work, task): task for task in tasks}
            while waiting:
                done, _ = wait(waiting, TICK_S, FIRST_COMPLETED)
                tick()
                for future in done:
                    yield waiting.pop(future), future.result()
            pool.shutdown()
        except BrokenProcessPool:
            raise RunError("a worker process was killed, perhaps for want of memory; finished rollouts are kept, "
                           "run again with --resume and perhaps fewer --jobs") from None  # fmt: skip
        finally:
            # After an error or Ctrl-C nobody waits for the tasks in work: what they have finished is on disk.
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
            pool.shutdown(cancel_futures=True)


def _begin() -> None:
    """First call in a worker: one thread per library, Ctrl-C left to the parent, and no life without it."""
    follow_parent()
    for name in ONE_THREAD:
        os.environ[name] = "1"
