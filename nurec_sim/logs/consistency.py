"""Faults of a clip's tables: times that do not increase, poses with invalid rotations; reads no images or sweeps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from nurec_sim.logs.clip import Clip

EARLIEST_US = 1_000_000
ROTATION_TOLERANCE = 1e-3


def table_faults(clip: Clip) -> list[str]:
    """Faults of times and poses only; no image or sweep is read."""
    faults = list(_pose_faults("ego pose", clip.ego.world_from_body))
    for name in clip.rig.cameras:
        records = clip.image_records(name)
        faults += _time_faults(f"camera {name!r} frame", [record.start_us for record in records])
        for end in (0, 1):
            poses = np.array([record.world_from_camera[end] for record in records]).reshape(-1, 4, 4)
            faults += [fault for fault in _pose_faults(f"camera {name!r} frame", poses) if fault not in faults]
    for name in clip.rig.lidars:
        sweeps = clip.sweep_records(name)
        faults += _time_faults(f"LiDAR {name!r} sweep", [sweep.t_us for sweep in sweeps])
        poses = np.array([sweep.world_from_lidar for sweep in sweeps]).reshape(-1, 4, 4)
        faults += _pose_faults(f"LiDAR {name!r} sweep", poses)
    for track in clip.tracks:
        faults += _pose_faults(f"track {track.id!r} pose", track.path.world_from_body)
    return faults


def _time_faults(what: str, times: list[int]) -> Iterator[str]:
    for index in range(1, len(times)):
        if times[index] <= times[index - 1]:
            yield f"{what} {index}: time goes back or stands still, {times[index]} us after {times[index - 1]} us"


def _pose_faults(what: str, poses: Float64[np.ndarray, "n 4 4"]) -> Iterator[str]:
    rotations = poses[:, :3, :3]
    product = rotations @ np.swapaxes(rotations, 1, 2)
    error = np.abs(product - np.eye(3)).max(axis=(1, 2), initial=0.0)
    for index in np.flatnonzero((error > ROTATION_TOLERANCE) | (np.linalg.det(rotations) <= 0)):
        yield f"{what} {index}: the 3 x 3 part of the pose is not a rotation (off by {error[index]:.3g})"
