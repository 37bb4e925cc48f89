"""What every verb shares: consoles, tables, progress bars."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

app = tyro.extras.SubcommandApp()
out = Console(width=None if sys.stdout.isatty() else 120)
err = Console(stderr=True)

Paths = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH...")]
OnePath = Annotated[Path, tyro.conf.Positional]
Report = Callable[[str, float], None]


@contextlib.contextmanager
def progress(title: str) -> Iterator[Report]:
    """A progress bar on stderr, fed with (what is being done, fraction 0..1)."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f}%"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=err, transient=True) as bar:
        task = bar.add_task(title, total=1.0)

        def advance(stage: str, fraction: float) -> None:
            bar.update(task, description=f"{title}: {stage}" if stage else title, completed=fraction)

        yield advance


def print_table(title: str, rows: Sequence[Sequence[object]], heading: Sequence[str] = ()) -> None:
    """Rows as a table, with or without a heading."""
    table = Table(title=title, title_justify="left", show_header=bool(heading))
    for name in heading or [""] * max((len(row) for row in rows), default=0):
        table.add_column(name, no_wrap=name == "policy")
    for row in rows:
        table.add_row(*(escape(str(cell)) for cell in row))
    out.print(table)


def print_faults(faults: Sequence[str]) -> None:
    """One red line per fault, and exit status 1 if there are any."""
    for fault in faults:
        out.print(f"fault: {fault}", style="red", markup=False, highlight=False, soft_wrap=True)
    if faults:
        raise SystemExit(1)
