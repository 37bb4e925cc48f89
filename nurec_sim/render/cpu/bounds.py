"""Kernels that bound where on the ray grid a Gaussian can be seen; conservative, in cells (centres at +0.5)."""

from __future__ import annotations

import math

import numpy as np

from nurec_sim.render.cpu.grid import LENS, LIDAR, PINHOLE
from nurec_sim.render.cpu.kernel import f4, inner

EVERYWHERE = (f4(-1e9), f4(1e9), f4(-1e9), f4(1e9))
NOWHERE = (f4(-1e9), f4(-1e9), f4(-1e9), f4(-1e9))
CIRCLE = np.array([(math.cos(k * math.pi / 8), math.sin(k * math.pi / 8)) for k in range(16)], np.float32)
WIDE = f4(1.5)
"""Tangent of the angular radius from which a Gaussian is taken to cover the whole grid of a lens or a LiDAR."""


@inner
def fast_atan2(y, x):
    """Angle of (x, y) to about 1e-5 rad."""
    ax, ay = abs(x), abs(y)
    a = min(ax, ay) / max(max(ax, ay), f4(1e-30))
    s = a * a
    r = a * (f4(0.9998660) + s * (f4(-0.3302995) + s * (f4(0.1801410) + s * (f4(-0.0851330) + s * f4(0.0208351)))))
    if ay > ax:
        r = f4(math.pi / 2) - r
    if x < 0:
        r = f4(math.pi) - r
    return -r if y < 0 else r


@inner
def lens_place(x, y, z, params, table):
    """Bilinear lookup of the pixel of a direction (any length)."""
    size = table.shape[0]
    scale = f4(0.5) * f4(size - 1)
    length = math.sqrt(x * x + y * y + z * z)
    inverse = f4(1) / (max(length + z, f4(1e-6) * length) * params[0])
    s = min(max((x * inverse + f4(1)) * scale, f4(0)), f4(size) - f4(1.001))
    t = min(max((y * inverse + f4(1)) * scale, f4(0)), f4(size) - f4(1.001))
    i, j = np.int64(s), np.int64(t)
    fs, ft = s - f4(i), t - f4(j)
    u0 = table[j, i, 0] + fs * (table[j, i + 1, 0] - table[j, i, 0])
    u1 = table[j + 1, i, 0] + fs * (table[j + 1, i + 1, 0] - table[j + 1, i, 0])
    v0 = table[j, i, 1] + fs * (table[j, i + 1, 1] - table[j, i, 1])
    v1 = table[j + 1, i, 1] + fs * (table[j + 1, i + 1, 1] - table[j + 1, i, 1])
    return u0 + ft * (u1 - u0), v0 + ft * (v1 - v0)


@inner
def lidar_column(x, y, params, table):
    """Grid column of an azimuth."""
    two_pi = f4(2 * math.pi)
    turned = params[0] * (fast_atan2(y, x) - params[1]) + params[2]
    turned -= two_pi * f4(math.floor(turned / two_pi))
    s = min(max(turned * (f4(table.shape[1] - 1) / two_pi), f4(0)), f4(table.shape[1]) - f4(1.01))
    i = np.int64(s)
    return table[0, i, 0] + (s - f4(i)) * (table[0, i + 1, 0] - table[0, i, 0])


@inner
def lidar_row(x, y, z, table):
    """Grid row of an elevation."""
    sine = z / max(math.sqrt(x * x + y * y + z * z), f4(1e-20))
    s = min(max((sine + f4(1)) * f4(0.5) * f4(table.shape[1] - 1), f4(0)), f4(table.shape[1]) - f4(1.01))
    i = np.int64(s)
    return table[1, i, 0] + (s - f4(i)) * (table[1, i + 1, 0] - table[1, i, 0])


@inner
def place(kind, x, y, z, params, table):
    """Grid place (column, row) of a direction."""
    if kind == PINHOLE:
        inverse = f4(1) / max(z, f4(1e-6))
        return params[0] * x * inverse + params[2], params[1] * y * inverse + params[3]
    if kind == LENS:
        return lens_place(x, y, z, params, table)
    return lidar_column(x, y, params, table), lidar_row(x, y, z, table)


@inner
def pinhole_bounds(x, y, z, axes, k2, params, cells):
    """Exact box around the image of the ellipsoid of squared radius k2: tangents of its dual conic k2 Sigma - m m^T.

    ``axes`` [3,3] holds the principal axes, times their standard deviations, as columns.
    """
    sxx = syy = szz = sxz = syz = f4(0)
    for k in range(3):
        ax, ay, az = axes[0, k], axes[1, k], axes[2, k]
        sxx += ax * ax
        syy += ay * ay
        szz += az * az
        sxz += ax * az
        syz += ay * az
    if k2 * szz > f4(0.999) * z * z:
        # It reaches the camera plane: everywhere, unless it lies behind a side of the image.
        for side in range(4):
            sign = f4(1) if side % 2 == 0 else f4(-1)
            if side < 2:
                edge = (f4(0) if side == 0 else cells[0]) / params[0] - params[2] / params[0]
                height, spread = sign * (x - edge * z), sxx - f4(2) * edge * sxz + edge * edge * szz
            else:
                edge = (f4(0) if side == 2 else cells[1]) / params[1] - params[3] / params[1]
                height, spread = sign * (y - edge * z), syy - f4(2) * edge * syz + edge * edge * szz
            if height < f4(0) and height * height > k2 * spread:
                return NOWHERE
        return EVERYWHERE
    inverse_z2 = f4(1) / (z * z)
    # With x = u z the discriminant is free of the cancelling m m^T products.
    u, v = x / z, y / z
    czz_n = k2 * szz * inverse_z2 - f4(1)
    bx = k2 * (sxz - u * szz) * inverse_z2
    by = k2 * (syz - v * szz) * inverse_z2
    vx = k2 * (sxx - f4(2) * u * sxz + u * u * szz) * inverse_z2
    vy = k2 * (syy - f4(2) * v * syz + v * v * szz) * inverse_z2
    rx = math.sqrt(max(bx * bx - vx * czz_n, f4(0)))
    ry = math.sqrt(max(by * by - vy * czz_n, f4(0)))
    # czz_n < 0: dividing swaps the two roots.
    pad = f4(1e-3)
    u0, u1 = u + (bx + rx) / czz_n, u + (bx - rx) / czz_n
    v0, v1 = v + (by + ry) / czz_n, v + (by - ry) / czz_n
    return (params[0] * u0 + params[2] - pad, params[0] * u1 + params[2] + pad,
            params[1] * v0 + params[3] - pad, params[1] * v1 + params[3] + pad)  # fmt: skip


@inner
def outline_bounds(kind, x, y, z, axes, e1, e2, squeeze, radius, params, table):
    """Box around points of the ellipsoid's outline, sent through the grid's tables, with a margin for the rest.

    The outline is the circle ``squeeze`` m + ``radius`` (e1 cos + e2 sin) in the frame where the Gaussian is a unit
    ball (``axes`` leads back to the sensor); e1, e2 are perpendicular to the view direction there.
    """
    ax = radius * (axes[0, 0] * e1[0] + axes[0, 1] * e1[1] + axes[0, 2] * e1[2])
    ay = radius * (axes[1, 0] * e1[0] + axes[1, 1] * e1[1] + axes[1, 2] * e1[2])
    az = radius * (axes[2, 0] * e1[0] + axes[2, 1] * e1[1] + axes[2, 2] * e1[2])
    bx = radius * (axes[0, 0] * e2[0] + axes[0, 1] * e2[1] + axes[0, 2] * e2[2])
    by = radius * (axes[1, 0] * e2[0] + axes[1, 1] * e2[1] + axes[1, 2] * e2[2])
    bz = radius * (axes[2, 0] * e2[0] + axes[2, 1] * e2[1] + axes[2, 2] * e2[2])
    cx, cy, cz = x * squeeze, y * squeeze, z * squeeze
    distance = math.sqrt(cx * cx + cy * cy + cz * cz)
    angle = math.sqrt(ax * ax + ay * ay + az * az + bx * bx + by * by + bz * bz) / max(distance, f4(1e-20))
    if angle > WIDE:
        return EVERYWHERE
    column, row = place(kind, x, y, z, params, table)
    around = False
    if kind == LIDAR:
        flat = math.sqrt(x * x + y * y) / max(math.sqrt(x * x + y * y + z * z), f4(1e-20))
        around = flat < f4(2) * angle  # near the pole: any azimuth
    u0 = u1 = column
    v0 = v1 = row
    su = suu = sv = svv = f4(0)
    points = 4 if angle < f4(0.02) else (8 if angle < f4(0.2) else 16)
    for k in range(points):
        a, b = CIRCLE[k * 16 // points, 0], CIRCLE[k * 16 // points, 1]
        px, py, pz = cx + a * ax + b * bx, cy + a * ay + b * by, cz + a * az + b * bz
        if kind == LIDAR:
            # Azimuth from the centre's, so that nothing wraps.
            u = column + params[0] * fast_atan2(x * py - y * px, x * px + y * py) * params[3]
            v = lidar_row(px, py, pz, table)
        else:
            u, v = lens_place(px, py, pz, params, table)
        u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
        du, dv = u - column, v - row
        su, suu, sv, svv = su + du, suu + du * du, sv + dv, svv + dv * dv
    # The affine image of a circle reaches sqrt(2) standard deviations of evenly spaced points; the rest is the bend.
    inverse = f4(1) / f4(points)
    mu, mv = su * inverse, sv * inverse
    pad = f4(0.3) if kind == LENS else f4(0.15)
    bend = f4(1.02) + f4(0.2) * angle
    hu = bend * math.sqrt(f4(2) * max(suu * inverse - mu * mu, f4(0))) + pad
    hv = bend * math.sqrt(f4(2) * max(svv * inverse - mv * mv, f4(0))) + pad
    u0, u1 = min(u0 - pad, column + mu - hu), max(u1 + pad, column + mu + hu)
    v0, v1 = min(v0 - pad, row + mv - hv), max(v1 + pad, row + mv + hv)
    if around:
        return f4(-1e9), f4(1e9), v0, v1
    return u0, u1, v0, v1


@inner
def perpendicular(x, y, z, n2, e1, e2):
    """Two unit vectors perpendicular to a vector and to each other (Duff et al. 2017)."""
    inverse = f4(1) / math.sqrt(n2)
    x, y, z = x * inverse, y * inverse, z * inverse
    sign = f4(1) if z >= f4(0) else f4(-1)
    a = f4(-1) / (sign + z)
    b = x * y * a
    e1[0], e1[1], e1[2] = f4(1) + sign * x * x * a, sign * b, -sign * x
    e2[0], e2[1], e2[2] = b, sign + y * y * a, -y
