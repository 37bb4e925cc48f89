"""The area between the kerbs, seen from above: roads, junctions with rounded corners, roundabouts with islands."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import shapely

from nurec_sim.world.junctions import Mouth
from nurec_sim.world.plan import Junction
from nurec_sim.world.road import RoadLanes, RoadLine

GRID_M = 1e-4
"""Vertices lie on this grid, so that the areas that share an edge share its vertices."""
ARM_REACH_M = 14.0
"""How much of each road takes part in the rounding of a junction's corners."""
QUARTER_SEGMENTS = 12


def drivable_area(roads: Mapping[str, RoadLanes], junctions: tuple[Junction, ...]) -> shapely.MultiPolygon:
    """Everything between the kerbs, as polygons whose holes are traffic islands."""
    parts: list[shapely.Geometry] = [line.surface(0.0, line.length_m) for line in roads.values()]
    parts += [junction_area(junction, roads) for junction in junctions]
    area = shapely.set_precision(shapely.union_all(parts), GRID_M).simplify(0.004)
    polygons = area.geoms if isinstance(area, shapely.MultiPolygon) else [area]
    return shapely.MultiPolygon([shapely.orient_polygons(polygon) for polygon in polygons])


def junction_area(junction: Junction, roads: Mapping[str, RoadLanes]) -> shapely.Geometry:
    """A junction up to a little beyond its mouths: arms extended to its centre, paths, ring, and rounded corners."""
    centre, parts = np.array([junction.x_m, junction.y_m]), []
    for mouth in mouths(junction, roads):
        line = mouth.line
        length = min(ARM_REACH_M, line.length_m)
        span = (0.0, length) if mouth.outward else (line.length_m - length, line.length_m)
        parts.append(line.surface(*span))
        if junction.kind != "roundabout":
            parts.append(_stub(mouth, centre))
    for path in junction.connections:
        parts.append(_lane_ribbon(RoadLine(path), path_half_width_m(path.from_lane, roads)))
    whole = shapely.union_all(parts)
    if junction.kind == "roundabout":
        ring, half = junction.ring_radius_m, junction.ring_width_m / 2
        point = shapely.Point(centre)
        whole = whole.union(point.buffer(ring + half, quad_segs=24))
        radius = junction.corner_radius_m
        rounded = whole.buffer(radius, quad_segs=QUARTER_SEGMENTS).buffer(-radius, quad_segs=QUARTER_SEGMENTS)
        return rounded.difference(point.buffer(ring - half, quad_segs=24))
    radius = junction.corner_radius_m
    return whole.buffer(radius, quad_segs=QUARTER_SEGMENTS).buffer(-radius, quad_segs=QUARTER_SEGMENTS)


def junction_core(junction: Junction, roads: Mapping[str, RoadLanes]) -> shapely.Geometry:
    """The part of a junction between its mouths, where roads have no markings of their own."""
    beyond = [
        mouth.line.surface(0.0, mouth.line.length_m).buffer(0.01, cap_style="flat") for mouth in mouths(junction, roads)
    ]
    return junction_area(junction, roads).difference(shapely.union_all(beyond))


def mouths(junction: Junction, roads: Mapping[str, RoadLanes]) -> list[Mouth]:
    """The arms of a junction."""
    return [Mouth(arm, roads[arm.road]) for arm in junction.arms]


def path_half_width_m(lane: str, roads: Mapping[str, RoadLanes]) -> float:
    """Half the width of a path through a junction that begins at a lane."""
    road, _, _ = lane.rpartition(":")
    return roads[road].plan.lane_width_m / 2


def _stub(mouth: Mouth, centre: np.ndarray) -> shapely.Polygon:
    """A road's full width, from its mouth straight on to the junction's centre."""
    station = mouth.station_m
    right, yaw = mouth.line.at(station, mouth.line.edge_m(-1, station))
    left, _ = mouth.line.at(station, mouth.line.edge_m(1, station))
    outward = np.array([np.cos(yaw), np.sin(yaw)]) * (1 if mouth.outward else -1)
    inwards = -outward * (float(outward @ (right - centre)) + 0.05)
    return shapely.Polygon([right, left, left + inwards, right + inwards])


def _lane_ribbon(line: RoadLine, half_m: float) -> shapely.Polygon:
    return line.band(0.0, line.length_m, -half_m, half_m).buffer(0)
