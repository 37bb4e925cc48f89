"""Tables that fit any terminal: wide ones are transposed, never truncated."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.table import Table

Columns = list[list[str]]
PROSE_WORDS, PROSE_WIDTH = 4, 28
"""Cells with at least this many words may wrap, at this width."""


def draw_table(console: Console, title: str, rows: Sequence[Sequence[object]], heading: Sequence[str] = ()) -> None:
    """Prints rows as a table, with or without a heading.

    Multi-word texts wrap, and headings if that saves width; numbers and names do not. A table that is still too wide is
    transposed, one row per heading, in as many parts as needed.

    Args:
        console: output console.
        title: printed above.
        rows: cells, equally many per row.
        heading: column names.
    """
    cells = [[str(cell) for cell in row] for row in rows]
    count = max(map(len, [heading, *cells]))
    columns = [[row[k] for row in cells] for k in range(count)]
    broken = [_broken(name, column) for name, column in zip(heading, columns, strict=False)]
    whole, light = (box.HEAVY_HEAD, box.SIMPLE_HEAD) if heading else (box.SQUARE, None)
    for names, style, between in ((list(heading), whole, 3), (broken, whole, 3), (broken, light, 3 if light else 1)):
        widths = [_least_width(column, names[k] if names else "") for k, column in enumerate(columns)]
        if sum(widths) + between * count + 1 <= console.width:
            return console.print(_table(title, columns, names, style, widths))
    if count < 3:
        return console.print(_table(title, columns, broken, whole))
    for part in _parts(cells, heading, console.width):
        first, *others = zip(heading, *part, strict=True)
        console.print(_table(title, [list(column) for column in zip(*others, strict=True)], first, None))
    return None


def _table(
    title: str, columns: Columns, names: Sequence[str], style: box.Box | None, widths: Sequence[int] = ()
) -> Table:
    """A table with minimum column widths; without widths everything wraps."""
    table = Table(title=title, title_justify="left", show_header=bool(names), box=style, pad_edge=style is not None)
    for k, column in enumerate(columns):
        wraps = not widths or any(_is_prose(cell) for cell in column)
        name = escape(names[k]) if names else ""
        table.add_column(name, no_wrap=not wraps, min_width=None if wraps else widths[k], overflow="fold")
    for row in zip(*columns, strict=True):
        table.add_row(*(escape(cell) for cell in row))
    return table


def _parts(cells: list[list[str]], heading: Sequence[str], width: int) -> list[list[list[str]]]:
    """Groups of transposed rows that fit the width, with their headings."""
    parts: list[list[list[str]]] = []
    free = 0
    for row in cells:
        wide = min(max(map(cell_len, row)), width // 2) + 2
        if not parts or wide > free:
            parts.append([])
            free = width - max(map(cell_len, heading))
        parts[-1].append(row)
        free -= wide
    return parts or [[]]


def _broken(name: str, column: list[str]) -> str:
    """Wraps a heading that is wider than its column."""
    room = max(map(cell_len, [*name.split(), *(cell for cell in column if not _is_prose(cell))]), default=0)
    lines: list[str] = []
    for word in name.split():
        if lines and cell_len(lines[-1]) + 1 + cell_len(word) <= room:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return "\n".join(lines)


def _least_width(column: list[str], name: str) -> int:
    widths = [cell_len(line) for line in name.split("\n")]
    for cell in column:
        if _is_prose(cell):
            widths.append(max(*map(cell_len, cell.split()), min(cell_len(cell), PROSE_WIDTH)))
        else:
            widths.append(cell_len(cell))
    return max(widths, default=0)


def _is_prose(cell: str) -> bool:
    return len(cell.split()) >= PROSE_WORDS
