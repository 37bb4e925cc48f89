"""Semi-global matching with whole numbers: the paths of ``network.stereo.paths`` with less memory to go through.

Costs are whole numbers of ``1 / UNIT``; those of measured pixels are not stored, as they follow from their depth.
Kernels index whole arrays: a view of a part counts its references, which takes as long as an inner loop.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, Int16, Int32, UInt8

from nurec_sim.compute.kernels import inner, kernel

UNIT = 20
"""Costs are counted in parts of 1 / 20, which the mean of two costs of matching is a multiple of."""
PRIOR_COST, PRIOR_CAP = 40 * UNIT, 220 * UNIT
"""What it costs that a measured pixel is one level off, and at most: a wrong measurement (a splat over a silhouette)
can be outvoted by its surroundings."""
SMOOTH_ONE, SMOOTH_MANY = 10.0, 80.0
"""What it costs that depth changes by one level, or by more, from a pixel to the next."""
EDGE = 8
"""A difference of brightness by this (of 255) halves the cost of large changes: depth is likely to jump there too."""
MOST = 0x7000
"""More than any cost along a path. Sums of eight paths have 16 bits: 8 * (PRIOR_CAP + SMOOTH_MANY * UNIT) is less."""
BEFORE = np.array([-1, -1, 0, 1])
"""Columns to the pixel before on each of four paths, as images are read; the first path goes along the row."""


def smooth_depth(
    cost: Int16[np.ndarray, "open levels"],
    measured: Int32[np.ndarray, "h w"],
    gray: UInt8[np.ndarray, "h w"],
    inverse_depths: Float64[np.ndarray, " levels"],
) -> Float32[np.ndarray, "h w"]:
    """Inverse depth of least cost after semi-global matching along eight paths (Hirschmueller 2008).

    Args:
        cost: of each pixel that is not measured, row by row, in parts of 1 / ``UNIT``, at most ``PRIOR_CAP``.
        measured: level at which pixels are measured, times ``PRIOR_COST``; negative where they are not.
        gray: brightness 0..255.
        inverse_depths: of the levels, 1/m.
    """
    jumps = np.maximum(SMOOTH_MANY / (1 + np.arange(256) / EDGE), SMOOTH_ONE + 1)
    jumps, small = np.rint(jumps * UNIT).astype(np.int16), np.int16(SMOOTH_ONE * UNIT)
    total, result = np.empty((*measured.shape, cost.shape[1]), np.uint16), np.zeros(measured.shape, np.float32)
    for forwards in (True, False):
        sum_paths(cost, measured, gray, jumps, small, inverse_depths, forwards, total, result)
    return result


@kernel
def sum_paths(cost, measured, gray, jumps, small, inverse_depths, forwards, total, result):
    """Sum the costs L along the four paths that come from the left and above, then from the right and below.

    Sums and costs are larger than the processor's cache, so the second pass decides on each pixel at once.

    Args:
        cost: see ``smooth_depth``.
        measured: likewise.
        gray: likewise.
        jumps: [256] int16: what it costs to go to any other level, by the difference of brightness.
        small: what it costs to go to the next level.
        inverse_depths: [levels] 1/m.
        forwards: whether this is the first pass.
        total: [h,w,levels] uint16: sums of the first pass.
        result: [h,w] inverse depth of the least sum, written in the second pass.
    """
    height, width, levels = total.shape
    sign, pixel = (1, -1) if forwards else (-1, len(cost))
    own, sums = np.empty(levels, np.int16), np.empty(levels, np.uint16)
    # L of this row and of the one before, in turn, and their least values. One more level at both ends spares the inner
    # loop a test of whether there is a next one, one more column at both sides a test of whether there is a pixel
    # before: after an L of zero, a path begins anew.
    along, low = np.zeros((2, 4, width + 2, levels + 2), np.int16), np.zeros((2, 4, width + 2), np.int16)
    for edge in (0, levels + 1):
        along[:, :, :, edge] = MOST
    for number in range(height):
        row, now = number if forwards else height - 1 - number, number % 2
        above = min(max(row - sign, 0), height - 1)
        for step in range(width):
            column = step if forwards else width - 1 - step
            at = measured[row, column]
            if at >= 0:
                for k in range(levels):
                    own[k] = min(abs(np.int32(np.int32(k * PRIOR_COST) - at)), np.int32(PRIOR_CAP))
            else:
                pixel += sign
                for k in range(levels):
                    own[k] = cost[pixel, k]
            shade = np.int64(gray[row, column])
            for n in range(4):
                place = column + sign * BEFORE[n]
                beside = min(max(place, 0), width - 1)
                jump = jumps[abs(shade - np.int64(gray[row if n == 0 else above, beside]))]
                # The first path comes from this row, the others from the one before.
                then, least = now if n == 0 else 1 - now, np.int16(MOST)
                before = low[then, n, place + 1]
                far = np.int16(before + jump)
                for k in range(levels):
                    near = np.int16(min(along[then, n, place + 1, k], along[then, n, place + 1, k + 2]) + small)
                    best = min(min(along[then, n, place + 1, k + 1], far), near)
                    here = np.int16(own[k] + np.int16(best - before))
                    along[now, n, column + 1, k + 1] = here
                    least = min(least, here)
                low[now, n, column + 1] = least
            if forwards:
                for k in range(levels):
                    total[row, column, k] = _four(along, now, column + 1, k + 1)
            else:
                low_sum = np.uint16(0xFFFF)
                for k in range(levels):
                    here_sum = np.uint16(total[row, column, k] + _four(along, now, column + 1, k + 1))
                    sums[k] = here_sum
                    low_sum = min(low_sum, here_sum)
                result[row, column] = _depth_of(sums, low_sum, inverse_depths)


@inner
def _four(costs, now, column, k):
    """Sum of the four paths."""
    return np.uint16(
        np.uint16(costs[now, 0, column, k] + costs[now, 1, column, k])
        + np.uint16(costs[now, 2, column, k] + costs[now, 3, column, k])
    )


@inner
def _depth_of(sums, low, inverse_depths):
    """Inverse depth of the least sum, with a parabola between levels."""
    best, shift = 0, 0.0
    while sums[best] != low:
        best += 1
    if best == 0:
        return 0.0
    if best < len(sums) - 1:
        # Vertex of the parabola through three equally spaced values: (a - c) / (2 (a - 2 b + c)) from the middle one.
        a, b, c = np.int64(sums[best - 1]), np.int64(low), np.int64(sums[best + 1])
        if a + c > 2 * b:
            shift = min(max(0.5 * (a - c) / (a - 2 * b + c), -0.5), 0.5)
    here, there = inverse_depths[best], inverse_depths[best + 1 if shift > 0 else best - 1]
    return here + abs(shift) * (there - here)
