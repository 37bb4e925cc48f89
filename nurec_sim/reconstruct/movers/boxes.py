"""From the points of a moving object over time to a track: its box, its label and the path of its centre.

An object is seen from one side. Its box has the largest extent that was seen, or the least size of its kind, and lies
behind the surface that faces the recording car.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.types import Matrix4, Track, Trajectory

STANDING_MPS = 0.5
"""Slower objects are static; their heading is the longer side of what was seen."""
EXTENT = (0.05, 0.95)
"""Quantiles of the points that count as the ends of an object."""
BEST_VIEW = 0.8
"""Quantile, over the instants, of what was seen of an object's length, width or height that counts as its own."""
LEAST_M: Mapping[str, tuple[float, float, float]] = {
    "person": (0.5, 0.5, 1.5),
    "rider": (1.6, 0.6, 1.5),
    "automobile": (4.2, 1.7, 1.4),
    "heavy_truck": (6.0, 2.2, 2.6),
}
"""Length, width and height that objects of a label have at least."""


@dataclass(frozen=True)
class Sighting:
    """Where the points of an object are at one instant, and how they move."""

    t_us: int
    position_m: Float64[np.ndarray, "n 3"]
    velocity_mps: Float64[np.ndarray, "n 3"]


def track_of(name: str, sightings: Sequence[Sighting], ego: Trajectory) -> Track:
    """A track of constant size from the first to the last sighting; one pose if the object is static.

    Args:
        name: id of the track.
        sightings: at increasing times.
        ego: poses of the recording car.
    """
    times = np.array([sighting.t_us for sighting in sightings])
    count = np.array([len(sighting.position_m) for sighting in sightings])
    velocity = np.stack([np.median(sighting.velocity_mps, axis=0) for sighting in sightings])
    velocity = _steadied(velocity, np.zeros_like(velocity), times, count)
    speed = np.linalg.norm(velocity[:, :2], axis=1)
    standing = bool(np.median(speed) < STANDING_MPS)
    if standing:
        everything = np.concatenate([sighting.position_m for sighting in sightings])
        yaw, clouds, velocity = np.array([_long_side(everything[:, :2])]), [everything], np.zeros((1, 3))
        times, count = np.array([(times[0] + times[-1]) // 2]), np.array([len(everything)])
    else:
        # Velocity gives the heading; a box that turned with the visible points would swing as the view of it changes.
        yaw, clouds = _headings(velocity, speed), [sighting.position_m for sighting in sightings]
    box_from_world = [geometry.rotation_from_yaw(-angle) for angle in yaw]
    seen = [np.quantile(xyz @ turn.T, EXTENT, axis=0) for xyz, turn in zip(clouds, box_from_world, strict=True)]
    low, high = np.stack([ends[0] for ends in seen]), np.stack([ends[1] for ends in seen])
    extent = np.quantile(high - low, BEST_VIEW, axis=0)
    label = _label(extent, float(np.median(speed)))
    size = np.maximum(extent, LEAST_M[label])
    # Only the side that faces the car is seen, and its extent is too small: the box begins at the visible face and
    # extends away from the car.
    eye = np.stack([turn @ at for turn, at in zip(box_from_world, ego.at(times)[:, :3, 3], strict=True)])
    middle = np.where(eye < low, low + size / 2, np.where(eye > high, high - size / 2, (low + high) / 2))
    middle[:, 2] = low[:, 2] + size[2] / 2  # nothing floats over the road because its roof was seen best
    centre = np.stack([turn.T @ at for turn, at in zip(box_from_world, middle, strict=True)])
    centre = _steadied(centre, velocity, times, count)
    poses = np.stack([geometry.pose(turn.T, at) for turn, at in zip(box_from_world, centre, strict=True)])
    length, width, height = map(float, size)
    return Track(name, label, (length, width, height), Trajectory(times, poses))


def lengthened(path: Trajectory, life_us: tuple[int, int]) -> Trajectory:
    """The path, extrapolated straight to the first and the last time of a life where these lie beyond its ends."""
    times, poses = path.t_us, path.world_from_body
    first, last = min(life_us[0], times[0]), max(life_us[1], times[-1])
    keep = np.concatenate([[first < times[0]], np.ones(len(times), bool), [last > times[-1]]])
    all_poses = np.concatenate([[_beyond(path, 0, 1, first)], poses, [_beyond(path, -1, -2, last)]])
    return Trajectory(np.concatenate([[first], times, [last]])[keep], all_poses[keep])


def _beyond(path: Trajectory, end: int, neighbour: int, t_us: int) -> Matrix4:
    """The pose at an end of a path moved on as it moves between there and the pose beside it."""
    pose = path.world_from_body[end].copy()
    if len(path.t_us) > 1:
        step = path.position_m[end] - path.position_m[neighbour]
        pose[:3, 3] += step * (int(t_us - path.t_us[end]) / int(path.t_us[end] - path.t_us[neighbour]))
    return pose


def _steadied(
    value: Float64[np.ndarray, "t 3"],
    rate: Float64[np.ndarray, "t 3"],
    times: Int64[np.ndarray, " t"],
    count: Int64[np.ndarray, " t"],
) -> Float64[np.ndarray, "t 3"]:
    """Each value averaged with the two before and the two after, extrapolated by their own rate of change.

    Values weigh as the points that they rest on, and less the more sightings lie between.
    """
    number = np.arange(len(times))
    weight = np.maximum(1 - np.abs(number[:, None] - number) / 3, 0) * count
    passed_s = (times[:, None] - times) / 1e6
    predicted = value + (rate[:, None] + rate) / 2 * passed_s[..., None]
    return np.einsum("ij,ijk->ik", weight / weight.sum(axis=1, keepdims=True), predicted)


def _headings(velocity: Float64[np.ndarray, "t 3"], speed: Float64[np.ndarray, " t"]) -> Float64[np.ndarray, " t"]:
    """Direction of motion; where an object stops for a while that of the instant nearest in time at which it moves."""
    moving = np.flatnonzero(speed >= STANDING_MPS)
    nearest = moving[np.argmin(np.abs(np.arange(len(speed))[:, None] - moving), axis=1)]
    return np.arctan2(velocity[nearest, 1], velocity[nearest, 0])


def _long_side(xy: Float64[np.ndarray, "n 2"]) -> float:
    """Angle of the direction in which points spread most, in -pi/2..pi/2."""
    _, axes = np.linalg.eigh(np.cov(xy.T))
    along = axes[:, 1] if axes[0, 1] >= 0 else -axes[:, 1]
    return float(np.arctan2(along[1], along[0]))


def _label(extent: Float64[np.ndarray, " 3"], speed_mps: float) -> str:
    """What an object of this size and speed most likely is (one of ``MOVABLE_LABELS``)."""
    length, width, height = extent
    if max(length, width) < 1.3 and height < 2.3:
        return "person" if speed_mps < 3.5 else "rider"
    if length < 2.6 and width < 1.2 and height < 2.3:
        return "rider"
    return "heavy_truck" if height > 2.7 or max(length, width) > 7.0 else "automobile"
