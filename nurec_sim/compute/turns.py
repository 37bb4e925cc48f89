"""Cooperative scheduling: long computations yield to others at safe points.

Work that takes more than a few milliseconds calls ``rest`` at intervals. Under a scheduler (``render_queue``) the call
blocks until the work may resume, or raises because its result is no longer needed; without one it does nothing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Protocol


class Turn(Protocol):
    """The time slice of one piece of work."""

    @property
    def is_over(self) -> bool:
        """Whether the work should yield soon; cheap, callable from any thread."""
        ...

    def rest(self) -> None:
        """Blocks until the work may resume; must be called from the thread that started it.

        Raises:
            CancelledError: the result is no longer needed.
            DeadlinePassedError: the client's deadline has passed.
        """
        ...

    def aside(self) -> contextlib.AbstractContextManager[None]:
        """Releases the slot for the duration of the block, for work that cannot yield."""
        ...


turn_of_thread: ContextVar[Turn | None] = ContextVar("turn", default=None)
"""The turn of the work that runs in this thread, set by the scheduler; None without one."""


def current_turn() -> Turn | None:
    """The turn of the work that runs in this thread; None without a scheduler."""
    return turn_of_thread.get()


def rest() -> None:
    """Yields to other work if this turn is over.

    Raises:
        CancelledError, DeadlinePassedError: see ``Turn.rest``.
    """
    turn = turn_of_thread.get()
    # ``is_over`` is a cheap flag, so that kernels can call this between small strips of work.
    if turn is not None and turn.is_over:
        turn.rest()


@contextlib.contextmanager
def aside() -> Iterator[None]:
    """See ``Turn.aside``; no effect without a scheduler. Inside the block, ``rest`` does nothing."""
    turn = turn_of_thread.get()
    if turn is None:
        yield
        return
    with turn.aside():
        # Without a turn, a nested ``rest`` cannot block on the slot that was just released.
        token = turn_of_thread.set(None)
        try:
            yield
        finally:
            turn_of_thread.reset(token)
