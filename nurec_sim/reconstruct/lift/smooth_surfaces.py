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
def _add(depth, others, near, x, y, w, wx, wy, wxx, wxy, wyy, v, vx, vy):
    """Adds pixels x and y aside, ``others`` [n], to the sums over the windows of pixels of ``depth`` [n]."""
    zero, one = np.float32(0), np.float32(1)
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
    one, zero = np.float32(1), np.float32(0)
    # Sums over the window for all pixels of a row at once, several per instruction: of weights w, of w times the
    # column and row aside, x and y, and their squares, and of the three right-hand sides.
    w, wx, wy = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    wxx, wxy, wyy = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    v, vx, vy = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    for row in range(height):
        for column in range(width):
            w[column], wx[column], wy[column], wxx[column], wxy[column] = zero, zero, zero, zero, zero
            wyy[column], v[column], vx[column], vy[column] = zero, zero, zero, zero
        for j in range(max(-REACH_PX, -row), min(REACH_PX, height - 1 - row) + 1):
            y = np.float32(j)
            for i in range(-REACH_PX, REACH_PX + 1):
                if i * i + j * j > REACH_PX * REACH_PX:
                    continue
                x, near = np.float32(i), np.float32(np.exp(-(i * i + j * j) / (2 * SPREAD_PX * SPREAD_PX)))
                own = slice(max(0, -i), min(width, width - i))
                there = slice(max(0, i), min(width, width + i))
                _add(
                    depth[row, own],
                    depth[row + j, there],
                    near,
                    x,
                    y,
                    w[own],
                    wx[own],
                    wy[own],
                    wxx[own],
                    wxy[own],
                    wyy[own],
                    v[own],
                    vx[own],
                    vy[own],
                )
        for column in range(width):
            own = depth[row, column]
            if fixed[row, column] or not own > NO_SURFACE:
                continue
            # Normal equations of value = a + b x + c y, by Cramer's rule for a.
            xx, xy, yy = wxx[column] + RIDGE, wxy[column], wyy[column] + RIDGE
            a, b, c = xx * yy - xy * xy, wy[column] * xy - wx[column] * yy, wx[column] * xy - wy[column] * xx
            value = v[column] * a + vx[column] * b + vy[column] * c
            size = w[column] * a + wx[column] * b + wy[column] * c
            smooth[row, column] = own * (one + ALIKE * value / size)
    return smooth
