"""Colours, layout and lines shared by all figures of the report. Figures are plain plotly JSON."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import numpy as np

EGO, RECORDED, ACTOR, PARKED, ALARM = "#1d4ed8", "#475569", "#b45309", "#94a3b8", "#dc2626"
WORLD_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
"""Colours of compared reconstructions: the Okabe-Ito palette, safe for the colour-blind."""
FONT = {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 12, "color": "#1e293b"}


def base_layout(height: int) -> dict[str, Any]:
    """Layout of every figure."""
    axis = {"gridcolor": "#e2e8f0", "zeroline": False, "linecolor": "#cbd5e1"}
    return {
        "height": height, "margin": {"l": 55, "r": 12, "t": 24, "b": 42}, "font": FONT, "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff", "hovermode": "closest", "xaxis": dict(axis), "yaxis": dict(axis),
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0, "font": {"size": 11}},
    }  # fmt: skip


def world_colour(place: int) -> str:
    """Colour of a reconstruction by its place in the comparison."""
    return WORLD_COLOURS[place % len(WORLD_COLOURS)]


def plain(text: str) -> str:
    """Text escaped for plotly, which interprets tags as markup."""
    return html.escape(text, quote=False)


def rounded(values: Sequence[float] | np.ndarray) -> list[float | None]:
    """Three decimals, None where not finite: small and valid JSON."""
    return [round(float(value), 3) if np.isfinite(value) else None for value in np.asarray(values, np.float64)]


def line_trace(name: str, points: np.ndarray, colour: str, width: float = 2, dash: str = "solid") -> dict[str, Any]:
    """A polyline as a plotly trace.

    Args:
        name: name in the legend.
        points: points [n, 2]; NaN breaks the line.
        colour: CSS colour.
        width: line width, pixels.
        dash: plotly dash style.
    """
    return {
        "type": "scatter", "mode": "lines", "name": plain(name), "x": rounded(points[:, 0]), "y": rounded(points[:, 1]),
        "line": {"color": colour, "width": width, "dash": dash}, "hoverinfo": "name",
    }  # fmt: skip
