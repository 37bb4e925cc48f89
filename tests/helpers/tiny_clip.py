"""A small clip with every kind of lens, one LiDAR, two tracks and a map, for tests of logs."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nurec_sim import geometry, logs, sensors
from nurec_sim.types import (
    Box,
    CameraModel,
    Fisheye,
    FTheta,
    FThetaReference,
    Pinhole,
    Rig,
    RoadMap,
    Shutter,
    Sweep,
    Track,
    Trajectory,
    Windshield,
    WindshieldReference,
)

FRAMES = 3
START_US = 2_000_000
STEP_US = 100_000
FORWARD = np.array([[0.0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.4], [0, 0, 0, 1]])
TURN = geometry.pose(geometry.rotation_from_yaw(0.4), np.array([0.2, 0.3, 0.0]))


def rig() -> Rig:
    glass = Windshield(WindshieldReference.FORWARD, (0.001, 1.01, 0.002), (0.0, 0.001, 0.99))
    ftheta = FTheta(
        32.0, 24.0, FThetaReference.PIXELDIST_TO_ANGLE, (0.0, 0.02, 1e-6), (), 1.3, linear_cde=(1.01, 0.002, 0.001)
    )
    pinhole = Pinhole(60.0, 61.0, 32.5, 24.5, (-0.1, 0.01, 0, 0, 0, 0), (0.001, 0.002), (0.001, 0, 0, 0))
    cameras = {
        "front": CameraModel("front", 64, 48, pinhole, FORWARD, Shutter.TOP_TO_BOTTOM),
        "left": CameraModel("left", 64, 48, Fisheye(30, 30, 32, 24, (0.01, 0, 0, 0), 1.4), TURN @ FORWARD),
        "wide": CameraModel("wide", 64, 48, ftheta, FORWARD, Shutter.LEFT_TO_RIGHT, glass),
    }
    top = sensors.lidar_model("VLP-16", geometry.pose(np.eye(3), np.array([1.2, 0.0, 1.8])), id="top", columns=90)
    return Rig(cameras, {"top": top}, Box((1.3, 0.0, 0.8), (4.6, 1.8, 1.6)))


def ego() -> Trajectory:
    """Poses at 20 Hz of a car in a gentle left turn."""
    seconds = np.arange(2 * FRAMES + 1) * 0.05
    poses = [geometry.pose_from_xyyaw(10 * s, 2 * s**2, 0.4 * s, z=0.01) for s in seconds]
    return Trajectory(START_US + np.rint(seconds * 1e6).astype(np.int64), np.array(poses))


def image(camera_id: str, index: int) -> np.ndarray:
    """Smooth, and different for every camera and frame."""
    rows, columns = np.indices((48, 64))
    seed = 40 * index + 15 * len(camera_id)
    return np.stack([rows * 4 + seed, columns * 3 + seed, 0 * rows + seed], axis=-1).astype(np.uint8)


def sweep(index: int) -> Sweep:
    """Returns from a cylinder around the car, in whole millimetres."""
    lidar = rig().lidars["top"]
    directions = sensors.beam_directions(lidar).reshape(-1, 3)
    xyz = np.rint(directions * (12.0 + index) * 1000) / 1000
    start_us = START_US + index * STEP_US
    fired = np.tile(sensors.column_fraction(lidar), len(lidar.elevation_rad))
    return Sweep(
        t_us=start_us + STEP_US,
        start_us=start_us,
        end_us=start_us + STEP_US,
        world_from_lidar=ego().at(start_us + STEP_US) @ lidar.rig_from_lidar,
        xyz_m=xyz,
        intensity=(np.arange(len(xyz)) % 256 / 255).astype(np.float32),
        point_t_us=start_us + np.rint(fired * STEP_US).astype(np.int64),
    )


def frames() -> Iterator[logs.CameraEntry | logs.LidarEntry]:
    for index in range(FRAMES):
        t_us = START_US + index * STEP_US
        for name in rig().cameras:
            yield logs.CameraEntry(name, t_us, t_us + 20_000, image(name, index))
        yield logs.LidarEntry("top", sweep(index))


def tracks() -> list[Track]:
    car = [geometry.pose_from_xyyaw(20 + index, 3, 0.1, z=0.7) for index in range(FRAMES)]
    times = START_US + STEP_US * np.arange(FRAMES)
    cone = Trajectory(np.array([START_US]), geometry.pose_from_xyyaw(8, -2, 0, z=0.3)[None])
    return [
        Track("7", "automobile", (4.5, 1.9, 1.5), Trajectory(times, np.array(car))),
        Track("cone", "traffic_cone", (0.3, 0.3, 0.6), cone, controllable=False),
    ]


def road_map() -> RoadMap:
    outer = np.array([[-10.0, -4], [60, -4], [60, 4], [-10, 4]])
    hole = np.array([[30.0, 0], [31, 0], [31, 1]])
    return RoadMap(((outer, hole),), (np.array([[-10.0, 2, 0], [60, 2, 0.5]]),))


def write(path: Path, **changes) -> Path:
    """Write the clip; ``changes`` replace arguments of ``write_clip``."""
    arguments = {
        "id": "tiny",
        "rig": rig(),
        "ego": ego(),
        "frames": frames(),
        "tracks": tracks(),
        "road_map": road_map(),
        "facts": {"licence": "none", "seed": 3},
        "jpeg_quality": None,
    }
    return logs.write_clip(path, **{**arguments, **changes})


def moved(entry: logs.LidarEntry, world_from_lidar: np.ndarray) -> logs.LidarEntry:
    """The same sweep at another pose."""
    return dataclasses.replace(entry, sweep=dataclasses.replace(entry.sweep, world_from_lidar=world_from_lidar))
