"""Vector code that carries gradients of a block's 8 x 4 rays back to a list of records, in a second pass front to back.

A block's state is [STATE_PLANES,32] float32. With q = sum of (gradient of a sum times what the record adds to it per
weight) and G = the sum of all weights times q, which the forward's sums give, one pass suffices:

    gradient of alpha = T q - (G - what has been added so far) / (1 - alpha)

Everything a record contributes along a ray d depends on (X, Y, W) = rows d, and only their products are needed
afterwards (``backward.project``), so no coordinate of a ray or pixel enters the sums.
"""

from __future__ import annotations

from llvmlite import ir

from nurec_sim.render.cpu.blend.responses import (
    LIDAR,
    LIDAR_MIN_TRANSMITTANCE,
    Bundle,
    Coefficient,
    RayGroup,
    hits_of,
    initial_transmittance,
    run_records,
)
from nurec_sim.render.cpu.blend.tiles import C_FEATURE, RAYS, WIDE
from nurec_sim.render.cpu.simd import F32, I32, I64, LANES, Lanes, Vector, vector_kernel

# Planes of a block's state behind the transmittance: G less what has been added so far, and the gradients of the sums.
REST, G_ALPHA, G_FEATURE, G_DISTANCE, G_HALF = 1, 2, 3, 6, 7
STATE_PLANES = 8
IMAGE_PLANES = 6
"""Planes of the blended image and of its gradients: alpha, three features, distance, half distance."""

# Sums of a record: products of the gradient by one of (X, Y, W) and one of (X, Y, W), gradients of FLAT and FADE, and
# of the features. The gradient by X times Y is that by Y times X: turning e1, e2 about the centre changes nothing.
S_XX, S_XY, S_YY, S_XW, S_YW, S_WX, S_WY, S_WW, S_FLAT, S_FADE, S_FEATURE = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10
SUMS = 16

COLOURS = 3
"""An output kind of the backward pass alone: sums of weights (in S_FADE) and of weights times features, no more."""
COLOUR_SUMS = 4
"""So many, from S_FADE on."""


@vector_kernel("nnniiiiiiifff")
def carry_back(
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
    sums: ir.Value,
    x0: ir.Value,
    y0: ir.Value,
    near: ir.Value,
) -> ir.Value:
    """Add a block's part to its records; returns 1 while any ray has transmittance left.

    Args:
        v: vectors.
        mode: AFFINE, TABLE or MOVING.
        output_kind: CAMERA, LIDAR or COLOURS.
        check_near: as for ``blocks.blend``.
        state: address of [STATE_PLANES,32].
        numbers: as for ``blocks.blend``, like all up to ``near`` that is not named here.
        count: see numbers.
        coefficients: see numbers.
        rays: see numbers.
        basis: see numbers.
        sums: address of [BATCH,SUMS], added to.
        x0: see numbers.
        y0: see numbers.
        near: near plane.
    """
    b = v.b

    def by_features(group: RayGroup, weight: Bundle) -> dict[int, Bundle]:
        return {S_FEATURE + c: weight * group.plane(state, G_FEATURE + c) for c in range(3)}

    def keep(number: ir.Value, sums_of: dict[int, Bundle]) -> None:
        # Lane k of the result is sum k over the group's rays: one store of SUMS floats per record.
        totals = [sums_of[k].total() if k in sums_of else v.number(0) for k in range(SUMS)]
        # 64 bytes a record: SUMS float32.
        place_of_sums = v.address(sums, b.shl(number, ir.Constant(I64, 6)))
        for first in range(0, SUMS, LANES):
            old = v.load(place_of_sums, 4 * first)
            v.store(old + v.sums(totals[first : first + LANES]), place_of_sums, 4 * first)

    def step(group: RayGroup, number: ir.Value, coefficient: Coefficient, values: list[Bundle]) -> list[Bundle]:
        # Forwards once more: the same responses, so the same rays are hit and T is what it was.
        """One more record; ``values``: transmittance before it, and G less what has been added so far."""
        meeting, alpha, hit = hits_of(
            v, mode, output_kind, group, coefficient, rays, basis, near if check_near else None
        )
        before = values[0]
        if output_kind == LIDAR:
            hit = hit & (before > LIDAR_MIN_TRANSMITTANCE)
        meeting.forget_misses(hit)
        alpha = hit.where(alpha, 0)
        weight = alpha * before
        after = before - weight
        if output_kind == COLOURS:
            keep(number, {S_FADE: weight * group.plane(state, G_ALPHA)} | by_features(group, weight))
            return [after]

        # Backwards: q is what a unit of this record's weight changes the loss by, ``rest`` what all behind it add.
        by_mean = group.plane(state, G_DISTANCE)
        q = group.plane(state, G_ALPHA) + by_mean * meeting.distance
        for c in range(3):
            q = q + group.plane(state, G_FEATURE + c) * coefficient(C_FEATURE + c)
        rest = values[1] - weight * q
        # A change of alpha changes this record's weight, and scales all weights behind it by 1 / (1 - alpha);
        # opacities are capped at 0.99, so the division is safe.
        by_alpha = before * q - rest * (1 - alpha).reciprocal(False)
        by_exponent, by_distance = alpha * by_alpha * -8, weight * by_mean  # alpha = exp(-8 exponent)
        if output_kind == LIDAR:
            # The half distance is the distance of one hit; which hit it is has no gradient.
            crossing = (before > 0.5) & (after <= 0.5)
            by_distance = by_distance + crossing.where(group.plane(state, G_HALF), 0)
        sums_of = [*meeting.sums(by_exponent, by_distance), by_exponent]
        keep(number, dict(enumerate(sums_of)) | by_features(group, weight))
        return [after, rest]

    changing = 1 if output_kind == COLOURS else REST + 1
    return run_records(v, state, changing, numbers, count, coefficients, (x0, y0), output_kind, step)


@vector_kernel("iiiiii")
def open_gradients(
    v: Lanes,
    state: ir.Value,
    planes: ir.Value,
    gradients: ir.Value,
    rays: ir.Value,
    row_bytes: ir.Value,
    plane_bytes: ir.Value,
) -> None:
    """Start a block from the blended image and its gradients.

    Args:
        v: vectors.
        state: address of the block's [STATE_PLANES,32], written.
        planes: address of the block's first cell in the blended image [IMAGE_PLANES,h,w].
        gradients: the same in the image's gradients, which must be 0 where a ray is not valid.
        rays: address of the block's [RAY_PLANES,32]; 0 where all rays are valid.
        row_bytes: distance of rows.
        plane_bytes: distance of planes.
    """
    b = v.b
    half = ir.VectorType(F32, WIDE)

    def cells(base: ir.Value, plane: int, k: int) -> Vector:
        """Vector k of a block, from rows of 8 cells of an image."""
        rows = LANES // WIDE
        start = b.add(base, b.mul(plane_bytes, ir.Constant(I64, plane)))
        pieces = [
            b.load(v.pointer(start, b.mul(row_bytes, ir.Constant(I64, k * rows + r))), typ=half, align=4)
            for r in range(rows)
        ]
        if rows == 1:
            return Vector(b, pieces[0])
        lanes = ir.Constant(ir.VectorType(I32, LANES), list(range(LANES)))
        return Vector(b, b.shuffle_vector(pieces[0], pieces[1], lanes))

    for k, transmittance in enumerate(initial_transmittance(v, state, rays)):
        offset = 4 * LANES * k
        image = [cells(planes, plane, k) for plane in range(IMAGE_PLANES)]
        gradient = [cells(gradients, plane, k) for plane in range(IMAGE_PLANES)]
        # G: the blended sums are linear in the weights, so G is the image times its gradients, without the half
        # distance.
        total = v.number(0)
        for plane in range(IMAGE_PLANES - 1):
            total = total + image[plane] * gradient[plane]
        # Planes of the state in order; the gradients are in the order of the image's planes.
        for plane, value in enumerate([transmittance, total, *gradient]):
            v.store(value, state, 4 * RAYS * plane + offset)
