"""Dynamic Gaussians of a street with moving things as a network would lift them: seen from one side, with noise."""

import numpy as np

from nurec_sim import geometry
from nurec_sim.types import DynamicGaussians, Gaussians, Label, Track, Trajectory

GAP_US, EXPOSURE_US = 500_000, 30_000


def ego(start_us=2_000_000, seconds=8.0, speed=6.0):
    t_us = start_us + 100_000 * np.arange(int(seconds * 10) + 1)
    return Trajectory(t_us, np.stack([geometry.pose_from_xyyaw(speed * s, 0, 0) for s in (t_us - t_us[0]) / 1e6]))


def thing(name, label, size, xy, heading, speed, turn=0.0, start_us=2_000_000, seconds=8.0):
    """Drives from ``xy`` along ``heading`` (radians), turning by ``turn`` rad/s; known 1 s longer at both ends."""
    s = np.arange(-1.0, seconds + 1.0, 0.02)
    yaw = heading + turn * s
    steps = np.diff(s, prepend=s[0])[:, None] * speed * np.column_stack([np.cos(yaw), np.sin(yaw)])
    at = np.asarray(xy) + np.cumsum(steps, axis=0) - np.cumsum(steps, axis=0)[50]
    poses = [geometry.pose_from_xyyaw(x, y, a, size[2] / 2) for (x, y), a in zip(at, yaw, strict=True)]
    return Track(name, label, size, Trajectory(start_us + np.rint(s * 1e6).astype(np.int64), np.stack(poses)))


def street(start_us=2_000_000):
    """Three cars (ahead, oncoming, one that turns) and two persons who cross in opposite directions."""
    common = {"start_us": start_us}
    return [
        thing("ahead", "automobile", (4.5, 1.8, 1.5), (14.0, 0.3), 0.0, 7.0, **common),
        thing("oncoming", "automobile", (4.2, 1.8, 1.6), (75.0, 3.8), np.pi, 8.0, **common),
        thing("turning", "automobile", (4.6, 1.9, 1.5), (40.0, -9.0), 0.2, 6.0, turn=0.25, **common),
        thing("left", "person", (0.6, 0.6, 1.75), (32.0, -5.0), np.pi / 2, 1.4, **common),
        thing("right", "person", (0.6, 0.6, 1.7), (33.0, 6.0), -np.pi / 2, 1.3, **common),
    ]


def lifted(things, ego, seed=0, speed_noise=0.3, depth_noise=0.01, outliers=300, seconds=8.0):
    """What two cameras give of things: points of the faces towards the car, each with knots at its camera's frames.

    Returns:
        The dynamic layer without tracks, and the place in ``things`` of each Gaussian, -1 for outliers.
    """
    rng = np.random.default_rng(seed)
    knots, times, owner = [], [], []
    for camera in range(2):
        for frame in range(int(seconds * 1e6 / GAP_US)):
            t = ego.start_us + frame * GAP_US + 13_000 * camera
            eye = ego.at(t)[:3, 3] + [1.5, 0, 1.4]
            for number, each in enumerate(things):
                xyz, t_us = _seen(each, t, eye, rng)
                xyz = eye + (xyz - eye) * (1 + depth_noise * rng.normal(size=(len(xyz), 1)))
                in_box = _moved(geometry.inverse(each.path.at(t_us)), xyz)
                three = np.stack([t_us * 0 + t + 15_000 - GAP_US, t_us, t_us * 0 + t + 15_000 + GAP_US], axis=1)
                at = np.stack([_moved(each.path.at(three[:, k]), in_box) for k in range(3)], axis=1)
                wrong = speed_noise * rng.normal(size=(len(xyz), 2, 3)) * (GAP_US / 1e6)
                at[:, [0, 2]] += wrong
                knots.append(at), times.append(three), owner.append(np.full(len(xyz), number))
    stray = rng.uniform([0, -20, 0], [90, 20, 4], (outliers, 3))
    middle = ego.start_us + rng.integers(0, int(seconds * 1e6), outliers)
    knots.append(stray[:, None] + rng.normal(0, 2, (outliers, 3, 3)))
    times.append(np.stack([middle - GAP_US, middle, middle + GAP_US], axis=1))
    owner.append(np.full(outliers, -1))
    knots, times = np.concatenate(knots).astype(np.float32), np.concatenate(times)
    n = len(knots)
    unit = Gaussians.empty(n)
    gaussians = Gaussians(
        knots[:, 1], unit.quat_wxyz, np.full((n, 3), 0.06, np.float32), np.full(n, 0.9, np.float32),
        rng.random((n, 3)).astype(np.float32), unit.normal, np.full(n, Label.MOVABLE, np.uint8), unit.intensity,
    )  # fmt: skip
    return DynamicGaussians(gaussians, times, knots, np.full(n, -1, np.int32)), np.concatenate(owner)


def _seen(track, t, eye, rng):
    """Points of a box's visible faces at the times of their lines; fewer from far away."""
    distance = np.linalg.norm(track.path.at(t)[:3, 3] - eye)
    size = np.array(track.size_m)
    count = int(np.clip(60_000 / distance**2, 60, 900) * np.sqrt(size[0] * size[2] / 7))
    axis, sign = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    box = rng.uniform(-0.5, 0.5, (count, 3))
    box[np.arange(count), axis] = sign / 2
    normal = np.zeros((count, 3))
    normal[np.arange(count), axis] = sign
    t_us = t + np.rint(rng.random(count) * EXPOSURE_US).astype(np.int64)
    poses = track.path.at(t_us)
    xyz = _moved(poses, box * size)
    facing = np.einsum("nij,nj,ni->n", poses[:, :3, :3], normal, eye - xyz) > 0
    return xyz[facing], t_us[facing]


def _moved(poses, xyz):
    return np.einsum("nij,nj->ni", poses[:, :3, :3], xyz) + poses[:, :3, 3]
