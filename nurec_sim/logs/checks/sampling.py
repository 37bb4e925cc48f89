"""The sample of a clip's sweeps used by the checks, in the rig frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.logs.clip import Clip
from nurec_sim.types import LidarModel, Matrix4, Sweep, Track

SWEEPS = 5
LOWEST_LIDAR_M = 0.5
SAME_TIME_US = 60_000

Points = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class SampledSweep:
    """One sweep with its points in the rig frame at its reference time, [n,3]."""

    lidar_id: str
    sweep: Sweep
    world_from_rig: Matrix4
    rig_m: Points


def sample_sweeps(clip: Clip) -> list[SampledSweep]:
    """Some sweeps of every LiDAR, evenly spaced; unreadable ones are skipped, as ``check_clip`` reports them."""
    found = []
    for name in clip.rig.lidars:
        for index in spread(clip.sweep_count(name), SWEEPS):
            try:
                sweep = clip.sweep(name, index)
            except ClipError:
                continue
            if len(sweep.xyz_m):
                pose = clip.ego.at(sweep.t_us)
                points = geometry.transform_points(geometry.inverse(pose) @ sweep.world_from_lidar, sweep.xyz_m)
                found.append(SampledSweep(name, sweep, pose, points))
    return found


def spread(count: int, most: int) -> list[int]:
    """At most ``most`` of the indices below ``count``, evenly spaced, including the first and the last."""
    return sorted({round(value) for value in np.linspace(0, count - 1, min(count, most))}) if count else []


def point_of_view(clip: Clip, lidar: LidarModel) -> Float64[np.ndarray, " 3"]:
    """Origin of the LiDAR's rays in the rig frame.

    A log that merges several LiDARs has its point clouds in the vehicle frame; the middle of the roof is used then.
    """
    origin = np.asarray(lidar.rig_from_lidar, np.float64)[:3, 3]
    if origin[2] >= LOWEST_LIDAR_M:
        return origin
    body = clip.rig.body
    return np.array([body.center_m[0], body.center_m[1], body.center_m[2] + body.size_m[2] / 2])


def pose_at(track: Track, t_us: int) -> Matrix4 | None:
    """A track's pose at a time within its path or close to one of its samples; None otherwise."""
    if np.abs(track.path.t_us - t_us).min() > SAME_TIME_US and not track.path.covers(t_us):
        return None
    return track.path.at(t_us)
