"""Kernel that turns Gaussians into records: where they can be seen, and what a ray needs to weigh them exactly.

A record holds the map M = S^-1 R^T from the sensor's reference frame to the frame where the Gaussian is a unit ball,
turned so that the centre lies on its third axis and scaled so that a unit ray through the centre has third coordinate
1. With (x, y, w) = M d, squared distance and hit distance of a ray from the reference point are

    q = n^2 (x^2 + y^2) / (x^2 + y^2 + w^2),   t = r w / (x^2 + y^2 + w^2)

where n is the distance of the centre in standard deviations and r in metres: nothing large cancels in float32.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from nurec_sim.render.cpu.bounds import EVERYWHERE, JIT, f4, outline_bounds, pinhole_bounds, place
from nurec_sim.render.cpu.grid import LIDAR, PINHOLE

# Columns of a packed Gaussian (pack.py).
MEAN, QUAT, SCALE, LOG_OPACITY, REACH, COLOUR, LABEL = 0, 3, 7, 10, 11, 12, 15
PACKED = 16

# Columns of a record.
BOX, MAP, BALL, FADE, RANGE, FEATURE, TAG, ORIGIN = 0, 4, 13, 14, 15, 16, 19, 20
RECORD = 24

LOG_255 = math.log(255.0)


@njit(**JIT)
def _rotation(w, x, y, z, out):
    out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@njit(**JIT)
def _line_of(kind, column, row, line_axis, lines, row_shift):
    """The line of rays (instant) that looks at a place."""
    if kind == LIDAR:
        r = min(max(np.int64(row), 0), row_shift.shape[0] - 1)
        return (np.int64(math.floor(column)) - row_shift[r]) % lines
    return min(max(np.int64(math.floor(column if line_axis == 1 else row)), 0), lines - 1)


@njit(**JIT)
def _sh_colour(rest, x, y, z, out):
    """Add view-dependent colour along a unit direction (basis of ``layers.sh_basis``); not below 0."""
    k = rest.shape[0]
    xx, yy, zz = x * x, y * y, z * z
    for c in range(3):
        v = out[c] + f4(0.4886025) * (z * rest[1, c] - y * rest[0, c] - x * rest[2, c])
        if k > 3:
            v += f4(1.0925485) * (x * y * rest[3, c] - y * z * rest[4, c] - x * z * rest[6, c])
            v += f4(0.31539157) * (2 * zz - xx - yy) * rest[5, c] + f4(0.54627424) * (xx - yy) * rest[7, c]
        if k > 8:
            v += f4(-0.5900436) * (y * (3 * xx - yy) * rest[8, c] + x * (xx - 3 * yy) * rest[14, c])
            v += f4(2.8906114) * x * y * z * rest[9, c] + f4(1.4453057) * z * (xx - yy) * rest[13, c]
            v += f4(-0.45704580) * (4 * zz - xx - yy) * (y * rest[10, c] + x * rest[12, c])
            v += f4(0.37317634) * z * (2 * zz - 3 * xx - 3 * yy) * rest[11, c]
        out[c] = max(v, f4(0))


@njit(**JIT)
def project(
    packed, intensity, sh_rest, first, last, blocks, block_size, eye, frame_quat, world_direction_rows,
    kind, params, table, row_shift, line_axis, lines, cells, by_range, near, records, keys, base,
):  # fmt: skip
    """Records of the Gaussians that can be seen, in the order of ``packed``.

    Args:
        packed: [n,16] Gaussians.
        intensity: [n] LiDAR intensity used as features (1 value, 1 if known), or empty for colours.
        sh_rest: [n,k,3] or [0,0,3].
        first: first entry of ``blocks`` to take.
        last: one behind the last.
        blocks: numbers of the blocks of ``block_size`` Gaussians to look at.
        block_size: Gaussians per block.
        eye: origin of the reference frame in the world, float64 [3].
        frame_quat: quaternion of reference_from_world.
        world_direction_rows: rotation reference_from_world, [3,3].
        kind: of the grid, as are params, table, row_shift, line_axis.
        params: see ``Grid``.
        table: see ``Grid``.
        row_shift: see ``Grid``.
        line_axis: see ``Grid``.
        lines: [l,24] per line: rotation and translation of reference_from_line, then of line_from_reference; a
            single line when nothing moves.
        cells: (columns, rows) of the grid, float32.
        by_range: order by distance instead of z.
        near: near plane.
        records: [.., 24] output, from row ``base`` on.
        keys: sort keys of the records.
        base: first row to write.

    Returns:
        Number of records written; at most two per Gaussian.
    """
    n = base
    rotation, axes = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32)
    turned = np.empty((3, 3), np.float32)
    e1, e2 = np.empty(3, np.float32), np.empty(3, np.float32)
    map_ = np.empty((3, 3), np.float32)
    wide, high = cells[0], cells[1]
    moving = lines.shape[0] > 1
    qw, qx, qy, qz = frame_quat[0], frame_quat[1], frame_quat[2], frame_quat[3]
    w_ = world_direction_rows
    for index in range(first, last):
        start = blocks[index] * block_size
        for i in range(start, min(start + block_size, packed.shape[0])):
            g = packed[i]
            k2 = f4(2) * (g[LOG_OPACITY] + f4(LOG_255))
            if not k2 > f4(0):
                continue
            dx, dy, dz = f4(g[0] - eye[0]), f4(g[1] - eye[1]), f4(g[2] - eye[2])
            x = w_[0, 0] * dx + w_[0, 1] * dy + w_[0, 2] * dz
            y = w_[1, 0] * dx + w_[1, 1] * dy + w_[1, 2] * dz
            z = w_[2, 0] * dx + w_[2, 1] * dy + w_[2, 2] * dz
            distance = math.sqrt(x * x + y * y + z * z)
            key = distance if by_range else z
            if not key >= near:
                continue
            gw, gx, gy, gz = g[QUAT], g[QUAT + 1], g[QUAT + 2], g[QUAT + 3]
            _rotation(qw * gw - qx * gx - qy * gy - qz * gz, qw * gx + qx * gw + qy * gz - qz * gy,
                      qw * gy - qx * gz + qy * gw + qz * gx, qw * gz + qx * gy - qy * gx + qz * gw, rotation)  # fmt: skip

            # Bounds, and the line whose pose the record refers to. A moving sensor can see a Gaussian from two lines
            # (around the seam of a sweep), so the search for it starts from the first and from the last one.
            ox = oy = oz = f4(0)
            boxes = 0
            u0 = u1 = v0 = v1 = p0 = p1 = r0 = r1 = f4(0)
            other_line = -1
            for guess in range(2 if moving else 1):
                lx, ly, lz = x, y, z
                line = 0 if guess == 0 else lines.shape[0] - 1
                if moving:
                    for _ in range(4):
                        m = lines[line]
                        lx = m[12] * x + m[13] * y + m[14] * z + m[21]
                        ly = m[15] * x + m[16] * y + m[17] * z + m[22]
                        lz = m[18] * x + m[19] * y + m[20] * z + m[23]
                        column, row = place(kind, lx, ly, lz, params, table)
                        following = _line_of(kind, column, row, line_axis, lines.shape[0], row_shift)
                        if following == line:
                            break
                        line = following
                    if guess == 1 and abs(line - other_line) <= 1:
                        continue
                    other_line = line
                    m = lines[line]
                    for a in range(3):
                        for b in range(3):
                            turned[a, b] = (m[12 + 3 * a] * rotation[0, b] + m[13 + 3 * a] * rotation[1, b]
                                            + m[14 + 3 * a] * rotation[2, b])  # fmt: skip
                    if guess == 0:
                        ox, oy, oz = m[9], m[10], m[11]
                else:
                    turned[:, :] = rotation
                for a in range(3):
                    for b in range(3):
                        axes[a, b] = turned[a, b] * g[SCALE + b]
                if kind == PINHOLE:
                    box = pinhole_bounds(lx, ly, lz, axes, k2, params, cells) if lz > f4(1e-3) else EVERYWHERE
                else:
                    bx = (turned[0, 0] * lx + turned[1, 0] * ly + turned[2, 0] * lz) / g[SCALE]
                    by = (turned[0, 1] * lx + turned[1, 1] * ly + turned[2, 1] * lz) / g[SCALE + 1]
                    bz = (turned[0, 2] * lx + turned[1, 2] * ly + turned[2, 2] * lz) / g[SCALE + 2]
                    n2 = bx * bx + by * by + bz * bz
                    if n2 <= k2 * f4(1.01):
                        box = EVERYWHERE  # the sensor is inside
                    else:
                        _perpendicular(bx, by, bz, n2, e1, e2)
                        part = k2 / n2
                        box = outline_bounds(kind, lx, ly, lz, axes, e1, e2, f4(1) - part,
                                             math.sqrt(k2 * (f4(1) - part)), params, table)  # fmt: skip
                if moving:
                    # Neighbouring lines see it from slightly elsewhere.
                    slack = f4(0.5) + f4(0.02) * ((box[1] - box[0]) + (box[3] - box[2]))
                    box = (box[0] - slack, box[1] + slack, box[2] - slack, box[3] + slack)
                if boxes == 0:
                    u0, u1, v0, v1 = box
                    boxes = 1
                elif kind == LIDAR and abs((box[0] + box[1]) - (u0 + u1)) > wide:
                    p0, p1, r0, r1 = box
                    boxes = 2
                else:
                    u0, u1, v0, v1 = min(u0, box[0]), max(u1, box[1]), min(v0, box[2]), max(v1, box[3])

            if kind == LIDAR:
                u0, u1 = u0 - params[6], u1 - params[5]
                p0, p1 = p0 - params[6], p1 - params[5]
                if boxes == 1 and params[4] > f4(0) and u1 - u0 < wide:
                    # Around the seam: the part outside of the grid appears at its other side.
                    if u0 < f4(0):
                        p0, p1, r0, r1, boxes = u0 + wide, u1 + wide, v0, v1, 2
                    elif u1 > wide:
                        p0, p1, r0, r1, boxes = u0 - wide, u1 - wide, v0, v1, 2
            first_seen = u1 > f4(0) and u0 < wide and v1 > f4(0) and v0 < high
            second_seen = boxes == 2 and p1 > f4(0) and p0 < wide and r1 > f4(0) and r0 < high
            if not (first_seen or second_seen):
                continue

            # The map, about the origin of the Gaussian's own line.
            rx, ry, rz = x - ox, y - oy, z - oz
            far = math.sqrt(rx * rx + ry * ry + rz * rz)
            for a in range(3):
                inverse = f4(1) / g[SCALE + a]
                for b in range(3):
                    map_[a, b] = rotation[b, a] * inverse
            bx = map_[0, 0] * rx + map_[0, 1] * ry + map_[0, 2] * rz
            by = map_[1, 0] * rx + map_[1, 1] * ry + map_[1, 2] * rz
            bz = map_[2, 0] * rx + map_[2, 1] * ry + map_[2, 2] * rz
            n2 = bx * bx + by * by + bz * bz
            if not n2 > f4(0):
                continue
            _perpendicular(bx, by, bz, n2, e1, e2)
            away = math.sqrt(n2)
            unit = far / away
            out = records[n]
            for b in range(3):
                out[MAP + b] = unit * (e1[0] * map_[0, b] + e1[1] * map_[1, b] + e1[2] * map_[2, b])
                out[MAP + 3 + b] = unit * (e2[0] * map_[0, b] + e2[1] * map_[1, b] + e2[2] * map_[2, b])
                out[MAP + 6 + b] = unit * (bx * map_[0, b] + by * map_[1, b] + bz * map_[2, b]) / away
            out[BALL] = n2 * f4(1 / 16) / (far * far if moving else f4(1))
            out[FADE] = g[LOG_OPACITY] * f4(-1 / 8)
            out[RANGE] = far
            out[TAG] = g[LABEL]
            out[ORIGIN], out[ORIGIN + 1], out[ORIGIN + 2] = ox, oy, oz
            if intensity.shape[0] > 0:
                value = intensity[i]
                known = value == value
                out[FEATURE] = value if known else f4(0)
                out[FEATURE + 1] = f4(1) if known else f4(0)
                out[FEATURE + 2] = f4(0)
            else:
                out[FEATURE], out[FEATURE + 1], out[FEATURE + 2] = g[COLOUR], g[COLOUR + 1], g[COLOUR + 2]
                if sh_rest.shape[0] > 0:
                    inverse = f4(1) / max(math.sqrt(dx * dx + dy * dy + dz * dz), f4(1e-12))
                    _sh_colour(sh_rest[i], dx * inverse, dy * inverse, dz * inverse, out[FEATURE : FEATURE + 3])
            if not first_seen:
                u0, u1, v0, v1 = p0, p1, r0, r1
                second_seen = False
            out[BOX], out[BOX + 1], out[BOX + 2], out[BOX + 3] = u0, u1, v0, v1
            keys[n] = key
            n += 1
            if second_seen:
                records[n, :] = out
                twin = records[n]
                twin[BOX], twin[BOX + 1], twin[BOX + 2], twin[BOX + 3] = p0, p1, r0, r1
                keys[n] = key
                n += 1
    return n - base


@njit(**JIT)
def _perpendicular(x, y, z, n2, e1, e2):
    """Two unit vectors perpendicular to a vector and to each other (Duff et al. 2017)."""
    inverse = f4(1) / math.sqrt(n2)
    x, y, z = x * inverse, y * inverse, z * inverse
    sign = f4(1) if z >= f4(0) else f4(-1)
    a = f4(-1) / (sign + z)
    b = x * y * a
    e1[0], e1[1], e1[2] = f4(1) + sign * x * x * a, sign * b, -sign * x
    e2[0], e2[1], e2[2] = b, sign + y * y * a, -y
