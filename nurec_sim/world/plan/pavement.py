"""The area between the kerbs, seen from above: roads, junctions with rounded corners, roundabouts with islands."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import shapely

from nurec_sim.world.plan.junctions import Mouth
from nurec_sim.world.plan.road import RoadLanes, RoadLine
from nurec_sim.world.plan.town import Junction

GRID_M = 1e-4
"""Vertices are snapped to this grid, so that adjacent areas share vertices."""
SMOOTH_M = 0.004
"""Simplification tolerance of outlines."""
ARM_REACH_M = 14.0
"""Length of each road used for rounding a junction's corners."""
QUARTER_SEGMENTS = 12


def drivable_area(roads: Mapping[str, RoadLanes], junctions: tuple[Junction, ...]) -> shapely.MultiPolygon:
    """Everything between the kerbs, as polygons whose holes are traffic islands."""
    parts: list[shapely.Geometry] = [line.surface(0.0, line.length_m) for line in roads.values()]
    parts += [junction_area(junction, roads) for junction in junctions]
    area = shapely.set_precision(shapely.union_all(parts), GRID_M).simplify(SMOOTH_M)
    polygons = area.geoms if isinstance(area, shapely.MultiPolygon) else [area]
    return shapely.MultiPolygon([shapely.orient_polygons(polygon) for polygon in polygons])


def junction_area(junction: Junction, roads: Mapping[str, RoadLanes]) -> shapely.Geometry:
    """A junction up to a little beyond its mouths: arms extended to its centre, paths, ring, and rounded corners."""
    centre, parts = np.array([junction.x_m, junction.y_m]), []
    for mouth in mouths(junction, roads):
        whole = mouth.line.length_m
        near = min(ARM_REACH_M, whole)
        parts.append(mouth.line.surface(*((0.0, near) if mouth.outward else (whole - near, whole))))
        if junction.kind != "roundabout":
            parts.append(_stub(mouth, centre))
    for path in junction.connections:
        half = roads[path.from_lane.rpartition(":")[0]].plan.lane_width_m / 2
        line = RoadLine(path)
        # buffer(0) repairs bands that overlap themselves in tight turns.
        parts.append(line.band(0.0, line.length_m, -half, half).buffer(0))
    if junction.kind == "roundabout":
        point, half = shapely.Point(centre), junction.ring_width_m / 2
        ring = point.buffer(junction.ring_radius_m + half, quad_segs=24)
        island = point.buffer(junction.ring_radius_m - half, quad_segs=24)
        return _rounded(shapely.union_all([*parts, ring]), junction.corner_radius_m).difference(island)
    return _rounded(shapely.union_all(parts), junction.corner_radius_m)


def _rounded(area: shapely.Geometry, radius_m: float) -> shapely.Geometry:
    """An area with its inner corners filled to arcs."""
    # A morphological closing: outer corners return to their place, inner ones keep the radius.
    return area.buffer(radius_m, quad_segs=QUARTER_SEGMENTS).buffer(-radius_m, quad_segs=QUARTER_SEGMENTS)


def mouths(junction: Junction, roads: Mapping[str, RoadLanes]) -> list[Mouth]:
    """The arms of a junction."""
    return [Mouth(arm, roads[arm.road]) for arm in junction.arms]


def _stub(mouth: Mouth, centre: np.ndarray) -> shapely.Polygon:
    """A road's full width, from its mouth straight on to the junction's centre."""
    station = mouth.station_m
    right, yaw = mouth.line.at(station, mouth.line.edge_m(-1, station))
    left, _ = mouth.line.at(station, mouth.line.edge_m(1, station))
    outward = np.array([np.cos(yaw), np.sin(yaw)]) * (1 if mouth.outward else -1)
    # As far as the centre, plus 5 cm of overlap so that opposite arms leave no gap.
    inwards = -outward * (float(outward @ (right - centre)) + 0.05)
    return shapely.Polygon([right, left, left + inwards, right + inwards])
