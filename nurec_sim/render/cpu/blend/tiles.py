"""Vector code that prepares the records of a macro tile for its 8 x 4 blocks of rays, LANES records at a time.

In a macro tile of 32 x 32 cells of a pinhole a ray's direction is d0 + x dx + y dy for cells x, y from the tile's
centre. A record's X, Y and W are then linear in (x, y), and the least Q1 over a block is that of a paraboloid over a
rectangle: an exact test of which blocks see it. Other grids read their rays from a table; for the test, each band of 8
rows of a macro tile has a linear fit of its own, which holds up to ``bend``.
"""

from __future__ import annotations

from collections.abc import Callable

from llvmlite import ir

from nurec_sim.render.cpu.records import FADE, FEATURE, FLAT, INSIDE, LIM, LOG_255, MACRO, RECORD, TAG, WROW, XROW, YROW
from nurec_sim.render.cpu.simd import (
    BITS,
    F32,
    I1,
    I8,
    I32,
    I64,
    INTS,
    LANES,
    Lanes,
    Mask,
    Vector,
    declare,
    spread,
    vector_kernel,
)

WIDE, HIGH = 8, 4
"""Sides of a block, in cells."""
ACROSS_BITS = 2
ACROSS, DOWN = MACRO // WIDE, MACRO // HIGH
BLOCKS, RAYS = ACROSS * DOWN, WIDE * HIGH
BAND = 8
"""Rows of a band."""
BANDS = MACRO // BAND
BATCH = 128
"""Most records that are prepared at once; their coefficients stay in the first-level cache."""
CAMERA_BATCH = 64
"""The same for cameras, whose blocks see more of a batch: with smaller batches, opaque blocks are noticed sooner."""
LIST = BATCH + LANES
"""Room for the numbers of a batch's records that a block sees, a byte each."""

# Rows of the coefficients [.., BATCH]. AFFINE: X, Y, W at the tile's centre and per cell along x and y, in turn;
# otherwise the three rows of the record. DRIFT: the rows times the sensor's motion.
C_X, C_Y, C_W, C_FLAT, C_FADE, C_TAG, C_FEATURE, C_NORMAL, C_DRIFT = 0, 3, 6, 9, 10, 11, 12, 15, 18
COEFFICIENTS = 21

# A basis (float32), of a pinhole's macro tile or of one of the 4 bands of another: d0, dx, dy, bend, then for moving
# sensors: middle and half range of the rays' places s on the line origin = s v, that v, and s per cell along y.
B_D0, B_DX, B_DY, B_BEND, B_MIDDLE, B_HALF, B_MOTION, B_RATE = 0, 3, 6, 9, 10, 11, 12, 15
BASIS = 16

AFFINE, ROLLING, TABLE, MOVING = 0, 1, 2, 3
"""Projection modes, how a tile's rays are described: linear directions, the same from a pose that moves along y, a
table of directions, and a table of directions with origins."""

LINEAR = (AFFINE, ROLLING)
"""Modes whose coefficients are linear in the cell."""

NEEDLE = 1e-3
"""Records thinner than this, seen from the side, go to all blocks of their tiles: their centre is ill-conditioned."""


_CHOSEN_LANES = [
    sum(lane << 8 * place for place, lane in enumerate(lane for lane in range(8) if chosen >> lane & 1))
    for chosen in range(256)
]
"""For each set of eight lanes, their numbers, a byte each, lowest first."""


def _load_records(v: Lanes, ids: ir.Value, records: ir.Value, count: ir.Value) -> list[Vector]:
    """Columns of the records with the numbers at ``ids``; lanes from ``count`` on repeat the first."""
    rows = []
    for lane in range(LANES):
        inside = v.b.icmp_signed("<", ir.Constant(I64, lane), count)
        place = v.b.select(inside, ir.Constant(I64, 4 * lane), ir.Constant(I64, 0))
        number = v.b.zext(v.b.load(v.pointer(ids, place), typ=I32, align=4), I64)
        rows.append(v.b.add(records, v.b.mul(number, ir.Constant(I64, 4 * RECORD))))
    return [
        column for first in range(0, RECORD, LANES) for column in v.transpose([v.load(row, 4 * first) for row in rows])
    ]


def _times(rows: list[list[Vector]], direction: list[Vector]) -> list[Vector]:
    """The three rows of records times one direction."""
    return [row[0] * direction[0] + row[1] * direction[1] + row[2] * direction[2] for row in rows]


def _turned(
    at: list[list[Vector]], drift: list[Vector], flat: Vector, place: Vector
) -> tuple[list[list[Vector]], list[Vector], Vector]:
    """(X, Y, W) at the centre and per cell, those of the sensor's motion, and FLAT, from a ``place`` on its way.

    In the frame of the record a ray is D = (4 X, 4 Y, n W) and the centre b = (0, 0, n) - s (4 xv, 4 yv, n wv); the
    frame is turned by the smallest rotation that brings b back to the third axis.
    """
    # FLAT = 16 / n^2.
    quarter = 1 / flat.sqrt()  # n / 4
    bx, by, bz = -(drift[0] * place), -(drift[1] * place), quarter * (1 - drift[2] * place)
    inverse = 1 / (bx * bx + by * by + bz * bz).max(1e-30).sqrt()
    bx, by, bz = bx * inverse, by * inverse, bz * inverse
    # Smallest rotation from b to the third axis; it divides by 1 + bz, which is kept away from zero.
    bend = 1 / (1 + bz.max(-0.9))
    e1 = [1 - bx * bx * bend, -(bx * by * bend), -bx]
    e2 = [-(bx * by * bend), 1 - by * by * bend, -by]

    def turn(x: Vector, y: Vector, w: Vector) -> list[Vector]:
        third = w * quarter
        return [
            e1[0] * x + e1[1] * y + e1[2] * third,
            e2[0] * x + e2[1] * y + e2[2] * third,
            (bx * x + by * y + bz * third) * inverse,
        ]

    return [turn(*part) for part in at], turn(*drift), inverse * inverse


def _rolled(
    at: list[list[Vector]], drift: list[Vector], flat: Vector, middle: Vector, rate: Vector
) -> tuple[list[list[Vector]], Vector]:
    """(X, Y, W) at the centre and per cell, and FLAT, for a shutter that rolls along y.

    Each record is seen from the place that the sensor has reached at the row of its centre, or at the tile's edge where
    the centre is outside; from there the sensor moves on by ``rate`` v per row, which shears the picture.
    """
    (centre, along_x, along_y), _, _ = _turned(at, drift, flat, middle)
    # The row at which X = Y = 0, by Cramer's rule.
    det = along_x[0] * along_y[1] - along_y[0] * along_x[1]
    row = (centre[0] * along_x[1] - centre[1] * along_x[0]) / (det.abs() > 1e-20).where(det, 1.0)
    row = row.max(-MACRO / 2).min(MACRO / 2)
    (centre, along_x, along_y), moved, flat = _turned(at, drift, flat, middle + rate * row)
    step = rate * (centre[2] + row * along_y[2])
    # Nearing the Gaussian by a part enlarges X and Y by it and shortens t; so does a W larger by that part.
    shear = [step * moved[k] for k in range(3)]
    centre = [c - row * change for c, change in zip(centre, shear, strict=True)]
    return [centre, along_x, [a + change for a, change in zip(along_y, shear, strict=True)]], flat


Squares = Callable[[ir.Value], list[Vector]]
"""Gives the least X^2 + Y^2 over each block of a row of them."""


def _least_over_blocks(at: list[list[Vector]], rows: int, v: Lanes) -> tuple[Squares, Mask]:
    """The least X^2 + Y^2 over each block of ``rows`` rows of them, and where it could not be found."""
    b = v.b
    (x0, y0, _), (xx, yx, _), (xy, yy, _) = at
    # Q1 = a (x - mx)^2 + b2 (x - mx)(y - my) + c (y - my)^2 about the centre (mx, my), where X = Y = 0.
    a, c, b2 = xx * xx + yx * yx, xy * xy + yy * yy, (xx * xy + yx * yy) * 2
    det = xx * yy - xy * yx
    # Nearly parallel gradients of X and Y: a needle, whose centre is ill-conditioned. Written so that NaN is unsure.
    unsure = ~(det.abs() > (a + c) * NEEDLE)
    inverse = 1 / unsure.where(1.0, det)
    mx, my = (y0 * xy - x0 * yy) * inverse, (x0 * yx - y0 * xx) * inverse
    half_b = b2 * -0.5
    slope_c, slope_a = half_b / c.max(1e-30), half_b / a.max(1e-30)
    zero = v.number(0)
    # Candidates: the side of the square nearest to the centre along one axis, the best place along the other.
    lefts = [WIDE * (k - ACROSS / 2) + 0.5 for k in range(ACROSS)]
    span_x = [(left - mx, left + (WIDE - 1) - mx) for left in lefts]
    near_x = [x.max(zero.min(x1)) for x, x1 in span_x]
    best_y = [slope_c * x for x in near_x]
    ax2, bx = [a * x * x for x in near_x], [b2 * x for x in near_x]

    def squares(row: ir.Value) -> list[Vector]:
        top = b.fadd(b.sitofp(b.mul(row, ir.Constant(I64, HIGH)), F32), ir.Constant(F32, 0.5 - HIGH * rows / 2))
        first, last = v.spread(top) - my, v.spread(b.fadd(top, ir.Constant(F32, HIGH - 1.0))) - my
        near = first.max(zero.min(last))
        best_x, cy2, by = slope_a * near, c * near * near, b2 * near
        least = []
        for column in range(ACROSS):
            # A convex quadratic over a rectangle that does not hold its centre has its least value on one of the two
            # sides that face the centre: the better of both candidates. Where the centre is inside, both are zero.
            y = best_y[column].max(first).min(last)
            x = best_x.max(span_x[column][0]).min(span_x[column][1])
            least.append((ax2[column] + (bx[column] + c * y) * y).min(cy2 + (by + a * x) * x))
        return least

    return squares, unsure


def _widened(
    column: list[Vector], drift: list[Vector], base: list[Vector], flat: Vector, reach: Vector
) -> tuple[Vector, Vector]:
    """LIM for a sensor that is up to ``reach`` from where the record was made, and how far it may be off sideways.

    From elsewhere on the way the ball of a Gaussian is nearer: allow for it.
    """
    sideways = (drift[0] * drift[0] + drift[1] * drift[1]).sqrt()
    # The distance of the centre after ``reach`` of the way, relative to that from the reference point, at least.
    shrink = 1 - reach * (drift[2].abs() + sideways * column[FLAT].sqrt())
    nearer = shrink.max(0.05)
    rim = LOG_255 / 8 - column[FADE]
    room = 1 - rim * flat / (nearer * nearer)
    # As LIM in ``records.build_records``, with FLAT of the nearer point.
    limit = ((room > 1e-4) & (shrink > 0.05)).where(rim / (room.max(1e-4) * nearer * nearer), INSIDE)
    return limit, sideways


def _append(v: Lanes, chosen: ir.Value, entry: ir.Value, lists: ir.Value, counts: ir.Value, block: ir.Value) -> None:
    """Append ``entry`` + k for every bit k of ``chosen`` to a block's list of bytes."""
    b = v.b
    counter = v.pointer(counts, b.shl(block, ir.Constant(I64, 3)))
    count = b.load(counter, typ=I64, align=8)
    end = v.pointer(v.address(lists, b.mul(block, ir.Constant(I64, LIST))), count)
    # All lanes are stored, the chosen ones in front, and the count decides what is valid, which is why a list has LANES
    # entries of spare room.
    if LANES == 8:
        # Eight bytes are a number: those of a table, which has them for all sets of lanes, and ``entry`` eight times.
        table = v.pointer(v.table("chosen_lanes", _CHOSEN_LANES), b.shl(b.zext(chosen, I64), ir.Constant(I64, 3)))
        lanes = b.load(table, typ=I64, align=8)
        b.store(b.add(lanes, b.mul(entry, ir.Constant(I64, 0x0101010101010101))), end, align=1)
    else:
        compress = declare(b, f"llvm.experimental.vector.compress.v{LANES}i32", INTS, [INTS, BITS, INTS])
        numbers = b.add(spread(b, b.trunc(entry, I32), INTS), ir.Constant(INTS, list(range(LANES))))
        front = b.call(compress, [numbers, b.bitcast(chosen, BITS), ir.Constant(INTS, ir.Undefined)])
        b.store(b.trunc(front, ir.VectorType(I8, LANES)), end, align=1)
    count_bits = declare(b, f"llvm.ctpop.i{LANES}", chosen.type, [chosen.type])
    b.store(b.add(count, b.zext(b.call(count_bits, [chosen]), I64)), counter, align=8)


@vector_kernel("niiiiiiiii")
def prepare(
    v: Lanes,
    mode: int,
    ids: ir.Value,
    records: ir.Value,
    count: ir.Value,
    alive: ir.Value,
    basis: ir.Value,
    coefficients: ir.Value,
    lists: ir.Value,
    counts: ir.Value,
    entry: ir.Value,
) -> ir.Value:
    """Coefficients of up to LANES records, and their numbers appended to the lists of the blocks that see them.

    Args:
        v: vectors.
        mode: projection mode.
        ids: address of their record numbers (int32).
        records: address of the records.
        count: how many there are, at least 1.
        alive: bit k is set while block k is still open (not all of its rays are opaque).
        basis: address of the tile's basis, or of those of its bands.
        coefficients: address of [COEFFICIENTS,BATCH].
        lists: address of [BLOCKS,LIST] bytes.
        counts: address of [BLOCKS] int64.
        entry: number of the first record within the batch.

    Returns:
        1 if any of them is close (TAG), else 0.
    """
    b, linear, moving = v.b, mode in LINEAR, mode in (ROLLING, MOVING)
    column = _load_records(v, ids, records, count)
    rows = [column[k : k + 3] for k in (XROW, YROW, WROW)]
    where = v.address(coefficients, b.shl(entry, ir.Constant(I64, 2)))
    lane = ir.Constant(INTS, list(range(LANES)))
    given = b.icmp_signed("<", lane, spread(b, b.trunc(count, I32), INTS))
    bands = 1 if linear else BANDS
    motion = [v.broadcast(basis, 4 * (B_MOTION + k)) for k in range(3)] if moving else []
    drift = _times(rows, motion) if moving else []
    lane_bits = ir.IntType(LANES)

    def keep(first: int, values: list[Vector]) -> None:
        """Store rows of the coefficients."""
        for k, value in enumerate(values):
            v.store(value, where, 4 * BATCH * (first + k))

    def list_band(band: ir.Value, nothing: list[Vector]) -> list[Vector]:
        flat = column[FLAT]
        band_basis = v.address(basis, b.mul(band, ir.Constant(I64, 4 * BASIS)))
        base = [v.broadcast(band_basis, 4 * k) for k in range(BASIS)]
        at = [_times(rows, base[k : k + 3]) for k in (B_D0, B_DX, B_DY)]
        limit, slack = column[LIM], v.number(0)
        if mode == ROLLING:
            at, flat = _rolled(at, drift, flat, base[B_MIDDLE], base[B_RATE])
            limit, _ = _widened(column, drift, base, flat, base[B_HALF])
        # The largest W in the tile or band: the cone Q1 < LIM W^2 is tested at its widest.
        height = MACRO / 2 / bands
        widest = at[0][2] + at[1][2].abs() * (MACRO / 2) + at[2][2].abs() * height
        if not linear:
            # |(X, Y)| changes by at most the norm of the rows times the fit's largest error; likewise W by its
            # row's.
            slope = (sum((x * x for x in rows[0] + rows[1]), start=v.number(0))).sqrt()
            slack = slope * base[B_BEND]
            depth = (rows[2][0] * rows[2][0] + rows[2][1] * rows[2][1] + rows[2][2] * rows[2][2]).sqrt()
            widest = widest + depth * base[B_BEND]
        if mode == MOVING:
            # Records hold the reference point; rays of this band start up to ``reach`` of the way from it.
            reach = base[B_HALF] + base[B_MIDDLE].abs()
            limit, sideways = _widened(column, drift, base, flat, reach)
            # Shifted by the band's middle place; the spread about it becomes slack.
            at = [[x + w * base[B_MIDDLE] * drift[0], y + w * base[B_MIDDLE] * drift[1], w] for x, y, w in at]
            slack = slack + base[B_HALF] * sideways * widest.max(0)
            slack = slack + reach * drift[2].abs() * (limit.min(1e6).sqrt() * widest.max(0))
        # 1 % for float32: a block too many costs time, one too few would be a hole.
        room = limit.min(INSIDE).sqrt() * widest.max(0) * 1.01 + slack
        squares, unsure = _least_over_blocks(at, DOWN // bands, v)
        # Around the eye (INSIDE) every ray meets it.
        always = unsure | (limit >= INSIDE)
        seen, room = widest > 0, room * room

        def list_row(row: ir.Value, nothing: list[Vector]) -> list[Vector]:
            first = b.shl(b.add(b.mul(band, ir.Constant(I64, DOWN // bands)), row), ir.Constant(I64, ACROSS_BITS))
            for k, square in enumerate(squares(row)):
                block = b.add(first, ir.Constant(I64, k))
                mask = b.and_((((square < room) & seen) | always).value, given)
                open_ = b.trunc(b.lshr(alive, block), I1)
                chosen = b.select(open_, b.bitcast(mask, lane_bits), ir.Constant(lane_bits, 0))
                _append(v, chosen, entry, lists, counts, block)
            return nothing

        v.repeat(ir.Constant(I64, DOWN // bands), [], list_row)
        if linear:
            keep(C_X, [at[j][k] for k in range(3) for j in range(3)])
        if mode == ROLLING:
            keep(C_FLAT, [flat])
        return nothing

    keep(C_FLAT, [column[FLAT], column[FADE], column[TAG], *column[FEATURE : FEATURE + 3]])
    if not linear:
        keep(C_X, [row[k] for row in rows for k in range(3)])
    if mode == MOVING:
        keep(C_DRIFT, drift)
    v.repeat(ir.Constant(I64, bands), [], list_band)

    # CLOSE_BIT is the sign bit of TAG.
    near = b.icmp_signed("<", column[TAG].bits(), ir.Constant(INTS, [0] * LANES))
    return Mask(b, b.and_(near, given)).any()
