"""A worker thread for one policy that can be abandoned if it hangs."""

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
    """Runs functions sequentially in a daemon thread, which does not block process exit.

    ``concurrent.futures`` would wait at exit for a hanging policy.
    """

    def __init__(self, name: str) -> None:
        self._jobs: queue.SimpleQueue[tuple[Future, Callable[[], object]] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def submit(self, function: Callable[[], T]) -> Future[T]:
        """A future with the result or exception of ``function``."""
        future: Future[T] = Future()
        self._jobs.put((future, function))
        return future

    async def run(self, function: Callable[[], T], timeout_s: float) -> T:
        """The result of ``function``, which is not started if the await is cancelled or times out before its turn.

        Raises:
            TimeoutError: after ``timeout_s``; a running function continues and the next one waits for it.
        """
        async with asyncio.timeout(timeout_s):
            return await asyncio.wrap_future(self.submit(function))

    @property
    def alive(self) -> bool:
        """Whether the thread is running or waiting for work."""
        return self._thread.is_alive()

    def stop(self) -> None:
        """Ends the thread after its current function; does not wait."""
        self._jobs.put(None)

    def abandon(self) -> None:
        """Ends the thread now if it runs Python code, or when its native call returns."""
        self.stop()
        _abandoned.append(self._thread)
        ident = self._thread.ident
        if ident is not None:
            # The exception is raised at the thread's next bytecode, hence only once a native call has returned.
            # SystemExit ends a thread without a message.
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(ident), ctypes.py_object(SystemExit))

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            future, function = job
            # A call whose caller timed out before its turn must not run: its result would have no recipient.
            if not future.set_running_or_notify_cancel():
                continue
            try:
                result = function()
            except BaseException as error:
                future.set_exception(error)
            else:
                future.set_result(result)
            # Otherwise the last observation would stay in memory while the thread waits for the next job.
            del job, future, function


def still_abandoned() -> int:
    """Number of abandoned threads that are still running."""
    _abandoned[:] = [thread for thread in _abandoned if thread.is_alive()]
    return len(_abandoned)
