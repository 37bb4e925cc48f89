"""Gaussians as the kernels read them: one 64-byte row each, in blocks that lie close together in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim.types import Gaussians

# Columns of a packed Gaussian.
MEAN, QUAT, SCALE, LOG_OPACITY, REACH, COLOUR, LABEL = 0, 3, 7, 10, 11, 12, 15
PACKED = 16

BLOCK = 256
MIN_SCALE_M = 1e-5


@dataclass(frozen=True, eq=False)
class PackedGaussians:
    """Rows for the kernels, and a sphere around every block of ``BLOCK`` rows."""

    rows: Float32[np.ndarray, "n 16"]
    intensity: Float32[np.ndarray, " n"]
    sh_rest: Float32[np.ndarray, "n k 3"]
    block_centre: Float64[np.ndarray, "b 3"]
    block_radius: Float64[np.ndarray, " b"]

    def __len__(self) -> int:
        return len(self.rows)


def pack(gaussians: Gaussians, sort: bool = True) -> PackedGaussians:
    """Pack Gaussians, dropping what can never be drawn (not finite, opacity below 1/255).

    ``sort`` groups neighbours in space into blocks, which changes the order of Gaussians of exactly equal depth only.
    """
    rows = np.zeros((len(gaussians), PACKED), np.float32)
    quat = gaussians.quat_wxyz.astype(np.float64)
    norm = np.linalg.norm(quat, axis=1, keepdims=True)
    scale = np.maximum(gaussians.scale_m, MIN_SCALE_M)
    rows[:, MEAN : MEAN + 3] = gaussians.mean_m
    rows[:, QUAT : QUAT + 4] = quat / np.maximum(norm, 1e-12)
    rows[:, SCALE : SCALE + 3] = scale
    opacity = gaussians.opacity.astype(np.float64)
    rows[:, LOG_OPACITY] = np.log(np.clip(opacity, 1e-6, 1.0))
    rows[:, REACH] = scale.max(axis=1) * np.sqrt(2 * np.log(255))
    rows[:, COLOUR : COLOUR + 3] = gaussians.rgb
    rows[:, LABEL] = gaussians.label
    keep = np.isfinite(rows).all(axis=1) & (norm[:, 0] > 1e-12) & (opacity >= 1 / 255)
    chosen = np.flatnonzero(keep)
    if sort and len(chosen):
        chosen = chosen[np.argsort(_morton(rows[chosen, :3]), kind="stable")]
    rows = rows[chosen]
    rest = gaussians.sh_rest
    rest = np.zeros((0, 0, 3), np.float32) if rest is None else np.ascontiguousarray(rest[chosen], np.float32)
    centre, radius = _block_spheres(rows)
    return PackedGaussians(rows, np.ascontiguousarray(gaussians.intensity[chosen], np.float32), rest, centre, radius)


def _morton(points: Float32[np.ndarray, "n 3"]) -> np.ndarray:
    """Place of points along a Z-order curve of 2^21 cells a side."""
    low, high = points.min(axis=0), points.max(axis=0)
    cells = (points - low) / max(float((high - low).max()), 1e-9) * (2**21 - 1)
    code = np.zeros(len(points), np.uint64)
    for axis in range(3):
        v = cells[:, axis].astype(np.uint64)
        for shift, mask in ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
                            (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)):  # fmt: skip
            v = (v | (v << np.uint64(shift))) & np.uint64(mask)
        code |= v << np.uint64(axis)
    return code


def _block_spheres(rows: Float32[np.ndarray, "n 16"]) -> tuple[np.ndarray, np.ndarray]:
    starts = np.arange(0, len(rows), BLOCK)
    if len(starts) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    mean = rows[:, :3].astype(np.float64)
    reach = rows[:, REACH, None].astype(np.float64)
    low, high = np.minimum.reduceat(mean - reach, starts), np.maximum.reduceat(mean + reach, starts)
    return (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2
