"""Paint on the road, as polygons seen from above: lines, crossings, stop and yield lines, arrows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import shapely

from nurec_sim.world.plan.junctions import Mouth
from nurec_sim.world.plan.road import RoadLanes
from nurec_sim.world.plan.town import Crossing, RoadPiece, StopLine, TownPlan

LINE_PART_M = 20.0
"""Long lines are split so that parts out of view can be culled."""


@dataclass(frozen=True)
class Marking:
    """One painted area."""

    colour: Literal["white", "yellow"]
    area: shapely.Polygon


def town_markings(
    plan: TownPlan, roads: Mapping[str, RoadLanes], junctions: Mapping[str, list[Mouth]], surface: shapely.Geometry
) -> tuple[Marking, ...]:
    """All paint of a town, within ``surface``.

    Args:
        plan: the town; its style decides the colour of centre lines.
        roads: by id, centre line and cross-section of every road.
        junctions: by id, the arms of every junction.
        surface: area between the kerbs (m); paint is clipped to it.
    """
    painted: list[Marking] = []
    centre_colour: Literal["white", "yellow"] = "yellow" if plan.style.yellow_lines else "white"
    for line in roads.values():
        for start, end in _open_spans(line, plan):
            painted += [Marking(centre_colour, area) for area in _centre_line(line, start, end)]
            painted += [Marking("white", area) for area in _lane_lines(line, start, end)]
            painted += [Marking("white", area) for area in _edge_lines(line, start, end)]
    white: list[shapely.Polygon] = []
    for junction in plan.junctions:
        if junction.kind == "fork":
            # A fork has no kerbs between main road and ramp: its lines run on, with short wide dashes along the exit.
            through = _through(junctions[junction.id])
            painted += [Marking(centre_colour, area) for area in _centre_line(through, 0.0, through.length_m)]
            white += _lane_lines(through, 0.0, through.length_m)
            white += _dashes(through, 0.0, through.length_m, -through.plan.lanes_forward, 1.0, 1.5, 0.2)
    for crossing in plan.crossings:
        white += _crossing(roads[crossing.road], crossing)
    # Keyed as stop lines are: a road that ends at the junction (not outward) is left driving forward.
    rules = {(mouth.arm.road, not mouth.outward): mouth.arm.rule for group in junctions.values() for mouth in group}
    for stop in plan.stop_lines:
        white += _stop_line(roads[stop.road], stop, broken=rules.get((stop.road, stop.forward)) == "yield")
    for group in junctions.values():
        for mouth in group:
            white += _arrows(mouth, plan)
    painted += [Marking("white", area) for area in white]
    # Paint keeps 2 cm off the kerb. Most of it lies inside, where no intersection is needed.
    inside = shapely.buffer(surface, -0.02)
    shapely.prepare(inside)
    clipped: list[Marking] = []
    for marking in painted:
        area = marking.area if inside.contains(marking.area) else marking.area.intersection(inside)
        parts = shapely.get_parts(area)
        # Slivers and stray lines of an intersection are no paint.
        clipped += [Marking(marking.colour, part) for part in parts
                    if isinstance(part, shapely.Polygon) and part.area > 0.005]  # fmt: skip
    return tuple(clipped)


def _open_spans(line: RoadLanes, plan: TownPlan) -> Iterator[tuple[float, float]]:
    """Stretches between crossings, in parts."""
    start = 0.0
    crossed = [c for c in plan.crossings if c.road == line.plan.id]
    stops = sorted((c.station_m - 0.4, c.station_m + c.depth_m + 0.4) for c in crossed)
    for low, high in [*stops, (line.length_m, line.length_m)]:
        if low - start > 1.0:
            count = max(1, round((low - start) / LINE_PART_M))
            ends = np.linspace(start, low, count + 1)
            yield from ((float(a), float(b)) for a, b in zip(ends[:-1], ends[1:], strict=True))
        start = max(start, high)


def _through(arms: list[Mouth]) -> RoadLanes:
    """The main road through a fork: straight from its first arm to its second, with the ramp to its right."""
    (start, _), (end, yaw) = arms[0].pose(), arms[1].pose()
    straight = (RoadPiece(float(np.hypot(*(end - start)))),)
    road = replace(arms[1].line.plan, x_m=float(start[0]), y_m=float(start[1]), yaw_rad=yaw, pieces=straight)
    return RoadLanes(road)


def _stripe(line: RoadLanes, start: float, end: float, offset: float | np.ndarray, width: float) -> shapely.Polygon:
    return line.band(start, end, offset - width / 2, offset + width / 2)


def _dashes(line: RoadLanes, start: float, end: float, offset_of: float, on: float, off: float, width: float
            ) -> list[shapely.Polygon]:  # fmt: skip
    """Dashes aligned with the road's stations, ``offset_of`` lane widths from the centre line."""
    found = []
    # Multiples of the period from station 0, so that dashes continue from one part of a line to the next.
    for dash in np.arange(np.floor(start / (on + off)) * (on + off), end, on + off):
        low, high = max(dash, start), min(dash + on, end)
        # Shorter stubs at crossings would look like errors.
        if high - low > 0.3:
            offset = offset_of * line.lane_width_m(line.stations(low, high))
            found.append(_stripe(line, low, high, offset, width))
    return found


def _centre_line(line: RoadLanes, start: float, end: float) -> list[shapely.Polygon]:
    kind = line.plan.centre_line
    if kind == "none" or not (line.plan.lanes_forward and line.plan.lanes_backward):
        return []
    if kind == "dashed":
        return _dashes(line, start, end, 0.0, 3.0, 4.5, 0.15)
    if kind == "solid":
        return [_stripe(line, start, end, 0.0, 0.15)]
    return [_stripe(line, start, end, offset, 0.12) for offset in (-0.14, 0.14)]


def _lane_lines(line: RoadLanes, start: float, end: float) -> list[shapely.Polygon]:
    """Between lanes of one direction."""
    found = []
    for side in (-1, 1):
        for k in range(1, line.count(side)):
            found += _dashes(line, start, end, side * k, 3.0, 6.0, 0.13)
    return found


def _edge_lines(line: RoadLanes, start: float, end: float) -> list[shapely.Polygon]:
    """Along parking strips always, along kerbs if the road has edge lines."""
    found = []
    stations = line.stations(start, end)
    for side in (-1, 1):
        strip = line.strip_width_m(side, stations).min() > 0.3
        if strip or line.plan.edge_lines:
            inset = 0.0 if strip else -0.25 * side
            found.append(_stripe(line, start, end, line.lane_edge_m(side, stations) + inset, 0.12))
    return found


def _crossing(line: RoadLanes, crossing: Crossing) -> list[shapely.Polygon]:
    """Zebra stripes, or two thin boundary lines."""
    start, end = crossing.station_m, crossing.station_m + crossing.depth_m
    right, left = (float(line.edge_m(side, (start + end) / 2)) for side in (-1, 1))
    if not crossing.zebra:
        return [line.band(s - 0.07, s + 0.07, right + 0.1, left - 0.1) for s in (start, end)]
    # Stripes of 0.5 m at a pitch of 1 m, centred between the kerbs.
    count = int((left - right - 0.4) // 1.0)
    first = (left + right) / 2 - count / 2 + 0.25
    return [line.band(start, end, first + k, first + k + 0.5) for k in range(count)]


def _stop_line(line: RoadLanes, stop: StopLine, broken: bool) -> list[shapely.Polygon]:
    side = -1 if stop.forward else 1
    edge = float(line.lane_edge_m(side, stop.station_m)) - side * 0.25
    # From beside the centre line to a little before the edge of the lanes.
    low, high = sorted((0.12 * side, edge))
    behind = (stop.station_m - 0.4, stop.station_m) if stop.forward else (stop.station_m, stop.station_m + 0.4)
    if not broken:
        return [line.band(*behind, low, high)]
    # A yield line is a row of blocks.
    return [line.band(*behind, a, a + 0.5) for a in np.arange(low + 0.1, high - 0.45, 0.8)]


def _arrows(mouth: Mouth, plan: TownPlan) -> list[shapely.Polygon]:
    """Turn arrows on roads with several lanes towards a junction."""
    lanes = mouth.lanes(inbound=True)
    junction = next(j for j in plan.junctions if any(arm == mouth.arm for arm in j.arms))
    if len(lanes) < 2 or mouth.line.length_m < 40.0:
        return []
    found = []
    for number in lanes:
        turns = {c.turn for c in junction.connections if c.from_lane == f"{mouth.arm.road}:{number}"}
        # Arrows lie 17 m before the junction and point towards it.
        station = 17.0 if mouth.outward else mouth.line.length_m - 17.0
        xy, yaw = mouth.line.at(station, mouth.line.lane_offset_m(number, station))
        heading = float(yaw) + (np.pi if mouth.outward else 0.0)
        ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
        glyph = shapely.union_all([_GLYPHS[turn] for turn in sorted(turns)] or [_GLYPHS["straight"]])
        found.append(shapely.transform(glyph, lambda p, o=xy, a=ahead, b=left: o + p[:, :1] * a + p[:, 1:] * b))
    return found


def _glyph(turn: float) -> shapely.Polygon:
    """An arrow along x, bent to a side (1 left, -1 right, 0 straight on)."""
    if turn == 0.0:
        shaft, head = shapely.box(-2.0, -0.075, 1.2, 0.075), [(1.1, -0.3), (2.3, 0.0), (1.1, 0.3)]
        return shaft.union(shapely.Polygon(head))
    bent = shapely.LineString([(-2.0, 0.0), (-0.4, 0.0), (0.5, turn * 0.55)]).buffer(0.075, cap_style="flat")
    tip = np.array([1.2, turn * 0.98])
    along = np.array([0.855, turn * 0.52])
    side = np.array([-along[1], along[0]])
    base = tip - 1.0 * along
    return bent.union(shapely.Polygon([base - 0.3 * side, tip, base + 0.3 * side]))


_GLYPHS = {"straight": _glyph(0.0), "left": _glyph(1.0), "right": _glyph(-1.0)}
