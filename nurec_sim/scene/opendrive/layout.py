"""Roads that cover a drivable area, laid out so that readers find the area's border and no edge inside it.

AlpaSim makes an edge at the side of every road and takes lanes of every type for road (``validate.alpasim_map``). Five
kinds of roads, each with one lane of constant width:

* a *driving* lane along every lane line;
* *shoulders*: strips inside every outline of the area, which they have on their right; their right borders are the
  edges that count;
* *parking* strips between the two, where the area is wider than its lanes;
* *patches*, shoulders too, over what is left, in junctions mostly;
* near the path, lanes of type ``none`` outside of the area, half a metre wide: a car that stands wholly beyond the
  border meets their edges, and none can stand on them.

Roads overlap by some centimetres, so that no gap is left between them. Sides without a border beside them are closed by
lanes of type ``none``, ``SEAL_M`` wide: edges within 0.2 m of a lane's centre line do not count. For that reason seals
keep ``CLEAR_M`` away from the border.
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
"""Longest strip along a border: a reader compares a car with one edge, so long edges serve best."""
CORNER_RAD = 0.5
UNCOVERED_M = 0.5
"""Patches cover what is farther than this from the border."""
BEYOND_M = (1.5, 3.2, 4.9, 6.6)
"""How far outside the area there are edges: their steps are less than the width of a car."""
BEYOND_WIDTH_M = 0.5
BEYOND_REACH_M = 12.0
BEYOND_EDGE_M = 30.0
Lines = Sequence[Float64[np.ndarray, "k 3"]]


def laid_out(area: Any, lanes: Lines, path: Float64[np.ndarray, "p 3"]) -> list[LaidRoad]:
    """Roads that cover an area.

    Args:
        area: the drivable area, shapely polygons.
        lanes: centre lines of driving lanes in driving direction.
        path: where the car drove; borders are cut into edges where that is far away.
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
    """Without hairline gaps and specks."""
    area = shapely.buffer(shapely.buffer(area, OVERLAP_M, join_style="mitre"), -OVERLAP_M, join_style="mitre")
    polygons = []
    for polygon in shapely.get_parts(area):
        if polygon.area > MAX_WIDTH_M:
            holes = [ring for ring in polygon.interiors if shapely.Polygon(ring).area > STRIP_M**2]
            polygons.append(shapely.orient_polygons(shapely.Polygon(polygon.exterior, holes)))
    return shapely.MultiPolygon(polygons).simplify(0.005)


def _covered(roads: list[LaidRoad]) -> Any:
    """What roads cover, each taken a little smaller, so that roads that merely touch leave a gap."""
    polygons = np.array([road.polygon for road in roads], dtype=object)
    covered = shapely.union_all(shapely.buffer(polygons, -OVERLAP_M / 2, join_style="mitre"))
    shapely.prepare(covered)
    return covered


# -------------------------------------------------------------------------------------------------------------- border


def _border(area: Any, path: Float64[np.ndarray, "p 3"]) -> Iterator[LaidRoad]:
    """Strips inside the outlines, which lie on their right."""
    driven = shapely.LineString(path[:, :2]) if len(path) > 1 else shapely.Point(path[0, :2])
    for polygon in shapely.get_parts(area):
        for ring in (polygon.exterior, *polygon.interiors):
            for line in _sides(np.array(ring.coords)[:-1], driven):
                for chain in gentle(fitted(line), STRIP_M, 0.0):
                    for run in _cut(chain, min(EDGE_M, 0.7 * ring.length), driven):
                        yield _strip(run, polygon)


def _sides(ring: Float64[np.ndarray, "k 2"], driven: Any) -> Iterator[Float64[np.ndarray, "n 2"]]:
    """A ring between its corners, which strips may not go round; one that has none begins far from the path."""
    way = np.diff(np.concatenate([ring[-1:], ring, ring[:1]]), axis=0)
    turn = np.arctan2(way[:-1, 0] * way[1:, 1] - way[:-1, 1] * way[1:, 0], (way[:-1] * way[1:]).sum(axis=1))
    corners = np.flatnonzero(turn > CORNER_RAD)
    if not len(corners):
        ring = np.roll(ring, -int(np.argmax(shapely.distance(driven, shapely.points(ring)))), axis=0)
        past = 2 * STRIP_M / max(np.hypot(*(ring[1] - ring[0])), 2 * STRIP_M)
        yield np.concatenate([ring, ring[:1], ring[:1] + past * (ring[1:2] - ring[:1])])  # so that the ring closes
        return
    ring = np.roll(ring, -corners[0], axis=0)
    stops = [*(corners - corners[0]), len(ring)]
    closed = np.concatenate([ring, ring[:1]])
    for start, stop in zip(stops, stops[1:], strict=False):
        side = shapely.LineString(closed[start : stop + 1])
        if side.length > 2 * UNCOVERED_M + MIN_ROAD_M:
            yield np.array(shapely.ops.substring(side, UNCOVERED_M, side.length - UNCOVERED_M).coords)


def _strip(border: list[Piece], polygon: Any) -> LaidRoad:
    """A strip to the left of a border; a narrow one, and not sealed, where the area's other side is near."""
    for width_m in (STRIP_M, NARROW_STRIP_M):
        strip = LaidRoad([piece.aside(width_m) for piece in border], "shoulder", width_m, (True, False))
        inner = shapely.LineString(sampled(strip.reference)[0])
        clear = shapely.distance(inner, shapely.boundary(polygon)) >= min(CLEAR_M, width_m) - FIT_M
        if clear and strip.polygon.is_valid:
            return strip
    return dataclasses.replace(strip, sealed=(False, False))


def _beyond(area: Any, path: Float64[np.ndarray, "p 3"]) -> Iterator[LaidRoad]:
    """Edges outside the area, near the path; too narrow and too far from it to drive on."""
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
    """Of two parallel edges with near centroids readers drop one, so neighbouring rows are cut at other places."""
    along = shapely.line_locate_point(path, shapely.points(line))
    part = np.floor(along / BEYOND_EDGE_M + row / 2)
    cuts = [0, *(np.flatnonzero(np.diff(part)) + 1), len(line) - 1]
    for start, stop in zip(cuts, cuts[1:], strict=False):
        for chain in gentle(fitted(line[start : stop + 1]), BEYOND_WIDTH_M, 0.0) if stop > start else ():
            yield LaidRoad([piece.aside(BEYOND_WIDTH_M) for piece in chain], "none", BEYOND_WIDTH_M, (True, False))


def _cut(chain: list[Piece], longest_m: float, driven: Any) -> Iterator[list[Piece]]:
    """Parts that overlap by a piece, cut where the driven path is far: near a cut, a car meets two edges."""
    ends = np.cumsum([piece.length_m for piece in chain])
    away = shapely.distance(driven, shapely.points([piece.xy for piece in chain]))
    start = 0
    while start < len(chain):
        left_m = ends[-1] - (ends[start - 1] if start else 0.0)
        stop = len(chain)
        if left_m > longest_m:
            along = ends - ends[-1] + left_m
            choice = np.flatnonzero((along > 0.3 * longest_m) & (along <= longest_m))
            choice = choice[choice > start]
            stop = int(choice[np.argmax(away[choice])]) + 1 if len(choice) else start + 2
        yield chain[start:stop]
        start = stop - 1 if stop < len(chain) else stop


# ------------------------------------------------------------------------------------------------------------- patches


def _patches(gaps: Any, inside: Any) -> Iterator[LaidRoad]:
    """Rectangles that cover the gaps and lie inside."""
    shapely.prepare(inside)
    for gap in shapely.get_parts(gaps):
        if gap.is_empty or gap.geom_type != "Polygon":
            continue
        corners = np.array(shapely.minimum_rotated_rectangle(gap).exterior.coords)
        sides = np.diff(corners, axis=0)[:2]
        axis = sides[int(np.argmax(np.hypot(*sides.T)))]
        u = axis / np.hypot(*axis)
        turn = np.array([[u[0], u[1]], [-u[1], u[0]]])
        turned = shapely.transform(gap, lambda xy, turn=turn: xy @ turn.T)
        yield from _rectangles(turned, turn, inside)


def _rectangles(gap: Any, turn: Float64[np.ndarray, "2 2"], inside: Any) -> Iterator[LaidRoad]:
    """Of a gap given in turned axes: one around it, or those of its halves."""
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
