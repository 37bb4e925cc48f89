"""Routes through a lane network: lane sequences, conflicts with other routes, and allowed speeds.

Stations of a route are metres along it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.distance import cdist

from nurec_sim import geometry
from nurec_sim.world.plan.network import Lane

SPACING_M = 0.5
SIDEWAYS_MPS2 = 2.2
BRAKE_MPS2 = 1.6
END_M = 8.0
"""Vehicles stop before the last metres of a route, where the town ends."""
CONFLICT_M = 2.5
"""Paths through a junction that come closer than this conflict."""


@dataclass(frozen=True)
class Leg:
    """A lane of a route, from ``start_m`` to ``end_m`` along it."""

    lane: str
    start_m: float
    end_m: float
    in_junction: bool


@dataclass(frozen=True, eq=False)
class Route:
    """A polyline with a point every ``SPACING_M``, allowed speeds by curvature, limits and end, and its lanes."""

    xy_m: Float64[np.ndarray, "k 2"]
    allowed_mps: Float64[np.ndarray, " k"]
    legs: tuple[Leg, ...]

    @property
    def length_m(self) -> float:
        """Length of the polyline."""
        return (len(self.xy_m) - 1) * SPACING_M

    def at(self, station_m: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n 2"]:
        """Points of the route, extrapolated straight before its start."""
        return _on_grid(self.xy_m, np.asarray(station_m, np.float64) / SPACING_M)


def _on_grid(points: np.ndarray, place: np.ndarray) -> np.ndarray:
    index = np.clip(np.floor(place).astype(int), 0, len(points) - 2)
    return points[index] + (place - index)[..., None] * (points[index + 1] - points[index])


def random_lanes(rng: np.random.Generator, lanes: Mapping[str, Lane], first: str, length_m: float) -> tuple[str, ...]:
    """A random lane sequence.

    Args:
        rng: random generator.
        lanes: of the town, by id.
        first: id of the lane to start on.
        length_m: the sequence ends when its lanes are this long together, or at the end of the town.
    """
    way, length = [first], lanes[first].length_m
    while length < length_m and lanes[way[-1]].successors:
        options = lanes[way[-1]].successors
        way.append(options[int(rng.integers(len(options)))])
        length += lanes[way[-1]].length_m
    return tuple(way)


def lay_route(lanes: Mapping[str, Lane], way: Sequence[str], right_m: float = 0.0, speed_factor: float = 1.0) -> Route:
    """The route along a sequence of lanes.

    Args:
        lanes: of the town, by id.
        way: ids of successive lanes.
        right_m: lateral offset to the right of the lane centres.
        speed_factor: scales the speed limits; below 1 also the speed in bends.
    """
    pieces: list[np.ndarray] = []
    limits, legs, start = [], [], 0.0
    for name in way:
        lane = lanes[name]
        xy = lane.polyline[:, :2]
        length = lane.length_m
        # A lane starts where its predecessor ends; the shared point is kept once.
        pieces.append(xy if not pieces else xy[1:])
        limits.append(lane.speed_limit_mps)
        legs.append(Leg(name, start, start + length, lane.in_junction))
        start += length
    points = np.concatenate(pieces)
    station = geometry.arc_length(points)
    # Interpolation needs strictly growing stations.
    keep = np.concatenate([[True], np.diff(station) > 1e-6])
    points, station = points[keep], station[keep]
    grid = np.arange(int(start / SPACING_M) + 1) * SPACING_M
    xy = np.stack([np.interp(grid, station, points[:, axis]) for axis in (0, 1)], axis=1)
    if right_m:
        tangent = np.gradient(xy, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        xy = xy + right_m * np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    leg_of = np.clip(np.searchsorted([leg.end_m for leg in legs], grid), 0, len(legs) - 1)
    return Route(xy, _allowed(xy, np.array(limits)[leg_of] * speed_factor, speed_factor), tuple(legs))


def _allowed(xy: np.ndarray, limit_mps: np.ndarray, speed_factor: float) -> Float64[np.ndarray, " k"]:
    """Speed limits, reduced in bends by lateral acceleration and before them by braking distance."""
    reach = 4  # points: curvature over 4 m, insensitive to polyline corners
    yaw = np.unwrap(np.arctan2(*np.diff(xy, axis=0).T[::-1]))
    padded = np.pad(yaw, reach, mode="edge")
    bend = np.abs(padded[2 * reach :] - padded[: -2 * reach]) / (2 * reach * SPACING_M)
    bend = np.append(bend, bend[-1])
    # Lateral acceleration v^2 k stays below SIDEWAYS_MPS2.
    speed = np.minimum(limit_mps, np.sqrt(SIDEWAYS_MPS2 / np.maximum(bend, 1e-6)) * min(speed_factor, 1.0))
    speed[-int(END_M / SPACING_M) :] = 0.0
    # v^2 falls by 2 a per metre before a slow place: the lower envelope of lines of that slope, from the end on.
    slope = 2 * BRAKE_MPS2 * SPACING_M * np.arange(len(speed))
    return np.sqrt(np.minimum.accumulate((speed**2 + slope)[::-1])[::-1] - slope)


@dataclass(frozen=True)
class Conflict:
    """Conflict zone of two junction lanes: stations of each lane, from its own start."""

    first: tuple[float, float]
    second: tuple[float, float]


def conflicts(lanes: Mapping[str, Lane]) -> dict[tuple[str, str], Conflict]:
    """All conflicting pairs of junction lanes, except those that only diverge.

    If both merge into the same lane, the zone of the second one is short: beyond it vehicles simply follow.
    """
    inside = {name: lane for name, lane in lanes.items() if lane.in_junction}
    before: dict[str, set[str]] = {name: set() for name in lanes}
    for name, lane in lanes.items():
        for successor in lane.successors:
            before[successor].add(name)
    found = {}
    for a, first in inside.items():
        for b, second in inside.items():
            # Paths from the same lane diverge: their vehicles already follow each other.
            if a == b or before[a] & before[b]:
                continue
            near = cdist(first.polyline[:, :2], second.polyline[:, :2]) < CONFLICT_M
            if not near.any():
                continue
            at_a = geometry.arc_length(first.polyline[:, :2])[near.any(axis=1)]
            at_b = geometry.arc_length(second.polyline[:, :2])[near.any(axis=0)]
            merge = bool(set(first.successors) & set(second.successors))
            second_end = float(at_b[0]) + 1.0 if merge else float(at_b[-1])
            found[a, b] = Conflict((float(at_a[0]), float(at_a[-1])), (float(at_b[0]), second_end))
    return found
