"""Kernel that turns the sums of records into gradients of Gaussians and of the sensor's pose; float64, closed form.

With A = S^-1 R^T, b = A (mean - eye), n = |b| and e1, e2, b / n as in ``records``, let Mrc be the sum over all rays of
the gradient by row r times coordinate c (r, c of X, Y, W) and F the gradient by FLAT. Then a small change dA has the
gradient K A^-T with, in the axes e1, e2, b / n, the symmetric

    K = [[Mxx, Mxy, 4 Mwx / n], [., Myy, 4 Mwy / n], [., ., -32 F / n^2]]

while that by b at fixed A is

    g = e1 (4 Mwx / n^2 - Mxw / 4) + e2 (4 Mwy / n^2 - Myw / 4) - b (Mww + 32 F / n^2) / n^2

where e1 and e2 follow b without spinning around it. From K, in the Gaussian's axes, the gradient by the logarithm of
scale i is -Kii and the torque about axis 1 is K23 (s3 / s2 - s2 / s3), and so on in turn; from g, that by the mean is
R S^-1 g. Nothing large cancels. The sensor feels the opposite of all forces and torques.
"""

from __future__ import annotations

import math

import numpy as np

from nurec_sim.render.cpu.backward.blend import (
    S_FADE,
    S_FEATURE,
    S_FLAT,
    S_WW,
    S_WX,
    S_WY,
    S_XW,
    S_XX,
    S_XY,
    S_YW,
    S_YY,
    SUMS,
)
from nurec_sim.render.cpu.kernel import inner, kernel
from nurec_sim.render.cpu.pack import BLOCK, MAX_OPACITY, MIN_SCALE_M
from nurec_sim.render.cpu.records import XROW, tile_count


@inner
def _axes(q, out):
    """Rotation of a unit quaternion."""
    w, x, y, z = q
    out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@inner
def _frame(axes, scale, ball, records, i, world_from_sensor, frame):
    """Rows e1, e2, b / n of a record, in the Gaussian's axes: b from the parameters, e1 as its X row has it."""
    n = math.sqrt(ball[0] ** 2 + ball[1] ** 2 + ball[2] ** 2)
    along = 0.0
    m = world_from_sensor
    x, y, z = records[i, XROW], records[i, XROW + 1], records[i, XROW + 2]
    x, y, z = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z, m[1, 0] * x + m[1, 1] * y + m[1, 2] * z,
               m[2, 0] * x + m[2, 1] * y + m[2, 2] * z)  # fmt: skip
    away = 1 / n
    for k in range(3):
        frame[2, k] = ball[k] * away
        frame[0, k] = (axes[0, k] * x + axes[1, k] * y + axes[2, k] * z) * scale[k]
        along += frame[0, k] * frame[2, k]
    length = 0.0
    for k in range(3):
        frame[0, k] -= along * frame[2, k]
        length += frame[0, k] ** 2
    # Orthogonalised against b in float64: the record's rows are float32.
    inverse = 1 / math.sqrt(max(length, 1e-300))
    for k in range(3):
        frame[0, k] *= inverse
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        frame[1, k] = frame[2, i] * frame[0, j] - frame[2, j] * frame[0, i]
    return n


@inner
def _kernel_matrix(sums, inverse_n, frame, out):
    """K in the Gaussian's axes."""
    xx, xy, yy = sums[S_XX], sums[S_XY], sums[S_YY]
    xb, yb = 4 * sums[S_WX] * inverse_n, 4 * sums[S_WY] * inverse_n
    bb = -32 * sums[S_FLAT] * inverse_n * inverse_n
    for j in range(3):
        e1, e2, e3 = frame[0, j], frame[1, j], frame[2, j]
        a, b, c = xx * e1 + xy * e2 + xb * e3, xy * e1 + yy * e2 + yb * e3, xb * e1 + yb * e2 + bb * e3
        for i in range(3):
            out[i, j] = frame[0, i] * a + frame[1, i] * b + frame[2, i] * c


@kernel
def project_back(first, count, projected, slots, gaussians, world_from_sensor, by, pose):
    """Add the gradients of a run of records to those of their Gaussians and of the pose.

    Args:
        first: first record.
        count: how many.
        projected: see ``records.Projected``.
        slots: see ``tiles.RecordSlots``: what ``draw_tiles_back`` left.
        gaussians: see ``repack.RawGaussians``.
        world_from_sensor: [4,4] float64, at the reference instant.
        by: gradients by ``gaussians``, added to.
        pose: [blocks,6] float64 per block of 256 Gaussians, added to: force on the eye, torque about it, in the world.
    """
    # Float64: sums of many small terms that partly cancel.
    sums, axes, frame = np.empty(SUMS), np.empty((3, 3)), np.empty((3, 3))
    offset, ball, by_ball, force, s = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    inverse_s, k_ = np.empty(3), np.empty((3, 3))
    mean, quat, scale, opacity, _ = gaussians
    spans = projected.spans
    for i in range(first, first + count):
        tiles = tile_count(spans, i)
        sums[:] = 0.0
        for slot in range(slots.first[i], slots.first[i] + tiles):
            for k in range(SUMS):
                sums[k] += slots.sums[slot, k]
        some = False
        for k in range(SUMS):
            some |= sums[k] != 0.0
        if not some:
            continue
        g = projected.sources[i]
        norm = math.sqrt(
            np.float64(quat[g, 0]) ** 2 + np.float64(quat[g, 1]) ** 2
            + np.float64(quat[g, 2]) ** 2 + np.float64(quat[g, 3]) ** 2
        )  # fmt: skip
        shrink = 1 / norm
        q = (quat[g, 0] * shrink, quat[g, 1] * shrink, quat[g, 2] * shrink, quat[g, 3] * shrink)
        _axes(q, axes)
        for k in range(3):
            offset[k] = mean[g, k] - world_from_sensor[k, 3]
            s[k] = max(np.float64(scale[g, k]), MIN_SCALE_M)
            inverse_s[k] = 1 / s[k]
        for k in range(3):
            ball[k] = (axes[0, k] * offset[0] + axes[1, k] * offset[1] + axes[2, k] * offset[2]) * inverse_s[k]
        n = _frame(axes, s, ball, projected.records, i, world_from_sensor, frame)
        inverse_n = 1 / n
        inverse = inverse_n * inverse_n
        # g of the module's text, in the axes e1, e2, b / n, divided by the scales: S^-1 g.
        across = 4 * sums[S_WX] * inverse - sums[S_XW] / 4
        down = 4 * sums[S_WY] * inverse - sums[S_YW] / 4
        along = -(sums[S_WW] + 32 * sums[S_FLAT] * inverse) * inverse_n
        for k in range(3):
            by_ball[k] = (frame[0, k] * across + frame[1, k] * down + frame[2, k] * along) * inverse_s[k]
        for k in range(3):
            force[k] = axes[k, 0] * by_ball[0] + axes[k, 1] * by_ball[1] + axes[k, 2] * by_ball[2]
        _kernel_matrix(sums, inverse_n, frame, k_)
        # Torque about the Gaussian's own axes; spheres (equal scales) have none.
        tx = k_[1, 2] * (s[2] * inverse_s[1] - s[1] * inverse_s[2])
        ty = k_[2, 0] * (s[0] * inverse_s[2] - s[2] * inverse_s[0])
        tz = k_[0, 1] * (s[1] * inverse_s[0] - s[0] * inverse_s[1])
        # A turn w in the Gaussian's axes changes a unit quaternion by q (0, w) / 2, so a torque t has the gradient
        # 2 q (0, t), divided by the given norm.
        by.quat[g, 0] += (-q[1] * tx - q[2] * ty - q[3] * tz) * 2 * shrink
        by.quat[g, 1] += (q[0] * tx + q[2] * tz - q[3] * ty) * 2 * shrink
        by.quat[g, 2] += (q[0] * ty + q[3] * tx - q[1] * tz) * 2 * shrink
        by.quat[g, 3] += (q[0] * tz + q[1] * ty - q[2] * tx) * 2 * shrink
        for k in range(3):
            by.mean[g, k] += force[k]
            # By the logarithm of the scale it is -Kii; where a value is clamped it has no gradient.
            if scale[g, k] >= MIN_SCALE_M:
                by.scale[g, k] -= k_[k, k] * inverse_s[k]
            by.features[g, k] += sums[S_FEATURE + k]
        # FADE = -log(p) / 8.
        if opacity[g] < MAX_OPACITY:
            by.opacity[g] -= sums[S_FADE] / (8 * np.float64(opacity[g]))
        # By blocks of Gaussians, so that neither threads nor their number change the sum.
        part = g // BLOCK
        for k in range(3):
            i1, i2 = (k + 1) % 3, (k + 2) % 3
            pose[part, k] -= force[k]
            pose[part, 3 + k] -= offset[i1] * force[i2] - offset[i2] * force[i1]
            pose[part, 3 + k] -= axes[k, 0] * tx + axes[k, 1] * ty + axes[k, 2] * tz
