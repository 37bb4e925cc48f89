"""Kernel that turns Gaussians into records: where they can be seen, and what a ray needs to weigh them exactly.

A record holds the map M = S^-1 R^T from the sensor's reference frame to the frame where the Gaussian is a unit ball,
turned so that the centre lies on its third axis and scaled so that a unit ray through the centre has third coordinate
1. With (x, y, w) = M d, squared distance and hit distance of a ray from the reference point are

    q = n^2 (x^2 + y^2) / (x^2 + y^2 + w^2),   t = r w / (x^2 + y^2 + w^2)

where n is the distance of the centre in standard deviations and r in metres: nothing large cancels in float32. Where
the Gaussian has faded to 1/255, (x^2 + y^2)^0.5 / w is RIM; SLOPE and DEEP are the largest changes of (x, y) and of w
with the direction.
"""

from __future__ import annotations

import math

import numpy as np

from nurec_sim.render.cpu.bounds import perpendicular, pinhole_bounds
from nurec_sim.render.cpu.grid import PINHOLE
from nurec_sim.render.cpu.kernel import f4, inner, kernel
from nurec_sim.render.cpu.pack import COLOUR, LABEL, LOG_OPACITY, QUAT, SCALE
from nurec_sim.render.cpu.sightings import sightings

# Columns of a record.
MAP, BALL, FADE, RANGE, FEATURE, TAG, ORIGIN, RIM, SLOPE, DEEP = 0, 9, 10, 11, 12, 15, 16, 19, 20, 21
RECORD = 22

LOG_255 = math.log(255.0)
TILE = 8
"""Side of the tiles that records are handed out to, in cells."""


@inner
def _rotation(w, x, y, z, out):
    out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@inner
def _motion(first, last):
    """Metres and radians between the poses of two lines."""
    travel = turn = f4(0)
    for k in range(3):
        travel += (last[9 + k] - first[9 + k]) ** 2
    for k in range(9):
        turn += first[k] * last[k]
    return math.sqrt(travel), math.acos(min(max((turn - f4(1)) * f4(0.5), f4(-1)), f4(1)))


@inner
def _cell_span(low, high, cells):
    """First and last cell whose centre lies in [low, high]; the first is larger if there is none."""
    first = np.int64(math.ceil(max(low, f4(0)) - f4(0.5)))
    last = np.int64(math.floor(min(high, cells) - f4(0.5))) if high > f4(0) else -1
    return first, last


@inner
def _drop_between_rays(boxes, count, cells, cell_spans):
    """Cells of the boxes that hold a ray at all, moved to the front; returns their number."""
    kept = 0
    for k in range(count):
        x0, x1 = _cell_span(boxes[k, 0], boxes[k, 1], cells[0])
        y0, y1 = _cell_span(boxes[k, 2], boxes[k, 3], cells[1])
        if x0 <= x1 and y0 <= y1:
            cell_spans[kept, 0], cell_spans[kept, 1], cell_spans[kept, 2], cell_spans[kept, 3] = x0, x1, y0, y1
            kept += 1
    return kept


@inner
def _sh_colour(rest, i, x, y, z, records, n):
    """Add the colour of Gaussian i along a unit direction (basis of ``layers.sh_basis``) to record n; not below 0."""
    k = rest.shape[1]
    xx, yy, zz = x * x, y * y, z * z
    for c in range(3):
        v = records[n, FEATURE + c] + f4(0.4886025) * (z * rest[i, 1, c] - y * rest[i, 0, c] - x * rest[i, 2, c])
        if k > 3:
            v += f4(1.0925485) * (x * y * rest[i, 3, c] - y * z * rest[i, 4, c] - x * z * rest[i, 6, c])
            v += f4(0.31539157) * (2 * zz - xx - yy) * rest[i, 5, c] + f4(0.54627424) * (xx - yy) * rest[i, 7, c]
        if k > 8:
            v += f4(-0.5900436) * (y * (3 * xx - yy) * rest[i, 8, c] + x * (xx - 3 * yy) * rest[i, 14, c])
            v += f4(2.8906114) * x * y * z * rest[i, 9, c] + f4(1.4453057) * z * (xx - yy) * rest[i, 13, c]
            v += f4(-0.45704580) * (4 * zz - xx - yy) * (y * rest[i, 10, c] + x * rest[i, 12, c])
            v += f4(0.37317634) * z * (2 * zz - 3 * xx - 3 * yy) * rest[i, 11, c]
        records[n, FEATURE + c] = max(v, f4(0))


@kernel
def project(
    packed, intensity, sh_rest, first, last, blocks, block_size, eye, frame_quat, world_direction_rows,
    kind, params, table, row_shift, line_axis, lines, cells, by_range, near, records, spans, keys, base,
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
        records: [.., 22] output, from row ``base`` on.
        spans: [..,4] first and last tile column and row of the records' boxes.
        keys: sort keys of the records.
        base: first row to write.

    Returns:
        Number of records written; at most two per Gaussian.
    """
    n = base
    rotation, axes = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32)
    boxes, cell_spans = np.empty((2, 4), np.float32), np.empty((2, 4), np.int64)
    e1, e2 = np.empty(3, np.float32), np.empty(3, np.float32)
    map_ = np.empty((3, 3), np.float32)
    moving = lines.shape[0] > 1
    travel, swing = _motion(lines[0], lines[-1])
    qw, qx, qy, qz = frame_quat[0], frame_quat[1], frame_quat[2], frame_quat[3]
    w_ = world_direction_rows
    for index in range(first, last):
        start = blocks[index] * block_size
        for i in range(start, min(start + block_size, packed.shape[0])):
            k2 = f4(2) * (packed[i, LOG_OPACITY] + f4(LOG_255))
            if not k2 > f4(0):
                continue
            dx, dy, dz = f4(packed[i, 0] - eye[0]), f4(packed[i, 1] - eye[1]), f4(packed[i, 2] - eye[2])
            x = w_[0, 0] * dx + w_[0, 1] * dy + w_[0, 2] * dz
            y = w_[1, 0] * dx + w_[1, 1] * dy + w_[1, 2] * dz
            z = w_[2, 0] * dx + w_[2, 1] * dy + w_[2, 2] * dz
            distance = math.sqrt(x * x + y * y + z * z)
            key = distance if by_range else z
            if not key >= near:
                continue
            gw, gx, gy, gz = packed[i, QUAT], packed[i, QUAT + 1], packed[i, QUAT + 2], packed[i, QUAT + 3]
            _rotation(
                qw * gw - qx * gx - qy * gy - qz * gz,
                qw * gx + qx * gw + qy * gz - qz * gy,
                qw * gy - qx * gz + qy * gw + qz * gx,
                qw * gz + qx * gy - qy * gx + qz * gw,
                rotation,
            )

            if kind == PINHOLE and not moving:
                for a in range(3):
                    for b in range(3):
                        axes[a, b] = rotation[a, b] * packed[i, SCALE + b]
                u0, u1, v0, v1 = pinhole_bounds(x, y, z, axes, k2, params, cells)
                line = 0
                seen = 1 if u1 > f4(0) and u0 < cells[0] and v1 > f4(0) and v0 < cells[1] else 0
                boxes[0, 0], boxes[0, 1], boxes[0, 2], boxes[0, 3] = u0, u1, v0, v1
            else:
                seen, line = sightings(
                    x, y, z, rotation, packed, i, k2, lines, travel, swing,
                    kind, params, table, row_shift, line_axis, cells, axes, e1, e2, boxes,
                )  # fmt: skip
            seen = _drop_between_rays(boxes, seen, cells, cell_spans)
            if seen == 0:
                continue
            ox = oy = oz = f4(0)
            if moving:
                ox, oy, oz = lines[line, 9], lines[line, 10], lines[line, 11]

            # The map, about the origin of the Gaussian's own line.
            rx, ry, rz = x - ox, y - oy, z - oz
            far = math.sqrt(rx * rx + ry * ry + rz * rz)
            for a in range(3):
                inverse = f4(1) / packed[i, SCALE + a]
                for b in range(3):
                    map_[a, b] = rotation[b, a] * inverse
            bx = map_[0, 0] * rx + map_[0, 1] * ry + map_[0, 2] * rz
            by = map_[1, 0] * rx + map_[1, 1] * ry + map_[1, 2] * rz
            bz = map_[2, 0] * rx + map_[2, 1] * ry + map_[2, 2] * rz
            n2 = bx * bx + by * by + bz * bz
            if not n2 > f4(0):
                continue
            perpendicular(bx, by, bz, n2, e1, e2)
            away = math.sqrt(n2)
            unit = far / away
            for b in range(3):
                records[n, MAP + b] = unit * (e1[0] * map_[0, b] + e1[1] * map_[1, b] + e1[2] * map_[2, b])
                records[n, MAP + 3 + b] = unit * (e2[0] * map_[0, b] + e2[1] * map_[1, b] + e2[2] * map_[2, b])
                records[n, MAP + 6 + b] = unit * (bx * map_[0, b] + by * map_[1, b] + bz * map_[2, b]) / away
            records[n, BALL] = n2 * f4(1 / 16) / (far * far if moving else f4(1))
            xx = yy = xy = ww = f4(0)
            for b in range(3):
                xx += records[n, MAP + b] * records[n, MAP + b]
                yy += records[n, MAP + 3 + b] * records[n, MAP + 3 + b]
                xy += records[n, MAP + b] * records[n, MAP + 3 + b]
                ww += records[n, MAP + 6 + b] * records[n, MAP + 6 + b]
            half = f4(0.5) * (xx - yy)
            records[n, SLOPE] = math.sqrt(f4(0.5) * (xx + yy) + math.sqrt(half * half + xy * xy))
            records[n, DEEP] = math.sqrt(ww)
            records[n, RIM] = math.sqrt(k2 / (n2 - k2)) if n2 > f4(1.0001) * k2 else f4(1e9)
            records[n, FADE] = packed[i, LOG_OPACITY] * f4(-1 / 8)
            records[n, RANGE] = far
            records[n, TAG] = packed[i, LABEL]
            records[n, ORIGIN], records[n, ORIGIN + 1], records[n, ORIGIN + 2] = ox, oy, oz
            if intensity.shape[0] > 0:
                value = intensity[i]
                known = value == value
                records[n, FEATURE] = value if known else f4(0)
                records[n, FEATURE + 1] = f4(1) if known else f4(0)
                records[n, FEATURE + 2] = f4(0)
            else:
                records[n, FEATURE], records[n, FEATURE + 1], records[n, FEATURE + 2] = (
                    packed[i, COLOUR],
                    packed[i, COLOUR + 1],
                    packed[i, COLOUR + 2],
                )
                if sh_rest.shape[0] > 0:
                    inverse = f4(1) / max(math.sqrt(dx * dx + dy * dy + dz * dz), f4(1e-12))
                    _sh_colour(sh_rest, i, dx * inverse, dy * inverse, dz * inverse, records, n)
            for k in range(seen):
                if k > 0:
                    for e in range(RECORD):
                        records[n, e] = records[n - 1, e]
                for b in range(4):
                    spans[n, b] = cell_spans[k, b] // TILE
                keys[n] = key
                n += 1
    return n - base
