"""Covers a drivable area with roads such that readers find the area's border, and no edge inside it.

AlpaSim generates an edge at the side of every road and treats lanes of every type as road (``validate.alpasim_map``).
There are five kinds of roads, each with one lane of constant width:

* a *driving* lane along every lane line;
* *shoulders*: strips inside every outline of the area, with the outline on their right; their right borders are the
  edges that count;
* *parking* strips between the two, where the area is wider than its lanes;
* *patches*, also shoulders, over the remaining area, mostly in junctions;
* near the path, lanes of type ``none`` outside the area, half a metre wide: a car entirely beyond the border touches
  their edges, and no car fits on them.

Roads overlap by some centimetres so that no gaps remain. Sides that are not at the border are closed by lanes of type
``none``, ``SEAL_M`` wide: edges within 0.2 m of a lane's centre line do not count. Seals therefore keep ``CLEAR_M``
away from the border.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import shapely
import shapely.ops
from jaxtyping import Float64

from nurec_sim.scene.opendrive.curves import Piece, fitted, resampled, sampled
from nurec_sim.scene.opendrive.lanes import NARROW_STRIP_M, STRIP_M, Outline, driving, lanes_of, parking
from nurec_sim.scene.opendrive.road import (
    CLEAR_M,
    FIT_M,
    MAX_WIDTH_M,
    MIN_ROAD_M,
    OVERLAP_M,
    STATION_M,
    LaidRoad,
    gentle,
)

EDGE_M = 200.0
"""Maximum length of a strip along a border: readers compare a car with one edge only, so long edges are best."""
CORNER_RAD = 0.5
UNCOVERED_M = 0.5
"""Patches cover the area farther than this from the border."""
BEYOND_M = (1.5, 3.2, 4.9, 6.6)
"""Distances of edges outside the area: their spacing is less than the width of a car."""
BEYOND_WIDTH_M = 0.5
BEYOND_REACH_M = 12.0
BEYOND_EDGE_M = 30.0
Lines = Sequence[Float64[np.ndarray, "k 3"]]


def laid_out(area: Any, lanes: Lines, path: Float64[np.ndarray, "p 3"]) -> list[LaidRoad]:
    """Roads that cover an area.

    Args:
        area: the drivable area, shapely polygons.
        lanes: centre lines of driving lanes, in driving direction.
        path: the recorded path; borders are cut into edges at points far from it.
    """
    area = _cleaned(area)
    if area.is_empty:
        return []
    outline = Outline(area)
    lines = [resampled(line[:, :2], STATION_M) for line in lanes if len(line) > 1]
    known = list(lanes_of([line for line in lines if len(line) > 2], outline))
    roads = [road for lane in known for road in driving(lane, outline)]
    roads += _border(area, path)
    covered = _covered(roads)
    roads += [road for lane in known for road in parking(lane, outline, covered)]
    gaps = shapely.difference(shapely.buffer(area, -UNCOVERED_M, quad_segs=4), _covered(roads))
    roads += _patches(shapely.buffer(gaps, -OVERLAP_M / 2, quad_segs=1), outline.inside)
    return roads + list(_beyond(area, path))


def _cleaned(area: Any) -> Any:
    """The area without hairline gaps and specks: a morphological closing, small polygons and holes dropped."""
    area = shapely.buffer(shapely.buffer(area, OVERLAP_M, join_style="mitre"), -OVERLAP_M, join_style="mitre")
    polygons = []
    for polygon in shapely.get_parts(area):
        if polygon.area > MAX_WIDTH_M:
            holes = [ring for ring in polygon.interiors if shapely.Polygon(ring).area > STRIP_M**2]
            polygons.append(shapely.orient_polygons(shapely.Polygon(polygon.exterior, holes)))
    return shapely.MultiPolygon(polygons).simplify(0.005)


def _covered(roads: list[LaidRoad]) -> Any:
    """The union of roads, each shrunk slightly, so that roads that merely touch leave a gap to be patched."""
    polygons = np.array([road.polygon for road in roads], dtype=object)
    covered = shapely.union_all(shapely.buffer(polygons, -OVERLAP_M / 2, join_style="mitre"))
    shapely.prepare(covered)
    return covered


# -------------------------------------------------------------------------------------------------------------- border


def _border(area: Any, path: Float64[np.ndarray, "p 3"]) -> Iterator[LaidRoad]:
    """Strips inside the outlines, with the outline on their right."""
    driven = shapely.LineString(path[:, :2]) if len(path) > 1 else shapely.Point(path[0, :2])
    for polygon in shapely.get_parts(area):
        for ring in (polygon.exterior, *polygon.interiors):
            for line in _sides(np.array(ring.coords)[:-1], driven):
                for chain in gentle(fitted(line), STRIP_M, 0.0):
                    for run in _cut(chain, min(EDGE_M, 0.7 * ring.length), driven):
                        yield _strip(run, polygon)


def _sides(ring: Float64[np.ndarray, "k 2"], driven: Any) -> Iterator[Float64[np.ndarray, "n 2"]]:
    """Splits a ring at corners, which strips cannot follow; a ring without corners starts far from the path."""
    way = np.diff(np.concatenate([ring[-1:], ring, ring[:1]]), axis=0)
    # Rings have the area on their left, so a left turn is a convex corner of it.
    turn = np.arctan2(way[:-1, 0] * way[1:, 1] - way[:-1, 1] * way[1:, 0], (way[:-1] * way[1:]).sum(axis=1))
    corners = np.flatnonzero(turn > CORNER_RAD)
    if not len(corners):
        ring = np.roll(ring, -int(np.argmax(shapely.distance(driven, shapely.points(ring)))), axis=0)
        past = 2 * STRIP_M / max(np.hypot(*(ring[1] - ring[0])), 2 * STRIP_M)
        yield np.concatenate([ring, ring[:1], ring[:1] + past * (ring[1:2] - ring[:1])])  # its ends overlap
        return
    ring = np.roll(ring, -corners[0], axis=0)
    stops = [*(corners - corners[0]), len(ring)]
    closed = np.concatenate([ring, ring[:1]])
    for start, stop in zip(stops, stops[1:], strict=False):
        side = shapely.LineString(closed[start : stop + 1])
        if side.length > 2 * UNCOVERED_M + MIN_ROAD_M:
            yield np.array(shapely.ops.substring(side, UNCOVERED_M, side.length - UNCOVERED_M).coords)


def _strip(border: list[Piece], polygon: Any) -> LaidRoad:
    """A strip to the left of a border; narrow and unsealed if the opposite border is near."""
    for width_m in (STRIP_M, NARROW_STRIP_M):
        strip = LaidRoad([piece.aside(width_m) for piece in border], "shoulder", width_m, (True, False))
        inner = shapely.LineString(sampled(strip.reference)[0])
        clear = shapely.distance(inner, shapely.boundary(polygon)) >= min(CLEAR_M, width_m) - FIT_M
        if clear and strip.polygon.is_valid:
            return strip
    return dataclasses.replace(strip, sealed=(False, False))


def _beyond(area: Any, path: Float64[np.ndarray, "p 3"]) -> Iterator[LaidRoad]:
    """Edges outside the area, near the path; too narrow and too far outside to drive on."""
    driven = shapely.LineString(path[:, :2]) if len(path) > 1 else shapely.Point(path[0, :2])
    reach = shapely.buffer(driven, BEYOND_REACH_M)
    line = resampled(path[:, :2], STATION_M)
    first, last = (line[1] - line[0], line[-1] - line[-2]) if np.ptp(line, axis=0).max() > 0 else np.eye(2)[[0, 0]]
    more = [step / np.hypot(*step) * 2 * BEYOND_REACH_M for step in (first, last)]
    beyond = shapely.LineString(np.concatenate([line[:1] - more[0], line, line[-1:] + more[1]]))
    for row, away_m in enumerate(BEYOND_M):
        grown = shapely.orient_polygons(shapely.buffer(area, away_m))
        for polygon in shapely.get_parts(grown):
            for ring in (polygon.exterior, *polygon.interiors):
                near = shapely.intersection(ring, reach)
                near = shapely.line_merge(near, directed=True) if near.geom_type == "MultiLineString" else near
                for part in shapely.get_parts(near):
                    if part.geom_type == "LineString" and part.length >= MIN_ROAD_M:
                        yield from _outer_edges(resampled(np.array(part.coords), STATION_M), row, beyond)


def _outer_edges(line: Float64[np.ndarray, "k 2"], row: int, path: Any) -> Iterator[LaidRoad]:
    """Readers drop one of two parallel edges with close centroids, so neighbouring rows are cut at staggered points."""
    along = shapely.line_locate_point(path, shapely.points(line))
    # Every other row is shifted by half an edge.
    part = np.floor(along / BEYOND_EDGE_M + row / 2)
    cuts = [0, *(np.flatnonzero(np.diff(part)) + 1), len(line) - 1]
    for start, stop in zip(cuts, cuts[1:], strict=False):
        for chain in gentle(fitted(line[start : stop + 1]), BEYOND_WIDTH_M, 0.0) if stop > start else ():
            yield LaidRoad([piece.aside(BEYOND_WIDTH_M) for piece in chain], "none", BEYOND_WIDTH_M, (True, False))


def _cut(chain: list[Piece], longest_m: float, driven: Any) -> Iterator[list[Piece]]:
    """Parts that overlap by one piece, cut far from the driven path: near a cut, a car touches two edges."""
    ends = np.cumsum([piece.length_m for piece in chain])
    away = shapely.distance(driven, shapely.points([piece.xy for piece in chain]))
    start = 0
    while start < len(chain):
        left_m = ends[-1] - (ends[start - 1] if start else 0.0)
        stop = len(chain)
        if left_m > longest_m:
            along = ends - ends[-1] + left_m
            # Not before 30 % of the allowed length, so that the parts do not become too many.
            choice = np.flatnonzero((along > 0.3 * longest_m) & (along <= longest_m))
            choice = choice[choice > start]
            stop = int(choice[np.argmax(away[choice])]) + 1 if len(choice) else start + 2
        yield chain[start:stop]
        start = stop - 1 if stop < len(chain) else stop


# ------------------------------------------------------------------------------------------------------------- patches


def _patches(gaps: Any, inside: Any) -> Iterator[LaidRoad]:
    """Rectangles that cover the gaps and stay inside the area."""
    shapely.prepare(inside)
    for gap in shapely.get_parts(gaps):
        if gap.is_empty or gap.geom_type != "Polygon":
            continue
        corners = np.array(shapely.minimum_rotated_rectangle(gap).exterior.coords)
        # The long side of the smallest enclosing rectangle gives the roads' direction.
        sides = np.diff(corners, axis=0)[:2]
        axis = sides[int(np.argmax(np.hypot(*sides.T)))]
        u = axis / np.hypot(*axis)
        turn = np.array([[u[0], u[1]], [-u[1], u[0]]])
        turned = shapely.transform(gap, lambda xy, turn=turn: xy @ turn.T)
        # Recursive: each cut halves an extent, down to a few overlaps in size.
        yield from _rectangles(turned, turn, inside)


def _rectangles(gap: Any, turn: Float64[np.ndarray, "2 2"], inside: Any) -> Iterator[LaidRoad]:
    """A rectangle around a gap in rotated axes, or, if it does not fit, those of the gap's halves (recursively)."""
    west, south, east, north = shapely.bounds(gap)
    if np.isnan(west):
        return
    west, south, east, north = west - OVERLAP_M, south - OVERLAP_M, east + OVERLAP_M, north + OVERLAP_M
    east = max(east, west + 0.2)
    corners = np.array([[west, south], [east, south], [east, north], [west, north]]) @ turn
    small = max(east - west, north - south) < 4 * OVERLAP_M
    if small or (north - south <= MAX_WIDTH_M and shapely.covers(inside, shapely.Polygon(corners))):
        start, heading = corners[3], float(np.arctan2(turn[0, 1], turn[0, 0]))
        piece = Piece((float(start[0]), float(start[1])), heading, float(east - west), 0.0)
        yield LaidRoad([piece], "shoulder", float(north - south), (True, True))
    elif north - south > MAX_WIDTH_M or north - south > east - west:
        middle = (south + north) / 2
        for low, high in ((south, middle), (middle, north)):
            yield from _rectangles(shapely.clip_by_rect(gap, west, low, east, high), turn, inside)
    else:
        middle = (west + east) / 2
        for low, high in ((west, middle), (middle, east)):
            yield from _rectangles(shapely.clip_by_rect(gap, low, south, high, north), turn, inside)
