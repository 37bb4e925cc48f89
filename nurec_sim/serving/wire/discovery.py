"""What discovery tells of a scene <-> messages: sensors with their place in the rig, trajectories, tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nurec_sim.errors import RequestError
from nurec_sim.serving.wire.requests import read_mounting, read_poses, write_mounting, write_poses
from nurec_sim.serving.wire.sensor_specs import read_camera, read_lidar, write_camera, write_lidar
from nurec_sim.types import CameraModel, LidarModel, Track, Trajectory


def write_available_camera(camera: CameraModel, message) -> None:
    """Fills an ``AvailableCamera`` message."""
    message.logical_id = camera.id
    write_camera(camera, message.intrinsics)
    write_mounting(camera.rig_from_camera, message.rig_to_camera)


def read_available_camera(message) -> CameraModel:
    """The camera of an ``AvailableCamera`` message.

    Raises:
        RequestError: its intrinsics or its pose are malformed.
    """
    mounting = read_mounting(message.rig_to_camera, "rig_to_camera")
    return replace(read_camera(message.intrinsics, 0, 0, {}), id=message.logical_id, rig_from_camera=mounting)


def write_available_lidar(lidar: LidarModel, message) -> None:
    """Fills an ``AvailableLidar`` message."""
    message.logical_id = lidar.id
    write_lidar(lidar, message.lidar_config)
    write_mounting(lidar.rig_from_lidar, message.rig_from_lidar)


def read_available_lidar(message) -> LidarModel:
    """The LiDAR of an ``AvailableLidar`` message.

    Raises:
        RequestError: its beams or its pose are malformed.
    """
    mounting = read_mounting(message.rig_from_lidar, "rig_from_lidar")
    return replace(read_lidar(message.lidar_config), id=message.logical_id, rig_from_lidar=mounting)


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
