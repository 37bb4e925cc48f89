"""Matched depths smoothed along surfaces: by local planes, and not across the edges of depth."""

from __future__ import annotations

import numpy as np

from nurec_sim.compute.kernels import unchecked_inner, unchecked_kernel
from nurec_sim.reconstruct.lift.depth import NO_SURFACE

REACH_PX = 4
"""Radius of the window that a pixel is smoothed in."""
SPREAD_PX = 3.0
"""Standard deviation of the weights by distance."""
ALIKE = np.float32(0.1)
"""Inverse depths that differ by less than this share of the pixel's own may be of one surface."""
RIDGE = np.float32(0.5)
"""Pulls slopes to 0, where few pixels tell them: what a pixel 0.7 pixels aside would count."""


@unchecked_inner
def _add(sums, first, depth, others, near, x, y):
    """Adds pixels x and y aside, ``others`` [n], to ``sums`` [9,w] of pixels ``first`` to first + n, ``depth`` [n]."""
    zero, one, last = np.float32(0), np.float32(1), first + len(depth)
    w, wx, wy = sums[0, first:last], sums[1, first:last], sums[2, first:last]
    wxx, wxy, wyy = sums[3, first:last], sums[4, first:last], sums[5, first:last]
    v, vx, vy = sums[6, first:last], sums[7, first:last], sums[8, first:last]
    for n in range(len(depth)):
        differs = (others[n] - depth[n]) / (depth[n] * ALIKE)
        like = one - differs * differs
        # Where depth is NaN the comparison is false.
        weight = near * like * like if like > zero else zero
        value = weight * differs if weight > zero else zero
        w[n] += weight
        wx[n] += weight * x
        wy[n] += weight * y
        wxx[n] += weight * (x * x)
        wxy[n] += weight * (x * y)
        wyy[n] += weight * (y * y)
        v[n] += value
        vx[n] += value * x
        vy[n] += value * y


@unchecked_kernel
def smooth_surfaces(depth, fixed):
    """Inverse depth after local linear regression (Cleveland 1979) with bilateral weights, but for ``fixed`` pixels.

    The inverse depth of a plane is linear in the pixel, so planes stay as they are up to their edges; a mean would bend
    slanted ones there, where more pixels lie on one side. Pixels count by their distance, a Gaussian, and by how little
    their depth differs, Tukey's biweight. The sky takes no part.

    Args:
        depth: [h,w] inverse depth, 1/m; float32.
        fixed: [h,w] pixels that stay as they are; they count for others.

    Returns:
        [h,w] smooth inverse depth, 1/m.
    """
    height, width = depth.shape
    smooth = depth.copy()
    one = np.float32(1)
    # Sums over the windows of all pixels of a row at once, several per instruction: of weights w, of w times the column
    # and row aside, x and y, and their products, and of w, w x and w y times how much the depth differs.
    sums = np.empty((9, width), np.float32)
    for row in range(height):
        sums[:] = 0
        for j in range(max(-REACH_PX, -row), min(REACH_PX, height - 1 - row) + 1):
            for i in range(-REACH_PX, REACH_PX + 1):
                if i * i + j * j > REACH_PX * REACH_PX:
                    continue
                near = np.float32(np.exp(-(i * i + j * j) / (2 * SPREAD_PX * SPREAD_PX)))
                first, last = max(0, -i), min(width, width - i)
                others = depth[row + j, first + i : last + i]
                _add(sums, first, depth[row, first:last], others, near, np.float32(i), np.float32(j))
        for column in range(width):
            own = depth[row, column]
            if fixed[row, column] or not own > NO_SURFACE:
                continue
            # Normal equations of value = a + b x + c y, by Cramer's rule for a.
            w, wx, wy = sums[0, column], sums[1, column], sums[2, column]
            v, vx, vy = sums[6, column], sums[7, column], sums[8, column]
            xx, xy, yy = sums[3, column] + RIDGE, sums[4, column], sums[5, column] + RIDGE
            a, b, c = xx * yy - xy * xy, wy * xy - wx * yy, wx * xy - wy * xx
            value, size = v * a + vx * b + vy * c, w * a + wx * b + wy * c
            smooth[row, column] = own * (one + ALIKE * value / size)
    return smooth
