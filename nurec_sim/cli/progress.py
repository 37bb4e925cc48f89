"""Progress of long commands: a bar with the time left on a terminal, else a line every ten seconds."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Column

Report = Callable[[str, float], None]
EVERY_S = 10.0
"""Seconds between lines without a terminal."""
BAR_WIDTH, FIGURES_WIDTH = 16, 33
"""Width of percentage, elapsed and remaining time with spacing on a terminal."""


@contextlib.contextmanager
def shown(console: Console, title: str) -> Iterator[Report]:
    """Shows the progress that the block reports.

    Yields a callback (stage, fraction 0..1) that may be called from any thread. Until its first call only the elapsed
    time is shown.
    """
    work = _Work(title)
    with _bar(console, work) if console.is_terminal else _lines(console, work):
        yield work.advance


class _Work:
    """State of a task: stage, fraction done, and recent speed."""

    def __init__(self, title: str) -> None:
        self.title, self.stage, self.fraction = title, "", 0.0
        self.since = time.monotonic()
        self.listener: Callable[[], None] = lambda: None
        self._known: deque[tuple[float, float]] = deque()  # (seconds, fraction) over the last half of the elapsed time

    def advance(self, stage: str, fraction: float) -> None:
        if self._known and fraction < self._known[-1][1]:  # restarted
            self._known.clear()
        self._known.append((self.seconds, fraction))
        while len(self._known) > 2 and self._known[1][0] <= self.seconds / 2:
            self._known.popleft()
        self.stage, self.fraction = stage, fraction
        self.listener()

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.since

    @property
    def left_s(self) -> float | None:
        """Remaining seconds at the speed over the last half of the elapsed time; None if unknown.

        Work that was already finished at the start, as with --resume, thus soon drops out of the estimate.
        """
        if not self._known:
            return None
        then, fraction = self._known[0]
        done = self.fraction - fraction
        return None if done <= 0 else (1 - self.fraction) * (self.seconds - then) / done

    @property
    def text(self) -> str:
        return f"{self.title}: {self.stage}" if self.stage else self.title

    @property
    def left(self) -> str:
        return "" if self.left_s is None else f"{_duration(self.left_s)} left"


@contextlib.contextmanager
def _bar(console: Console, work: _Work) -> Iterator[None]:
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(BAR_WIDTH),
        TextColumn("{task.percentage:3.0f}%", table_column=Column(no_wrap=True)),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}", table_column=Column(no_wrap=True)),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(work.title, total=None, left="")

        def show() -> None:
            room = max(10, console.width - BAR_WIDTH - FIGURES_WIDTH)
            text = work.text if len(work.text) <= room else work.text[: room - 1] + "…"
            bar.update(task, description=text, total=1.0, completed=work.fraction, left=work.left)

        work.listener = show
        yield


@contextlib.contextmanager
def _lines(console: Console, work: _Work) -> Iterator[None]:
    ended = threading.Event()

    def tell() -> None:
        while not ended.wait(EVERY_S):
            share = [f"{work.fraction:.0%}"] if work.fraction else []
            parts = [work.text, *share, f"{_duration(work.seconds)} so far", *filter(None, [work.left])]
            console.print(", ".join(parts), markup=False, highlight=False, soft_wrap=True)

    teller = threading.Thread(target=tell, name="progress", daemon=True)
    teller.start()
    try:
        yield
    finally:
        ended.set()
        teller.join()


def _duration(seconds: float) -> str:
    """Seconds, minutes or hours, to two digits."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes / 60:.1f} h"
