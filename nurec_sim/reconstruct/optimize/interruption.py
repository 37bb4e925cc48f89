"""Ctrl-C between the steps of an optimisation instead of within one."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType


@contextlib.contextmanager
def whole_steps() -> Iterator[list[int]]:
    """Ctrl-C fills the list, so that a step is not torn apart; the second one raises KeyboardInterrupt."""
    interrupted: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        if interrupted:
            raise KeyboardInterrupt
        interrupted.append(number)

    usual = signal.getsignal(signal.SIGINT)
    # Handlers belong to the main thread; a caller that handles or ignores Ctrl-C itself is left alone.
    if threading.current_thread() is not threading.main_thread() or usual is not signal.default_int_handler:
        yield interrupted
        return
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, usual)
