"""Kernel that blends a tile's records front to back with the exact response along every ray; float32."""

from __future__ import annotations

import math

import numpy as np

from nurec_sim.render.cpu.kernel import f4, inner, kernel
from nurec_sim.render.cpu.projection import BALL, DEEP, FADE, FEATURE, MAP, ORIGIN, RANGE, RIM, SLOPE, TAG, TILE

CELLS = TILE * TILE
"""Rays of a tile; they are blended at once and their sums stay in the first-level cache."""

PLANES = 7
"""Output planes: three features, distance, alpha, label, distance at half transmittance."""

# Sections of a tile's buffer, CELLS values each.
DX, DY, DZ, OX, OY, OZ, LIVE, SUM = 0, 1, 2, 3, 4, 5, 6, 7
BEST = SUM + PLANES
SECTIONS = BEST + 1

CUT = math.log(255.0) / 8


def _exponential() -> tuple[np.float32, ...]:
    """Coefficients of the quartic nearest to exp(-x) on 0..CUT in relative terms (Chebyshev nodes)."""
    x = (1 - np.cos((np.arange(64) + 0.5) * np.pi / 64)) / 2 * CUT
    basis = np.stack([x**k for k in range(5)], axis=1) * np.exp(x)[:, None]
    return tuple(np.float32(c) for c in np.linalg.lstsq(basis, np.ones(64), rcond=None)[0])


E0, E1, E2, E3, E4 = _exponential()


@inner
def _load_rays(b, direction, valid, line, lines, x0, y0, width, height):
    """Rays of a tile in the reference frame; cells outside of the grid or without a ray are dead from the start."""
    alive = 0
    for k in range(CELLS):
        x, y = x0 + k % TILE, y0 + k // TILE
        b[DX * CELLS + k], b[DY * CELLS + k], b[DZ * CELLS + k] = f4(0), f4(0), f4(1)
        b[OX * CELLS + k], b[OY * CELLS + k], b[OZ * CELLS + k] = f4(0), f4(0), f4(0)
        b[LIVE * CELLS + k] = f4(0)
        for s in range(SUM, SECTIONS):
            b[s * CELLS + k] = f4(0)
        if x < width and y < height and valid[y, x] != 0:
            dx, dy, dz = direction[y, x, 0], direction[y, x, 1], direction[y, x, 2]
            if lines.shape[0] > 1:
                m = lines[line[y, x]]
                b[OX * CELLS + k], b[OY * CELLS + k], b[OZ * CELLS + k] = m[9], m[10], m[11]
                dx, dy, dz = (m[0] * dx + m[1] * dy + m[2] * dz, m[3] * dx + m[4] * dy + m[5] * dz,
                              m[6] * dx + m[7] * dy + m[8] * dz)  # fmt: skip
            b[DX * CELLS + k], b[DY * CELLS + k], b[DZ * CELLS + k] = dx, dy, dz
            b[LIVE * CELLS + k] = f4(1)
            alive += 1
    return alive


@inner
def _bundle(b, middle):
    """A cone around a tile's rays: ``middle`` gets its direction and origin; returns its spread of both."""
    for e in range(6):
        middle[e] = f4(0)
    alive = f4(0)
    for k in range(CELLS):
        live = b[LIVE * CELLS + k]
        alive += live
        for e in range(6):
            middle[e] += live * b[e * CELLS + k]
    for e in range(6):
        middle[e] /= alive
    wide = shift = f4(0)
    for k in range(CELLS):
        if b[LIVE * CELLS + k] > f4(0):
            dx, dy, dz = b[DX * CELLS + k] - middle[0], b[DY * CELLS + k] - middle[1], b[DZ * CELLS + k] - middle[2]
            ox, oy, oz = b[OX * CELLS + k] - middle[3], b[OY * CELLS + k] - middle[4], b[OZ * CELLS + k] - middle[5]
            wide, shift = max(wide, dx * dx + dy * dy + dz * dz), max(shift, ox * ox + oy * oy + oz * oz)
    return math.sqrt(wide), math.sqrt(shift)


@inner
def _misses(records, i, middle, wide, shift, moving):
    """Whether no ray of a bundle can meet a Gaussian before it has faded to 1/255; never wrongly true."""
    dx, dy, dz = middle[0], middle[1], middle[2]
    x = records[i, MAP] * dx + records[i, MAP + 1] * dy + records[i, MAP + 2] * dz
    y = records[i, MAP + 3] * dx + records[i, MAP + 4] * dy + records[i, MAP + 5] * dz
    w = records[i, MAP + 6] * dx + records[i, MAP + 7] * dy + records[i, MAP + 8] * dz
    rim = records[i, RIM]
    if moving:
        # Seen from the bundle's origin the centre lies at -gro, a little off the third axis.
        far = records[i, RANGE]
        px, py, pz = (
            middle[3] - records[i, ORIGIN],
            middle[4] - records[i, ORIGIN + 1],
            middle[5] - records[i, ORIGIN + 2],
        )
        gx = records[i, MAP] * px + records[i, MAP + 1] * py + records[i, MAP + 2] * pz
        gy = records[i, MAP + 3] * px + records[i, MAP + 4] * py + records[i, MAP + 5] * pz
        gw = far - (records[i, MAP + 6] * px + records[i, MAP + 7] * py + records[i, MAP + 8] * pz)
        if abs(gx) + abs(gy) > f4(0.1) * gw:
            return False
        ahead = w / gw
        x, y = x + ahead * gx, y + ahead * gy
        wide = f4(1.1) * (wide + shift / gw)
        rim *= f4(1.05) * far / gw
    nearest = math.sqrt(x * x + y * y) - records[i, SLOPE] * wide
    return nearest > rim * max(w + records[i, DEEP] * wide, f4(0))


@inner
def _add(b, k, a, t, near, fa, fb, fc, tag):
    """Blend a hit at distance ``t`` into ray k; its alpha is exp(-8 a)."""
    e = E0 + a * (E1 + a * (E2 + a * (E3 + a * E4)))
    e = e * e
    e = e * e
    e = min(e * e, f4(0.99))
    live = b[LIVE * CELLS + k]
    weight = e * live
    left = live - weight
    hit = (a < f4(CUT)) & (t >= near)
    ends = left <= f4(1e-4)
    weight = weight if hit & (not ends) else f4(0)
    half = hit & (live > f4(0.5)) & (left <= f4(0.5))
    b[(SUM + 6) * CELLS + k] = t if half else b[(SUM + 6) * CELLS + k]
    left = f4(0) if ends else left
    b[LIVE * CELLS + k] = left if hit else live
    b[SUM * CELLS + k] += weight * fa
    b[(SUM + 1) * CELLS + k] += weight * fb
    b[(SUM + 2) * CELLS + k] += weight * fc
    b[(SUM + 3) * CELLS + k] += weight * t
    b[(SUM + 4) * CELLS + k] += weight
    best = b[BEST * CELLS + k]
    b[(SUM + 5) * CELLS + k] = tag if weight > best else b[(SUM + 5) * CELLS + k]
    b[BEST * CELLS + k] = max(weight, best)


@inner
def _blend_fixed(b, records, i, near):
    """Blend one record into a tile whose rays all start at the reference point."""
    m00, m01, m02, m10, m11, m12 = (
        records[i, MAP],
        records[i, MAP + 1],
        records[i, MAP + 2],
        records[i, MAP + 3],
        records[i, MAP + 4],
        records[i, MAP + 5],
    )
    m20, m21, m22 = records[i, MAP + 6], records[i, MAP + 7], records[i, MAP + 8]
    ball, fade, far, tag = records[i, BALL], records[i, FADE], records[i, RANGE], records[i, TAG]
    fa, fb, fc = records[i, FEATURE], records[i, FEATURE + 1], records[i, FEATURE + 2]
    for k in range(CELLS):
        dx, dy, dz = b[DX * CELLS + k], b[DY * CELLS + k], b[DZ * CELLS + k]
        x = m00 * dx + m01 * dy + m02 * dz
        y = m10 * dx + m11 * dy + m12 * dz
        w = m20 * dx + m21 * dy + m22 * dz
        off = x * x + y * y
        inverse = f4(1) / (off + w * w)
        a = ball * off * inverse + fade
        t = far * w * inverse
        _add(b, k, a, t, near, fa, fb, fc, tag)


@inner
def _blend_moving(b, records, i, near):
    """Blend one record into a tile whose rays start anywhere: full cross product with the offset of the origin."""
    m00, m01, m02, m10, m11, m12 = (
        records[i, MAP],
        records[i, MAP + 1],
        records[i, MAP + 2],
        records[i, MAP + 3],
        records[i, MAP + 4],
        records[i, MAP + 5],
    )
    m20, m21, m22 = records[i, MAP + 6], records[i, MAP + 7], records[i, MAP + 8]
    ball, fade, far, tag = records[i, BALL], records[i, FADE], records[i, RANGE], records[i, TAG]
    fa, fb, fc = records[i, FEATURE], records[i, FEATURE + 1], records[i, FEATURE + 2]
    ox, oy, oz = records[i, ORIGIN], records[i, ORIGIN + 1], records[i, ORIGIN + 2]
    for k in range(CELLS):
        dx, dy, dz = b[DX * CELLS + k], b[DY * CELLS + k], b[DZ * CELLS + k]
        px, py, pz = b[OX * CELLS + k] - ox, b[OY * CELLS + k] - oy, b[OZ * CELLS + k] - oz
        x = m00 * dx + m01 * dy + m02 * dz
        y = m10 * dx + m11 * dy + m12 * dz
        w = m20 * dx + m21 * dy + m22 * dz
        gx = m00 * px + m01 * py + m02 * pz
        gy = m10 * px + m11 * py + m12 * pz
        gw = m20 * px + m21 * py + m22 * pz - far
        cx, cy, cw = y * gw - w * gy, w * gx - x * gw, x * gy - y * gx
        inverse = f4(1) / (x * x + y * y + w * w)
        a = ball * (cx * cx + cy * cy + cw * cw) * inverse + fade
        t = -(x * gx + y * gy + w * gw) * inverse
        _add(b, k, a, t, near, fa, fb, fc, tag)


@kernel
def blend(tiles, starts, lists, records, direction, valid, line, lines, near, columns, planes):
    """Blend the given tiles into ``planes`` [7,h,w]: three features, distance, alpha (weighted sums), label, half.

    Args:
        tiles: numbers of the tiles to do.
        starts: [tiles+1] where each tile's list starts.
        lists: rows of ``records`` front to back, tile after tile.
        records: see projection.
        direction: [h,w,3] rays in the sensor frame, with valid and line as in ``Grid``.
        valid: [h,w].
        line: [h,w].
        lines: poses per line; a single one when nothing moves.
        near: near plane.
        columns: tiles per row of tiles.
        planes: output; cells that see nothing hold 0.
    """
    height, width = valid.shape
    b = np.empty(SECTIONS * CELLS, np.float32)
    middle = np.empty(6, np.float32)
    moving = lines.shape[0] > 1
    for index in range(tiles.shape[0]):
        tile = tiles[index]
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        if _load_rays(b, direction, valid, line, lines, x0, y0, width, height) > 0:
            wide, shift = _bundle(b, middle)
            done = 0
            for j in range(starts[tile], starts[tile + 1]):
                i = np.uint64(lists[j])  # unsigned: spares the test for negative indices
                if _misses(records, i, middle, wide, shift, moving):
                    continue
                if moving:
                    _blend_moving(b, records, i, near)
                else:
                    _blend_fixed(b, records, i, near)
                done += 1
                if done % 16 == 0:
                    live = f4(0)
                    for k in range(CELLS):
                        live += b[LIVE * CELLS + k]
                    if live == f4(0):
                        break
        for k in range(CELLS):
            x, y = x0 + k % TILE, y0 + k // TILE
            if x < width and y < height:
                for p in range(PLANES):
                    planes[p, y, x] = b[(SUM + p) * CELLS + k]
