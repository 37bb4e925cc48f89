"""Vector code that blends a list of records into a block of 8 x 4 rays, whose sums stay in registers.

A block's state is [planes, 32] float32: transmittance, features, distance, and for cameras the largest weight so far,
whose lowest bits hold the label it came with, for LiDARs the distance at which the transmittance fell to a half.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir

from nurec_sim.render.cpu.blend.tiles import (
    AFFINE,
    B_D0,
    B_DX,
    B_DY,
    BATCH,
    C_DRIFT,
    C_FADE,
    C_FEATURE,
    C_FLAT,
    C_NORMAL,
    C_TAG,
    C_W,
    C_X,
    C_Y,
    MOVING,
    RAYS,
    TABLE,
    WIDE,
)
from nurec_sim.render.cpu.records import LABEL_BITS
from nurec_sim.render.cpu.simd import I8, I32, I64, INTS, LANES, Lanes, Vector, spread, vector_kernel

CAMERA, NORMALS, LIDAR = 0, 1, 2
"""What is summed up: three features, distance and label; the same and three more features; features, distance, half."""

# Planes of a block's state.
T, FEATURES = 0, 1
PLANES = {CAMERA: 6, NORMALS: 9, LIDAR: 6}
"""T, 3 features, (3 more,) distance, and the largest weight or the half distance."""
MOST_PLANES = 9

# Planes of a block's rays: direction, 1 where there is one else 0, place on the way of a moving sensor.
DX, DY, DZ, VALID, PLACE = 0, 1, 2, 3, 4
RAY_PLANES = 5

CUT = math.log(255.0) / 8
MIN_TRANSMITTANCE, LIDAR_MIN_TRANSMITTANCE = 1e-4, 1e-2
VECTORS = RAYS // LANES
"""Vectors that cover a block."""
AT_ONCE = 2
"""Vectors of rays that are blended at once: as many as the registers hold."""


def _exponential() -> list[float]:
    """Coefficients of the quartic nearest to exp(-x) on 0..CUT in relative terms (Chebyshev nodes)."""
    x = (1 - np.cos((np.arange(64) + 0.5) * np.pi / 64)) / 2 * CUT
    basis = np.stack([x**k for k in range(5)], axis=1) * np.exp(x)[:, None]
    return [float(c) for c in np.linalg.lstsq(basis, np.ones(64), rcond=None)[0]]


EXPONENTIAL = _exponential()


def fading(x: list[Vector]) -> list[Vector]:
    """exp(-8 x) for x in 0..CUT to 2e-5: the quartic, three times squared."""
    e = [xi * EXPONENTIAL[4] + EXPONENTIAL[3] for xi in x]
    for c in EXPONENTIAL[2::-1]:
        e = [ei * xi + c for ei, xi in zip(e, x, strict=True)]
    for _ in range(3):
        e = [ei * ei for ei in e]
    return e


def responses(
    v: Lanes,
    way: int,
    coefficient: Callable[[int], Vector],
    rays: Callable[[int], list[Vector]],
    x: Vector,
    y: list[Vector],
    refined: bool,
) -> tuple[list[Vector], list[Vector]]:
    """Faded exponents Q1 / Q2 + FADE and distances t of one record for some vectors of rays.

    Args:
        v: vectors.
        way: AFFINE, TABLE or MOVING.
        coefficient: a row of the record's coefficients in all lanes.
        rays: a plane of the rays, per vector (unused for AFFINE).
        x: cells from the tile's centre (AFFINE), the same for every vector.
        y: the same along y, per vector.
        refined: whether distances need more than 14 bits (LiDARs).
    """
    count = len(y)
    rows = [[coefficient(start + k) for k in range(3)] for start in (C_X, C_Y, C_W)]
    if way == AFFINE:
        first = [row[0] + row[1] * x for row in rows]
        big_x, big_y, big_w = ([first[r] + rows[r][2] * y[k] for k in range(count)] for r in range(3))
    else:
        d = [rays(plane) for plane in (DX, DY, DZ)]
        big_x, big_y, big_w = (
            [row[0] * d[0][k] + row[1] * d[1][k] + row[2] * d[2][k] for k in range(count)] for row in rows
        )
    flat, fade = coefficient(C_FLAT), coefficient(C_FADE)
    q1 = [a * a + b * b for a, b in zip(big_x, big_y, strict=True)]
    q2 = [flat * q + w * w for q, w in zip(q1, big_w, strict=True)]
    inverse = [q.reciprocal(refined) for q in q2]
    if way != MOVING:
        return (
            [q * i + fade for q, i in zip(q1, inverse, strict=True)],
            [w * i for w, i in zip(big_w, inverse, strict=True)],
        )
    # The origin lies s v from the reference point; exact, see ``tiles.py``.
    xv, yv, wv = (coefficient(C_DRIFT + k) for k in range(3))
    exponents, distances = [], []
    for k, s in enumerate(rays(PLACE)):
        rest = 1 - s * wv
        step = s * big_w[k]
        a, b = big_x[k] * rest + xv * step, big_y[k] * rest + yv * step
        c = s * (big_x[k] * yv - big_y[k] * xv)
        exponents.append((a * a + b * b + flat * c * c) * inverse[k] + fade)
        along = big_w[k] * rest - s * flat * (big_x[k] * xv + big_y[k] * yv)
        distances.append(along * inverse[k])
    return exponents, distances


def still_open(transmittance: list[Vector], kind: int) -> ir.Value:
    """An int64: 1 while any of the rays of a CAMERA or LIDAR goes on, else 0."""
    most = functools.reduce(Vector.max, transmittance)
    return (most > (LIDAR_MIN_TRANSMITTANCE if kind == LIDAR else MIN_TRANSMITTANCE)).any()


def _blending(way: int, kind: int, check_near: bool) -> Callable[..., Any]:
    @vector_kernel("iiiiiifff")
    def blend(
        v: Lanes,
        state: ir.Value,
        numbers: ir.Value,
        count: ir.Value,
        coefficients: ir.Value,
        rays: ir.Value,
        basis: ir.Value,
        x0: ir.Value,
        y0: ir.Value,
        near: ir.Value,
    ) -> ir.Value:
        """Blend records into a block; returns 1 while any of its rays still has transmittance.

        Args:
            v: vectors.
            state: address of [planes,32].
            numbers: address of the records' numbers in the batch, a byte each.
            count: how many, at least 1.
            coefficients: address of [COEFFICIENTS,BATCH].
            rays: address of the block's [RAY_PLANES,32].
            basis: address of the tile's basis.
            x0: first cell's x from the tile's centre.
            y0: the same for y.
            near: near plane.
        """
        b = v.b
        alive: ir.Value | None = None
        for part in range(0, VECTORS, AT_ONCE):
            offsets = [4 * LANES * (part + k) for k in range(AT_ONCE)]
            x = v.numbers([lane % WIDE for lane in range(LANES)]) + v.spread(x0)
            y = [
                v.numbers([((part + k) * LANES + lane) // WIDE for lane in range(LANES)]) + v.spread(y0)
                for k in range(AT_ONCE)
            ]

            def plane_of(base: ir.Value, plane: int, offsets: list[int] = offsets) -> list[Vector]:
                return [v.load(base, 4 * RAYS * plane + offset) for offset in offsets]

            def body(
                i: ir.Value, values: list[Vector], x: Vector = x, y: list[Vector] = y, plane_of: Any = plane_of
            ) -> list[Vector]:
                number = b.zext(b.load(v.pointer(numbers, i), typ=I8, align=1), I64)
                where = v.address(coefficients, b.shl(number, ir.Constant(I64, 2)))

                def coefficient(k: int) -> Vector:
                    return v.broadcast(where, 4 * BATCH * k)

                planes = [values[k : k + AT_ONCE] for k in range(0, len(values), AT_ONCE)]
                own_rays = functools.partial(plane_of, rays)
                exponent, distance = responses(v, way, coefficient, own_rays, x, y, kind == LIDAR)
                hits = [e < CUT for e in exponent]
                if check_near:
                    least = v.spread(near)
                    if way == AFFINE:
                        d = [[v.broadcast(basis, 4 * (start + c)) for start in (B_D0, B_DX, B_DY)] for c in range(3)]
                        for k in range(AT_ONCE):
                            lengths = [c[0] + c[1] * x + c[2] * y[k] for c in d]
                            length = (
                                lengths[0] * lengths[0] + lengths[1] * lengths[1] + lengths[2] * lengths[2]
                            ).sqrt()
                            hits[k] = hits[k] & (distance[k] * length >= least)
                    else:
                        hits = [hit & (t >= least) for hit, t in zip(hits, distance, strict=True)]
                distance = [hit.where(t, 0) for hit, t in zip(hits, distance, strict=True)]  # no NaN from a miss
                alpha = fading(exponent)
                before = planes[T]
                if kind == LIDAR:
                    hits = [hit & (t > LIDAR_MIN_TRANSMITTANCE) for hit, t in zip(hits, before, strict=True)]
                weight = [hit.where(a * t, 0) for hit, a, t in zip(hits, alpha, before, strict=True)]
                after = [t - w for t, w in zip(before, weight, strict=True)]
                result = [after]
                features = [C_FEATURE + k for k in range(3)] + (
                    [C_NORMAL + k for k in range(3)] if kind == NORMALS else []
                )
                for plane, feature in zip(planes[FEATURES:], features, strict=False):
                    f = coefficient(feature)
                    result.append([p + w * f for p, w in zip(plane, weight, strict=True)])
                result.append([p + w * t for p, w, t in zip(planes[-2], weight, distance, strict=True)])
                if kind == LIDAR:
                    crossing = [(t > 0.5) & (u <= 0.5) for t, u in zip(before, after, strict=True)]
                    result.append([c.where(t, p) for c, t, p in zip(crossing, distance, planes[-1], strict=True)])
                else:
                    label = b.and_(coefficient(C_TAG).bits(), ir.Constant(INTS, [LABEL_BITS] * LANES))
                    keep = ir.Constant(INTS, [~LABEL_BITS] * LANES)
                    tagged = [v.from_bits(b.or_(b.and_(w.bits(), keep), label)) for w in weight]
                    result.append([p.max(w) for p, w in zip(planes[-1], tagged, strict=True)])
                return [value for plane in result for value in plane]

            initial = [value for plane in range(PLANES[kind]) for value in plane_of(state, plane)]
            final = v.repeat(count, initial, body)
            for plane in range(PLANES[kind]):
                for k, offset in enumerate(offsets):
                    v.store(final[plane * AT_ONCE + k], state, 4 * RAYS * plane + offset)
            left = still_open(final[:AT_ONCE], kind)
            alive = left if alive is None else b.or_(alive, left)
        assert alive is not None
        return alive

    return blend


blend_affine_camera = _blending(AFFINE, CAMERA, False)
blend_affine_camera_near = _blending(AFFINE, CAMERA, True)
blend_affine_normals = _blending(AFFINE, NORMALS, True)
blend_table_camera = _blending(TABLE, CAMERA, True)
blend_table_normals = _blending(TABLE, NORMALS, True)
blend_table_lidar = _blending(TABLE, LIDAR, True)
blend_moving_camera = _blending(MOVING, CAMERA, True)
blend_moving_normals = _blending(MOVING, NORMALS, True)
blend_moving_lidar = _blending(MOVING, LIDAR, True)


@vector_kernel("iii")
def open_block(v: Lanes, state: ir.Value, planes: ir.Value, rays: ir.Value) -> None:
    """Start a block: full transmittance where there is a ray (everywhere if ``rays`` is 0), all sums zero."""
    b = v.b
    table = b.icmp_signed("!=", rays, ir.Constant(I64, 0))
    source = b.select(table, b.add(rays, ir.Constant(I64, 4 * RAYS * VALID)), state)
    for k in range(VECTORS):
        valid = v.load(source, 4 * LANES * k)
        one = b.select(spread(b, table, ir.VectorType(ir.IntType(1), LANES)), valid.value, v.number(1).value)
        v.store(Vector(b, one), state, 4 * LANES * k)

    def clear(i: ir.Value, values: list[Vector]) -> list[Vector]:
        v.store(v.number(0), state, b.mul(b.add(i, ir.Constant(I64, VECTORS)), ir.Constant(I64, 4 * LANES)))
        return values

    v.repeat(b.mul(b.sub(planes, ir.Constant(I64, 1)), ir.Constant(I64, VECTORS)), [], clear)


def _writing(count: int) -> Callable[..., Any]:
    @vector_kernel("iiii")
    def write_block(v: Lanes, state: ir.Value, target: ir.Value, row_bytes: ir.Value, plane_bytes: ir.Value) -> None:
        """Copy a block's state to image planes [planes,h,w] whose sides are multiples of a block's; T becomes alpha."""
        b = v.b
        half = ir.VectorType(ir.FloatType(), WIDE)
        for plane in range(count):
            base = b.add(target, b.mul(plane_bytes, ir.Constant(I64, plane)))
            for k in range(VECTORS):
                x = v.load(state, 4 * (RAYS * plane + LANES * k))
                x = 1 - x if plane == T else x
                for part in range(LANES // WIDE):
                    lanes = ir.Constant(ir.VectorType(I32, WIDE), list(range(WIDE * part, WIDE * part + WIDE)))
                    row = k * (LANES // WIDE) + part
                    piece = b.shuffle_vector(x.value, x.value, lanes)
                    assert piece.type == half
                    b.store(piece, v.pointer(base, b.mul(row_bytes, ir.Constant(I64, row))), align=4)

    return write_block


write_block_6, write_block_9 = _writing(6), _writing(9)
