"""Kernels that lay a sensor's rays out by blocks of 8 x 4 and describe each macro tile's directions by bases.

A pinhole needs no table: its directions are linear in the cell, also, to first order about the middle of a macro tile,
with a shutter that rolls along y.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int16

from nurec_sim.compute.turns import rest
from nurec_sim.render.cpu.blend.responses import DX, DY, DZ, PLACE, RAY_PLANES, VALID
from nurec_sim.render.cpu.blend.tiles import (
    ACROSS,
    B_BEND,
    B_D0,
    B_DX,
    B_DY,
    B_HALF,
    B_MIDDLE,
    B_MOTION,
    B_RATE,
    BAND,
    BANDS,
    BASIS,
    BLOCKS,
    DOWN,
    HIGH,
    RAYS,
    WIDE,
)
from nurec_sim.render.cpu.grid import Grid
from nurec_sim.render.cpu.kernel import f4, inner, kernel
from nurec_sim.render.cpu.records import MACRO


@dataclass(frozen=True, eq=False)
class RayTiles:
    """A grid's rays by macro tile and block, in the sensor's own frame, and the bases of the tiles' bands.

    ``line`` numbers the line (instant) of each ray.
    """

    table: Float32[np.ndarray, "tiles 32 5 32"]
    line: Int16[np.ndarray, "tiles 32 32"]
    basis: Float32[np.ndarray, "tiles 4 16"]


class SensorRays(NamedTuple):
    """How the blending kernels find the rays of a macro tile.

    Fields followed by modes in parentheses are only read in those.
    """

    mode: int
    """AFFINE, ROLLING (pinholes), TABLE or MOVING (everything else, at one pose or several), see ``tiles``."""
    intrinsics: Float32[np.ndarray, " 4"]
    """fx, fy, cx, cy in pixels (AFFINE, ROLLING)."""
    table: Float32[np.ndarray, "tiles 32 5 32"]
    """See ``RayTiles`` (TABLE, MOVING)."""
    line: Int16[np.ndarray, "tiles 32 32"]
    """See ``RayTiles`` (MOVING)."""
    basis: Float32[np.ndarray, "tiles 4 16"]
    """See ``RayTiles`` (TABLE)."""
    turns: Float32[np.ndarray, "lines 9"]
    """Rotation of each line into the reference frame (MOVING)."""
    places: Float32[np.ndarray, " lines"]
    """Where each line's origin lies on the sensor's way (MOVING)."""
    motion: Float32[np.ndarray, " 8"]
    """See ``rolling_basis`` (ROLLING); its velocity for MOVING, too."""
    near: np.float32
    """Near plane: metres along the optical axis, for LiDARs along the beam."""
    width: int
    """Columns of the grid."""
    height: int
    """Rows of the grid."""


def tile_rays(grid: Grid) -> RayTiles:
    """Lay out the rays of a grid (some milliseconds per million; keep the result)."""
    height, width = grid.valid.shape
    columns, rows = -(-width // MACRO), -(-height // MACRO)

    def by_block(plane: np.ndarray) -> np.ndarray:
        """Up to ``MACRO`` rows of cells as macro tiles."""
        full = np.zeros((MACRO, columns * MACRO), plane.dtype)
        full[: len(plane), :width] = plane
        parts = full.reshape(DOWN, HIGH, columns, ACROSS, WIDE).transpose(2, 0, 3, 1, 4)
        return parts.reshape(columns, BLOCKS, RAYS)

    table = np.zeros((rows * columns, BLOCKS, RAY_PLANES, RAYS), np.float32)
    line = np.zeros((rows * columns, BLOCKS, RAYS), np.int16)
    basis = np.zeros((rows * columns, BANDS, BASIS), np.float32)
    for row in range(rows):
        rest()
        cells, tiles = slice(row * MACRO, (row + 1) * MACRO), slice(row * columns, (row + 1) * columns)
        for plane in range(3):
            table[tiles, :, DX + plane] = by_block(grid.direction[cells, :, plane])
        table[tiles, :, VALID] = by_block(grid.valid[cells])
        line[tiles] = by_block(grid.line[cells])
        _all_bases(table[tiles], columns, width, len(grid.valid[cells]), basis[tiles])
    return RayTiles(table, line, basis)


@inner
def _ray(rays, x, y, plane):
    return rays[y // HIGH * ACROSS + x // WIDE, plane, y % HIGH * WIDE + x % WIDE]


@inner
def table_basis(rays, wide, high, band, basis):
    """The basis of 8 rows of a macro tile: a linear fit to their directions, and how far it is off.

    Directions are fitted to the corners; ``bend`` is the largest deviation. Where rays are missing, the fit is
    a constant.

    Args:
        rays: [BLOCKS,RAY_PLANES,RAYS] the tile's rays.
        wide: columns of the tile that belong to the grid.
        high: its rows.
        band: number of the band of ``BAND`` rows, 0 to ``BANDS`` - 1.
        basis: [BASIS] output.
    """
    # First pass: count the valid rays, sum their directions, and find the range of their places.
    low_s, high_s = f4(1e30), f4(-1e30)
    first, last_y = band * BAND, min(high, (band + 1) * BAND) - 1
    last_x = wide - 1
    for k in range(BASIS):
        basis[k] = f4(0)
    count = 0
    for y in range(first, last_y + 1):
        for x in range(wide):
            if _ray(rays, x, y, VALID) > f4(0):
                count += 1
                s = _ray(rays, x, y, PLACE)
                low_s, high_s = min(low_s, s), max(high_s, s)
                for k in range(3):
                    basis[B_D0 + k] += _ray(rays, x, y, DX + k)
    if count == 0:
        return
    basis[B_MIDDLE], basis[B_HALF] = f4(0.5) * (low_s + high_s), f4(0.5) * (high_s - low_s)
    whole = count == wide * (last_y + 1 - first)
    for k in range(3):
        if not whole:
            basis[B_D0 + k] /= f4(count)
            continue
        # Averages of the slopes along both pairs of opposite sides.
        d00, d10 = _ray(rays, 0, first, DX + k), _ray(rays, last_x, first, DX + k)
        d01, d11 = _ray(rays, 0, last_y, DX + k), _ray(rays, last_x, last_y, DX + k)
        dx = f4(0.5) * (d10 - d00 + d11 - d01) / f4(max(last_x, 1))
        dy = f4(0.5) * (d01 - d00 + d11 - d10) / f4(max(last_y - first, 1))
        # The corners' middle lies (last - 31) / 2 and (last - first - 7) / 2 cells from the band's.
        middle = f4(0.25) * (d00 + d10 + d01 + d11)
        basis[B_DX + k], basis[B_DY + k] = dx, dy
        basis[B_D0 + k] = middle - dx * f4(0.5 * (last_x - 31)) - dy * f4(0.5 * (last_y - first - 7))
    worst = f4(0)
    for y in range(first, last_y + 1):
        for x in range(wide):
            if _ray(rays, x, y, VALID) > f4(0):
                px, py, off = f4(x) - f4(15.5), f4(y - first) - f4(3.5), f4(0)
                for k in range(3):
                    fit = basis[B_D0 + k] + px * basis[B_DX + k] + py * basis[B_DY + k]
                    off += (_ray(rays, x, y, DX + k) - fit) ** 2
                worst = max(worst, off)
    # Rounded up: a bound, from float32 sums.
    basis[B_BEND] = f4(1.01) * math.sqrt(worst) + f4(1e-7)


@kernel
def _all_bases(table, columns, width, height, basis):
    for tile in range(table.shape[0]):
        wide = min(MACRO, width - tile % columns * MACRO)
        high = min(MACRO, height - tile // columns * MACRO)
        for band in range(BANDS):
            table_basis(table[tile], wide, high, band, basis[tile, band])


@inner
def turn_rays(rays, line, line_poses, out):
    """Turn the rays of a macro tile into the reference frame, each by the rotation of its own line.

    Args:
        rays: [BLOCKS,RAY_PLANES,RAYS] the tile's rays in the sensor's own frame.
        line: [BLOCKS,RAYS] the line of each ray.
        line_poses: ``turns`` and ``places`` of the lines, see ``SensorRays``.
        out: output, as ``rays``, with the place of each ray's line on the sensor's way.
    """
    turns, places = line_poses
    for block in range(BLOCKS):
        for k in range(RAYS):
            i = np.uint64(line[block, k])
            x, y, z = rays[block, DX, k], rays[block, DY, k], rays[block, DZ, k]
            out[block, DX, k] = turns[i, 0] * x + turns[i, 1] * y + turns[i, 2] * z
            out[block, DY, k] = turns[i, 3] * x + turns[i, 4] * y + turns[i, 5] * z
            out[block, DZ, k] = turns[i, 6] * x + turns[i, 7] * y + turns[i, 8] * z
            out[block, VALID, k] = rays[block, VALID, k]
            out[block, PLACE, k] = places[i]


@inner
def moving_tile(rays, line, line_poses, wide, high, motion, out, bases):
    """Turn a macro tile's rays and describe its bands.

    Args:
        rays: [BLOCKS,RAY_PLANES,RAYS] the tile's rays in the sensor's own frame.
        line: [BLOCKS,RAYS] the line of each.
        line_poses: ``turns`` and ``places`` of the lines, see ``SensorRays``.
        wide: columns of the tile that belong to the grid.
        high: its rows.
        motion: the sensor's velocity and more, see ``rolling_basis``.
        out: output, as ``rays``: in the reference frame.
        bases: [BANDS,BASIS] output.
    """
    turn_rays(rays, line, line_poses, out)
    for band in range(BANDS):
        table_basis(out, wide, high, band, bases[band])
        for k in range(3):
            bases[band, B_MOTION + k] = motion[k]


@inner
def pinhole_basis(intrinsics, column, row, basis):
    """The basis of a pinhole's macro tile, exact: directions with z = 1.

    Args:
        intrinsics: fx, fy, cx, cy in pixels.
        column: column of the macro tile.
        row: row of the macro tile.
        basis: [BASIS] output.
    """
    for k in range(BASIS):
        basis[k] = f4(0)
    basis[B_D0] = (f4(column * MACRO + MACRO // 2) - intrinsics[2]) / intrinsics[0]
    basis[B_D0 + 1] = (f4(row * MACRO + MACRO // 2) - intrinsics[3]) / intrinsics[1]
    basis[B_D0 + 2] = f4(1)
    basis[B_DX], basis[B_DY + 1] = f4(1) / intrinsics[0], f4(1) / intrinsics[1]


@inner
def _rotate(turn, basis, start):
    """Turn three numbers of a basis by a rotation vector (Rodrigues)."""
    # A shutter's turn is small: two terms of sin(a) / a and (1 - cos a) / a^2 suffice, without trigonometric functions.
    x, y, z = turn
    angle2 = x * x + y * y + z * z
    sine, versine = f4(1) - angle2 / f4(6), f4(0.5) - angle2 / f4(24)  # of small angles, over angle and its square
    a, b, c = basis[start], basis[start + 1], basis[start + 2]
    u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
    basis[start] = a + sine * u + versine * (y * w - z * v)
    basis[start + 1] = b + sine * v + versine * (z * u - x * w)
    basis[start + 2] = c + sine * w + versine * (x * v - y * u)


@inner
def rolling_basis(motion, row, basis):
    """Make a pinhole's basis that of a shutter rolling along y.

    ``motion`` [8]: velocity and rotation vector over the whole exposure in the reference frame, place of row 0, and
    the step per row.
    """
    place = motion[6] + motion[7] * (f4(row * MACRO) + f4(15.5))
    turn = (place * motion[3], place * motion[4], place * motion[5])
    _rotate(turn, basis, B_D0)
    _rotate(turn, basis, B_DX)
    _rotate(turn, basis, B_DY)
    rate = motion[7]
    x, y, z = rate * motion[3], rate * motion[4], rate * motion[5]
    # From row to row the rays also turn by omega x d0, which adds to dy: first order about the tile's middle row.
    a, b, c = basis[B_D0], basis[B_D0 + 1], basis[B_D0 + 2]
    basis[B_DY] += y * c - z * b
    basis[B_DY + 1] += z * a - x * c
    basis[B_DY + 2] += x * b - y * a
    basis[B_MIDDLE], basis[B_HALF], basis[B_RATE] = place, f4(MACRO // 2) * abs(rate), rate
    for k in range(3):
        basis[B_MOTION + k] = motion[k]
