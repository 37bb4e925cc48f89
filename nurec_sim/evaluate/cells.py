"""A table as text, and its cells."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass

NOT_KNOWN = "-"


@dataclass(frozen=True)
class Table:
    """Heading and rows of text, with an explanatory ``note``."""

    name: str
    title: str
    heading: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def markdown(self) -> str:
        """Markdown with title and note."""
        lines = [self.heading, ["---"] + ["---:"] * (len(self.heading) - 1), *self.rows]
        body = "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
        return f"## {self.title}\n\n{body}\n" + (f"\n{self.note}\n" if self.note else "")

    def csv(self) -> str:
        """As CSV."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([self.heading, *self.rows])
        return text.getvalue()


def number(value: float | None, digits: int, sign: bool = False) -> str:
    """A value with fixed decimals; a dash if unknown."""
    if value is None:
        return NOT_KNOWN
    return f"{value:+,.{digits}f}" if sign else f"{value:,.{digits}f}"


def percent(value: float | None) -> str:
    """A fraction in percent; a dash if unknown."""
    return NOT_KNOWN if value is None else f"{100 * value:.1f} %"
