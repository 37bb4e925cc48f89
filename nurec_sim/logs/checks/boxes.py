"""Checks that labelled boxes contain LiDAR points, and whether another interpretation of them would contain more."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from nurec_sim import geometry
from nurec_sim.logs.checks.measure import Measure
from nurec_sim.logs.checks.sampling import Points, SampledSweep, point_of_view, pose_at
from nurec_sim.logs.clip import Clip
from nurec_sim.types import Matrix4

NEAREST_M, FURTHEST_M = 3.0, 70.0
MARGIN_M = 0.1
AROUND_M = 2.0
OVER_GROUND_M = 0.25
LOWEST_SHARE = 0.05
"""The ground height around a box is this quantile of the nearby points' heights; no plane, as roads rise and fall."""
FEWEST_POINTS = 3
ENOUGH_POINTS = 8
INNER = 0.6
FEWEST_BOXES = 4
LEAST_SHARE = 0.5
CLEAR_GAIN, CLEAR_ERRORS = 0.1, 2.5
TELLING_SHARE = 0.2
"""Random boxes contain points by chance: at least this fraction of all must support another interpretation."""

Size = tuple[float, float, float]
Reading = Callable[[Matrix4, Size, Matrix4], tuple[Matrix4, Size]]


def _raised(share: float) -> Reading:
    def read(rig_from_box: Matrix4, size: Size, world_from_rig: Matrix4) -> tuple[Matrix4, Size]:
        return rig_from_box @ geometry.pose(np.eye(3), np.array([0.0, 0.0, share * size[2]])), size

    return read


READINGS: dict[str, Reading] = {
    "half a height higher: their poses seem to be those of the middle of the bottom, not of the centre": _raised(0.5),
    "half a height lower: their poses seem to be those of the middle of the top, not of the centre": _raised(-0.5),
    "with length and width exchanged": lambda box, size, _: (box, (size[1], size[0], size[2])),
    "as poses in the ego frame, which the clip takes for poses in the world": lambda box, size, ego: (ego @ box, size),
    "as poses in the world, to which the ego's pose was applied once more": lambda box, size, ego: (
        geometry.inverse(ego) @ box, size),
}  # fmt: skip
"""Alternative interpretations of a box (from its pose in the rig, its size, the ego's pose), by their meaning."""


@dataclass(frozen=True)
class _Box:
    """Number of points in a box as given and in each alternative, and of rays that cross its middle."""

    held: int
    crossed: int
    otherwise: tuple[int, ...]


def check_boxes(clip: Clip, sweeps: Sequence[SampledSweep]) -> list[Measure]:
    """Fraction of the visible boxes that contain points; empty if a log has no boxes or no LiDAR.

    A box counts if it is 3 to 70 m away and contains at least 3 points above the ground, or if a ray passes through its
    middle and returns from behind: then it is empty. Any other box is occluded and does not count.
    """
    if not clip.tracks or not sweeps:
        return []
    boxes = [box for each in sweeps for box in _looked_at(clip, each)]
    held = sum(box.held >= FEWEST_POINTS for box in boxes)
    seen = held + sum(box.held < FEWEST_POINTS and box.crossed > 0 for box in boxes)
    what = "boxes that hold LiDAR points"
    better = max((_better(boxes, number, name) for number, name in enumerate(READINGS)), key=lambda found: found[0])
    faults = [better[1]] if better[1] else []
    if seen < FEWEST_BOXES:
        return [Measure(what, f"cannot tell: {seen} boxes in sight within {FURTHEST_M:g} m", tuple(faults))]
    if held < LEAST_SHARE * seen and not faults:
        faults = [
            f"boxes: {seen - held} of {seen} boxes in sight within {FURTHEST_M:g} m hold no LiDAR points; "
            "their frame, their times or the LiDAR's pose is wrong"
        ]
    return [Measure(what, f"{held / seen:.0%} of {seen} in sight within {FURTHEST_M:g} m", tuple(faults))]


def _better(boxes: Sequence[_Box], number: int, name: str) -> tuple[float, str]:
    """Relative gain of points in an alternative, -1 to 1, and the fault; empty unless the gain is significant."""
    pairs = np.array([(box.held, box.otherwise[number]) for box in boxes], np.float64).reshape(-1, 2)
    pairs = pairs[pairs.sum(axis=1) >= ENOUGH_POINTS]
    if len(pairs) < max(FEWEST_BOXES, TELLING_SHARE * len(boxes)):
        return -1.0, ""
    # Per box, so that near boxes with thousands of points do not dominate.
    gains = (pairs[:, 1] - pairs[:, 0]) / pairs.sum(axis=1)
    gain = float(gains.mean())
    # Both large and significant: the mean must exceed some standard errors of itself.
    if gain < max(CLEAR_GAIN, CLEAR_ERRORS * gains.std(ddof=1) / np.sqrt(len(gains))):
        return -1.0, ""
    given, other = np.median(pairs, axis=0)
    return gain, f"boxes: they hold more LiDAR points (median {other:.0f} against {given:.0f}) if they are read {name}"


def _looked_at(clip: Clip, each: SampledSweep) -> Iterator[_Box]:
    """The boxes within range at the time of a sweep."""
    standing = _Standing(each.rig_m)
    origin = point_of_view(clip, clip.rig.lidars[each.lidar_id])
    rig_from_world = geometry.inverse(each.world_from_rig)
    for track in clip.tracks:
        world_from_box = pose_at(track, each.sweep.t_us)
        if world_from_box is None:
            continue
        box = rig_from_world @ world_from_box
        others = [read(box, track.size_m, each.world_from_rig) for read in READINGS.values()]
        counted = [NEAREST_M < np.linalg.norm(pose[:3, 3] - origin) < FURTHEST_M for pose, _ in [(box, None), *others]]
        if not any(counted):
            continue
        held = standing.held(box, track.size_m) if counted[0] else 0
        crossed = _crossing(each.rig_m, origin, box, track.size_m) if counted[0] and held < FEWEST_POINTS else 0
        yield _Box(held, crossed, tuple(standing.held(*other) for other in others))


class _Standing:
    """Points above the ground, indexed by their horizontal position."""

    def __init__(self, points: Points) -> None:
        self._points = points
        self._tree = cKDTree(points[:, :2])

    def held(self, rig_from_box: Matrix4, size: Size) -> int:
        """Number of points in a box, without those on the ground around it."""
        near = self._points[self._tree.query_ball_point(rig_from_box[:2, 3], np.linalg.norm(size) / 2 + AROUND_M)]
        if len(near) == 0:
            return 0
        standing = near[near[:, 2] > np.quantile(near[:, 2], LOWEST_SHARE) + OVER_GROUND_M]
        local = geometry.transform_points(geometry.inverse(rig_from_box), standing)
        return int(geometry.points_in_box(local, size, MARGIN_M).sum())


def _crossing(points: Points, origin: Float64[np.ndarray, " 3"], rig_from_box: Matrix4, size: Size) -> int:
    """Number of LiDAR rays that pass through the middle of a box and end behind it."""
    centre = rig_from_box[:3, 3] - origin
    ray = points - origin
    distance = np.linalg.norm(centre)
    cosine = ray @ centre / (np.linalg.norm(ray, axis=1) * distance + 1e-12)
    # A cone around the box discards most rays before the exact test.
    near = cosine > np.cos(np.arctan(np.linalg.norm(size) / distance))
    box_from_rig = geometry.inverse(rig_from_box)
    start = geometry.transform_points(box_from_rig, origin)
    ray = geometry.transform_points(box_from_rig, points[near]) - start
    half = INNER * np.asarray(size) / 2
    # Slab test (Kay and Kajiya 1986): a ray is inside between its last entry and its first exit.
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-half - start) / ray, (half - start) / ray
    enter, leave = np.fmin(first, second).max(axis=1), np.fmax(first, second).min(axis=1)
    # Parameter 0 is the LiDAR, 1 the measured point: both must be outside, on either side.
    return int(((enter < leave) & (enter > 0) & (leave < 1)).sum())
