"""Points of a sweep that stand still: without those in boxes of what moves, and without the car itself."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim import geometry
from nurec_sim.compute.kernels import kernel
from nurec_sim.logs.clip import Clip
from nurec_sim.types import Sweep, Track

NEAREST_M, FURTHEST_M = 2.5, 80.0
MARGIN_M = 0.3
SLOWEST_MPS = 1.0
"""Boxes that are slower may be parked cars seen from recorded poses that drift."""
ALWAYS = ("person", "rider", "animal")

Points = Float64[np.ndarray, "n 3"]


def moving_tracks(clip: Clip) -> list[Track]:
    """Tracks whose boxes are left out: those that move, and people and animals, who may."""
    return [track for track in clip.tracks if track.label in ALWAYS or _speed_mps(track) > SLOWEST_MPS]


def _speed_mps(track: Track) -> float:
    """Largest mean speed over half a second or more."""
    seconds = (track.path.t_us - track.path.start_us) / 1e6
    place = track.path.position_m
    late = np.searchsorted(seconds, seconds + 0.5)
    early = np.flatnonzero(late < len(seconds))
    if not len(early):
        return 0.0
    late = late[early]
    return float((np.linalg.norm(place[late] - place[early], axis=1) / (seconds[late] - seconds[early])).max())


def static_points(clip: Clip, lidar_id: str, index: int, moving: Sequence[Track]) -> Points:
    """Points of a sweep in the rig frame at its time, motion compensated, without ``moving`` and the car itself."""
    keep, points = standing(clip, clip.sweep(lidar_id, index), moving)
    return points[keep]


def standing(clip: Clip, sweep: Sweep, moving: Sequence[Track]) -> tuple[Bool[np.ndarray, " n"], Points]:
    """Which points of a sweep are near and belong neither to ``moving`` nor the car, and all in the rig frame then."""
    world_from_rig = clip.ego.at(sweep.t_us)
    points = geometry.transform_points(geometry.inverse(world_from_rig) @ sweep.world_from_lidar, sweep.xyz_m)
    body = clip.rig.body
    keep = _near(points, np.asarray(body.center_m, np.float64), np.asarray(body.size_m) / 2 + MARGIN_M)
    for track in moving:
        if track.path.covers(sweep.t_us):
            box_from_rig = geometry.inverse(track.path.at(sweep.t_us)) @ world_from_rig
            reach = float(np.linalg.norm(np.asarray(track.size_m) / 2 + MARGIN_M)) + MARGIN_M
            # Most points are far from most boxes.
            beside = np.flatnonzero(_beside(points, keep, geometry.inverse(box_from_rig)[:3, 3], reach))
            local = geometry.transform_points(box_from_rig, points[beside])
            keep[beside] = ~geometry.points_in_box(local, track.size_m, MARGIN_M)
    return keep, points


@kernel
def _beside(points: np.ndarray, keep: np.ndarray, center: np.ndarray, reach: float) -> Bool[np.ndarray, " n"]:
    """Which of the points to keep lie in a cube around a place, whose sides are as far away as ``reach``."""
    found = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        off = max(abs(points[i, 0] - center[0]), abs(points[i, 1] - center[1]), abs(points[i, 2] - center[2]))
        found[i] = keep[i] and off <= reach
    return found


@kernel
def _near(points: np.ndarray, center: np.ndarray, half: np.ndarray) -> Bool[np.ndarray, " n"]:
    keep = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        x, y, z = points[i]
        distance = math.sqrt(x * x + y * y + z * z)
        inside = abs(x - center[0]) <= half[0] and abs(y - center[1]) <= half[1] and abs(z - center[2]) <= half[2]
        keep[i] = NEAREST_M < distance < FURTHEST_M and not inside
    return keep


def thinned(points: Points, cell_m: float) -> Points:
    """The first point in each cell of a grid, in the order of the points."""
    cells = np.floor(points / cell_m).astype(np.int64) + (1 << 20)
    # One number for each cell: sorting triples takes several times as long.
    _, first = np.unique((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2], return_index=True)
    return points[np.sort(first)]
