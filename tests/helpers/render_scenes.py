"""Small scenes and requests for the renderer's tests."""

from __future__ import annotations

import dataclasses

import numpy as np

from nurec_sim import geometry, sensors
from nurec_sim.lenses import Fisheye, FTheta, FThetaReference, Pinhole
from nurec_sim.types import (
    LIDAR_SECTORS,
    CameraModel,
    DynamicGaussians,
    Gaussians,
    GaussianScene,
    Rig,
    SensorRequest,
    Shutter,
    Spin,
    Track,
    Trajectory,
)

START_US = 1_000_000
CAMERA_AXES = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""rig_from_camera of a camera that looks forward."""
LENSES = {
    "pinhole": Pinhole(47.0, 49.0, 35.0, 25.0),
    "wide pinhole": Pinhole(20.0, 20.0, 36.0, 24.0),
    "distorted": Pinhole(47.0, 47.0, 36.0, 24.0, (-0.2, 0.05, 0, 0, 0, 0), (0.002, -0.003), (0.001, 0, 0.002, 0)),
    "fisheye": Fisheye(24.0, 24.0, 36.0, 24.0, (0.02, -0.005, 0, 0), max_angle_rad=1.7),
    "f-theta": FTheta(36.0, 24.0, FThetaReference.PIXELDIST_TO_ANGLE, (0.0, 0.04, 0.0, 2e-6), max_angle_rad=1.6),
}
"""Every kind of lens, for ``camera()``'s 72 x 48 pixels."""
LIDARS = {
    "full": sensors.lidar_model("VLP-16", np.eye(4), columns=240),
    "sector": sensors.lidar_model("AT128", np.eye(4), columns=100),
    "offsets": dataclasses.replace(
        sensors.lidar_model("HDL-32", np.eye(4), columns=200), row_azimuth_offset_rad=np.tile([0.07, -0.05], 16)
    ),
    "other way": dataclasses.replace(
        sensors.lidar_model("HDL-32", np.eye(4), columns=200),
        azimuth_rad=np.linspace(-1, 2 * np.pi - 1, 200, endpoint=False),
        spin=Spin.COUNTERCLOCKWISE,
    ),
    "blocked": dataclasses.replace(
        sensors.lidar_model("VLP-16", np.eye(4), columns=240),
        blocked=np.arange(9 * LIDAR_SECTORS + 60, 11 * LIDAR_SECTORS),
    ),
    "sector with offsets": dataclasses.replace(
        sensors.lidar_model("AT128", np.eye(4), columns=100), row_azimuth_offset_rad=np.tile([0.02, -0.03], 64)
    ),
}
"""Spinning LiDARs of all kinds: full turns and sectors, either way round, rows with offsets, blocked beams."""


def gaussians(mean, scale=0.1, opacity=0.9, rgb=(0.5, 0.5, 0.5), label=0, intensity=np.nan, quat=(1, 0, 0, 0)):
    """Gaussians from values that are broadcast to the number of means."""
    mean = np.atleast_2d(np.asarray(mean, np.float32))
    n = len(mean)

    def full(value, *shape):
        return np.broadcast_to(np.asarray(value, np.float32), (n, *shape)).copy()

    return Gaussians(
        mean_m=mean,
        quat_wxyz=full(quat, 4),
        scale_m=full(scale, 3) if np.ndim(scale) != 1 else np.broadcast_to(np.float32(scale), (n, 3)).copy(),
        opacity=full(opacity),
        rgb=full(rgb, 3),
        normal=np.zeros((n, 3), np.float32),
        label=full(label).astype(np.uint8),
        intensity=full(intensity),
    )


def row_of_walls(distances_m, **kwargs):
    """Wide discs across the x axis, 1 mm thick."""
    return gaussians([[x, 0, 0] for x in distances_m], scale=(0.001, 50.0, 50.0), **kwargs)


def cloud(n=250, seed=0, low=(-8, -8, -3), high=(14, 8, 4), sh=0, drop=False):
    """Random Gaussians around and in front of the origin: flat, large, over the camera plane; some without a normal."""
    rng = np.random.default_rng(seed)
    scale = np.exp(rng.uniform(np.log(0.02), np.log(0.8), (n, 3)))
    scale[rng.random(n) < 0.3, 2] = 0.004
    result = gaussians(rng.uniform(low, high, (n, 3)), scale=0.1)
    normal = np.random.default_rng(seed + 1).normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[::5] = 0
    return dataclasses.replace(
        result,
        quat_wxyz=rng.normal(size=(n, 4)).astype(np.float32),
        scale_m=scale.astype(np.float32),
        opacity=rng.uniform(0.02, 1.0, n).astype(np.float32),
        rgb=rng.random((n, 3)).astype(np.float32),
        normal=normal.astype(np.float32),
        label=rng.integers(0, 3, n).astype(np.uint8),
        intensity=np.where(rng.random(n) < 0.2, np.nan, rng.random(n)).astype(np.float32),
        sh_rest=rng.normal(0, 0.15, (n, sh, 3)).astype(np.float32) if sh else None,
        ray_drop=np.random.default_rng(seed + 2).random(n).astype(np.float32) if drop else None,
        falloff=np.random.default_rng(seed + 3).random(n).astype(np.float32) if drop else None,
    )


def scene(static=None, dynamic=None, tracks=(), sky=0.5, isp=None, span_us=(START_US, 2_000_000)):
    """A scene without sensors of its own; ``sky`` is one grey or a cubemap."""
    cubemap = np.full((6, 2, 2, 3), sky, np.float32) if np.ndim(sky) == 0 else np.asarray(sky, np.float32)
    return GaussianScene(
        id="test",
        static=Gaussians.empty() if static is None else static,
        dynamic=DynamicGaussians.empty() if dynamic is None else dynamic,
        sky=cubemap,
        isp={} if isp is None else isp,
        rig=Rig({}, {}),
        ego=Trajectory(np.array([START_US]), np.eye(4)[None]),
        tracks=list(tracks),
        road_map=None,
        span_us=span_us,
    )


def camera(width=72, height=48, lens=None, shutter=Shutter.GLOBAL, id="front", **kwargs):
    """A camera of about 75 degrees."""
    lens = lens or Pinhole(width * 0.65, width * 0.65, width / 2, height / 2)
    return CameraModel(id, width, height, lens, CAMERA_AXES, shutter, **kwargs)


def request(sensor, start_from_rig=None, end_from_rig=None, start_us=START_US, end_us=START_US + 30_000, actors=None):
    """A request from rig poses; LiDARs and cameras alike sit at the rig's origin."""
    first = np.eye(4) if start_from_rig is None else start_from_rig
    last = first if end_from_rig is None else end_from_rig
    mount = sensor.rig_from_camera if isinstance(sensor, CameraModel) else sensor.rig_from_lidar
    return SensorRequest("test", sensor, start_us, end_us, np.stack([first @ mount, last @ mount]), actors or {})


def moved(yaw=0.05, x=0.5, y=0.1):
    """Where a car is a moment later."""
    return geometry.pose_from_xyyaw(x, y, yaw)


def moving_cloud(n=60, seed=5, track=0):
    """Dynamic Gaussians with three knots around ``START_US`` and the track they belong to."""
    rng = np.random.default_rng(seed)
    static = cloud(n, seed, low=(4, -2, -1), high=(8, 2, 1))
    middle = START_US + rng.integers(-80_000, 120_000, n)
    times = np.stack([middle - rng.integers(50_000, 200_000, n), middle, middle + rng.integers(50_000, 200_000, n)], 1)
    knots = static.mean_m[:, None] + rng.normal(0, 0.3, (n, 3, 3)).astype(np.float32)
    static = dataclasses.replace(static, mean_m=knots[:, 1])
    return DynamicGaussians(static, times, knots.astype(np.float32), np.full(n, track, np.int32))


def track(id="car"):
    """A car that drives forward at 10 m/s through (6, 0, 0)."""
    times = np.array([START_US - 500_000, START_US + 500_000])
    poses = np.stack([geometry.pose_from_xyyaw(1.0, 0, 0.2), geometry.pose_from_xyyaw(11.0, 0, 0.2)])
    return Track(id, "automobile", (4.5, 1.9, 1.6), Trajectory(times, poses))


def psnr_db(a, b):
    """Peak signal-to-noise ratio of two 8-bit images."""
    error = np.mean((np.asarray(a, np.float64) - np.asarray(b, np.float64)) ** 2)
    return np.inf if error == 0 else 10 * np.log10(255**2 / error)
