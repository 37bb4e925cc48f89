"""Vector code that carries gradients of a block's 8 x 4 rays back to a list of records, front to back once more.

A block's state is [STATE_PLANES,32] float32. With q = sum of (gradient of a sum times what the record adds to it per
weight) and G = the sum of all weights times q, which the forward's sums give, one pass suffices:

    gradient of alpha = T q - (G - what has been added so far) / (1 - alpha)

Everything a record gives along a ray d depends on (X, Y, W) = rows d, and only their products are needed afterwards
(``backward_project``), so that no coordinate of a ray or pixel enters the sums.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable
from typing import Any

from llvmlite import ir

from nurec_sim.render.cpu.blend.blocks import (
    AT_ONCE,
    CAMERA,
    CUT,
    DX,
    DY,
    DZ,
    LIDAR,
    LIDAR_MIN_TRANSMITTANCE,
    MIN_TRANSMITTANCE,
    PLACE,
    VALID,
    VECTORS,
    fading,
    still_open,
)
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
    C_W,
    C_X,
    C_Y,
    MOVING,
    RAYS,
    TABLE,
    WIDE,
)
from nurec_sim.render.cpu.simd import F32, I8, I32, I64, LANES, Lanes, Vector, vector_kernel

# Planes of a block's state: transmittance, G less what has been added so far, and the gradients of the sums.
T, REST, G_ALPHA, G_FEATURE, G_DISTANCE, G_HALF = 0, 1, 2, 3, 6, 7
STATE_PLANES = 8
IMAGE_PLANES = 6
"""Planes of the blended image and of its gradients: alpha, three features, distance, half distance."""

# Sums of a record: products of the gradient by one of (X, Y, W) and one of (X, Y, W), gradients of FLAT and FADE, and
# of the features. The gradient by X times Y is that by Y times X: turning e1, e2 about the centre changes nothing.
S_XX, S_XY, S_YY, S_XW, S_YW, S_WX, S_WY, S_WW, S_FLAT, S_FADE, S_FEATURE = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10
SUMS = 16


class Bundle:
    """Some vectors (or masks) that go through the same steps side by side, which keeps the arithmetic units busy."""

    __slots__ = ("parts",)

    def __init__(self, parts: Iterable[Any]) -> None:
        self.parts = list(parts)

    def _with(self, step: Callable[..., Any], *others: Any) -> Bundle:
        columns = [other.parts if isinstance(other, Bundle) else [other] * len(self.parts) for other in others]
        return Bundle(step(*each) for each in zip(self.parts, *columns, strict=True))

    def __add__(self, other: Any) -> Bundle:
        return self._with(operator.add, other)

    def __sub__(self, other: Any) -> Bundle:
        return self._with(operator.sub, other)

    def __rsub__(self, other: Any) -> Bundle:
        return self._with(lambda mine, its: its - mine, other)

    def __mul__(self, other: Any) -> Bundle:
        return self._with(operator.mul, other)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> Bundle:
        return self._with(operator.neg)

    def __lt__(self, other: Any) -> Bundle:
        return self._with(operator.lt, other)

    def __le__(self, other: Any) -> Bundle:
        return self._with(operator.le, other)

    def __gt__(self, other: Any) -> Bundle:
        return self._with(operator.gt, other)

    def __ge__(self, other: Any) -> Bundle:
        return self._with(operator.ge, other)

    def __and__(self, other: Any) -> Bundle:
        return self._with(operator.and_, other)

    def where(self, yes: Any, no: Any) -> Bundle:
        """``yes`` in true lanes, ``no`` in the others."""
        return self._with(lambda mask, a, b: mask.where(a, b), yes, no)

    def sqrt(self) -> Bundle:
        """Square root."""
        return self._with(lambda x: x.sqrt())

    def reciprocal(self, refined: bool) -> Bundle:
        """1 / x, to at least 14 bits, to 1e-7 if ``refined``."""
        return self._with(lambda x: x.reciprocal(refined))

    def total(self) -> Vector:
        """The sum of the vectors."""
        return functools.reduce(operator.add, self.parts)


class _Still:
    """A record along rays from the reference point, and the way back."""

    def __init__(self, x: Bundle, y: Bundle, w: Bundle, flat: Bundle, refined: bool) -> None:
        self.x, self.y, self.w, self.flat = x, y, w, flat
        self.q1 = x * x + y * y
        self.inverse = (flat * self.q1 + w * w).reciprocal(refined)
        self.exponent, self.distance = self.q1 * self.inverse, w * self.inverse

    def forget_misses(self, hit: Bundle) -> None:
        """Make everything finite where there is no hit."""
        self.inverse, self.exponent, self.distance = (
            hit.where(value, 0) for value in (self.inverse, self.exponent, self.distance)
        )

    def sums(self, by_exponent: Bundle, by_distance: Bundle) -> list[Bundle]:
        """S_XX to S_FLAT of the gradients by exponent and distance."""
        by_q2 = -(by_exponent * self.exponent + by_distance * self.distance) * self.inverse
        twice_q1 = (by_exponent * self.inverse + self.flat * by_q2) * 2
        by_x, by_y = twice_q1 * self.x, twice_q1 * self.y
        by_w = by_distance * self.inverse + by_q2 * self.w * 2
        return [by_x * self.x, by_x * self.y, by_y * self.y, by_x * self.w, by_y * self.w,
                by_w * self.x, by_w * self.y, by_w * self.w, by_q2 * self.q1]  # fmt: skip


class _Moved:
    """The same along rays that start at s v, v being the record's (xv, yv, wv)."""

    def __init__(
        self, x: Bundle, y: Bundle, w: Bundle, flat: Bundle, s: Bundle, drift: list[Bundle], refined: bool
    ) -> None:
        self.x, self.y, self.w, self.flat, self.s, self.drift = x, y, w, flat, s, drift
        xv, yv, wv = drift
        self.left = 1 - s * wv
        step = s * w
        self.a, self.b, self.c = x * self.left + xv * step, y * self.left + yv * step, s * (x * yv - y * xv)
        self.inverse = (flat * (x * x + y * y) + w * w).reciprocal(refined)
        self.exponent = (self.a * self.a + self.b * self.b + flat * self.c * self.c) * self.inverse
        self.along = w * self.left - s * flat * (x * xv + y * yv)
        self.distance = self.along * self.inverse

    forget_misses = _Still.forget_misses

    def sums(self, by_exponent: Bundle, by_distance: Bundle) -> list[Bundle]:
        """S_XX to S_FLAT; products with v count like those with a ray's direction."""
        x, y, w, flat, s = self.x, self.y, self.w, self.flat, self.s
        xv, yv, wv = self.drift
        by_along = by_distance * self.inverse
        by_q2 = -(by_exponent * self.exponent + by_distance * self.distance) * self.inverse
        twice = by_exponent * self.inverse * 2
        by_a, by_b, by_c = twice * self.a, twice * self.b, twice * flat * self.c * s
        across, spread = by_along * s * flat, by_q2 * flat * 2
        by_left = by_a * x + by_b * y + by_along * w
        by_x = by_a * self.left + by_c * yv - across * xv + spread * x
        by_y = by_b * self.left - by_c * xv - across * yv + spread * y
        by_w = (by_a * xv + by_b * yv) * s + by_along * self.left + by_q2 * w * 2
        by_xv = by_a * s * w - by_c * y - across * x
        by_yv = by_b * s * w + by_c * x - across * y
        by_wv = -(by_left * s)
        by_flat = (by_exponent * self.c * self.c - by_distance * s * (x * xv + y * yv)) * self.inverse
        return [
            by_x * x + by_xv * xv,
            by_x * y + by_xv * yv,
            by_y * y + by_yv * yv,
            by_x * w + by_xv * wv,
            by_y * w + by_yv * wv,
            by_w * x + by_wv * xv,
            by_w * y + by_wv * yv,
            by_w * w + by_wv * wv,
            by_flat + by_q2 * (x * x + y * y),
        ]


def _far_enough(v: Lanes, way: int, basis: ir.Value, x: Vector, y: Bundle, distance: Bundle, near: ir.Value) -> Bundle:
    """Whether hits lie behind the near plane, as ``blend`` tests it."""
    if way != AFFINE:
        return distance >= v.spread(near)
    d = [[v.broadcast(basis, 4 * (start + c)) for start in (B_D0, B_DX, B_DY)] for c in range(3)]
    lengths = [y * c[2] + (c[0] + c[1] * x) for c in d]
    length = (lengths[0] * lengths[0] + lengths[1] * lengths[1] + lengths[2] * lengths[2]).sqrt()
    return distance * length >= v.spread(near)


def _carrying_back(way: int, kind: int, check_near: bool) -> Callable[..., Any]:
    dark = LIDAR_MIN_TRANSMITTANCE if kind == LIDAR else MIN_TRANSMITTANCE

    @vector_kernel("iiiiiiifff")
    def carry_back(
        v: Lanes,
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
            state: address of [STATE_PLANES,32].
            numbers: address of the records' numbers in the batch, a byte each.
            count: how many, at least 1.
            coefficients: address of [COEFFICIENTS,BATCH].
            rays: address of the block's [RAY_PLANES,32].
            basis: address of the tile's basis.
            sums: address of [BATCH,SUMS].
            x0: first cell's x from the tile's centre.
            y0: the same for y.
            near: near plane.
        """
        b = v.b
        alive: ir.Value | None = None
        for part in range(0, VECTORS, AT_ONCE):
            offsets = [4 * LANES * (part + k) for k in range(AT_ONCE)]
            x = v.numbers([lane % WIDE for lane in range(LANES)]) + v.spread(x0)
            y = Bundle(
                v.numbers([((part + k) * LANES + lane) // WIDE for lane in range(LANES)]) + v.spread(y0)
                for k in range(AT_ONCE)
            )

            def plane_of(base: ir.Value, plane: int, offsets: list[int] = offsets) -> Bundle:
                return Bundle(v.load(base, 4 * RAYS * plane + offset) for offset in offsets)

            def body(
                i: ir.Value, values: list[Vector], x: Vector = x, y: Bundle = y, plane_of: Any = plane_of
            ) -> list[Vector]:
                number = b.zext(b.load(v.pointer(numbers, i), typ=I8, align=1), I64)
                where = v.address(coefficients, b.shl(number, ir.Constant(I64, 2)))

                def coefficient(k: int) -> Vector:
                    return v.broadcast(where, 4 * BATCH * k)

                rows = [[coefficient(start + k) for k in range(3)] for start in (C_X, C_Y, C_W)]
                flat, fade = Bundle([coefficient(C_FLAT)] * AT_ONCE), coefficient(C_FADE)
                if way == AFFINE:
                    place = [y * row[2] + (row[0] + row[1] * x) for row in rows]
                else:
                    d = [plane_of(rays, plane) for plane in (DX, DY, DZ)]
                    place = [d[0] * row[0] + d[1] * row[1] + d[2] * row[2] for row in rows]
                big_x, big_y, big_w = place
                if way == MOVING:
                    drift = [Bundle([coefficient(C_DRIFT + c)] * AT_ONCE) for c in range(3)]
                    meeting: Any = _Moved(big_x, big_y, big_w, flat, plane_of(rays, PLACE), drift, kind == LIDAR)
                else:
                    meeting = _Still(big_x, big_y, big_w, flat, kind == LIDAR)
                exponent = meeting.exponent + fade
                hit = exponent < CUT
                if check_near:
                    hit = hit & _far_enough(v, way, basis, x, y, meeting.distance, near)
                before, left = Bundle(values[:AT_ONCE]), Bundle(values[AT_ONCE:])
                if kind == LIDAR:
                    hit = hit & (before > dark)
                meeting.forget_misses(hit)
                alpha = hit.where(Bundle(fading(exponent.parts)), 0)
                weight = alpha * before
                after = before - weight
                by_mean = plane_of(state, G_DISTANCE)
                q = plane_of(state, G_ALPHA) + by_mean * meeting.distance
                for c in range(3):
                    q = q + plane_of(state, G_FEATURE + c) * coefficient(C_FEATURE + c)
                rest = left - weight * q
                by_alpha = before * q - rest * (1 - alpha).reciprocal(False)
                by_exponent, by_distance = alpha * by_alpha * -8, weight * by_mean
                if kind == LIDAR:
                    crossing = (before > 0.5) & (after <= 0.5)
                    by_distance = by_distance + crossing.where(plane_of(state, G_HALF), 0)
                sums_of = [*meeting.sums(by_exponent, by_distance), by_exponent]
                sums_of += [weight * plane_of(state, G_FEATURE + c) for c in range(3)]
                totals = [bundle.total() for bundle in sums_of]
                totals += [v.number(0)] * (SUMS - len(totals))
                place_of_sums = v.address(sums, b.shl(number, ir.Constant(I64, 6)))
                for first in range(0, SUMS, LANES):
                    old = v.load(place_of_sums, 4 * first)
                    v.store(old + v.sums(totals[first : first + LANES]), place_of_sums, 4 * first)
                return after.parts + rest.parts

            initial = plane_of(state, T).parts + plane_of(state, REST).parts
            final = v.repeat(count, initial, body)
            for plane in (T, REST):
                for k, offset in enumerate(offsets):
                    v.store(final[plane * AT_ONCE + k], state, 4 * RAYS * plane + offset)
            left = still_open(final[:AT_ONCE], kind)
            alive = left if alive is None else b.or_(alive, left)
        assert alive is not None
        return alive

    return carry_back


back_affine_camera = _carrying_back(AFFINE, CAMERA, False)
back_affine_camera_near = _carrying_back(AFFINE, CAMERA, True)
back_table_camera = _carrying_back(TABLE, CAMERA, True)
back_table_lidar = _carrying_back(TABLE, LIDAR, True)
back_moving_camera = _carrying_back(MOVING, CAMERA, True)
back_moving_lidar = _carrying_back(MOVING, LIDAR, True)


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
    """Start a block from the blended image and its gradients, both [IMAGE_PLANES,h,w] at the block's first cell.

    Rays that are not valid need gradients of 0. ``rays`` is the address of the block's rays, 0 where all are valid.
    """
    b = v.b
    half = ir.VectorType(F32, WIDE)
    table = b.icmp_signed("!=", rays, ir.Constant(I64, 0))
    source = b.select(table, b.add(rays, ir.Constant(I64, 4 * RAYS * VALID)), state)

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

    for k in range(VECTORS):
        offset = 4 * LANES * k
        image = [cells(planes, plane, k) for plane in range(IMAGE_PLANES)]
        gradient = [cells(gradients, plane, k) for plane in range(IMAGE_PLANES)]
        total = v.number(0)
        for plane in range(IMAGE_PLANES - 1):
            total = total + image[plane] * gradient[plane]
        valid = v.load(source, offset)
        one = b.select(table, valid.value, v.number(1).value)
        values = [Vector(b, one), total, *gradient]
        for plane, value in zip(
            (T, REST, G_ALPHA, *(G_FEATURE + c for c in range(3)), G_DISTANCE, G_HALF), values, strict=True
        ):
            v.store(value, state, 4 * RAYS * plane + offset)
