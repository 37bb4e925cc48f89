"""Kernel that finds the boxes of the grid in which a Gaussian can be seen; two around the seam of a LiDAR sweep.

A sensor that moves during its exposure sees a Gaussian from the pose of the line that looks at it, which depends on
where it is seen: a short fixed point.
"""

from __future__ import annotations

import math

import numpy as np

from nurec_sim.render.cpu.bounds import EVERYWHERE, outline_bounds, perpendicular, pinhole_bounds, place
from nurec_sim.render.cpu.grid import LIDAR, PINHOLE
from nurec_sim.render.cpu.kernel import f4, inner
from nurec_sim.render.cpu.pack import SCALE

STEPS = 4
"""Iterations of the fixed point; it contracts by the sensor's motion over a line, about a hundredfold per step."""


@inner
def _line_of(kind, column, row, line_axis, lines, row_shift):
    """The line of rays (instant) that looks at a place."""
    if kind == LIDAR:
        r = min(max(np.int64(row), 0), row_shift.shape[0] - 1)
        return (np.int64(math.floor(column)) - row_shift[r]) % lines
    return min(max(np.int64(math.floor(column if line_axis == 1 else row)), 0), lines - 1)


@inner
def _solve_line(line, x, y, z, lines, kind, params, table, row_shift, line_axis):
    """The line that sees a point of the reference frame, searched from ``line``."""
    for _ in range(STEPS):
        lx = lines[line, 12] * x + lines[line, 13] * y + lines[line, 14] * z + lines[line, 21]
        ly = lines[line, 15] * x + lines[line, 16] * y + lines[line, 17] * z + lines[line, 22]
        lz = lines[line, 18] * x + lines[line, 19] * y + lines[line, 20] * z + lines[line, 23]
        column, row = place(kind, lx, ly, lz, params, table)
        following = _line_of(kind, column, row, line_axis, lines.shape[0], row_shift)
        if following == line:
            break
        line = following
    return line


@inner
def _box_from(lines, line, x, y, z, rotation, packed, i, k2, kind, params, table, cells, axes, e1, e2):
    """Where Gaussian i (centre and ``rotation`` in the reference frame) is seen from the pose of one line."""
    moving = lines.shape[0] > 1
    lx, ly, lz = x, y, z
    if moving:
        lx = lines[line, 12] * x + lines[line, 13] * y + lines[line, 14] * z + lines[line, 21]
        ly = lines[line, 15] * x + lines[line, 16] * y + lines[line, 17] * z + lines[line, 22]
        lz = lines[line, 18] * x + lines[line, 19] * y + lines[line, 20] * z + lines[line, 23]
    for b in range(3):
        sx, sy, sz = (
            rotation[0, b] * packed[i, SCALE + b],
            rotation[1, b] * packed[i, SCALE + b],
            rotation[2, b] * packed[i, SCALE + b],
        )
        if moving:
            axes[0, b] = lines[line, 12] * sx + lines[line, 13] * sy + lines[line, 14] * sz
            axes[1, b] = lines[line, 15] * sx + lines[line, 16] * sy + lines[line, 17] * sz
            axes[2, b] = lines[line, 18] * sx + lines[line, 19] * sy + lines[line, 20] * sz
        else:
            axes[0, b], axes[1, b], axes[2, b] = sx, sy, sz
    if kind == PINHOLE:
        box = pinhole_bounds(lx, ly, lz, axes, k2, params, cells)
    else:
        bx = (axes[0, 0] * lx + axes[1, 0] * ly + axes[2, 0] * lz) / (packed[i, SCALE] * packed[i, SCALE])
        by = (axes[0, 1] * lx + axes[1, 1] * ly + axes[2, 1] * lz) / (packed[i, SCALE + 1] * packed[i, SCALE + 1])
        bz = (axes[0, 2] * lx + axes[1, 2] * ly + axes[2, 2] * lz) / (packed[i, SCALE + 2] * packed[i, SCALE + 2])
        n2 = bx * bx + by * by + bz * bz
        if n2 <= k2 * f4(1.01):
            return EVERYWHERE  # the sensor is inside
        perpendicular(bx, by, bz, n2, e1, e2)
        kept = f4(1) - k2 / n2
        box = outline_bounds(kind, lx, ly, lz, axes, e1, e2, kept, math.sqrt(k2 * kept), params, table)
    if moving:
        # Neighbouring lines see it from slightly elsewhere.
        slack = f4(0.5) + f4(0.02) * ((box[1] - box[0]) + (box[3] - box[2]))
        return box[0] - slack, box[1] + slack, box[2] - slack, box[3] + slack
    return box


@inner
def sightings(
    x, y, z, rotation, packed, i, k2, lines, travel, swing,
    kind, params, table, row_shift, line_axis, cells, axes, e1, e2, boxes,
):  # fmt: skip
    """Boxes (column low, high, row low, high) that can see a Gaussian, written to ``boxes`` [2,4].

    Args:
        x: centre in the reference frame, as y and z.
        y: see x.
        z: see x.
        rotation: of the Gaussian in the reference frame.
        packed: all Gaussians.
        i: which of them.
        k2: squared radius, in standard deviations, at which it fades to 1/255.
        lines: [l,24] poses per line, a single one if nothing moves.
        travel: metres between the first and the last line.
        swing: radians between them.
        kind: of the grid; params, table, row_shift, line_axis as in ``Grid``.
        params: see kind.
        table: see kind.
        row_shift: see kind.
        line_axis: see kind.
        cells: columns and rows of the grid.
        axes: scratch [3,3].
        e1: scratch [3].
        e2: scratch [3].
        boxes: output.

    Returns:
        Number of boxes (0..2), and the line whose pose suits the Gaussian best.
    """
    wide, high = cells[0], cells[1]
    moving = lines.shape[0] > 1
    turning = kind == LIDAR and params[4] > f4(0)
    line, other = 0, -1
    if moving:
        line = _solve_line(0, x, y, z, lines, kind, params, table, row_shift, line_axis)
        if not turning:
            twin = _solve_line(lines.shape[0] - 1, x, y, z, lines, kind, params, table, row_shift, line_axis)
            if abs(twin - line) > 1:
                other = twin
    u0, u1, v0, v1 = _box_from(
        lines, line, x, y, z, rotation, packed, i, k2, kind, params, table, cells, axes, e1, e2
    )  # fmt: skip
    if moving and turning:
        # Near the seam of a turn it can be seen from the other end of the sweep, too.
        distance = math.sqrt(x * x + y * y + z * z)
        reach = (f4(2) * travel / max(distance, f4(1e-3)) + swing) * params[3] + f4(1)
        low, high_end = u0 - reach, u1 + reach
        if (low <= params[8] and high_end >= params[7]) or (low <= wide + params[8] and high_end >= wide + params[7]):
            other = lines.shape[0] - 1 if 2 * line < lines.shape[0] else 0
    if other >= 0:
        p0, p1, r0, r1 = _box_from(
            lines, other, x, y, z, rotation, packed, i, k2, kind, params, table, cells, axes, e1, e2
        )  # fmt: skip
        if turning:
            shift = wide * f4(math.floor((u0 + u1 - p0 - p1) / (f4(2) * wide) + f4(0.5)))
            p0, p1 = p0 + shift, p1 + shift
        u0, u1, v0, v1 = min(u0, p0), max(u1, p1), min(v0, r0), max(v1, r1)
    if kind == LIDAR:  # rows look up to a residual aside of their column
        u0, u1 = u0 - params[6], u1 - params[5]
    if not (v1 > f4(0) and v0 < high):
        return 0, line
    if turning and u1 - u0 >= wide:
        u0, u1 = f4(0), wide
    count = 0
    if u1 > f4(0) and u0 < wide:
        boxes[0, 0], boxes[0, 1], boxes[0, 2], boxes[0, 3] = u0, u1, v0, v1
        count = 1
    if turning and u1 - u0 < wide and (u0 < f4(0) or u1 > wide):
        # What leaves one side of the grid enters at the other.
        shift = wide if u0 < f4(0) else -wide
        boxes[count, 0], boxes[count, 1], boxes[count, 2], boxes[count, 3] = u0 + shift, u1 + shift, v0, v1
        count += 1
    return count, line
