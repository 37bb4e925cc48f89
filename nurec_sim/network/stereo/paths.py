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


@_without_nan
def add_path(cost, jump, small, dy, dx, total):
    """Add L of all paths in one direction to ``total``.

    Arithmetic has the precision of ``jump`` and ``small``; L is kept in float32.

    Args:
        cost: C [h,w,d] float32.
        jump: [h,w] what it costs to go to any other depth, from the pixel before to this one.
        small: what it costs to go to the next depth; not negative.
        dy: rows from one pixel of a path to the next, -1, 0 or 1.
        dx: the same in columns.
        total: [h,w,d] float32 output, added to.
    """
    height, width, levels = cost.shape
    # L of the row before and of this one; the infinite ends spare the inner loop a test of whether d has neighbours.
    line = np.full((width, levels + 2), np.inf, np.float32)
    fresh = np.full((width, levels + 2), np.inf, np.float32)
    downwards = dy > 0 or (dy == 0 and dx > 0)
    for number in range(height):
        row = number if downwards else height - 1 - number
        for step in range(width):
            column = step if dx >= 0 else width - 1 - step
            r, c = row - dy, column - dx
            here, own, sums = fresh[column], cost[row, column], total[row, column]
            if r < 0 or r >= height or c < 0 or c >= width:  # the path enters the image
                for k in range(levels):
                    here[k + 1] = own[k]
            else:
                before = line[c] if dy != 0 else fresh[c]
                low = before[1]
                for k in range(2, levels + 1):
                    low = min(low, before[k])
                # low is min_k L(q, k): jumping to any depth costs the same, so one minimum per pixel replaces a loop
                # over pairs.
                least = low + jump[row, column]
                for k in range(levels):
                    best = min(min(before[k + 1], least), min(before[k], before[k + 2]) + small)
                    here[k + 1] = own[k] + (best - low)
            for k in range(levels):
                sums[k] += here[k + 1]
        # Only the previous row is ever read, so two rows of L suffice.
        line, fresh = fresh, line
