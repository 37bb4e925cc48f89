"""A small hand-made scene for the tests of the wire: a road, a wall with a pattern, one parked and one moving car."""

from __future__ import annotations

import numpy as np

from nurec_sim import geometry
from nurec_sim.lenses import Fisheye, FTheta, FThetaReference, Pinhole
from nurec_sim.types import (
    CameraModel,
    DynamicGaussians,
    Gaussians,
    GaussianScene,
    Label,
    LidarModel,
    Rig,
    SensorRequest,
    Shutter,
    Track,
    Trajectory,
)

START_US, LAST_US = 5_000_000, 7_000_000
CAMERA_AXES = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # columns: x right, y down, z forward in the rig


def rig() -> Rig:
    mounting = geometry.pose(CAMERA_AXES, np.array([1.6, 0.02, 1.5]))
    front = CameraModel("front", 320, 180, Pinhole(260.0, 255.0, 161.3, 88.7), mounting, Shutter.TOP_TO_BOTTOM)
    wide = CameraModel(
        "wide",
        160,
        100,
        FTheta(80.2, 49.6, FThetaReference.ANGLE_TO_PIXELDIST, (), (0.0, 90.0, 0.0, -3.0), 1.3),
        mounting,
    )
    left = geometry.pose(geometry.rotation_from_yaw(np.pi / 2) @ CAMERA_AXES, np.array([1.2, 0.8, 1.4]))
    fish = CameraModel("fish", 120, 90, Fisheye(60.0, 60.0, 60.0, 45.0, (0.01, 0.0, 0.0, 0.0), 1.4), left)
    roof = LidarModel(
        "roof",
        np.radians(np.linspace(5, -20, 16)),
        np.radians(np.linspace(180, -180, 180, endpoint=False)),
        np.radians(np.linspace(-0.3, 0.4, 16)),
        geometry.pose(np.eye(3), np.array([1.0, 0.0, 1.9])),
    )
    return Rig({camera.id: camera for camera in (front, wide, fish)}, {"roof": roof})


def ego() -> Trajectory:
    t_us = np.arange(START_US, LAST_US + 1, 100_000)
    x = 8e-6 * (t_us - START_US)
    return Trajectory(t_us, np.stack([geometry.pose_from_xyyaw(v, 0.1 * v, 0.02 * v) for v in x]))


def _blobs(xyz: np.ndarray, rgb: np.ndarray, scale_m: float, label: Label) -> Gaussians:
    n = len(xyz)
    blobs = Gaussians.empty(n)
    return Gaussians(
        xyz.astype(np.float32),
        blobs.quat_wxyz,
        np.full((n, 3), scale_m, np.float32),
        np.full(n, 0.9, np.float32),
        rgb.astype(np.float32),
        blobs.normal,
        np.full(n, label, np.uint8),
        np.linspace(0.1, 0.9, n, dtype=np.float32),
    )


def scene(scene_id: str = "street", *, seed: int = 0) -> GaussianScene:
    random = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(-5, 40, 1.5), np.arange(-6, 6.1, 1.5))
    road = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    u, z = np.meshgrid(np.arange(-12, 12, 1.0), np.arange(0.5, 6, 1.0))
    wall = np.stack([np.full(u.size, 35.0), u.ravel(), z.ravel()], 1)
    parked = np.array([14.0, 3.5, 0.8]) + random.uniform(-0.9, 0.9, (40, 3)) * (2, 0.8, 0.7)
    static = Gaussians.concatenate(
        [
            _blobs(road, np.full((len(road), 3), 0.35), 0.7, Label.ROAD),
            _blobs(wall, random.uniform((0.4, 0.45, 0.1), (0.8, 0.9, 0.4), (len(wall), 3)), 0.5, Label.OTHER),
            _blobs(parked, np.tile([0.1, 0.2, 0.8], (40, 1)), 0.3, Label.MOVABLE),
        ]
    )
    times = np.array([START_US, (START_US + LAST_US) // 2, LAST_US])
    path = np.stack([geometry.pose_from_xyyaw(12 + 4 * i, -2.0, 0.0, 0.8) for i in range(3)])
    local = random.uniform(-0.9, 0.9, (60, 3)) * (2, 0.8, 0.7)
    knots = np.stack([geometry.transform_points(pose, local) for pose in path], axis=1)
    moving = _blobs(knots[:, 1], np.tile([0.9, 0.1, 0.1], (60, 1)), 0.3, Label.MOVABLE)
    dynamic = DynamicGaussians(moving, np.tile(times, (60, 1)), knots.astype(np.float32), np.zeros(60, np.int32))
    sky = np.zeros((6, 8, 8, 3), np.float32) + np.array([0.5, 0.7, 0.95], np.float32)
    tint = np.array([[0.9, 0.05, 0, 0.02], [0, 0.95, 0, 0.0], [0.03, 0, 1.05, -0.01]])
    still = Trajectory(np.array([START_US, LAST_US]), np.tile(geometry.pose_from_xyyaw(14, 3.5, 0.0, 0.8), (2, 1, 1)))
    tracks = (
        Track("car-1", "automobile", (4.4, 1.8, 1.6), Trajectory(times, path)),
        Track("parked-1", "automobile", (4.4, 1.8, 1.6), still, controllable=False),
    )
    return GaussianScene(
        scene_id, static, dynamic, sky, {"front": tint}, rig(), ego(), tracks, None, (START_US, LAST_US + 1)
    )


def camera_request(camera_id: str = "front", t_us: int = 5_500_000, *, actors=None, scene_id: str = "street"):
    camera = rig().cameras[camera_id]
    poses = ego().at(np.array([t_us, t_us + 30_000])) @ camera.rig_from_camera
    return SensorRequest(scene_id, camera, t_us, t_us + 30_000, poses, actors or {})


def lidar_request(t_us: int = 5_500_000, *, scene_id: str = "street"):
    lidar = rig().lidars["roof"]
    poses = ego().at(np.array([t_us, t_us + 100_000])) @ lidar.rig_from_lidar
    return SensorRequest(scene_id, lidar, t_us, t_us + 100_000, poses)
