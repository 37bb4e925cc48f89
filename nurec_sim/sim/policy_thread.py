"""A thread for one policy: what it is asked happens one after the other, and nobody waits for one that hangs."""

from __future__ import annotations

import asyncio
import ctypes
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")

_abandoned: list[threading.Thread] = []


class PolicyThread:
    """Runs functions one after the other in a daemon thread, which does not keep the process alive.

    ``concurrent.futures`` would wait at exit for a policy that never answers.
    """

    def __init__(self, name: str) -> None:
        self._jobs: queue.SimpleQueue[tuple[Future, Callable[[], object]] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def submit(self, function: Callable[[], T]) -> Future[T]:
        """What ``function`` will give, or raise, whatever that is."""
        future: Future[T] = Future()
        self._jobs.put((future, function))
        return future

    async def run(self, function: Callable[[], T], timeout_s: float) -> T:
        """What ``function`` gives; it is not begun if the await is cancelled or times out before its turn.

        Raises:
            TimeoutError: it took longer than ``timeout_s``; if it had begun, it goes on and the next one waits for it.
        """
        async with asyncio.timeout(timeout_s):
            return await asyncio.wrap_future(self.submit(function))

    @property
    def alive(self) -> bool:
        """Whether it still works or waits for work."""
        return self._thread.is_alive()

    def stop(self) -> None:
        """Ends the thread after what it is doing; does not wait."""
        self._jobs.put(None)

    def abandon(self) -> None:
        """Ends the thread now if it runs Python code; one that is inside of a library ends when that returns."""
        self.stop()
        _abandoned.append(self._thread)
        ident = self._thread.ident
        if ident is not None:
            # SystemExit, because threads end by it without a message.
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(ident), ctypes.py_object(SystemExit))

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


def still_abandoned() -> int:
    """How many threads were abandoned and have not ended."""
    _abandoned[:] = [thread for thread in _abandoned if thread.is_alive()]
    return len(_abandoned)
