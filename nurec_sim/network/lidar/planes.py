"""The plane through each return and its neighbours, by which footprints lie on surfaces before any training.

In the axes of a beam (h level to its left, v up, d along it) a plane is ``1 / d = m0 + m1 (h / d) + m2 (v / d)``,
linear in what a range image measures. It is fitted to a window of beams by reweighted least squares, so that what lies
beyond an edge does not count.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from nurec_sim.compute.kernels import kernel
from nurec_sim.network.lidar.range_image import RangeImage

ROWS, COLUMNS = 2, 3
"""The window reaches so far from its centre."""
STEEPEST = 30.0
"""Neighbours whose range differs by more than this many times their distance across the beam lie on other surfaces."""
NOISE_M, NOISE_SHARE = 0.03, 0.002
"""Errors of range beyond this, plus a share of the range, lose weight."""
ROUNDS = 3
PULL = 1e-3
"""Pull towards a plane across the beam, in beams: what has no neighbours faces the sensor."""
PLANE_VALUES = ("slope h", "slope v", "offset", "roughness", "support", "left", "right", "up", "down")


def fit_planes(image: RangeImage) -> Float32[np.ndarray, "rows columns 9"]:
    """Planes of all returns, zeros for beams without one.

    Returns:
        By ``PLANE_VALUES``: by how much the range of the plane falls per metre to the left and up, so that its normal
        away from the sensor is (slope h, slope v, 1); metres from the return to the plane along the beam; mean absolute
        residual, metres; sum of weights by the beams of the window; logarithms of the ranges of the four neighbours by
        the own one, 0 where they did not return.
    """
    rows, columns = image.returned.shape
    out = np.zeros((rows, columns, len(PLANE_VALUES)), np.float32)
    _fit(image.xyz_m, image.eye_m, image.returned, image.full_turn, out)
    return out


@kernel
def _fit(xyz, eye, returned, full_turn, out):
    rows, columns = returned.shape
    size = (2 * ROWS + 1) * (2 * COLUMNS + 1)
    a, b, y, weight = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    for r in range(rows):
        for c in range(columns):
            if not returned[r, c]:
                continue
            px, py, pz = xyz[r, c, 0] - eye[c, 0], xyz[r, c, 1] - eye[c, 1], xyz[r, c, 2] - eye[c, 2]
            reach = np.sqrt(px * px + py * py + pz * pz)
            level = max(np.sqrt(px * px + py * py), 1e-6)
            dx, dy, dz = px / reach, py / reach, pz / reach
            hx, hy = -py / level, px / level
            vx, vy, vz = -dz * hy, dz * hx, dx * hy - dy * hx
            count = 0
            for i in range(max(r - ROWS, 0), min(r + ROWS, rows - 1) + 1):
                for k in range(c - COLUMNS, c + COLUMNS + 1):
                    j = k % columns
                    if (k != j and not full_turn) or not returned[i, j]:
                        continue
                    qx, qy, qz = xyz[i, j, 0] - eye[c, 0], xyz[i, j, 1] - eye[c, 1], xyz[i, j, 2] - eye[c, 2]
                    along = qx * dx + qy * dy + qz * dz
                    if along <= 0.1:
                        continue
                    left, up = qx * hx + qy * hy, qx * vx + qy * vy + qz * vz
                    change = along - reach
                    if abs(change) > STEEPEST * np.sqrt(left * left + up * up) + NOISE_M:
                        continue
                    if i == r and abs(k - c) == 1:
                        out[r, c, 5 if k < c else 6] = np.log(along / reach)
                    if k == c and abs(i - r) == 1:
                        out[r, c, 7 if i < r else 8] = np.log(along / reach)
                    # Scaled by the own range, so that all numbers are near 1.
                    a[count], b[count], y[count], weight[count] = left / along, up / along, reach / along, 1.0
                    count += 1
            noise = (NOISE_M + NOISE_SHARE * reach) / reach
            m0, m1, m2, total = 1.0, 0.0, 0.0, 0.0
            for _ in range(ROUNDS):
                s1, sa, sb, saa, sab, sbb, sy, say, sby = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                spread = 0.0
                for n in range(count):
                    w = weight[n]
                    s1, sa, sb = s1 + w, sa + w * a[n], sb + w * b[n]
                    saa, sab, sbb = saa + w * a[n] * a[n], sab + w * a[n] * b[n], sbb + w * b[n] * b[n]
                    sy, say, sby = sy + w * y[n], say + w * a[n] * y[n], sby + w * b[n] * y[n]
                    spread = max(spread, a[n] * a[n] + b[n] * b[n])
                pull = PULL * spread + 1e-12
                # Centred normal equations of two unknowns.
                caa, cab, cbb = saa - sa * sa / s1 + pull, sab - sa * sb / s1, sbb - sb * sb / s1 + pull
                cay, cby = say - sa * sy / s1, sby - sb * sy / s1
                det = caa * cbb - cab * cab
                m1, m2 = (cbb * cay - cab * cby) / det, (caa * cby - cab * cay) / det
                m0 = (sy - m1 * sa - m2 * sb) / s1
                total = s1
                for n in range(count):
                    error = (y[n] - m0 - m1 * a[n] - m2 * b[n]) / noise
                    weight[n] = 1 / (1 + error * error)
            rough = 0.0
            for n in range(count):
                rough += weight[n] * abs(y[n] - m0 - m1 * a[n] - m2 * b[n])
            m0 = max(m0, 0.2)
            out[r, c, 0], out[r, c, 1] = m1 / m0, m2 / m0
            out[r, c, 2] = (1 / m0 - 1) * reach
            out[r, c, 3] = rough / max(total, 1e-9) * reach
            out[r, c, 4] = total / size
