"""What reading a sweep does to each of its points, compiled: NumPy would pass over all of them for every operation."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim.compute.angles import arctan2
from nurec_sim.compute.kernels import kernel, unchecked_kernel
from nurec_sim.types import Matrix4, Trajectory

BLOCK = 1024
APART_US = 500
"""Between poses so far apart, their matrices are interpolated: at ten radians a second that errs by 0.3 mm at 80 m,
less than the grain of the files, and needs a thousandth of a pose for each point."""


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


def instants_of(t_us: Int64[np.ndarray, " n"], path: Trajectory) -> Int64[np.ndarray, " k"]:
    """Two instants or more, ``APART_US`` apart at most, from the first point of a sweep to its last (``moved_points``).

    Args:
        t_us: times of points, at least one.
        path: poses of the car, which are constant before it and after it.
    """
    first, last = np.clip([t_us.min(), t_us.max()], path.start_us, path.end_us).tolist()
    return np.rint(np.linspace(first, last, (last - first) // APART_US + 2)).astype(np.int64)


def moved_points(
    xyz: Float64[np.ndarray, "n 3"],
    t_us: Int64[np.ndarray, " n"],
    instants_us: Int64[np.ndarray, " k"],
    poses: Float64[np.ndarray, "k 4 4"],
) -> Float64[np.ndarray, "n 3"]:
    """Each point moved by the pose at its time.

    Args:
        xyz: points.
        t_us: their times.
        instants_us: instants at equal distances, two or more (``instants_of``).
        poses: the poses then; constant before and after.
    """
    rows = np.ascontiguousarray(poses[:, :3])
    return _moved(np.ascontiguousarray(xyz, np.float64), t_us, int(instants_us[0]), int(instants_us[-1]), rows)


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
def _moved(
    xyz: np.ndarray, t_us: np.ndarray, first_us: int, last_us: int, poses: np.ndarray
) -> Float64[np.ndarray, "n 3"]:
    result, last = np.empty(xyz.shape), len(poses) - 1
    by = last / max(last_us - first_us, 1)
    for i in range(len(xyz)):
        place = min(max((t_us[i] - first_us) * by, 0.0), float(last))
        low = min(int(place), last - 1)
        share, before, after = place - low, poses[low], poses[low + 1]
        for k in range(3):
            from_before = before[k, 0] * xyz[i, 0] + before[k, 1] * xyz[i, 1] + before[k, 2] * xyz[i, 2] + before[k, 3]
            from_after = after[k, 0] * xyz[i, 0] + after[k, 1] * xyz[i, 1] + after[k, 2] * xyz[i, 2] + after[k, 3]
            result[i, k] = from_before + share * (from_after - from_before)
    return result
