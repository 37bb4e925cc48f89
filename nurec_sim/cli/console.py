"""Consoles, tables and progress for all commands."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from nurec_sim.cli.progress import Report, shown
from nurec_sim.cli.tables import draw_table

PIPED_WIDTH = 160

app = tyro.extras.SubcommandApp()
out = Console(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else PIPED_WIDTH)
err = Console(stderr=True)

Paths = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH...")]
OnePath = Annotated[Path, tyro.conf.Positional]


def progress(title: str) -> AbstractContextManager[Report]:
    """Progress of the block on stderr, updated by calls of (stage, fraction 0..1)."""
    return shown(err, title)


def part_of(advance: Report, index: int, count: int, name: str) -> Report:
    """Progress callback for one of ``count`` equal parts.

    Args:
        advance: callback of the whole, with (stage, fraction 0..1).
        index: the part, from 0.
        count: number of parts.
        name: name of the part; shown with the stage if there are several.
    """
    start = f"{name} ({index + 1} of {count}), " if count > 1 else ""
    return lambda stage, fraction: advance(start + stage, (index + fraction) / count)


def print_table(title: str, rows: Sequence[Sequence[object]], heading: Sequence[str] = ()) -> None:
    """Rows as a table, with or without a heading."""
    draw_table(out, title, rows, heading)


def chosen_device(device: str, quiet: bool = False) -> str:
    """The device to render on; says which one ``auto`` is, and why it is no GPU, unless ``quiet``.

    Raises:
        GpuError: see ``render.choose_device``.
    """
    from nurec_sim.render.device import choose_device

    name, reason = choose_device(device)
    if device == "auto" and reason and not quiet:
        err.print(f"rendering on {name}: {reason}", style="dim", markup=False, highlight=False, soft_wrap=True)
    return name


def print_faults(faults: Sequence[str]) -> None:
    """One red line per fault, and exit status 1 if there are any."""
    for fault in faults:
        out.print(f"fault: {fault}", style="red", markup=False, highlight=False, soft_wrap=True)
    if faults:
        raise SystemExit(1)
