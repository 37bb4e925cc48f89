"""Memory of a renderer or a server that never stops: a moving mix of sensors, frame after frame.

``python benchmarks/soak.py [--frames 5000] [--direct]`` asks a sensor server in this process for cameras of every lens
and shutter and for LiDAR sweeps along a drive (``--direct``: the renderer itself), prints the resident memory every
500 frames, and ends with 1 if it has grown by more than 2 % since the warm-up. Linux only: it reads /proc.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import itertools
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nurec_sim import geometry, sensors
from nurec_sim.lenses import Fisheye, FTheta, FThetaReference, Pinhole
from nurec_sim.render import CpuRenderer
from nurec_sim.serving.client import RemoteSensors
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.types import (
    CameraModel,
    DynamicGaussians,
    Gaussians,
    GaussianScene,
    LidarModel,
    Rig,
    Sense,
    SensorRequest,
    Shutter,
    Track,
    Trajectory,
)

GAUSSIANS, MOVING = 30_000, 2_000
START_US, SPAN_US = 1_000_000, 10_000_000
CAMERA_AXES = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
WARM_UP = 200
"""Frames after which memory is first looked at: tables are made, buffers have reached their size."""
REPORT = 500
MOST_GROWTH = 0.02


def gaussian_cloud(n: int, low: tuple[float, ...], high: tuple[float, ...], seed: int) -> Gaussians:
    """Random Gaussians in a box."""
    rng = np.random.default_rng(seed)
    rest = rng.normal(0, 0.1, (n, 3, 3)).astype(np.float32)
    return Gaussians(
        mean_m=rng.uniform(low, high, (n, 3)).astype(np.float32),
        quat_wxyz=rng.normal(size=(n, 4)).astype(np.float32),
        scale_m=np.exp(rng.uniform(np.log(0.02), np.log(0.5), (n, 3))).astype(np.float32),
        opacity=rng.uniform(0.1, 1.0, n).astype(np.float32),
        rgb=rng.random((n, 3)).astype(np.float32),
        normal=np.zeros((n, 3), np.float32),
        label=rng.integers(0, 3, n).astype(np.uint8),
        intensity=rng.random(n).astype(np.float32),
        sh_rest=rest,
    )


def drive_scene() -> GaussianScene:
    """A seeded street along x with a car that drives ahead of the ego."""
    static = gaussian_cloud(GAUSSIANS, (-20, -15, -2), (120, 15, 6), 0)
    car = gaussian_cloud(MOVING, (10, -1, 0), (14, 1, 2), 1)
    ends = np.array([START_US, START_US + SPAN_US // 2, START_US + SPAN_US])
    knots = car.mean_m[:, None] + np.array([0, 30, 60], np.float32)[None, :, None] * np.float32([1, 0, 0])
    path = Trajectory(ends, np.stack([geometry.pose_from_xyyaw(12.0 + x, 0.0, 0.0, 1.0) for x in (0, 30, 60)]))
    ego = Trajectory(ends, np.stack([geometry.pose_from_xyyaw(float(x), 0.0, 0.0) for x in (0, 30, 60)]))
    return GaussianScene(
        id="soak",
        static=static,
        dynamic=DynamicGaussians(car, np.tile(ends, (MOVING, 1)), knots, np.zeros(MOVING, np.int32)),
        sky=np.full((6, 16, 16, 3), 0.7, np.float32),
        isp={},
        rig=Rig({}, {}),
        ego=ego,
        tracks=[Track("car", "automobile", (4.5, 1.9, 1.6), path)],
        road_map=None,
        span_us=(START_US, START_US + SPAN_US),
    )


def sensor_mix(width: int, height: int) -> list[CameraModel | LidarModel]:
    """Cameras of every lens, with and without a rolling shutter, and two LiDARs."""
    cx, cy = width / 2, height / 2
    lenses = [
        Pinhole(width * 0.6, width * 0.6, cx, cy),
        Pinhole(width * 0.6, width * 0.6, cx, cy, (-0.1, 0.02, 0, 0, 0, 0)),
        Fisheye(width * 0.35, width * 0.35, cx, cy, max_angle_rad=1.6),
        FTheta(cx, cy, FThetaReference.ANGLE_TO_PIXELDIST, (), (0.0, width * 0.4, 0.0, -width * 0.01), 1.3),
    ]
    cameras = [
        CameraModel(f"camera {k}", width, height, lens, CAMERA_AXES, shutter)
        for k, (lens, shutter) in enumerate(itertools.product(lenses, (Shutter.GLOBAL, Shutter.TOP_TO_BOTTOM)))
    ]
    lidars = [sensors.lidar_model(name, np.eye(4), columns=width) for name in ("VLP-16", "HDL-32")]
    return [*cameras, *lidars]


def drive(scene: GaussianScene, mix: list[CameraModel | LidarModel]) -> Iterator[SensorRequest]:
    """Endless requests: the sensors in turn, the ego on its path, and every other time an edited actor."""
    for k in itertools.count():
        sensor = mix[k % len(mix)]
        mount = sensor.rig_from_camera if isinstance(sensor, CameraModel) else sensor.rig_from_lidar
        exposure_us = 30_000 if isinstance(sensor, CameraModel) else 100_000
        start_us = START_US + (k * 7_919) % (SPAN_US - exposure_us)
        poses = scene.ego.at(np.array([start_us, start_us + exposure_us]))
        swerve = geometry.pose_from_xyyaw(0.0, 0.5 * np.sin(0.1 * k), 0.3 * np.sin(0.03 * k), 1.6)
        aside = geometry.pose_from_xyyaw(0.0, 1.0, 0.1)
        car = scene.tracks[0].path.at(np.array([start_us, start_us + exposure_us])) @ aside
        actors = {"car": car} if k % 2 else {}
        yield SensorRequest("soak", sensor, start_us, start_us + exposure_us, poses @ swerve @ mount, actors)


@contextlib.contextmanager
def sensing(scene: GaussianScene, direct: bool, threads: int) -> Iterator[Sense]:
    """What renders: the renderer, or a client of a server in this process."""
    if direct:
        yield CpuRenderer(scene, threads=threads).sense
        return
    with SensorServer(SceneStore([scene], threads=threads), port=0) as address:
        with RemoteSensors(address, scene.id) as remote:
            yield remote.sense


def resident_mb() -> float:
    """Resident memory of this process, without freed memory that the C library retains."""
    gc.collect()
    if hasattr(ctypes.CDLL(None), "malloc_trim"):
        ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def soak(frames: int, sense: Sense, requests: Iterator[SensorRequest]) -> float:
    """Renders frames, printing the memory on the way; gives its growth since the warm-up, also when interrupted."""
    first, done, began = 0.0, 0, time.perf_counter()
    try:
        for _ in range(WARM_UP):
            sense([next(requests)])
        first = resident_mb()
        print(f"{done:7d} frames {first:8.1f} MB, after {WARM_UP} to warm up", flush=True)
        began = time.perf_counter()
        for done in range(1, frames + 1):
            sense([next(requests)])
            if done % REPORT == 0 or done == frames:
                now, ms = resident_mb(), 1e3 * (time.perf_counter() - began) / done
                print(f"{done:7d} frames {now:8.1f} MB {now / first - 1:+7.2%} {ms:6.1f} ms a frame", flush=True)
    except KeyboardInterrupt:
        print("interrupted")
    growth = resident_mb() / first - 1 if first else 0.0
    print(f"memory grew by {growth:+.2%} in {done} frames; {MOST_GROWTH:.0%} may be", flush=True)
    return growth


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=5000, help="how many, after those to warm up")
    parser.add_argument("--width", type=int, default=160, help="of the images; columns of the LiDARs")
    parser.add_argument("--height", type=int, default=90)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--direct", action="store_true", help="without a server in between")
    options = parser.parse_args()
    scene = drive_scene()
    mix = sensor_mix(options.width, options.height)
    way = "directly" if options.direct else "over gRPC"
    print(f"{len(mix)} sensors {way}, {GAUSSIANS + MOVING} Gaussians, {options.threads} threads", flush=True)
    with sensing(scene, options.direct, options.threads) as sense:
        growth = soak(options.frames, sense, drive(scene, mix))
    return 1 if growth > MOST_GROWTH else 0


if __name__ == "__main__":
    sys.exit(main())
