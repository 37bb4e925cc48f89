"""Vector code that turns Gaussians into records: what a ray needs to weigh them exactly, 64 bytes each.

All values are in the sensor's reference frame (its axes at the reference instant, origin at the reference point). With
R the rotation and S the standard deviations of a Gaussian, A = S^-1 R^T, centre m, b = A m, n = |b|, and e1, e2 unit
vectors perpendicular to b, a record holds the rows e1^T A / 4, e2^T A / 4 and b^T A / n^2. A ray d of any length from
the reference point, (X, Y, W) = rows d, has

    Q1 = X^2 + Y^2,  Q2 = FLAT Q1 + W^2,  q / 16 = Q1 / Q2,  t = W / Q2,  alpha = exp(-8 (Q1 / Q2 + FADE))

with q its squared distance in standard deviations and t the place of the largest response in lengths of d: X and Y
vanish at the centre, so nothing large cancels in float32. It is seen (alpha at least 1/255) where W > 0 and
Q1 < LIM W^2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int16, Int32
from llvmlite import ir

from nurec_sim.render.cpu.kernel import inner
from nurec_sim.render.cpu.pack import (
    BLOCK,
    COLOUR,
    DROP,
    FALLOFF,
    INTENSITY,
    KNOWN,
    LABEL,
    LOG_OPACITY,
    MEAN,
    NORMAL,
    QUAT,
    SCALE,
)
from nurec_sim.render.cpu.simd import I32, LANES, Lanes, Vector, declare, spread, vector_kernel
from nurec_sim.types import Matrix4

# Columns of a record.
XROW, YROW, WROW, FLAT, FADE, LIM, TAG, FEATURE = 0, 3, 6, 9, 10, 11, 12, 13
RECORD = 16
INSIDE = 1e30
"""LIM of a Gaussian that holds the reference point."""
LOG_255 = math.log(255.0)
LABEL_BITS = 0xFF
CLOSE_BIT = -(1 << 31)
"""Set in TAG where a pinhole's rays may meet it nearer than the near plane, or behind."""

# Scratch of one group of LANES Gaussians, in vectors: centre, rotation (row-major), scales, log opacity, label, key.
CENTRE, ROTATION, SIGMA, LOG_P, CLASS, DEPTH, FEATURES = 0, 3, 12, 15, 16, 17, 18
SCRATCH = 21
STEP = 4 * LANES
"""Bytes of a vector."""

# Columns of the view's parameters (float32).
TURN, EYE_HIGH, EYE_LOW, NEAR, BY_RANGE, TRAVEL, SWING, INTRINSICS, CELLS = 0, 9, 12, 15, 16, 17, 18, 19, 23
VIEW = 25

MACRO_BITS = 5
MACRO = 1 << MACRO_BITS
"""Side of the tiles that records are handed out to, in cells."""


class Projected(NamedTuple):
    """What projection writes, a row per record: a Gaussian that may be seen."""

    records: Float32[np.ndarray, "n 16"]
    """Columns as above."""
    keys: Float32[np.ndarray, " n"]
    """Depth to sort by (m): z of the centre, or its distance."""
    spans: Int16[np.ndarray, "n 4"]
    """First and last column, first and last row of the cells that may see it."""
    sources: Int32[np.ndarray, " n"]
    """Its packed row: 256 times the block plus the place in it."""


def view_parameters(
    world_from_reference: Matrix4,
    near_m: float,
    by_range: bool,
    travel_m: float,
    swing_rad: float,
    intrinsics: Sequence[float],
    cells: tuple[int, int],
) -> Float32[np.ndarray, " 25"]:
    """The view for the kernels; the eye is a sum of two float32, so that differences to it keep their precision.

    Args:
        world_from_reference: pose of the sensor at the reference instant.
        near_m: near plane.
        by_range: whether depth is the distance instead of z.
        travel_m: how far the sensor gets from the reference point during the exposure.
        swing_rad: how far it turns from the reference pose.
        intrinsics: fx, fy, cx, cy of a pinhole, else zeros.
        cells: columns and rows of the grid.
    """
    eye = world_from_reference[:3, 3]
    high = eye.astype(np.float32)
    parts = [
        world_from_reference[:3, :3].T.ravel(),
        high,
        eye - high,
        [near_m, by_range, travel_m, swing_rad],
        intrinsics,
        cells,
    ]
    return np.concatenate([np.asarray(part, np.float32) for part in parts])


def rotation_of(w: Vector, x: Vector, y: Vector, z: Vector) -> list[list[Vector]]:
    """Matrices of unit quaternions.

    Args:
        w: real parts.
        x: first imaginary parts.
        y: second imaginary parts.
        z: third imaginary parts.
    """
    return [
        [1 - (y * y + z * z) * 2, (x * y - w * z) * 2, (x * z + w * y) * 2],
        [(x * y + w * z) * 2, 1 - (x * x + z * z) * 2, (y * z - w * x) * 2],
        [(x * z - w * y) * 2, (y * z + w * x) * 2, 1 - (x * x + y * y) * 2],
    ]


def dot(a: list[Vector], b: list[Vector]) -> Vector:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@vector_kernel("iii")
def place(v: Lanes, block: ir.Value, view: ir.Value, scratch: ir.Value) -> ir.Value:
    """Centre, rotation and depth of Gaussians in the reference frame.

    Args:
        v: vectors.
        block: address of the group's first Gaussian in its block.
        view: address of ``view_parameters``.
        scratch: address of the group's [SCRATCH,LANES] output, all but FEATURES.

    Returns:
        The mask of the Gaussians behind the near plane that are at least 1/255 opaque.
    """
    field = [v.load(block, 4 * BLOCK * k) for k in range(LABEL + 1)]
    turn = [[v.broadcast(view, 4 * (TURN + 3 * row + column)) for column in range(3)] for row in range(3)]
    # Nearby Gaussians far from the origin: the high part cancels exactly (Sterbenz), the low part is what it lacked.
    offset = [
        (field[MEAN + k] - v.broadcast(view, 4 * (EYE_HIGH + k))) - v.broadcast(view, 4 * (EYE_LOW + k))
        for k in range(3)
    ]
    centre = [dot(row, offset) for row in turn]
    world = rotation_of(*field[QUAT : QUAT + 4])
    for row in range(3):
        v.store(centre[row], scratch, STEP * (CENTRE + row))
        v.store(field[SCALE + row], scratch, STEP * (SIGMA + row))
        for column in range(3):
            axis = [world[k][column] for k in range(3)]
            v.store(dot(turn[row], axis), scratch, STEP * (ROTATION + 3 * row + column))
    v.store(field[LOG_OPACITY], scratch, STEP * LOG_P)
    v.store(field[LABEL], scratch, STEP * CLASS)
    by_range = v.broadcast(view, 4 * BY_RANGE)
    depth = (by_range > 0).where(dot(centre, centre).sqrt(), centre[2])
    v.store(depth, scratch, STEP * DEPTH)
    return ((depth >= v.broadcast(view, 4 * NEAR)) & (field[LOG_OPACITY] > -LOG_255)).integer()


@vector_kernel("ii")
def colour_features(v: Lanes, block: ir.Value, scratch: ir.Value) -> None:
    """Take the colours as features."""
    for k in range(3):
        v.store(v.load(block, 4 * BLOCK * (COLOUR + k)), scratch, STEP * (FEATURES + k))


@vector_kernel("iii")
def lidar_features(v: Lanes, block: ir.Value, view: ir.Value, scratch: ir.Value) -> None:
    """Take intensity, as it returns to the eye, whether it is known, and the drop probability as features."""
    offset = [
        (v.load(block, 4 * BLOCK * (MEAN + k)) - v.broadcast(view, 4 * (EYE_HIGH + k)))
        - v.broadcast(view, 4 * (EYE_LOW + k))
        for k in range(3)
    ]
    normal = [v.load(block, 4 * BLOCK * (NORMAL + k)) for k in range(3)]
    met = dot(normal, offset).abs() / dot(offset, offset).max(1e-24).sqrt()
    # See ``Gaussians.falloff``.
    kept = 1 - v.load(block, 4 * BLOCK * FALLOFF) * (1 - met).max(0)
    v.store(v.load(block, 4 * BLOCK * INTENSITY) * kept, scratch, STEP * FEATURES)
    for k, field in enumerate((KNOWN, DROP)):
        v.store(v.load(block, 4 * BLOCK * field), scratch, STEP * (FEATURES + 1 + k))


@vector_kernel("iii")
def build_records(v: Lanes, scratch: ir.Value, rows: ir.Value, view: ir.Value) -> None:
    """Records of a group, row after row.

    Args:
        v: vectors.
        scratch: address of the group's [SCRATCH,LANES], with features.
        rows: address of [LANES,RECORD] output.
        view: address of ``view_parameters``.
    """

    def part(k: int) -> Vector:
        return v.load(scratch, STEP * k)

    centre = [part(CENTRE + k) for k in range(3)]
    inverse = [part(SIGMA + k).reciprocal() for k in range(3)]
    # A = S^-1 R^T.
    canonical = [[part(ROTATION + 3 * column + row) * inverse[row] for column in range(3)] for row in range(3)]
    ball = [dot(row, centre) for row in canonical]
    # 1 / n; the floor keeps a Gaussian centred on the eye finite.
    away = 1 / dot(ball, ball).max(1e-30).sqrt()
    x, y, z = (component * away for component in ball)
    # Two unit vectors perpendicular to the centre and to each other (Duff et al. 2017).
    sign = (z >= 0).where(1.0, -1.0)
    a = -1 / (sign + z)
    e1 = [1 + sign * x * x * a, sign * x * y * a, -(sign * x)]
    e2 = [x * y * a, sign + y * y * a, -y]
    across, along = [], []
    for e in (e1, e2):
        # A quarter, so that exp(-q / 2) = exp(-8 Q1 / Q2): ``responses.fading`` squares three times.
        across += [(e[0] * canonical[0][k] + e[1] * canonical[1][k] + e[2] * canonical[2][k]) * 0.25 for k in range(3)]
    along = [(x * canonical[0][k] + y * canonical[1][k] + z * canonical[2][k]) * away for k in range(3)]
    # With |A d|^2 = 16 Q1 + n^2 W^2, q = 16 n^2 Q1 / |A d|^2 = 16 Q1 / (FLAT Q1 + W^2) for FLAT = 16 / n^2.
    flat = away * away * 16
    log_opacity = part(LOG_P)
    # alpha >= 1/255 is Q1 <= rim Q2, that is Q1 (1 - rim FLAT) <= rim W^2; the first factor is not positive where the
    # reference point lies within the ellipsoid of 1/255.
    rim = (log_opacity + LOG_255) * 0.125
    room = 1 - rim * flat
    lim = (room > 1e-4).where(rim / room.max(1e-4), INSIDE)
    # Where it reaches the plane of the camera, rays may meet it too near or, mirrored, behind.
    # Standard deviation along z is the norm of the last row of R S; the ellipsoid of 1/255 has the squared radius 16
    # rim.
    depths = [part(ROTATION + 6 + k) * part(SIGMA + k) for k in range(3)]
    lowest = centre[2] - (rim * dot(depths, depths) * 16).sqrt()
    lowest = lowest - dot(centre, centre).sqrt() * v.broadcast(view, 4 * SWING) - v.broadcast(view, 4 * TRAVEL)
    b = v.b
    ints = ir.VectorType(I32, LANES)
    close = b.select(
        (lowest < v.broadcast(view, 4 * NEAR)).value, spread(b, I32(CLOSE_BIT), ints), spread(b, I32(0), ints)
    )
    # Label and flag are bits of an integer, carried in a float32 column.
    tag = v.from_bits(b.or_(part(CLASS).integers(), close))
    columns = [*across, *along, flat, log_opacity * -0.125, lim, tag, *(part(FEATURES + k) for k in range(3))]
    # Structure of arrays to records of 64 bytes, one cache line each.
    for first in range(0, RECORD, LANES):
        for lane, row in enumerate(v.transpose(columns[first : first + LANES])):
            v.store(row, rows, 4 * (RECORD * lane + first))


@vector_kernel("ii")
def copy_record(v: Lanes, source: ir.Value, target: ir.Value) -> None:
    """Copy one record."""
    for first in range(0, RECORD, LANES):
        v.store(v.load(source, 4 * first), target, 4 * first)


@vector_kernel("i")
def lowest_bit(v: Lanes, mask: ir.Value) -> ir.Value:
    """Number of the lowest set bit of a mask that is not 0."""
    i64 = ir.IntType(64)
    f = declare(v.b, "llvm.cttz.i64", i64, [i64, ir.IntType(1)])
    return v.b.call(f, [mask, ir.Constant(ir.IntType(1), 1)])


@inner
def tiles_of(spans, i):
    """First and last column, first and last row of the macro tiles of span i."""
    # A shift is cheaper than a division that rounds down.
    return (np.int64(spans[i, 0]) >> MACRO_BITS, np.int64(spans[i, 1]) >> MACRO_BITS,
            np.int64(spans[i, 2]) >> MACRO_BITS, np.int64(spans[i, 3]) >> MACRO_BITS)  # fmt: skip


@inner
def tile_count(spans, i):
    """Number of macro tiles of span i."""
    left, right, top, bottom = tiles_of(spans, i)
    return (right - left + 1) * (bottom - top + 1)


@inner
def emit(mask, rows, scratch, box, source, n, output):
    """Write some records of a group; returns the row after the last.

    Args:
        mask: the lanes to write.
        rows: [LANES,16] what ``build_records`` left.
        scratch: [SCRATCH,LANES] what ``place`` left.
        box: [4,LANES] first and last column, first and last row of cells.
        source: packed row of lane 0.
        n: first row to write.
        output: see ``Projected``.
    """
    while mask != 0:
        lane = lowest_bit(mask)
        mask &= mask - 1
        copy_record(rows.ctypes.data + lane * (4 * RECORD), output.records.ctypes.data + n * (4 * RECORD))
        output.keys[n] = scratch[DEPTH, lane]
        for k in range(4):
            output.spans[n, k] = np.int16(box[k, lane])
        output.sources[n] = source + lane
        n += 1
    return n
