"""Curves of a rollout over time, and collision classes per policy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nurec_sim.report.data import Comparison, ReportRollout
from nurec_sim.report.events import first_offroad_us
from nurec_sim.report.figure import ALARM, EGO, RECORDED, base_layout, plain, rounded, world_colour
from nurec_sim.report.support import support_curve
from nurec_sim.types import Rollout, Series

if TYPE_CHECKING:
    import polars as pl

SUPPORT_TITLE = "support of the images, share"
CLASS_COLOURS = {"front": "#d55e00", "lateral": "#e69f00", "rear": "#0072b2"}  # Okabe-Ito palette, colour-blind safe


def time_view(group: Sequence[ReportRollout]) -> dict[str, Any]:
    """Speed, acceleration, reach beyond the road, gap to the nearest actor, and support if known, over time.

    Args:
        group: one rollout, or the same one in several reconstructions.
    """
    rollout = max((entry.rollout for entry in group), key=lambda rollout: len(rollout.states))
    t_us = rollout.t_us
    zero_us = int(t_us[0])
    seconds = (t_us - zero_us) / 1e6
    rows: list[tuple[str, list[tuple[str, np.ndarray, np.ndarray, str, str | None]]]] = [
        ("speed, m/s", [("recorded", seconds, _recorded_speed(rollout), RECORDED, "dash")]),
        ("acceleration, m/s2", []), ("beyond the road, m", []), ("gap to actors, m", []),
    ]  # fmt: skip
    if any(len(support_curve(entry)[0]) for entry in group):
        rows.append((SUPPORT_TITLE, []))
    for place, entry in enumerate(group):
        name = entry.rollout.reconstruction if len(group) > 1 else "ego"
        colour = world_colour(place) if len(group) > 1 else EGO
        states = entry.rollout.states
        curves = (
            np.array([state.speed_mps for state in states]), np.array([state.accel_mps2 for state in states]),
            _values_of(entry.series.get("offroad_max_excursion_m")),
            _values_of(entry.series.get("min_distance_to_obstacle_m")),
        )  # fmt: skip
        for (_, lines), values in zip(rows, curves, strict=False):
            lines.append((name, seconds, values, colour, None))
        times, support = support_curve(entry)
        if len(times):
            rows[-1][1].append((name, (times - zero_us) / 1e6, support, colour, None))
    gap_px, row_px = 30, 101
    plot_px = len(rows) * row_px + (len(rows) - 1) * gap_px
    layout, data = base_layout(plot_px + 66), []
    layout["xaxis"] |= {
        "title": {"text": "seconds since the start"},
        "anchor": f"y{len(rows)}",
        "range": rounded([0, max(seconds[-1], 0.1)]),
    }
    layout["showlegend"] = False
    height, gap = row_px / plot_px, gap_px / plot_px
    for index, (title, lines) in enumerate(rows):
        axis = "y" if index == 0 else f"y{index + 1}"
        top = 1 - index * (height + gap)
        layout[f"yaxis{'' if index == 0 else index + 1}"] = {
            **layout["yaxis"], "domain": rounded([max(top - height, 0), top]), "rangemode": "tozero", "nticks": 4,
            **({"range": [0, 1.02]} if title == SUPPORT_TITLE else {}),
        }  # fmt: skip
        layout.setdefault("annotations", []).append(
            {"text": title, "xref": "paper", "yref": "paper", "x": 0, "y": top, "xanchor": "left", "yanchor": "bottom",
             "showarrow": False, "font": {"size": 12, "color": "#475569"}}
        )  # fmt: skip
        for name, at, values, colour, dash in lines:
            style = {"color": colour, "width": 2} | ({"dash": dash} if dash else {})
            data.append(
                {"type": "scatter", "mode": "lines", "name": name, "x": rounded(at[: len(values)]),
                 "y": rounded(values), "xaxis": "x", "yaxis": axis, "line": style, "connectgaps": False}
            )  # fmt: skip
    layout["shapes"] = (_spans(group[0], zero_us) if len(group) == 1 else []) + [
        {"type": "line", "xref": "x", "yref": "paper", "x0": at, "x1": at, "y0": 0, "y1": 1,
         "line": {"color": colour, "width": 1.5, "dash": dash}}
        for at, colour, dash in _moments(group, zero_us)
    ]  # fmt: skip
    return {"data": data, "layout": layout}


BARS = {"collision_any": "Collision C", "offroad": "Off-road O", "scene_score": "Scene score"}


def comparison_bars(comparison: Comparison, metric: str) -> dict[str, Any]:
    """One metric of every policy as one bar per reconstruction, with intervals.

    Args:
        comparison: the comparison.
        metric: a key of ``BARS``.
    """
    import polars as pl

    layout = base_layout(0)
    data: list[dict[str, Any]] = []
    table = comparison.summary.filter(pl.col("name") == metric)
    policies = sorted(table["policy"].unique().to_list())
    for place, world in enumerate(comparison.worlds):
        rows = {row["policy"]: row for row in table.filter(reconstruction=world).iter_rows(named=True)}
        cells = [rows[policy] for policy in policies]
        percent = [
            [None if cell[end] is None else 100 * cell[end] for cell in cells] for end in ("mean", "low", "high")
        ]
        means, low, high = (np.array(values, np.float64) for values in percent)
        data.append(
            {"type": "bar", "orientation": "h", "name": plain(world), "y": [plain(policy) for policy in policies],
             "x": rounded(means), "marker": {"color": world_colour(place)}, "offsetgroup": str(place),
             "error_x": {"type": "data", "array": rounded(high - means), "arrayminus": rounded(means - low),
                         "visible": bool(np.isfinite(low).any()), "color": "#1e293b", "thickness": 1.2},
             "hovertemplate": "%{y}: %{x:.0f} %<extra>" + plain(world) + "</extra>"}
        )  # fmt: skip
        # Outside of a bar that nobody sees, as long as the interval: beside the whisker instead of on it.
        data.append(
            {"type": "bar", "orientation": "h", "y": data[-1]["y"], "x": rounded(np.fmax(np.nan_to_num(high), means)),
             "marker": {"color": "rgba(0,0,0,0)"}, "offsetgroup": str(place), "hoverinfo": "skip",
             "text": ["unknown" if np.isnan(mean) else f"{mean:.0f} %" for mean in means],
             "textposition": "outside", "cliponaxis": False, "textfont": {"size": 10}}
        )  # fmt: skip
    layout["height"] = 80 + (14 + 16 * len(comparison.worlds)) * len(policies)
    layout |= {"barmode": "group", "bargap": 0.3, "showlegend": False}
    layout["xaxis"] |= {"range": [0, 118], "ticksuffix": " %", "nticks": 4}
    layout["yaxis"] |= {"autorange": "reversed", "automargin": True}
    return {"data": data, "layout": layout}


def collision_bars(summary: pl.DataFrame) -> dict[str, Any]:
    """Share of rollouts with a front, lateral and rear contact, stacked per policy."""
    import polars as pl

    layout = base_layout(110)
    names: list[str] = []
    data, total = [], np.zeros(0)
    many = summary["reconstruction"].n_unique() > 1
    for side, colour in CLASS_COLOURS.items():
        rows = summary.filter(pl.col("name") == f"collision_{side}")
        names = [
            plain(f"{row['policy']} · {row['reconstruction']}" if many else row["policy"])
            for row in rows.iter_rows(named=True)
        ]
        shares = [None if value is None else round(100 * value, 2) for value in rows["mean"].to_list()]
        total = np.array(rows["mean"].fill_null(float("nan")).to_list()) + (total if len(total) else 0.0)
        data.append(
            {"type": "bar", "orientation": "h", "name": side, "y": names, "x": shares, "marker": {"color": colour},
             "hovertemplate": "%{y}: %{x:.0f} % " + side + "<extra></extra>"}
        )  # fmt: skip
    layout |= {"barmode": "stack", "height": 110 + 30 * len(names), "bargap": 0.35}
    layout["xaxis"] |= {
        "title": {"text": "% of rollouts with a contact"},
        "range": [0, max(100.0, 100 * float(np.nanmax(total, initial=0.0)))],
    }
    words = {name: "not known" if np.isnan(share) else "no contact" for name, share in zip(names, total, strict=True)}
    layout["annotations"] = [
        {"x": 0.5, "y": name, "text": words[name], "xanchor": "left", "showarrow": False, "font": {"color": "#64748b"}}
        for name, share in zip(names, total, strict=True)
        if not share > 0
    ]
    layout["yaxis"] |= {"autorange": "reversed", "automargin": True}
    return {"data": data, "layout": layout}


def _values_of(series: Series | None) -> np.ndarray:
    return np.zeros(0) if series is None else np.where(series.valid, series.values, np.nan)


def _recorded_speed(rollout: Rollout) -> np.ndarray:
    recorded, t_us = rollout.recorded, rollout.t_us
    if len(recorded.t_us) < 2:
        return np.full(len(t_us), np.nan)
    steps = np.linalg.norm(np.diff(recorded.position_m[:, :2], axis=0), axis=1) / (np.diff(recorded.t_us) / 1e6)
    middle = (recorded.t_us[1:] + recorded.t_us[:-1]) / 2
    return np.where(t_us <= recorded.end_us, np.interp(t_us, middle, steps), np.nan)


def _moments(group: Sequence[ReportRollout], zero_us: int) -> list[tuple[float, str, str]]:
    """Vertical lines: take-over, contacts, and where reconstructions are compared also the first off-road state."""
    lines = [((group[0].rollout.first_closed_loop_us - zero_us) / 1e6, "#64748b", "dot")]
    for place, entry in enumerate(group):
        colour = world_colour(place) if len(group) > 1 else ALARM
        times = [contact.t_us for contact in entry.contacts]
        times += [t for t in (first_offroad_us(entry),) if t is not None and len(group) > 1]
        lines += [((t_us - zero_us) / 1e6, colour, "solid") for t_us in times]
    return [(round(at, 3), colour, dash) for at, colour, dash in lines if at > 0]


def _spans(entry: ReportRollout, zero_us: int) -> list[dict[str, Any]]:
    """Shaded times behind the curves: off-road red, road unknown grey."""
    shapes = []
    for name, colour in (("offroad", "rgba(220,38,38,0.15)"), ("offroad_unknown_frac", "rgba(100,116,139,0.18)")):
        series = entry.series.get(name)
        if series is None or not len(series.t_us):
            continue
        marked = np.concatenate([[False], series.valid & (np.nan_to_num(series.values) > 0.5), [False]])
        edges = np.flatnonzero(np.diff(marked.astype(int)))
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            x0, x1 = ((int(series.t_us[index]) - zero_us) / 1e6 for index in (start, end - 1))
            shapes.append(
                {"type": "rect", "xref": "x", "yref": "paper", "x0": round(x0 - 0.05, 3), "x1": round(x1 + 0.05, 3),
                 "y0": 0, "y1": 1, "fillcolor": colour, "line": {"width": 0}, "layer": "below"}
            )  # fmt: skip
    return shapes
