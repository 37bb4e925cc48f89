"""Small pieces of the report's HTML: escaped texts, table cells, lists."""

from __future__ import annotations

import html
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from nurec_sim.metrics.aggregate import DERIVED
from nurec_sim.metrics.series import METRICS
from nurec_sim.report.data import ReportRollout

if TYPE_CHECKING:
    import polars as pl

Row = dict[str, Any]


def by_policy(summary: pl.DataFrame) -> Iterator[tuple[tuple[str, str], dict[str, Row]]]:
    """(reconstruction, policy) and its summary rows by metric, in the order of the table."""
    for key, part in summary.group_by("reconstruction", "policy", maintain_order=True):
        yield key, {row["name"]: row for row in part.iter_rows(named=True)}


def summary_cell(row: Row) -> str:
    """A table cell: mean, interval, and the number of rollouts with a known value."""
    if row["mean"] is None:
        return f'<td class="n"><span class="none">unknown</span><small>0 of {row["n"]}</small></td>'
    interval = ""
    if row["low"] is not None:
        low, high = (shown(row[end], row["unit"]) for end in ("low", "high"))
        interval = f"<small>[{low}, {high}]</small>"
    return (
        f'<td class="n">{shown(row["mean"], row["unit"])}{interval}<small>{row["n_valid"]} of {row["n"]}</small></td>'
    )


def shown(value: object, unit: object) -> str:
    """A value with its unit; fractions in percent."""
    if not isinstance(value, float):
        return '<span class="none">unknown</span>'
    if unit in ("bool", "share"):
        return f"{100 * value:.0f} %"
    return f"{value:.2f} {escape(str(unit))}"


def fact_list(facts: Mapping[str, object]) -> str:
    """Names and values side by side; values that have names of their own are folded."""
    rows = [f"<dt>{escape(str(name))}</dt><dd>{_fact(value)}</dd>" for name, value in facts.items()]
    return f"<dl>{''.join(rows)}</dl>"


def _fact(value: object) -> str:
    if isinstance(value, Mapping) and value:
        names = ", ".join(escape(str(name)) for name in value)
        return f"<details><summary>{names}</summary>{fact_list(value)}</details>"
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return escape(text[:2000])


def meaning(name: str) -> str:
    """The meaning of a metric."""
    return METRICS[name].meaning if name in METRICS else DERIVED[name][1]


def full_name(entry: ReportRollout) -> str:
    """The full name of a rollout."""
    rollout = entry.rollout
    return f"{rollout.policy} in {rollout.scene_id} ({rollout.reconstruction}), seed {rollout.seed}"


def list_items(items: Sequence[str]) -> str:
    """HTML list items; the texts must be HTML."""
    return "".join(f"<li>{item}</li>" for item in items)


def first_five(items: Sequence[str]) -> str:
    """``list_items`` of the first five, and how many more there are."""
    return list_items([*items[:5], f"and {len(items) - 5} more"] if len(items) > 5 else items)


def count_of(number: int, one: str, many: str = "") -> str:
    """A number with its noun."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def escape(text: str) -> str:
    """Text made safe for HTML and attributes."""
    return html.escape(text)
