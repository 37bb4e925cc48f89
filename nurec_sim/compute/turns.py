"""How long work lets others have their turn.

Work that takes more than a few milliseconds calls ``rest`` in between. Where somebody shares out the machine
(``render_queue``), it then waits until it may go on, or ends because nobody wants its result any more; elsewhere the
call does nothing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Protocol


class Turn(Protocol):
    """The turn of one piece of work."""

    @property
    def is_over(self) -> bool:
        """Whether it should stop soon, to go on later or never; cheap, from any thread."""
        ...

    def rest(self) -> None:
        """Returns when it may go on; from the thread that the work was begun in.

        Raises:
            CancelledError: nobody waits for the result any more.
            DeadlinePassedError: the client has stopped waiting.
        """
        ...

    def aside(self) -> contextlib.AbstractContextManager[None]:
        """Lets somebody else have the place while work goes on that cannot rest."""
        ...


turn_of_thread: ContextVar[Turn | None] = ContextVar("turn", default=None)
"""The turn of the work that runs in this thread, set by whoever shares out the machine; None if nobody does."""


def current_turn() -> Turn | None:
    """The turn of the work that runs in this thread; None if nobody shares out the machine."""
    return turn_of_thread.get()


def rest() -> None:
    """Lets others have their turn if this one is over.

    Raises:
        CancelledError, DeadlinePassedError: see ``Turn.rest``.
    """
    turn = turn_of_thread.get()
    if turn is not None and turn.is_over:
        turn.rest()


@contextlib.contextmanager
def aside() -> Iterator[None]:
    """See ``Turn.aside``; without effect where nobody shares out the machine. Inside, ``rest`` does nothing."""
    turn = turn_of_thread.get()
    if turn is None:
        yield
        return
    with turn.aside():
        token = turn_of_thread.set(None)
        try:
            yield
        finally:
            turn_of_thread.reset(token)
