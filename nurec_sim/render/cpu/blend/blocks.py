"""Vector code that blends a list of records into a block of 8 x 4 rays, whose sums stay in registers.

A block's state is [planes, 32] float32: transmittance, features, distance, and for cameras the largest weight so far,
whose lowest bits hold the label it came with, for LiDARs the distance at which the transmittance fell to a half.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir

from nurec_sim.render.cpu.blend.responses import (
    CAMERA,
    LIDAR,
    NORMALS,
    VECTORS,
    Bundle,
    Coefficient,
    RayGroup,
    T,
    hits_of,
    initial_transmittance,
    run_records,
)
from nurec_sim.render.cpu.blend.tiles import C_FEATURE, C_NORMAL, C_TAG, RAYS, WIDE
from nurec_sim.render.cpu.kernel import fixed
from nurec_sim.render.cpu.records import LABEL_BITS
from nurec_sim.render.cpu.simd import I32, I64, INTS, LANES, Lanes, Vector, vector_kernel

FEATURES = 1
"""The plane of a block's state that follows T: the first feature."""
PLANES = {CAMERA: 6, NORMALS: 9, LIDAR: 6}
"""T, 3 features, (3 more,) distance, and the largest weight or the half distance."""
MOST_PLANES = 9
ALL_FAR, CHECK_NEAR = fixed(0), fixed(1)
"""Whether records may reach the near plane."""
_COLOURS, _NORMALS = [C_FEATURE + k for k in range(3)], [C_NORMAL + k for k in range(3)]
FEATURE_ROWS = {CAMERA: _COLOURS, NORMALS: _COLOURS + _NORMALS}
"""Rows of the coefficients that are summed up, by output kind."""


@vector_kernel("nnniiiiiifff")
def blend(
    v: Lanes,
    mode: int,
    output_kind: int,
    check_near: int,
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
        mode: projection mode.
        output_kind: CAMERA or NORMALS.
        check_near: ALL_FAR or CHECK_NEAR.
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

    def step(group: RayGroup, number: ir.Value, coefficient: Coefficient, sums: list[Bundle]) -> list[Bundle]:
        """The rays' sums (planes of the block's state) after one more record."""
        meeting, alpha, hit = hits_of(
            v, mode, output_kind, group, coefficient, rays, basis, near if check_near else None
        )
        distance = hit.where(meeting.distance, 0)  # no NaN from a miss
        before = sums[T]
        # Front to back: a record's weight is its alpha times what the nearer ones have let through. Rays continue
        # until the whole block is opaque, which adds at most 1e-4 to a ray.
        weight = hit.where(alpha * before, 0)
        after = before - weight
        result = [after]
        for plane, feature in zip(sums[FEATURES:-2], FEATURE_ROWS[output_kind], strict=True):
            result.append(plane + weight * coefficient(feature))
        result.append(sums[-2] + weight * distance)
        # The label replaces the lowest bits of the weight, so that one maximum finds weight and label.
        label = b.and_(coefficient(C_TAG).bits(), ir.Constant(INTS, [LABEL_BITS] * LANES))
        # 8 of 23 mantissa bits: weights are compared to 1 part in 2^15.
        keep = ir.Constant(INTS, [~LABEL_BITS] * LANES)
        tagged = [v.from_bits(b.or_(b.and_(w.bits(), keep), label)) for w in weight.parts]
        result.append(Bundle(p.max(w) for p, w in zip(sums[-1].parts, tagged, strict=True)))
        return result

    return run_records(v, state, PLANES[output_kind], numbers, count, coefficients, (x0, y0), output_kind, step)


@vector_kernel("iii")
def open_block(v: Lanes, state: ir.Value, planes: ir.Value, rays: ir.Value) -> None:
    """Start a block: full transmittance where there is a ray, all sums zero.

    Args:
        v: vectors.
        state: address of the block's [planes,32].
        planes: how many planes it has.
        rays: address of the block's [RAY_PLANES,32]; 0 where every cell has a ray.
    """
    b = v.b
    for k, transmittance in enumerate(initial_transmittance(v, state, rays)):
        v.store(transmittance, state, 4 * LANES * k)

    def clear(i: ir.Value, values: list[Vector]) -> list[Vector]:
        v.store(v.number(0), state, b.mul(b.add(i, ir.Constant(I64, VECTORS)), ir.Constant(I64, 4 * LANES)))
        return values

    v.repeat(b.mul(b.sub(planes, ir.Constant(I64, 1)), ir.Constant(I64, VECTORS)), [], clear)


def _writing(count: int) -> Callable[..., Any]:
    @vector_kernel("iiii")
    def write_block(v: Lanes, state: ir.Value, target: ir.Value, row_bytes: ir.Value, plane_bytes: ir.Value) -> None:
        """Copy a block's state to image planes [planes,h,w] whose sides are multiples of a block's; T becomes alpha.

        Args:
            v: vectors.
            state: address of the block's [planes,32].
            target: address of the block's first cell in the first plane.
            row_bytes: distance of rows.
            plane_bytes: distance of planes.
        """
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
                    # A vector holds one or two rows of 8 cells, which lie apart in the image.
                    piece = b.shuffle_vector(x.value, x.value, lanes)
                    assert piece.type == half
                    b.store(piece, v.pointer(base, b.mul(row_bytes, ir.Constant(I64, row))), align=4)

    return write_block


write_block_6, write_block_9 = _writing(6), _writing(9)
