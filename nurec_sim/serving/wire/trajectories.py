"""Trajectories and tracks <-> messages."""

from __future__ import annotations

import numpy as np

from nurec_sim.errors import RequestError
from nurec_sim.serving.wire.requests import read_poses, write_poses
from nurec_sim.types import Track, Trajectory


def write_trajectory(trajectory: Trajectory, message) -> None:
    """Fills a ``common.Trajectory`` message."""
    samples = [message.poses.add(timestamp_us=t) for t in trajectory.t_us.tolist()]
    write_poses(trajectory.world_from_body, [sample.pose for sample in samples])


def read_trajectory(message, name: str) -> Trajectory:
    """The trajectory of a ``common.Trajectory`` message.

    Raises:
        RequestError: it is empty, a pose is malformed, or times do not increase.
    """
    poses = read_poses([s.pose for s in message.poses], [f"{name}[{i}]" for i in range(len(message.poses))])
    try:
        return Trajectory(np.array([s.timestamp_us for s in message.poses], np.int64), poses)
    except (ValueError, OverflowError) as error:
        raise RequestError(f"{name}: {error}") from error


def write_track(track: Track, message) -> None:
    """Fills a ``DynamicObjectTrack`` message."""
    message.id, message.semantic_class, message.asset_id = track.id, track.label, track.id
    message.object_size.size_x, message.object_size.size_y, message.object_size.size_z = track.size_m
    write_trajectory(track.path, message.trajectory)


def read_track(message) -> Track:
    """The track of a ``DynamicObjectTrack`` message.

    Raises:
        RequestError: its trajectory is malformed.
    """
    size = message.object_size
    path = read_trajectory(message.trajectory, f"track {message.id!r}")
    return Track(message.id, message.semantic_class, (size.size_x, size.size_y, size.size_z), path)
