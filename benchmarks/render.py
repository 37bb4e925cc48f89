"""Speed of the CPU renderer on a seeded street of Gaussians, each row with its PSNR against the reference.

``python benchmarks/render.py [--gaussians 300000] [--threads 2] [--repeats 15]`` prints a table and writes
``build/bench.json``. The scene is pixel-aligned like a feed-forward reconstruction: Gaussians sit where rays of a
driving camera meet a road, facades, cars and poles, and are as large as their pixels. The PSNR is that of the same
sensor, smaller, on a part of the same scene, because the reference is slow.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import time
from pathlib import Path

import numpy as np

from nurec_sim import geometry, sensors
from nurec_sim.render import Renderer, spec
from nurec_sim.types import (
    CameraModel,
    DynamicGaussians,
    Fisheye,
    Gaussians,
    GaussianScene,
    LidarModel,
    Pinhole,
    Rig,
    SensorRequest,
    Shutter,
    Trajectory,
)

START_US = 1_000_000
CAMERA_AXES = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
PSNR_GAUSSIANS = 3000


def street_boxes(rng):
    """Lower corners, upper corners and colours of facades, cars and poles along the x axis."""
    low, high, colour = [], [], []

    def add(a, b, rgb):
        low.append(np.minimum(a, b))
        high.append(np.maximum(a, b))
        colour.append(rgb)

    for side in (-1, 1):
        x = -30.0
        while x < 320:
            length, height, depth = rng.uniform(10, 30), rng.uniform(5, 20), rng.uniform(8, 14)
            front = side * rng.uniform(11, 15)
            add([x, front, 0], [x + length, front + side * depth, height], rng.uniform(0.3, 0.8, 3))
            x += length + rng.uniform(0, 8)
    for _ in range(60):
        x, y = rng.uniform(-20, 280), rng.choice([-6.5, 2.0, 6.5])
        add([x, y - 0.9, 0.1], [x + 4.4, y + 0.9, 1.5], rng.uniform(0.05, 0.95, 3))
    for _ in range(80):
        x, y = rng.uniform(-20, 300), rng.choice([-8.5, 8.5])
        add([x, y - 0.15, 0], [x + 0.3, y + 0.15, 5], np.array([0.3, 0.25, 0.2]))
    return np.array(low), np.array(high), np.array(colour)


def street_scene(count, seed=0):
    """A scene of ``count`` Gaussians seen from 36 views along the street."""
    rng = np.random.default_rng(seed)
    low, high, box_colour = street_boxes(rng)
    views = [(x, yaw) for x in np.arange(12) * 5.0 for yaw in (0.0, 60.0, -60.0)]
    width = int(np.sqrt(count * 1.8 / len(views) * 16 / 9))
    height = width * 9 // 16
    parts = []
    for x, yaw in views:
        origin = np.array([x, -2.0, 1.6])
        u, v = rng.uniform(-1, 1, (2, width * height)) * np.tan(np.radians([[40.0], [25.0]]))
        direction = np.stack([np.ones_like(u), -u, -v], axis=-1) @ geometry.rotation_from_yaw(np.radians(yaw)).T
        hit, axis, box = first_hits(origin, direction, low, high)
        keep = hit < 200
        hit, axis, box, direction = hit[keep], axis[keep], box[keep], direction[keep]
        grazing = np.maximum(0.15, np.abs(direction[np.arange(len(hit)), axis]) / np.linalg.norm(direction, axis=1))
        size = 2 * np.tan(np.radians(40.0)) / width * hit * 0.62 / np.sqrt(grazing)
        rgb = np.where((box >= 0)[:, None], box_colour[np.maximum(box, 0)], 0.35)
        point = origin + direction * hit[:, None]
        point[np.arange(len(hit)), axis] += rng.normal(0, 0.05, len(hit)) * size  # no two at exactly one depth
        rgb = np.where((np.floor(point).sum(axis=1) % 2 > 0)[:, None], rgb, rgb * 0.7)
        parts.append((point, axis, size, rgb + rng.normal(0, 0.03, rgb.shape), box < 0))
    point, axis, size, rgb, road = (np.concatenate(part) for part in zip(*parts, strict=True))
    chosen = rng.permutation(len(point))[:count]
    point, axis, size, rgb, road = point[chosen], axis[chosen], size[chosen], rgb[chosen], road[chosen]
    n = len(point)
    scale = np.repeat(size[:, None], 3, axis=1) * np.exp(0.3 * rng.standard_normal((n, 3)))
    scale[np.arange(n), axis] *= 0.15
    tilt = np.concatenate([np.ones((n, 1)), rng.normal(0, 0.05, (n, 3))], axis=1)
    static = dataclasses.replace(
        Gaussians.empty(n),
        mean_m=point.astype(np.float32),
        quat_wxyz=geometry.quat_normalize(tilt).astype(np.float32),
        scale_m=scale.astype(np.float32),
        opacity=np.clip(rng.beta(1.6, 0.9, n), 0.02, 0.995).astype(np.float32),
        rgb=np.clip(rgb, 0, 1).astype(np.float32),
        label=road.astype(np.uint8),
        intensity=rng.random(n).astype(np.float32),
    )
    return GaussianScene("street", static, DynamicGaussians.empty(), np.full((6, 16, 16, 3), 0.72, np.float32), {},
                         Rig({}, {}), Trajectory(np.array([START_US]), np.eye(4)[None]), [], None,
                         (START_US, 2 * START_US))  # fmt: skip


def first_hits(origin, direction, low, high):
    """Ray parameter, axis of the normal and number of the first box that rays meet; -1 for the ground at z = 0."""
    down = np.minimum(direction[:, 2], -1e-9)
    best = np.where(direction[:, 2] < -1e-6, -origin[2] / down, np.inf)
    axis, box = np.full(len(direction), 2), np.full(len(direction), -1)
    inverse = 1 / np.where(np.abs(direction) < 1e-9, 1e-9, direction)
    for k in range(len(low)):
        a, b = (low[k] - origin) * inverse, (high[k] - origin) * inverse
        near, far = np.minimum(a, b), np.maximum(a, b)
        enter = near.max(axis=1)
        hit = (enter > 0.1) & (enter < far.min(axis=1)) & (enter < best)
        best[hit], axis[hit], box[hit] = enter[hit], near[hit].argmax(axis=1), k
    return best, axis, box


def cases():
    """Name and sensor of every row."""

    def camera(width, height, lens=None, shutter=Shutter.GLOBAL):
        lens = lens or Pinhole(width / 2, width / 2, width / 2, height / 2)
        return CameraModel("camera", width, height, lens, np.eye(4), shutter)

    for width, height in ((320, 180), (640, 360), (960, 540), (1920, 1080)):
        yield "pinhole", camera(width, height)
    yield "pinhole, rolling", camera(640, 360, shutter=Shutter.TOP_TO_BOTTOM)
    yield "distorted", camera(640, 360, Pinhole(320, 320, 320, 180, (-0.1, 0.02, 0, 0, 0, 0)))
    yield "fisheye", camera(640, 360, Fisheye(200, 200, 320, 180, max_angle_rad=1.6))
    yield "lidar, driving", sensors.lidar_model("HDL-64", np.eye(4), columns=1800)
    yield "lidar, driving", sensors.lidar_model("PANDAR128", np.eye(4), columns=1800)


def street_request(sensor):
    """A request in the middle of the street; sensors that do not expose at one instant move at 13 m/s."""
    start = geometry.pose_from_xyyaw(22.0, -2.0, 0.0, 1.7)
    exposure_us = 100_000 if isinstance(sensor, LidarModel) else 30_000
    end = geometry.pose_from_xyyaw(22.0 + 13e-6 * exposure_us, -2.0, 2e-7 * exposure_us, 1.7)
    mount = CAMERA_AXES if isinstance(sensor, CameraModel) else np.eye(4)
    if isinstance(sensor, CameraModel) and sensor.shutter is Shutter.GLOBAL:
        end = start
    return SensorRequest("street", sensor, START_US, START_US + exposure_us, np.stack([start @ mount, end @ mount]))


def psnr_against_spec(scene, sensor):
    """PSNR of a smaller version of the sensor on a part of the scene; for LiDARs that of the ranges, peak 100 m."""
    subset = np.random.default_rng(1).permutation(len(scene.static))[:PSNR_GAUSSIANS]
    static = dataclasses.replace(scene.static[subset], scale_m=scene.static.scale_m[subset] * 4)
    part = dataclasses.replace(scene, static=static)
    if isinstance(sensor, LidarModel):
        asked = street_request(dataclasses.replace(sensor, azimuth_rad=sensor.azimuth_rad[::18]))
        got, expected = Renderer(part).render_lidar(asked), spec.render_lidar(part, asked)
        _, mine, theirs = np.intersect1d(got.beam, expected.beam, return_indices=True)
        difference, peak = got.range_m[mine] - expected.range_m[theirs], 100.0
    else:
        asked = street_request(sensors.scaled_camera(sensor, 160, 90))
        got, expected = Renderer(part).render_camera(asked), spec.render_camera(part, asked)
        difference, peak = got.rgb.astype(float) - expected.rgb, 255.0
    return float(10 * np.log10(peak**2 / max(np.mean(np.square(difference, dtype=np.float64)), 1e-12)))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=int, default=300_000)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--output", type=Path, default=Path("build/bench.json"))
    options = parser.parse_args()
    scene = street_scene(options.gaussians)
    renderer = Renderer(scene, threads=options.threads)
    rows = []
    print(f"{len(scene.static)} Gaussians, {options.threads} threads, load {os.getloadavg()[0]:.1f}")
    print(f"{'sensor':18s} {'size':>10s} {'median ms':>10s} {'p99 ms':>8s} {'cpu ms':>8s} {'PSNR dB':>8s}")
    for name, sensor in cases():
        asked = street_request(sensor)
        began = time.perf_counter()
        renderer.sense([asked])  # compiles, or loads the compiled kernels, and makes the sensor's tables
        first_ms = (time.perf_counter() - began) * 1e3
        wall, cpu = [], []
        for _ in range(options.repeats):
            began, cpu_began = time.perf_counter(), time.process_time()
            renderer.sense([asked])
            wall.append((time.perf_counter() - began) * 1e3)
            cpu.append((time.process_time() - cpu_began) * 1e3)
        lidar = isinstance(sensor, LidarModel)
        width, height = (1800, len(sensor.elevation_rad)) if lidar else (sensor.width_px, sensor.height_px)
        row = {
            "name": name,
            "width": width,
            "height": height,
            "gaussians": len(scene.static),
            "threads": options.threads,
            "ms_median": float(np.median(wall)),
            "ms_p99": float(np.quantile(wall, 0.99)),
            "cpu_ms_median": float(np.median(cpu)),
            "ms_first": first_ms,
            "psnr_vs_spec_db": psnr_against_spec(scene, sensor),
        }
        rows.append(row)
        print(
            f"{name:18s} {width:>5d}x{height:<4d} {row['ms_median']:10.1f} {row['ms_p99']:8.1f} "
            f"{row['cpu_ms_median']:8.1f} {row['psnr_vs_spec_db']:8.1f}",
            flush=True,
        )
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
