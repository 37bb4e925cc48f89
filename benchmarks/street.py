"""A seeded street as Gaussians: boxes and ground, sampled by the rays of cameras that drove through it.

Like the output of a feed-forward reconstruction, every Gaussian belongs to a pixel of an input view: as wide as the
pixel's footprint where the ray met a surface, flat along the surface's normal. The street runs along x, z is up.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8
from numba import njit

from nurec_sim import geometry
from nurec_sim.types import Gaussians, Label

EYE_HEIGHT_M = 1.6
LANE_Y_M = -2.0
FARTHEST_M = 220.0
VIEW_X_M = tuple(np.arange(12) * 5.0)
VIEW_YAW_DEG = (0.0, 60.0, -60.0)
ROAD_HALF_WIDTH_M = 7.5
SURFEL_WIDTH = 0.62
"""Standard deviation of a Gaussian over the width of its pixel's footprint."""
RAYS_PER_GAUSSIAN = 1.35
"""Input pixels per Gaussian that is kept; some meet the sky, some Gaussians are pruned."""


@dataclass(frozen=True)
class Boxes:
    """Upright boxes: corners, colours, labels, and whether they have windows."""

    low: Float64[np.ndarray, "b 3"]
    high: Float64[np.ndarray, "b 3"]
    rgb: Float64[np.ndarray, "b 3"]
    label: UInt8[np.ndarray, " b"]
    windows: np.ndarray


def street_boxes(rng: np.random.Generator, facades: bool = True) -> Boxes:
    """Houses on both sides, parked cars, poles and trees."""
    rows: list[tuple] = []

    def add(low, high, rgb, label=Label.OTHER, windows=False):
        rows.append((np.minimum(low, high), np.maximum(low, high), np.asarray(rgb, float), int(label), windows))

    for side in (-1.0, 1.0):
        x = -30.0
        while facades and x < 260:
            length, height, depth = rng.uniform(10, 30), rng.uniform(5, 20), rng.uniform(8, 14)
            front = side * rng.uniform(11, 15)
            add([x, front, 0], [x + length, front + side * depth, height], rng.uniform(0.3, 0.8, 3), windows=True)
            x += length + rng.uniform(0, 8)
        for x in np.arange(-20.0, 240.0, 9.0) + rng.uniform(0, 4, 29):
            if rng.random() < 0.7:
                y = side * (6.4 + rng.uniform(-0.2, 0.2))
                paint = rng.uniform(0.05, 0.9, 3)
                add([x, y - 0.9, 0.25], [x + 4.4, y + 0.9, 0.95], paint, Label.MOVABLE)
                add([x + 1.0, y - 0.8, 0.95], [x + 3.6, y + 0.8, 1.5], paint * 0.3, Label.MOVABLE)
        for x in np.arange(-15.0, 240.0, 13.0) + rng.uniform(0, 8, 20):
            y = side * 8.5
            add([x, y - 0.12, 0], [x + 0.24, y + 0.12, 5.5], (0.3, 0.25, 0.2))
            if rng.random() < 0.5:
                add([x - 1.5, y - 1.5, 3], [x + 1.7, y + 1.5, 6.2], (0.15, 0.38, 0.12))
    low, high, rgb, label, windows = zip(*rows, strict=True)
    return Boxes(np.array(low), np.array(high), np.array(rgb), np.array(label, np.uint8), np.array(windows))


@njit(cache=True, nogil=True)
def first_hits(origin, direction, low, high):
    """Ray parameter, axis of the normal and box of what each ray meets first; -1 for the ground, inf for the sky."""
    count = len(direction)
    distance, axis, box = np.full(count, np.inf), np.full(count, 2), np.full(count, -1)
    for i in range(count):
        d = direction[i]
        if d[2] < -1e-9:
            distance[i] = -origin[2] / d[2]
        for k in range(len(low)):
            enter, leave, side = -np.inf, np.inf, 0
            for c in range(3):
                step = d[c] if abs(d[c]) > 1e-12 else 1e-12
                a, b = (low[k, c] - origin[c]) / step, (high[k, c] - origin[c]) / step
                if min(a, b) > enter:
                    enter, side = min(a, b), c
                leave = min(leave, max(a, b))
            if 0.1 < enter < min(leave, distance[i]):
                distance[i], axis[i], box[i] = enter, side, k
    return distance, axis, box


def surfels(boxes: Boxes, count: int, rng: np.random.Generator) -> Gaussians:
    """``count`` Gaussians on the surfaces visible in 36 views along the street, a random subset of their pixels."""
    views = [(np.array([x, LANE_Y_M, EYE_HEIGHT_M]), np.radians(yaw)) for x in VIEW_X_M for yaw in VIEW_YAW_DEG]
    probe = np.random.default_rng(0)
    width = 24
    share = np.mean([len(_view(boxes, *view, width, probe)) for view in views]) / (width * (width * 9 // 16))
    rays = max(RAYS_PER_GAUSSIAN, 1.05 / share) * count / len(views)
    width = int(np.ceil(np.sqrt(rays * 16 / 9))) + 1
    seen = Gaussians.concatenate([_view(boxes, *view, width, rng) for view in views])
    return seen[np.sort(rng.permutation(len(seen))[:count])]


def _view(boxes: Boxes, eye: np.ndarray, yaw_rad: float, width: int, rng: np.random.Generator) -> Gaussians:
    """Ray hits of one view: 80 degrees wide, one jittered ray per pixel."""
    height, tangent = max(width * 9 // 16, 1), np.tan(np.radians(40.0))
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    u = ((column + rng.random(column.shape)) / width * 2 - 1).ravel() * tangent
    v = ((row + rng.random(row.shape)) / height * 2 - 1).ravel() * tangent * height / width
    ray = np.stack([np.ones_like(u), -u, -v], axis=-1) @ geometry.rotation_from_yaw(yaw_rad).T
    distance, axis, box = first_hits(eye, ray, boxes.low, boxes.high)
    hit = distance < FARTHEST_M
    distance, axis, box, ray = distance[hit], axis[hit], box[hit], ray[hit]
    point, rows = eye + ray * distance[:, None], np.arange(len(ray))
    facing = -np.sign(ray[rows, axis])
    footprint = 2 * tangent / width * distance
    slant = np.maximum(0.15, np.abs(ray[rows, axis]) / np.linalg.norm(ray, axis=1))
    size = SURFEL_WIDTH * footprint / np.sqrt(slant)
    flat = 0.12 * footprint
    rgb, label = _paint(boxes, point, axis, box, rng)
    scale = np.stack([size, size, flat], axis=1) * np.exp(0.3 * rng.standard_normal((len(point), 3)))
    point[rows, axis] += rng.normal(0, 1, len(point)) * scale[:, 2]  # surfaces are noisy; no two depths are the same
    return gaussians_of(
        point,
        scale,
        lying_on(axis, facing, rng),
        opacity=np.clip(rng.beta(1.6, 0.9, len(point)), 0.02, 0.995),
        rgb=rgb,
        label=label,
        normal=facing[:, None] * np.eye(3)[axis],
        intensity=np.clip(0.2 + 0.6 * rgb.mean(axis=1), 0, 1),
    )


def _paint(boxes: Boxes, point: np.ndarray, axis: np.ndarray, box: np.ndarray, rng: np.random.Generator):
    """Colours and labels of surface points: lanes on asphalt, pavements, windows in facades, noise everywhere."""
    x, y, z = point.T
    ground = box < 0
    across = np.abs(y)
    rgb = np.where(ground[:, None], 0.33, boxes.rgb[box])
    rgb[ground & (across > ROAD_HALF_WIDTH_M)] = (0.5, 0.49, 0.46)
    rgb[ground & (across > 10.5)] = (0.28, 0.4, 0.2)
    dashes = (across < 0.08) & (x % 9 < 4) | (np.abs(across - 4.2) < 0.07)
    rgb[ground & dashes] = 0.85
    along = np.where(axis == 1, x, y)
    panes = ~ground & boxes.windows[box] & (axis != 2) & (z % 3 > 1.1) & (z % 3 < 2.5) & (along % 2.5 > 1.1)
    rgb[panes] = (0.16, 0.2, 0.26)
    rgb = rgb * (1 + 0.12 * rng.standard_normal((len(point), 1))) + 0.02 * rng.standard_normal(rgb.shape)
    label = np.where(ground, np.where(across < ROAD_HALF_WIDTH_M, Label.ROAD, Label.OTHER), boxes.label[box])
    return np.clip(rgb, 0, 1), label


def lying_on(axis: np.ndarray, facing: np.ndarray, rng: np.random.Generator) -> Float64[np.ndarray, "n 4"]:
    """Rotations that turn z to the normals ``facing * e_axis``, about which they are random, and a little tilted."""
    h = np.sqrt(0.5)
    to_axis = np.array([[h, 0, h, 0], [h, -h, 0, 0], [1.0, 0, 0, 0]])[axis]
    away = np.array([[0, 0, 0, 1.0], [0, 0, 0, 1.0], [0, 1.0, 0, 0]])[axis]
    base = np.where((facing < 0)[:, None], geometry.quat_multiply(away, to_axis), to_axis)
    turn = rng.uniform(0, np.pi, len(axis))
    spin = np.stack([np.cos(turn), *rng.normal(0, 0.04, (2, len(axis))), np.sin(turn)], axis=1)
    return geometry.quat_normalize(geometry.quat_multiply(base, spin))


def gaussians_of(point, scale, quat, *, opacity, rgb, label=Label.OTHER, normal=0.0, intensity=np.nan) -> Gaussians:
    """Gaussians from float64 values; scalars apply to all of them."""
    n = len(point)
    return dataclasses.replace(
        Gaussians.empty(n),
        mean_m=np.asarray(point, np.float32),
        scale_m=np.asarray(scale, np.float32),
        quat_wxyz=np.asarray(quat, np.float32),
        opacity=np.broadcast_to(opacity, n).astype(np.float32),
        rgb=np.broadcast_to(rgb, (n, 3)).astype(np.float32),
        label=np.broadcast_to(label, n).astype(np.uint8),
        normal=np.broadcast_to(normal, (n, 3)).astype(np.float32),
        intensity=np.broadcast_to(intensity, n).astype(np.float32),
    )
