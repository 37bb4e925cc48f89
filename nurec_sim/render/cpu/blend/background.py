"""Kernels that look a sky up in every ray's direction, and carry gradients back to the sky and to the sensor's turn."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim.render.cpu.kernel import inner, kernel
from nurec_sim.render.cpu.workers import Workers

PARTS = 4
"""Parts of an image whose shares of the sky's gradient are summed; a fixed number, so that threads do not change
the sum."""

# Per face of ``geometry.cubemap_coordinates``: axis and sign of its direction, of s and of t, in the world.
FACES = np.array(
    [[1, -1, 0, 1, 2, -1], [1, 1, 0, -1, 2, -1], [2, 1, 1, -1, 0, -1],
     [2, -1, 1, -1, 0, 1], [0, -1, 1, -1, 2, -1], [0, 1, 1, 1, 2, -1]]
)  # fmt: skip


@inner
def find_face(d):
    """Number of the cubemap's face that a direction meets."""
    # Ties are resolved as in ``composite.sky_lookup``, so that both find the same texel.
    x, y, z = abs(d[0]), abs(d[1]), abs(d[2])
    if x > y and x > z:
        return 5 if d[0] > 0 else 4
    if z > y and z >= x:
        return 2 if d[2] > 0 else 3
    return 1 if d[1] > 0 else 0


@inner
def find_place(d, size, face):
    """Texel coordinates on a face, and whether they were clamped."""
    major = abs(d[FACES[face, 0]])
    x = (d[FACES[face, 2]] * FACES[face, 3] / major + 1) / 2 * size - 0.5
    y = (d[FACES[face, 4]] * FACES[face, 5] / major + 1) / 2 * size - 0.5
    return min(max(x, 0.0), size - 1.0), min(max(y, 0.0), size - 1.0), 0 <= x <= size - 1, 0 <= y <= size - 1


@inner
def turned(direction, row, column, turn, d):
    """Write a ray's direction in the world to ``d``."""
    for k in range(3):
        d[k] = (
            turn[k, 0] * direction[row, column, 0]
            + turn[k, 1] * direction[row, column, 1]
            + turn[k, 2] * direction[row, column, 2]
        )


@kernel
def look_up(first, last, direction, turn, sky, clear, behind):
    """Colours of the sky behind the rays of some rows.

    Args:
        first: first row.
        last: one behind the last.
        direction: [h,w,3] rays in the reference frame.
        turn: [3,3] float64, world_from_reference.
        sky: [6,s,s,3] cubemap.
        clear: [h,w] what the rays let through; empty: look behind all of them.
        behind: [3,h,w] output; 0 behind rays that let nothing through.
    """
    d, size = np.empty(3), sky.shape[1]
    for row in range(first, last):
        for column in range(direction.shape[1]):
            if clear.size and clear[row, column] <= 0:
                for c in range(3):
                    behind[c, row, column] = np.float32(0)
                continue
            turned(direction, row, column, turn, d)
            face = find_face(d)
            x, y, _, _ = find_place(d, size, face)
            i, j = np.uint64(x), np.uint64(y)
            i1, j1 = min(i + np.uint64(1), np.uint64(size - 1)), min(j + np.uint64(1), np.uint64(size - 1))
            fx, fy = np.float32(x - i), np.float32(y - j)
            for c in range(3):
                top = sky[face, j, i, c] + fx * (sky[face, j, i1, c] - sky[face, j, i, c])
                bottom = sky[face, j1, i, c] + fx * (sky[face, j1, i1, c] - sky[face, j1, i, c])
                behind[c, row, column] = top + fy * (bottom - top)


@kernel
def look_back(first, last, direction, turn, sky, by_behind, by_sky, touched, torque):
    """Gradients of ``look_up``.

    Args:
        first: see ``look_up``, as all up to ``sky``.
        last: see first.
        direction: see first.
        turn: see first.
        sky: see first.
        by_behind: [3,h,w] gradients of ``behind``.
        by_sky: [6,s,s,3] float64 gradients of the sky, added to.
        touched: [6,s] rows of texels that have a gradient, set to 1.
        torque: [h,3] output, per row, about the world's axes.
    """
    d, by_d, size = np.empty(3), np.empty(3), sky.shape[1]
    for row in range(first, last):
        torque[row] = 0.0
        for column in range(direction.shape[1]):
            if by_behind[0, row, column] == 0 and by_behind[1, row, column] == 0 and by_behind[2, row, column] == 0:
                continue
            turned(direction, row, column, turn, d)
            face = find_face(d)
            x, y, inside_x, inside_y = find_place(d, size, face)
            i, j = np.uint64(x), np.uint64(y)
            i1, j1 = min(i + np.uint64(1), np.uint64(size - 1)), min(j + np.uint64(1), np.uint64(size - 1))
            fx, fy = x - i, y - j
            touched[face, j] = touched[face, j1] = 1
            by_x = by_y = 0.0
            for c in range(3):
                g = by_behind[c, row, column]
                a, b, e, f = sky[face, j, i, c], sky[face, j, i1, c], sky[face, j1, i, c], sky[face, j1, i1, c]
                by_x += g * ((1 - fy) * (b - a) + fy * (f - e))
                by_y += g * ((1 - fx) * (e - a) + fx * (f - b))
                by_sky[face, j, i, c] += g * (1 - fx) * (1 - fy)
                by_sky[face, j, i1, c] += g * fx * (1 - fy)
                by_sky[face, j1, i, c] += g * (1 - fx) * fy
                by_sky[face, j1, i1, c] += g * fx * fy
            axis, along, down = FACES[face, 0], FACES[face, 2], FACES[face, 4]
            # Texel x = (d_along / |d_axis| + 1) / 2 * size: its derivative by d_along. The colour does not depend on
            # the length of d, which gives the third component; the torque is d x gradient.
            half = size / (2 * abs(d[axis]))
            by_d[along] = by_x * half * FACES[face, 3] if inside_x else 0.0
            by_d[down] = by_y * half * FACES[face, 5] if inside_y else 0.0
            by_d[axis] = -(by_d[along] * d[along] + by_d[down] * d[down]) / d[axis]
            for k in range(3):
                p, q = (k + 1) % 3, (k + 2) % 3
                torque[row, k] += d[p] * by_d[q] - d[q] * by_d[p]


def draw_sky(
    direction: Float32[np.ndarray, "h w 3"],
    turn: Float64[np.ndarray, "3 3"],
    sky: Float32[np.ndarray, "6 s s 3"],
    workers: Workers,
    clear: Float32[np.ndarray, "h w"] | None = None,
) -> Float32[np.ndarray, "3 h w"]:
    """Colours of the sky behind every ray.

    Args:
        direction: unit rays in the reference frame.
        turn: world_from_reference rotation.
        sky: cubemap, faces as in ``geometry.cubemap_coordinates``.
        workers: threads to run on.
        clear: what the rays let through; the sky behind those that let nothing through is black. None: all of it.
    """
    height, width = direction.shape[:2]
    behind = np.empty((3, height, width), np.float32)
    clear = np.empty((0, 0), np.float32) if clear is None else clear
    workers.run(look_up, [(*rows, direction, turn, sky, clear, behind) for rows in workers.ranges(height, 16)])
    return behind


def draw_sky_back(
    direction: Float32[np.ndarray, "h w 3"],
    turn: Float64[np.ndarray, "3 3"],
    sky: Float32[np.ndarray, "6 s s 3"],
    by_behind: Float32[np.ndarray, "3 h w"],
    workers: Workers,
) -> tuple[Float64[np.ndarray, "6 s s 3"], Float64[np.ndarray, " 3"]]:
    """Gradients of ``draw_sky``.

    Args:
        direction: see ``draw_sky``, as the next two.
        turn: see direction.
        sky: see direction.
        by_behind: gradients of the loss by the colours.
        workers: threads to run on.

    Returns:
        Gradients by the sky and by a small turn about the world's axes.
    """
    height = len(direction)
    by_sky, torque = np.zeros((PARTS, *sky.shape)), np.empty((height, 3))
    touched = np.zeros((PARTS, *sky.shape[:2]), np.uint8)
    # Each part has a gradient of its own: texels are shared by rays of all rows.
    edges = np.linspace(0, height, PARTS + 1).astype(np.int64)
    workers.run(
        look_back,
        [(edges[k], edges[k + 1], direction, turn, sky, by_behind, by_sky[k], touched[k], torque)
         for k in range(PARTS)],
    )  # fmt: skip
    # Most of the sky is out of view; what no part has touched need not be read.
    total, rows = np.zeros(sky.shape), np.nonzero(touched.any(axis=0))
    total[rows] = by_sky[:, rows[0], rows[1]].sum(axis=0)
    return total, torque.sum(axis=0)
