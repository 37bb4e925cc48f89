"""Figures of the report as plain plotly JSON: seen from above, over time, and collision classes per policy.

Plans are turned so that the recorded drive goes to the right: x is metres along its chord, y metres to the left.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nurec_sim import geometry
from nurec_sim.metrics.boxes import BoxPath, actor_boxes, ego_boxes
from nurec_sim.metrics.offroad_grid import Cell, OffroadGrid
from nurec_sim.report.data import ReportRollout
from nurec_sim.types import RoadMap, Rollout, Series, Trajectory

if TYPE_CHECKING:
    import polars as pl

EGO, RECORDED, ACTOR, PARKED = "#1d4ed8", "#475569", "#b45309", "#94a3b8"
CLASS_COLOURS = {"front": "#d55e00", "lateral": "#e69f00", "rear": "#0072b2"}  # Okabe-Ito: told apart by all eyes
CELL_COLOURS = {Cell.ROAD: (203, 213, 225), Cell.NONROAD: (240, 226, 205), Cell.UNKNOWN: (255, 255, 255)}
ALARM = "#dc2626"
PIXEL_M = 0.2
MARGIN_M = 25.0
EVERY_STATES = 10
FONT = {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 12, "color": "#1e293b"}


class View:
    """Turns the world so that a recorded drive goes to the right."""

    def __init__(self, recorded: Trajectory) -> None:
        line = recorded.position_m[:, :2]
        chord = line[-1] - line[0]
        far = np.linalg.norm(chord) > 1.0
        self.yaw = float(np.arctan2(chord[1], chord[0]) if far else geometry.yaw_of(recorded.world_from_body[0]))
        self.origin = line[0]
        self.low, self.high = (bound(self.points(line), axis=0) for bound in (np.min, np.max))

    def points(self, xy: np.ndarray) -> np.ndarray:
        """World points in the view."""
        offset = np.asarray(xy, np.float64)[..., :2] - self.origin
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.stack([offset[..., 0] * c + offset[..., 1] * s, offset[..., 1] * c - offset[..., 0] * s], axis=-1)

    def grid_image(self, grid: OffroadGrid) -> dict[str, Any]:
        """The cells around the recorded drive as a PNG data URI and its place in the view."""
        import cv2

        low, high = self.low - MARGIN_M, self.high + MARGIN_M
        columns, rows = np.ceil((high - low) / PIXEL_M).astype(int)
        x, y = np.meshgrid(low[0] + (np.arange(columns) + 0.5) * PIXEL_M, high[1] - (np.arange(rows) + 0.5) * PIXEL_M)
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        world = np.stack([x * c - y * s, x * s + y * c], axis=-1) + self.origin
        place = np.floor((world - np.asarray(grid.origin_m)) / grid.cell_m).astype(np.int64)
        inside = np.all((place >= 0) & (place < np.array(grid.state.shape[::-1])), axis=-1)
        cells = np.full(inside.shape, Cell.UNKNOWN, np.uint8)
        cells[inside] = grid.state[place[inside][:, 1], place[inside][:, 0]]
        palette = np.array([CELL_COLOURS[cell] for cell in Cell], np.uint8)
        _, png = cv2.imencode(".png", palette[cells][..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
        return {
            "source": "data:image/png;base64," + base64.b64encode(png.tobytes()).decode(),
            "x": float(low[0]), "y": float(high[1]), "sizex": columns * PIXEL_M, "sizey": rows * PIXEL_M,
        }  # fmt: skip


def plan_view(entry: ReportRollout, view: View, image_key: str | None, road_map: RoadMap | None) -> dict[str, Any]:
    """Road grid, recorded and driven path, ego and actor boxes every second, events."""
    rollout = entry.rollout
    ego, boxes = ego_boxes(rollout), actor_boxes(rollout)
    data: list[dict[str, Any]] = []
    if image_key is not None:
        for cell, name in ((Cell.ROAD, "road"), (Cell.NONROAD, "not road"), (Cell.UNKNOWN, "unknown")):
            data.append(_swatch(name, "rgb({},{},{})".format(*CELL_COLOURS[cell])))
    if road_map is not None and road_map.drivable:
        rings = [np.vstack([ring, ring[:1]]) for area in road_map.drivable for ring in area]
        data.append(_outlines("true road edge", [view.points(ring) for ring in rings], "#0f766e", width=1, dash="dot"))
    seconds = np.arange(0, len(rollout.states), EVERY_STATES)
    parked, moving = [], []
    for box in boxes.values():
        known = np.flatnonzero(box.present)
        if len(known) == 0:
            continue
        centres = box.world_from_box[known, :2, 3]
        if np.ptp(centres, axis=0).max() < 0.5:
            parked.append(_outline(view, box, known[0]))
        else:
            moving += [_outline(view, box, index) for index in seconds if box.present[index]]
    data.append(_outlines("standing actors", parked, PARKED, fill="rgba(148,163,184,0.45)"))
    data.append(_outlines("moving actors, each second", moving, ACTOR, width=1))
    line = view.points(rollout.recorded.position_m)
    data.append(_line("recorded path", line, RECORDED, dash="dash", width=1.5))
    data.append(_line("driven path", view.points(rollout.world_from_rig[:, :2, 3]), EGO, width=2.5))
    data.append(_outlines("ego, each second", [_outline(view, ego, index) for index in seconds], EGO, width=1))
    moment, marks = _first_event(entry), _event_marks(entry, view)
    if moment is not None:
        hit = [_outline(view, box, moment) for box in boxes.values() if box.present[moment]]
        data.append(_outlines("actors at the first event", hit, ACTOR, width=2, fill="rgba(180,83,9,0.25)"))
        data.append(
            _outlines("ego at the first event", [_outline(view, ego, moment)], ALARM, fill="rgba(220,38,38,0.25)")
        )
    data += marks
    drawn = [trace for trace in data if trace["x"]]
    reach = np.vstack([view.points(rollout.world_from_rig[:, :2, 3]), line])
    low, high = reach.min(axis=0) - 10, reach.max(axis=0) + 10
    layout = _layout(430)
    layout["xaxis"] |= {"title": {"text": "metres along the recorded drive"}, "range": _rounded([low[0], high[0]])}
    layout["yaxis"] |= {"title": {"text": "metres to the left"}, "range": _rounded([low[1], high[1]])}
    layout["yaxis"] |= {"scaleanchor": "x", "scaleratio": 1}
    if image_key is not None:
        layout["images"] = [{"image_key": image_key}]
    return {"data": drawn, "layout": layout}


def time_view(entry: ReportRollout) -> dict[str, Any]:
    """Speed, acceleration, reach beyond the road and gap to the nearest actor over time."""
    rollout = entry.rollout
    t_us = rollout.t_us
    zero_us = int(t_us[0])
    seconds = (t_us - zero_us) / 1e6
    recorded_speed = _recorded_speed(rollout)
    speed = np.array([state.speed_mps for state in rollout.states])
    rows = [
        ("speed, m/s", [("ego", speed, EGO, None), ("recorded", recorded_speed, RECORDED, "dash")]),
        ("acceleration, m/s2", [("ego", [s.accel_mps2 for s in rollout.states], EGO, None)]),
        ("beyond the road, m", [("ego", _values(entry.series.get("offroad_max_excursion_m")), EGO, None)]),
        ("gap to actors, m", [("ego", _values(entry.series.get("min_distance_to_obstacle_m")), EGO, None)]),
    ]  # fmt: skip
    layout, data = _layout(560), []
    layout["xaxis"] |= {
        "title": {"text": "seconds since the start"},
        "anchor": "y4",
        "range": _rounded([0, max(seconds[-1], 0.1)]),
    }
    layout["showlegend"] = False
    height, gap = 0.205, 0.06
    for index, (title, lines) in enumerate(rows):
        axis = "y" if index == 0 else f"y{index + 1}"
        top = 1 - index * (height + gap)
        layout[f"yaxis{'' if index == 0 else index + 1}"] = {
            **layout["yaxis"], "domain": _rounded([max(top - height, 0), top]), "rangemode": "tozero", "nticks": 4,
        }  # fmt: skip
        layout.setdefault("annotations", []).append(
            {"text": title, "xref": "paper", "yref": "paper", "x": 0, "y": top, "xanchor": "left", "yanchor": "bottom",
             "showarrow": False, "font": {"size": 12, "color": "#475569"}}
        )  # fmt: skip
        for name, values, colour, dash in lines:
            style = {"color": colour, "width": 2} | ({"dash": dash} if dash else {})
            data.append(
                {"type": "scatter", "mode": "lines", "name": name, "x": _rounded(seconds), "y": _rounded(values),
                 "xaxis": "x", "yaxis": axis, "line": style, "connectgaps": False}
            )  # fmt: skip
    layout["shapes"] = _spans(entry, zero_us) + [
        {"type": "line", "xref": "x", "yref": "paper", "x0": at, "x1": at, "y0": 0, "y1": 1,
         "line": {"color": colour, "width": 1.5, "dash": dash}}
        for at, colour, dash in _moments(entry, zero_us)
    ]  # fmt: skip
    return {"data": data, "layout": layout}


def collision_bars(summary: pl.DataFrame) -> dict[str, Any]:
    """Share of rollouts with a front, lateral and rear contact, stacked per policy."""
    import polars as pl

    layout = _layout(110)
    names: list[str] = []
    data = []
    many = summary["reconstruction"].n_unique() > 1
    for side, colour in CLASS_COLOURS.items():
        rows = summary.filter(pl.col("name") == f"collision_{side}")
        names = [
            f"{row['policy']} · {row['reconstruction']}" if many else row["policy"]
            for row in rows.iter_rows(named=True)
        ]
        shares = [None if value is None else round(100 * value, 2) for value in rows["mean"].to_list()]
        data.append(
            {"type": "bar", "orientation": "h", "name": side, "y": names, "x": shares, "marker": {"color": colour},
             "hovertemplate": "%{y}: %{x:.0f} % " + side + "<extra></extra>"}
        )  # fmt: skip
    layout |= {"barmode": "stack", "height": 110 + 30 * len(names), "bargap": 0.35}
    layout["xaxis"] |= {"title": {"text": "% of rollouts with a contact"}, "rangemode": "tozero", "range": [0, 100]}
    layout["yaxis"] |= {"autorange": "reversed", "automargin": True}
    return {"data": data, "layout": layout}


# ------------------------------------------------------------------------------------------------------------ parts


def _layout(height: int) -> dict[str, Any]:
    axis = {"gridcolor": "#e2e8f0", "zeroline": False, "linecolor": "#cbd5e1"}
    return {
        "height": height, "margin": {"l": 55, "r": 12, "t": 24, "b": 42}, "font": FONT, "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff", "hovermode": "closest", "xaxis": dict(axis), "yaxis": dict(axis),
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0, "font": {"size": 11}},
    }  # fmt: skip


def _rounded(values: Sequence[float] | np.ndarray) -> list[float | None]:
    """Three decimals, None where not finite: small and valid JSON."""
    return [round(float(value), 3) if np.isfinite(value) else None for value in np.asarray(values, np.float64)]


def _values(series: Series | None) -> np.ndarray:
    return np.zeros(0) if series is None else np.where(series.valid, series.values, np.nan)


def _line(name: str, points: np.ndarray, colour: str, width: float = 2, dash: str = "solid") -> dict[str, Any]:
    return {
        "type": "scatter", "mode": "lines", "name": name, "x": _rounded(points[:, 0]), "y": _rounded(points[:, 1]),
        "line": {"color": colour, "width": width, "dash": dash}, "hoverinfo": "name",
    }  # fmt: skip


def _outlines(
    name: str, rings: Sequence[np.ndarray], colour: str, width: float = 1.5, fill: str = "", dash: str = "solid"
):
    """Many closed outlines as one trace."""
    broken = [np.vstack([ring, [[np.nan, np.nan]]]) for ring in rings]
    points = np.vstack(broken) if broken else np.zeros((0, 2))
    trace = _line(name, points, colour, width, dash)
    return trace | ({"fill": "toself", "fillcolor": fill} if fill else {})


def _outline(view: View, box: BoxPath, index: int) -> np.ndarray:
    corners = geometry.box_corners_xy(box.world_from_box[index], *box.size_m[:2])
    return view.points(corners[[0, 1, 2, 3, 0]])


def _swatch(name: str, colour: str) -> dict[str, Any]:
    marker = {"symbol": "square", "size": 11, "color": colour, "line": {"color": "#94a3b8", "width": 1}}
    return {"type": "scatter", "mode": "markers", "name": name, "x": [None], "y": [None], "marker": marker}


def _first_event(entry: ReportRollout) -> int | None:
    """Index of the first state with a collision or off-road."""
    found = []
    for name in ("collision_any", "offroad"):
        series = entry.series.get(name)
        if series is not None and len(series.t_us) == len(entry.rollout.states):
            found += np.flatnonzero(series.valid & (series.values > 0.5))[:1].tolist()
    return min(found) if found else None


def _event_marks(entry: ReportRollout, view: View) -> list[dict[str, Any]]:
    rollout = entry.rollout
    marks: list[tuple[int, str, str, str]] = [
        (contact.t_us, f"{contact.side} contact with {contact.actor}", ALARM, "x") for contact in entry.contacts
    ]
    offroad = entry.series.get("offroad")
    if offroad is not None and (hits := np.flatnonzero(offroad.valid & (offroad.values > 0.5))).size:
        marks.append((int(offroad.t_us[hits[0]]), "off-road", "#c026d3", "triangle-up"))
    marks += [(event.t_us, f"{event.kind}: {event.text}"[:120], "#334155", "diamond") for event in rollout.events]
    traces = []
    for t_us, text, colour, symbol in marks:
        place = view.points(geometry.interpolate_poses(rollout.t_us, rollout.world_from_rig, t_us)[None, :2, 3])[0]
        at_s = (t_us - rollout.states[0].t_us) / 1e6
        traces.append(
            {"type": "scatter", "mode": "markers", "name": text[:40],
             "x": _rounded(place[:1]), "y": _rounded(place[1:]),
             "marker": {"color": colour, "symbol": symbol, "size": 11, "line": {"color": "#ffffff", "width": 1}},
             "text": [f"{at_s:.1f} s: {text}"], "hoverinfo": "text"}
        )  # fmt: skip
    return traces


def _recorded_speed(rollout: Rollout) -> np.ndarray:
    recorded, t_us = rollout.recorded, rollout.t_us
    if len(recorded.t_us) < 2:
        return np.full(len(t_us), np.nan)
    steps = np.linalg.norm(np.diff(recorded.position_m[:, :2], axis=0), axis=1) / (np.diff(recorded.t_us) / 1e6)
    middle = (recorded.t_us[1:] + recorded.t_us[:-1]) / 2
    return np.where(t_us <= recorded.end_us, np.interp(t_us, middle, steps), np.nan)


def _moments(entry: ReportRollout, zero_us: int) -> list[tuple[float, str, str]]:
    """Vertical lines: take-over, contacts."""
    lines = [((entry.rollout.first_closed_loop_us - zero_us) / 1e6, "#64748b", "dot")]
    lines += [((contact.t_us - zero_us) / 1e6, ALARM, "solid") for contact in entry.contacts]
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
