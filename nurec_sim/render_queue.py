"""Where frames wait for their turn to be rendered, in threads of their own."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from nurec_sim.calls import current_call

T = TypeVar("T")


def usable_cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class RenderQueue:
    """Runs functions in a few threads, first come first served, and counts them.

    What its client gave up, or has stopped waiting for, before its turn came is not begun.

    Args:
        workers: functions that run at the same time.
    """

    def __init__(self, workers: int) -> None:
        self._executor = ThreadPoolExecutor(workers, thread_name_prefix="render")
        self._lock = threading.Lock()
        self._waiting = self._running = 0

    @property
    def waiting(self) -> int:
        """Functions whose turn has not come."""
        return self._waiting

    @property
    def running(self) -> int:
        """Functions at work."""
        return self._running

    async def run(self, function: Callable[..., T], *arguments) -> T:
        """What ``function`` gives; if the await is cancelled before its turn, it is never called.

        Raises:
            DeadlinePassedError: the deadline of the current call passed before its turn came.
        """
        call = current_call()

        def begin() -> T:
            with self._lock:
                self._waiting -= 1
                self._running += 1
            try:
                call.check_deadline()
                return function(*arguments)
            finally:
                with self._lock:
                    self._running -= 1

        with self._lock:
            self._waiting += 1
        try:
            future = self._executor.submit(begin)
        except RuntimeError:  # closed: the server stops
            self._forget()
            raise
        future.add_done_callback(self._ended)
        return await asyncio.wrap_future(future)

    def close(self) -> None:
        """Drops what has not begun and waits for the rest."""
        self._executor.shutdown(wait=True, cancel_futures=True)

    def _ended(self, future: Future) -> None:
        if future.cancelled():  # then it had not begun
            self._forget()

    def _forget(self) -> None:
        with self._lock:
            self._waiting -= 1
