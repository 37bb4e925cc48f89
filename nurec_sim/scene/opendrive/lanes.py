"""Driving lanes along their lines, and the strips between them and the border of the drivable area."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool, Float64

from nurec_sim.scene.opendrive.curves import fitted
from nurec_sim.scene.opendrive.road import (
    CLEAR_M,
    FIT_M,
    LANE_WIDTH_M,
    MAX_WIDTH_M,
    OVERLAP_M,
    STATION_M,
    LaidRoad,
    gentle,
    runs,
)

STRIP_M = 1.0
"""Width of the strips along the border."""
NARROW_STRIP_M = 0.5


class Outline:
    """A drivable area and its border.

    Attributes:
        inside: the area farther than ``CLEAR_M`` from the border.
        allowed: the area, enlarged by the tolerance of fitted curves.
    """

    def __init__(self, area: Any):
        rings = [np.array(ring.coords) for ring in shapely.get_parts(shapely.boundary(area))]
        self.segments = np.concatenate([np.stack([ring[:-1], ring[1:]], axis=1) for ring in rings])
        self.tree = shapely.STRtree(shapely.linestrings(self.segments))
        self.inside, self.allowed = shapely.buffer(area, -CLEAR_M, quad_segs=4), shapely.buffer(area, FIT_M)
        shapely.prepare(self.inside)
        shapely.prepare(self.allowed)

    def inside_at(self, places: Float64[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Whether points are in the area and farther than ``CLEAR_M`` from the border."""
        return shapely.covers(self.inside, shapely.points(places))

    def clear_m(self, places: np.ndarray, out: np.ndarray, limit_m: float) -> Float64[np.ndarray, " k"]:
        """Distance from points to the border along unit directions, infinite beyond the limit."""
        rays = shapely.linestrings(np.stack([places, places + limit_m * out], axis=1))
        row, segment = self.tree.query(rays)
        start, step = self.segments[segment, 0] - places[row], np.diff(self.segments[segment], axis=1)[:, 0]
        way = out[row]
        cross = way[:, 0] * step[:, 1] - way[:, 1] * step[:, 0]
        # Ray p + t d against segment q + u e: t = (q - p) x e / (d x e), u = (q - p) x d / (d x e). Parallel ones give
        # NaN.
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (start[:, 0] * step[:, 1] - start[:, 1] * step[:, 0]) / cross
            share = (start[:, 0] * way[:, 1] - start[:, 1] * way[:, 0]) / cross
        met = (distance >= 0) & (distance <= limit_m) & (share >= 0) & (share <= 1)
        clear = np.full(len(places), np.inf)
        np.minimum.at(clear, row[met], distance[met])
        return clear


@dataclass(frozen=True)
class Lane:
    """Centre line of a lane, its extent to the left and right, and whether that side is at the border."""

    line: Float64[np.ndarray, "k 2"]
    reach_m: tuple[float, float]
    kerb: tuple[bool, bool]


def lanes_of(lines: list[np.ndarray], outline: Outline) -> Iterator[Lane]:
    """Lanes whose sides reach halfway to a neighbour, to the border, or half of the usual width."""
    from scipy.spatial import cKDTree

    if not lines:
        return
    places, ways = np.concatenate(lines), np.concatenate([directions_of(line) for line in lines])
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    one, other = cKDTree(places).query_pairs(MAX_WIDTH_M + 0.5, output_type="ndarray").T
    # Each pair in both directions, so that every lane sees its neighbours.
    one, other = np.concatenate([one, other]), np.concatenate([other, one])
    step = places[other] - places[one]
    along, aside = (ways[one] * step).sum(axis=1), ways[one, 0] * step[:, 1] - ways[one, 1] * step[:, 0]
    beside = (owner[one] != owner[other]) & (np.abs(along) < STATION_M) & (np.abs(aside) > 1.5)
    # Within 14 degrees of parallel, in either driving direction: crossing lanes are not neighbours.
    beside &= np.abs((ways[one] * ways[other]).sum(axis=1)) > 0.97
    for index, line in enumerate(lines):
        reach, kerb = [], []
        for sign in (1.0, -1.0):
            gaps = sign * aside[beside & (owner[one] == index) & (sign * aside > 0)]
            usual = LANE_WIDTH_M / 2
            # A neighbour along at least a quarter of the lane: the boundary is halfway, with a little overlap.
            if len(gaps) >= len(line) / 4:
                usual = float(np.median(gaps)) / 2 + OVERLAP_M
            free = outline.clear_m(line, sign * normals_of(line), LANE_WIDTH_M)
            free = free[free > NARROW_STRIP_M] if (free > NARROW_STRIP_M).any() else np.array([np.inf])
            at_border = bool(np.median(free) < usual + CLEAR_M + OVERLAP_M)
            # The width is constant, so it follows the narrow places; the rest is left to the strips and patches.
            low = float(np.quantile(free, 0.1, method="lower"))
            reach.append(max(NARROW_STRIP_M, min(usual, low - (FIT_M if at_border else CLEAR_M + OVERLAP_M))))
            kerb.append(at_border)
        yield Lane(line, (reach[0], reach[1]), (kerb[0], kerb[1]))


def driving(lane: Lane, outline: Outline) -> Iterator[LaidRoad]:
    """The parts of a lane that fit into the area, extended slightly beyond its line."""
    way = directions_of(lane.line)
    line = np.concatenate([lane.line[:1] - CLEAR_M * way[:1], lane.line, lane.line[-1:] + CLEAR_M * way[-1:]])
    out = np.concatenate([normals_of(lane.line)[:1], normals_of(lane.line), normals_of(lane.line)[-1:]])
    left_m, right_m = lane.reach_m
    ends = np.stack([line + left_m * out, line - right_m * out], axis=1)
    fits = shapely.covers(outline.allowed, shapely.linestrings(ends)) & outline.inside_at(line)
    for side in (0, 1):
        fits &= outline.inside_at(ends[:, side]) | lane.kerb[side]
    for start, stop in runs(fits):
        for chain in gentle(fitted(line[start:stop]), left_m, right_m):
            reference = [piece.aside(left_m) for piece in chain]
            yield LaidRoad(reference, "driving", left_m + right_m, (not lane.kerb[0], not lane.kerb[1]))


def parking(lane: Lane, outline: Outline, covered: Any) -> Iterator[LaidRoad]:
    """Strips on both sides of a driving lane that fill the gap to the strips along the border."""
    for side, sign in ((0, 1.0), (1, -1.0)):
        beside_m, out = lane.reach_m[side], sign * normals_of(lane.line)
        free = outline.clear_m(lane.line, out, beside_m + MAX_WIDTH_M + STRIP_M)
        low = free - STRIP_M + OVERLAP_M - beside_m  # the border strip must be reached
        high = np.minimum(free - CLEAR_M - OVERLAP_M - beside_m, MAX_WIDTH_M)
        start, end = lane.line + beside_m * out, lane.line + np.maximum(free - STRIP_M, beside_m)[:, None] * out
        needed = np.isfinite(free) & (low > 0) & (low < MAX_WIDTH_M)
        across = shapely.linestrings(np.stack([start, np.where(needed[:, None], end, start)], axis=1))
        needed &= shapely.covers(outline.inside, across) & ~shapely.covers(covered, across)
        for first, last in runs(needed):
            for start_row, stop_row, width_m in _even(low[first:last], high[first:last]):
                line = lane.line[first + start_row : first + stop_row]
                far_m, near_m = beside_m + width_m, OVERLAP_M - beside_m
                left_m, right_m = (far_m, near_m) if side == 0 else (near_m, far_m)
                for chain in gentle(fitted(line), left_m, right_m):
                    pieces = [piece.aside(left_m) for piece in chain]
                    road = LaidRoad(pieces, "parking", left_m + right_m, (True, True))
                    # Curve fitting may push a strip beyond the border; patches cover such places instead.
                    if shapely.difference(road.polygon, outline.inside).area < 0.01:
                        yield road


def _even(low: Float64[np.ndarray, " n"], high: Float64[np.ndarray, " n"]) -> Iterator[tuple[int, int, float]]:
    """Greedy runs (start, stop, value) in which one value satisfies all limits; neighbours share an end."""
    first = 0
    while first < len(low):
        # A common value exists as long as the largest lower limit does not exceed the smallest upper one.
        lows, highs = np.maximum.accumulate(low[first:]), np.minimum.accumulate(high[first:])
        count = int(np.argmin(np.append(lows <= highs, False)))
        stop = first + count
        if count > 2:
            yield first, stop, float(lows[count - 1] + highs[count - 1]) / 2
        first = stop - 1 if count > 2 and stop < len(low) else stop + (count == 0)


def normals_of(line: Float64[np.ndarray, "k 2"]) -> Float64[np.ndarray, "k 2"]:
    """Unit vectors to the left of a line."""
    way = directions_of(line)
    return np.stack([-way[:, 1], way[:, 0]], axis=1)


def directions_of(line: Float64[np.ndarray, "k 2"]) -> Float64[np.ndarray, "k 2"]:
    """Unit vectors along a line."""
    way = np.gradient(line, axis=0)
    return way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
