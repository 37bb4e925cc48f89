"""The kernel of ``planes``: windows of beams, and planes through them.

Neighbour by neighbour, for a block of beams of a row at once, each quantity an array of its own: compilers then do
several beams at once. Whether a neighbour counts is a weight, since a branch would keep them from it.
"""

from __future__ import annotations

import numpy as np

from nurec_sim.compute.kernels import unchecked_kernel

ROWS, COLUMNS = 2, 3
"""The window reaches so far from its centre."""
STEEPEST = 30.0
"""Neighbours whose range differs by more than this many times their distance across the beam lie on other surfaces."""
NOISE_M, NOISE_SHARE = 0.03, 0.002
"""Errors of range beyond this, plus a share of the range, lose weight."""
NEAREST_M = 0.1
"""Neighbours count from this distance along the beam on."""
ROUNDS = 3
PULL = 1e-3
"""Pull towards a plane across the beam, in beams: what has no neighbours faces the sensor."""
LEAST_M0 = 0.2
WIDE = 2 * COLUMNS + 1
SIZE = (2 * ROWS + 1) * WIDE
BLOCK = 128
"""Beams of a row that are fitted at once: few loops, and their neighbours stay in the cache."""


@unchecked_kernel
def fit_windows(xyz, eye, out):
    """Fits the planes of all beams.

    Args:
        xyz: [3,rows,COLUMNS + columns + COLUMNS] float32, NaN for beams without a return; beyond the ends lie the
            columns on the other side of the seam, or NaN.
        eye: [3,columns] float32, where the sensor was at each column.
        out: [rows,columns,9] float32, zeros, filled for beams with a return (``planes.PLANE_VALUES``).
    """
    rows, columns = out.shape[0], out.shape[1]
    # Of each beam its direction, range, error of range as a part of it, and level and upright axes across it.
    dx, dy, dz, reach = (np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32),
                         np.empty(BLOCK, np.float32))  # fmt: skip
    noise, hx, hy = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    vx, vy, vz = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    # A neighbour along the beam and across it.
    along, left, up = np.empty(BLOCK, np.float32), np.empty(BLOCK), np.empty(BLOCK)
    # All neighbours: left and up by the distance along the beam, the own range by it; whether they count, and weights.
    a, b, y = np.empty((SIZE, BLOCK)), np.empty((SIZE, BLOCK)), np.empty((SIZE, BLOCK))
    counts, weight = np.empty((SIZE, BLOCK)), np.empty((SIZE, BLOCK))
    # Their weighted sums, and the plane.
    s1, sa, sb, saa, sab = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    sbb, sy, say, sby = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    m0, m1, m2, spread, rough = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    for r in range(rows):
        low, high = max(r - ROWS, 0), min(r + ROWS, rows - 1) + 1
        begin, end = (low - r + ROWS) * WIDE, (high - r + ROWS) * WIDE
        for start in range(0, columns, BLOCK):
            many = min(BLOCK, columns - start)
            ex, ey, ez = eye[0, start : start + many], eye[1, start : start + many], eye[2, start : start + many]
            here = start + COLUMNS
            px, py, pz = xyz[0, r, here : here + many], xyz[1, r, here : here + many], xyz[2, r, here : here + many]
            for c in range(many):
                x, y_, z = px[c] - ex[c], py[c] - ey[c], pz[c] - ez[c]
                reach[c] = np.sqrt(x * x + y_ * y_ + z * z)
                level = np.float64(np.sqrt(x * x + y_ * y_))
                level = level if level > 1e-6 else 1e-6
                dx[c], dy[c], dz[c] = x / reach[c], y_ / reach[c], z / reach[c]
                hx[c], hy[c] = -y_ / level, x / level
                vx[c], vy[c], vz[c] = -dz[c] * hy[c], dz[c] * hx[c], dx[c] * hy[c] - dy[c] * hx[c]
                noise[c] = (NOISE_M + NOISE_SHARE * reach[c]) / reach[c]
                spread[c] = 0.0
            for n in range(begin, end):
                i, k = r - ROWS + n // WIDE, n % WIDE
                there = start + k
                qx, qy, qz = (xyz[0, i, there : there + many], xyz[1, i, there : there + many],
                              xyz[2, i, there : there + many])  # fmt: skip
                for c in range(many):
                    along[c] = (qx[c] - ex[c]) * dx[c] + (qy[c] - ey[c]) * dy[c] + (qz[c] - ez[c]) * dz[c]
                for c in range(many):
                    left[c] = (qx[c] - ex[c]) * hx[c] + (qy[c] - ey[c]) * hy[c]
                for c in range(many):
                    up[c] = (qx[c] - ex[c]) * vx[c] + (qy[c] - ey[c]) * vy[c] + (qz[c] - ez[c]) * vz[c]
                for c in range(many):
                    most = STEEPEST * np.sqrt(left[c] * left[c] + up[c] * up[c]) + NOISE_M
                    # False for NaN, without a return.
                    counts[n, c] = 1.0 if (along[c] > NEAREST_M) & (abs(along[c] - reach[c]) <= most) else 0.0
                for c in range(many):
                    # Scaled by the own range, so that all numbers are near 1.
                    on = counts[n, c] > 0
                    a[n, c] = left[c] / along[c] if on else 0.0
                    b[n, c] = up[c] / along[c] if on else 0.0
                    y[n, c] = reach[c] / along[c] if on else 0.0
                for c in range(many):
                    apart = a[n, c] * a[n, c] + b[n, c] * b[n, c]
                    spread[c] = apart if apart > spread[c] else spread[c]
                side = 0
                if i == r and abs(k - COLUMNS) == 1:
                    side = 5 if k < COLUMNS else 6
                elif k == COLUMNS and abs(i - r) == 1:
                    side = 7 if i < r else 8
                if side:
                    for c in range(many):
                        if counts[n, c] > 0:
                            out[r, start + c, side] = np.log(along[c] / reach[c])
                for c in range(many):
                    weight[n, c] = counts[n, c]
            for _ in range(ROUNDS):
                for c in range(many):
                    s1[c], sa[c], sb[c], sy[c] = 0.0, 0.0, 0.0, 0.0
                for c in range(many):
                    saa[c], sab[c], sbb[c], say[c], sby[c] = 0.0, 0.0, 0.0, 0.0, 0.0
                # A row of the window at once: its sums stay in registers.
                for n in range(begin, end, WIDE):
                    for c in range(many):
                        t0, t1, t2 = s1[c], sa[c], sb[c]
                        for k in range(WIDE):
                            w = weight[n + k, c]
                            t0, t1, t2 = t0 + w, t1 + w * a[n + k, c], t2 + w * b[n + k, c]
                        s1[c], sa[c], sb[c] = t0, t1, t2
                    for c in range(many):
                        t0, t1, t2 = saa[c], sab[c], sbb[c]
                        for k in range(WIDE):
                            w, p, q = weight[n + k, c], a[n + k, c], b[n + k, c]
                            t0, t1, t2 = t0 + w * p * p, t1 + w * p * q, t2 + w * q * q
                        saa[c], sab[c], sbb[c] = t0, t1, t2
                    for c in range(many):
                        t0, t1, t2 = sy[c], say[c], sby[c]
                        for k in range(WIDE):
                            w, v = weight[n + k, c], y[n + k, c]
                            t0, t1, t2 = t0 + w * v, t1 + w * a[n + k, c] * v, t2 + w * b[n + k, c] * v
                        sy[c], say[c], sby[c] = t0, t1, t2
                for c in range(many):
                    pull = PULL * spread[c] + 1e-12
                    # Centred normal equations of two unknowns.
                    caa, cbb = saa[c] - sa[c] * sa[c] / s1[c] + pull, sbb[c] - sb[c] * sb[c] / s1[c] + pull
                    cab = sab[c] - sa[c] * sb[c] / s1[c]
                    cay, cby = say[c] - sa[c] * sy[c] / s1[c], sby[c] - sb[c] * sy[c] / s1[c]
                    det = caa * cbb - cab * cab
                    m1[c], m2[c] = (cbb * cay - cab * cby) / det, (caa * cby - cab * cay) / det
                    m0[c] = (sy[c] - m1[c] * sa[c] - m2[c] * sb[c]) / s1[c]
                for n in range(begin, end):
                    for c in range(many):
                        error = (y[n, c] - m0[c] - m1[c] * a[n, c] - m2[c] * b[n, c]) / noise[c]
                        weight[n, c] = counts[n, c] / (1 + error * error)
            for c in range(many):
                rough[c] = 0.0
            for n in range(begin, end):
                for c in range(many):
                    rough[c] += weight[n, c] * abs(y[n, c] - m0[c] - m1[c] * a[n, c] - m2[c] * b[n, c])
            for c in range(many):
                # A beam with a return, which is not so near that it does not count itself.
                if s1[c] > 0:
                    near = max(m0[c], LEAST_M0)
                    out[r, start + c, 0], out[r, start + c, 1] = m1[c] / near, m2[c] / near
                    out[r, start + c, 2] = (1 / near - 1) * reach[c]
                    out[r, start + c, 3] = rough[c] / max(s1[c], 1e-9) * reach[c]
                    out[r, start + c, 4] = s1[c] / SIZE
