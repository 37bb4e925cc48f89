"""Kernel that turns blended planes into a camera frame: sky, colour correction, rounding, depth, labels."""

from __future__ import annotations

import math

import numpy as np

from nurec_sim.render.cpu.kernel import f4, inner, kernel
from nurec_sim.types import Label

SKY = int(Label.SKY)
SURFACE_ALPHA = 0.5


@inner
def sky_lookup(sky, x, y, z, out):
    """Bilinear colour of a world direction (``geometry.cubemap_coordinates``), clamped within a face."""
    gx, gy, gz = -y, z, -x
    ax, ay, az = abs(gx), abs(gy), abs(gz)
    if az > ax and az > ay:
        face, major, s, t = (4, az, gx, -gy) if gz > 0 else (5, az, -gx, -gy)
    elif ay > ax and ay >= az:
        face, major, s, t = (2, ay, gx, gz) if gy > 0 else (3, ay, gx, -gz)
    else:
        face, major, s, t = (0, ax, -gz, -gy) if gx > 0 else (1, ax, gz, -gy)
    size = sky.shape[1]
    scale = f4(0.5) / max(major, f4(1e-30))
    u = min(max((s * scale + f4(0.5)) * f4(size) - f4(0.5), f4(0)), f4(size - 1))
    v = min(max((t * scale + f4(0.5)) * f4(size) - f4(0.5), f4(0)), f4(size - 1))
    i, j = np.int64(u), np.int64(v)
    i1, j1 = min(i + 1, size - 1), min(j + 1, size - 1)
    fu, fv = u - f4(i), v - f4(j)
    for c in range(3):
        top = sky[face, j, i, c] + fu * (sky[face, j, i1, c] - sky[face, j, i, c])
        bottom = sky[face, j1, i, c] + fu * (sky[face, j1, i1, c] - sky[face, j1, i, c])
        out[c] = top + fv * (bottom - top)


@kernel
def composite(first, last, planes, direction, valid, line, world_from_line, sky, isp, rgb, depth, alpha, label):
    """Finish the rows first..last of a camera frame; ``world_from_line`` [l,3,3] turns a line's rays into the world."""
    width = valid.shape[1]
    behind = np.zeros(3, np.float32)
    colour = np.zeros(3, np.float32)
    for y in range(first, last):
        for x in range(width):
            a = planes[4, y, x]
            surface = a >= f4(SURFACE_ALPHA)
            alpha[y, x] = a
            label[y, x] = np.uint8(planes[5, y, x]) if surface else np.uint8(SKY)
            distance = planes[3, y, x] / max(a, f4(1e-6))
            depth[y, x] = max(distance * direction[y, x, 2], f4(0)) if surface else f4(0)
            if valid[y, x] == 0:
                for c in range(3):
                    rgb[y, x, c] = np.uint8(0)
                continue
            m = world_from_line[line[y, x]]
            dx, dy, dz = direction[y, x, 0], direction[y, x, 1], direction[y, x, 2]
            sky_lookup(sky, m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz, m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz,
                       m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz, behind)  # fmt: skip
            for c in range(3):
                colour[c] = planes[c, y, x] + (f4(1) - a) * behind[c]
            for c in range(3):
                v = isp[c, 0] * colour[0] + isp[c, 1] * colour[1] + isp[c, 2] * colour[2] + isp[c, 3]
                rgb[y, x, c] = np.uint8(math.floor(min(max(v, f4(0)), f4(1)) * f4(255) + f4(0.5)))
