"""Bird's-eye view of a rollout.

The recorded drive points to the right: x is metres along its chord, y metres to the left.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from nurec_sim import geometry
from nurec_sim.metrics.boxes import BoxPath, actor_boxes, ego_boxes
from nurec_sim.metrics.offroad_grid import Cell, OffroadGrid
from nurec_sim.report.data import ReportRollout
from nurec_sim.report.events import first_offroad_us
from nurec_sim.report.figure import (
    ACTOR,
    ALARM,
    EGO,
    PARKED,
    RECORDED,
    base_layout,
    line_trace,
    plain,
    rounded,
    world_colour,
)
from nurec_sim.types import RoadMap, Trajectory

CELL_COLOURS = {Cell.ROAD: (203, 213, 225), Cell.NONROAD: (240, 226, 205), Cell.UNKNOWN: (255, 255, 255)}
PIXEL_M = 0.2
MARGIN_M = 25.0
EVERY_STATES = 10


class PlanAxes:
    """Rotates the world so that a recorded drive points to the right."""

    def __init__(self, recorded: Trajectory) -> None:
        line = recorded.position_m[:, :2]
        chord = line[-1] - line[0]
        # The chord of a (nearly) stationary recording has no meaningful direction: its first heading is used.
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
        # Inverse mapping: every pixel of the rotated view looks up its cell, so that there are no gaps.
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


def plan_view(
    group: Sequence[ReportRollout], view: PlanAxes, image_key: str | None, road_map: RoadMap | None
) -> dict[str, Any]:
    """Road grid, recorded and driven path, ego and actor boxes every second, events, as a plotly figure.

    Args:
        group: one rollout, or the same one in several reconstructions, which share actors and recorded path.
        view: axes of the recorded drive.
        image_key: key of the shared image of the road grid; None without a grid.
        road_map: the true map; its road edges are added if given.
    """
    entry = max(group, key=lambda entry: len(entry.rollout.states))
    rollout, alone = entry.rollout, len(group) == 1
    boxes = actor_boxes(rollout)
    data: list[dict[str, Any]] = []
    if image_key is not None:
        for cell, name in ((Cell.ROAD, "road"), (Cell.NONROAD, "not road"), (Cell.UNKNOWN, "unknown")):
            data.append(_swatch(name, "rgb({},{},{})".format(*CELL_COLOURS[cell])))
    if road_map is not None and road_map.drivable:
        rings = [np.vstack([ring, ring[:1]]) for area in road_map.drivable for ring in area]
        data.append(_outlines("true road edge", [view.points(ring) for ring in rings], "#0f766e", width=1, dash="dot"))
    seconds = np.arange(0, len(rollout.states), EVERY_STATES)
    parked, moving, movers = [], [], []
    for box in boxes.values():
        known = np.flatnonzero(box.present)
        if len(known) == 0:
            continue
        centres = box.world_from_box[known, :2, 3]
        if np.ptp(centres, axis=0).max() < 0.5:
            parked.append(_outline(view, box, known[0]))
        else:
            movers.append(box)
            moving += [_outline(view, box, index) for index in seconds if box.present[index]]
    data.append(_outlines("static actors", parked, PARKED, fill="rgba(148,163,184,0.45)"))
    data.append(_outlines("moving actors, each second", moving, ACTOR, width=1))
    line = view.points(rollout.recorded.position_m)
    data.append(line_trace("recorded path", line, RECORDED, dash="dash", width=1.5))
    now, marks = [], []
    for place, each in enumerate(group):
        ego, driven = ego_boxes(each.rollout), view.points(each.rollout.world_from_rig[:, :2, 3])
        colour = EGO if alone else world_colour(place)
        name = "driven path" if alone else f"driven in {each.rollout.reconstruction}"
        data.append(line_trace(name, driven, colour, width=2.5))
        outlines = [_outline(view, ego, index) for index in seconds if index < len(driven)]
        data.append(_outlines("ego, each second", outlines, colour, width=1))
        now.append({"colour": colour, "x": rounded(driven[:, 0]), "y": rounded(driven[:, 1])})
        marks += _event_marks(each, view, "" if alone else f"{each.rollout.reconstruction}: ")
    moment = _first_event(entry) if alone else None
    if moment is not None:
        hit = [_outline(view, box, moment) for box in movers if box.present[moment]]
        data.append(_outlines("moving actors at the first event", hit, ACTOR, width=2, fill="rgba(180,83,9,0.25)"))
        data.append(
            _outlines("ego at the first event", [_outline(view, ego, moment)], ALARM, fill="rgba(220,38,38,0.25)")
        )
    data += marks
    traces = [trace for trace in data if trace["x"]]
    reach = np.vstack([*(view.points(each.rollout.world_from_rig[:, :2, 3]) for each in group), line])
    low, high = reach.min(axis=0) - 10, reach.max(axis=0) + 10
    layout = base_layout(460)
    layout["xaxis"] |= {"title": {"text": "metres along the recorded drive"}, "range": rounded([low[0], high[0]])}
    layout["yaxis"] |= {"title": {"text": "metres to the left"}, "range": rounded([low[1], high[1]])}
    layout["yaxis"] |= {"scaleanchor": "x", "scaleratio": 1}
    if image_key is not None:
        layout["images"] = [{"image_key": image_key}]
    return {"data": traces, "layout": layout, "now": now}


def _outlines(
    name: str, rings: Sequence[np.ndarray], colour: str, width: float = 1.5, fill: str = "", dash: str = "solid"
) -> dict[str, Any]:
    """Many closed outlines as one trace."""
    broken = [np.vstack([ring, [[np.nan, np.nan]]]) for ring in rings]
    points = np.vstack(broken) if broken else np.zeros((0, 2))
    trace = line_trace(name, points, colour, width, dash)
    return trace | ({"fill": "toself", "fillcolor": fill} if fill else {})


def _outline(view: PlanAxes, box: BoxPath, index: int | np.integer) -> np.ndarray:
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


def _event_marks(entry: ReportRollout, view: PlanAxes, prefix: str) -> list[dict[str, Any]]:
    rollout = entry.rollout
    marks: list[tuple[int, str, str, str]] = [
        (contact.t_us, f"{contact.side} contact with {contact.actor}", ALARM, "x") for contact in entry.contacts
    ]
    if (left_us := first_offroad_us(entry)) is not None:
        marks.append((left_us, "off-road", "#c026d3", "triangle-up"))
    marks += [(event.t_us, f"{event.kind}: {event.text}"[:120], "#334155", "diamond") for event in rollout.events]
    traces = []
    for t_us, text, colour, symbol in marks:
        place = view.points(geometry.interpolate_poses(rollout.t_us, rollout.world_from_rig, t_us)[None, :2, 3])[0]
        at_s = (t_us - rollout.states[0].t_us) / 1e6
        traces.append(
            {"type": "scatter", "mode": "markers", "name": plain((prefix + text)[:40]),
             "x": rounded(place[:1]), "y": rounded(place[1:]),
             "marker": {"color": colour, "symbol": symbol, "size": 11, "line": {"color": "#ffffff", "width": 1}},
             "text": [plain(f"{at_s:.1f} s: {prefix}{text}")], "hoverinfo": "text"}
        )  # fmt: skip
    return traces
