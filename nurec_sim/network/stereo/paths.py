"""The sums of semi-global matching: what a depth costs at the end of a straight path through the image.

Hirschmueller, Stereo Processing by Semiglobal Matching and Mutual Information (2008), equation 13: along a path,

    L(p, d) = C(p, d) + min(L(q, d), L(q, d-1) + small, L(q, d+1) + small, min_k L(q, k) + jump) - min_k L(q, k)

with q the pixel before p. NumPy only, so that it can be used without torch.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nurec_sim.compute.kernels import entry_point


def brightness_steps(guide: np.ndarray, dy: int, dx: int) -> np.ndarray:
    """How much the brightness [h,w] changes into each pixel from the one before it on a path; any value at the edge."""
    return np.abs(guide - np.roll(guide, (dy, dx), axis=(0, 1)))


def _without_nan(function: Callable) -> Callable:
    """A kernel whose values are never NaN: minima may then be taken in any order, so in vectors; results are equal."""
    return entry_point(function, salt="nnan", nogil=True, fastmath={"nnan", "nsz"})


FORWARDS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Directions (rows, columns) of the paths that reach every pixel from one before it in reading order."""


@_without_nan
def add_paths(cost, jump, small, directions, total):
    """Add L of all paths in some directions to ``total``.

    Directions that go through the image in the same order share one pass over it: costs and sums are far larger than
    the processor's cache, the L of two rows are not. Arithmetic has the precision of ``jump`` and ``small``; L is kept
    in float32.

    Args:
        cost: C [h,w,d] float32.
        jump: [directions,h,w] what it costs to go to any other depth, from the pixel before to this one.
        small: what it costs to go to the next depth; not negative.
        directions: [directions,2] rows and columns from one pixel of a path to the next, -1, 0 or 1: all of them of
            ``FORWARDS``, or all of them the opposite.
        total: [h,w,d] float32 output, added to.
    """
    height, width, levels = cost.shape
    count = len(directions)
    forwards = directions[0, 0] > 0 or (directions[0, 0] == 0 and directions[0, 1] > 0)
    # L of the row before and of this one; the infinite ends spare the inner loop a test of whether d has neighbours.
    line = np.full((count, width, levels + 2), np.inf, np.float32)
    fresh = np.full((count, width, levels + 2), np.inf, np.float32)
    for number in range(height):
        row = number if forwards else height - 1 - number
        for step in range(width):
            column = step if forwards else width - 1 - step
            own, sums = cost[row, column], total[row, column]
            for n in range(count):
                dy, dx = directions[n, 0], directions[n, 1]
                r, c = row - dy, column - dx
                here = fresh[n, column]
                if r < 0 or r >= height or c < 0 or c >= width:  # the path enters the image
                    for k in range(levels):
                        here[k + 1] = own[k]
                else:
                    before = line[n, c] if dy != 0 else fresh[n, c]
                    low = before[1]
                    for k in range(2, levels + 1):
                        low = min(low, before[k])
                    # low is min_k L(q, k): jumping to any depth costs the same, so one minimum per pixel replaces a
                    # loop over pairs.
                    least = low + jump[n, row, column]
                    for k in range(levels):
                        best = min(min(before[k + 1], least), min(before[k], before[k + 2]) + small)
                        here[k + 1] = own[k] + (best - low)
                for k in range(levels):
                    sums[k] += here[k + 1]
        # Only the previous row is ever read, so two rows of L suffice.
        line, fresh = fresh, line
