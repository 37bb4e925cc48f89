"""A thread for one policy: what it is asked happens one after the other, and nobody waits for one that hangs."""

from __future__ import annotations

import asyncio
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")


class PolicyThread:
    """Runs functions one after the other in a daemon thread, which does not keep the process alive.

    ``concurrent.futures`` would wait at exit for a policy that never answers.
    """

    def __init__(self, name: str) -> None:
        self._jobs: queue.SimpleQueue[tuple[Future, Callable[[], object]] | None] = queue.SimpleQueue()
        threading.Thread(target=self._work, name=name, daemon=True).start()

    async def run(self, function: Callable[[], T], timeout_s: float) -> T:
        """What ``function`` gives; it is not begun if the await is cancelled or times out before its turn.

        Raises:
            TimeoutError: it took longer than ``timeout_s``; if it had begun, it goes on and the next one waits for it.
        """
        future: Future[T] = Future()
        self._jobs.put((future, function))
        async with asyncio.timeout(timeout_s):
            return await asyncio.wrap_future(future)

    def stop(self) -> None:
        """Ends the thread after what it is doing; does not wait."""
        self._jobs.put(None)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            future, function = job
            if not future.set_running_or_notify_cancel():
                continue
            try:
                result = function()
            except BaseException as error:
                future.set_exception(error)
            else:
                future.set_result(result)
            del job, future, function
