"""What reading a sweep does to each of its points, compiled: NumPy would pass over all of them for every operation."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim.compute.angles import arctan2
from nurec_sim.compute.kernels import kernel, unchecked_kernel
from nurec_sim.types import Matrix4

BLOCK = 1024


def unpacked_points(steps_mm: np.ndarray, out_from_stored: Matrix4) -> Float64[np.ndarray, "n 3"]:
    """Points in metres from integer millimetres [3,n], each less the one before it, moved by a pose."""
    kind = np.int32 if steps_mm.dtype == np.int32 else np.int64
    return _unpacked(np.ascontiguousarray(steps_mm, kind), np.ascontiguousarray(out_from_stored, np.float64))


def turn_times_us(xyz: Float64[np.ndarray, "n 3"], turn_us: float) -> Int64[np.ndarray, " n"]:
    """When each point was measured, after the instant at which the scanner looked along the x axis.

    Args:
        xyz: points around the scanner.
        turn_us: duration of a turn; negative if it turns clockwise.
    """
    return _turn_times(np.ascontiguousarray(xyz, np.float64), float(turn_us))


def moved_points(
    xyz: Float64[np.ndarray, "n 3"], poses: Float64[np.ndarray, "k 4 4"], place: Int64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3"]:
    """Each point moved by one of several poses.

    Args:
        xyz: points.
        poses: the poses.
        place: of each point, the index of its pose.
    """
    return _moved(np.ascontiguousarray(xyz, np.float64), np.ascontiguousarray(poses[:, :3]), place)


def numbered(values: Int64[np.ndarray, " n"]) -> tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " n"]]:
    """The different values, ascending, and the place of each value among them; not sorted if they are close together.

    Args:
        values: at least one.
    """
    first = int(values.min())
    span = int(values.max()) - first + 1
    if span > max(len(values), 1 << 16):
        different, place = np.unique(values, return_inverse=True)
        return different, place
    place = values - first
    found = np.zeros(span, bool)
    found[place] = True
    return np.flatnonzero(found) + first, (np.cumsum(found) - 1)[place]


@kernel
def _unpacked(steps_mm: np.ndarray, pose: np.ndarray) -> Float64[np.ndarray, "n 3"]:
    count = steps_mm.shape[1]
    result = np.empty((count, 3))
    # Summed as integers, which accumulate no rounding error; 32 bits could overflow.
    sums = np.zeros(3, np.int64)
    for i in range(count):
        for k in range(3):
            sums[k] += steps_mm[k, i]
        x, y, z = sums[0] / 1000.0, sums[1] / 1000.0, sums[2] / 1000.0
        for k in range(3):
            result[i, k] = pose[k, 0] * x + pose[k, 1] * y + pose[k, 2] * z + pose[k, 3]
    return result


@unchecked_kernel
def _turn_times(xyz: np.ndarray, turn_us: float) -> Int64[np.ndarray, " n"]:
    # Blocks that fit into the fastest cache, their coordinates apart: compilers then do several angles at once.
    across, along, result = np.empty(BLOCK), np.empty(BLOCK), np.empty(len(xyz), np.int64)
    for start in range(0, len(xyz), BLOCK):
        part, count = xyz[start : start + BLOCK], min(BLOCK, len(xyz) - start)
        for i in range(count):
            along[i], across[i] = part[i, 0], part[i, 1]
        for i in range(count):
            across[i] = np.rint(arctan2(across[i], along[i]) / (2 * math.pi) * turn_us)
        for i in range(count):
            result[start + i] = np.int64(across[i])
    return result


@kernel
def _moved(xyz: np.ndarray, poses: np.ndarray, place: np.ndarray) -> Float64[np.ndarray, "n 3"]:
    result = np.empty(xyz.shape)
    for i in range(len(xyz)):
        pose, x, y, z = poses[place[i]], xyz[i, 0], xyz[i, 1], xyz[i, 2]
        for k in range(3):
            result[i, k] = (pose[k, 0] * x + pose[k, 2] * z) + pose[k, 1] * y + pose[k, 3]
    return result
