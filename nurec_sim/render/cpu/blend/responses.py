"""What both passes of blending share: how a record meets rays, and the loop over the records and rays of a block.

The forward (``blocks``) and the backward pass (``backward.blend``) take a list of records through the 8 x 4 rays of a
block, ``AT_ONCE`` vectors at a time, and keep the rays' sums in registers until the list ends.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from llvmlite import ir

from nurec_sim.render.cpu.blend.tiles import (
    B_D0,
    B_DX,
    B_DY,
    BATCH,
    C_DRIFT,
    C_FADE,
    C_FLAT,
    C_W,
    C_X,
    C_Y,
    LINEAR,
    MOVING,
    RAYS,
    WIDE,
)
from nurec_sim.render.cpu.simd import F32, I8, I64, LANES, Lanes, Vector

CAMERA, NORMALS, LIDAR = 0, 1, 2
"""Output kinds: what is summed up. Three features, distance and label; the same and three more features; three
features, distance, and where half of the beam has been stopped."""

T = 0
"""The first plane of a block's state, forwards and backwards: transmittance."""

# Planes of a block's rays: direction, 1 where there is one else 0, place on the way of a moving sensor.
DX, DY, DZ, VALID, PLACE = 0, 1, 2, 3, 4
RAY_PLANES = 5

CUT = math.log(255.0) / 8
"""Exponent at which a response has faded to 1/255: alpha = exp(-8 x)."""
MIN_TRANSMITTANCE, LIDAR_MIN_TRANSMITTANCE = 1e-4, 1e-2
VECTORS = RAYS // LANES
"""Vectors that cover a block."""
AT_ONCE = 2
"""Vectors of rays that are blended at once: as many as the registers hold."""


def _exponential() -> list[float]:
    """Coefficients of the quartic nearest to exp(-x) on 0..CUT in relative terms (Chebyshev nodes)."""
    x = (1 - np.cos((np.arange(64) + 0.5) * np.pi / 64)) / 2 * CUT
    # Weights exp(x) turn the least squares of the absolute error into those of the relative one.
    basis = np.stack([x**k for k in range(5)], axis=1) * np.exp(x)[:, None]
    return [float(c) for c in np.linalg.lstsq(basis, np.ones(64), rcond=None)[0]]


EXPONENTIAL = _exponential()


def fading(x: list[Vector]) -> list[Vector]:
    """exp(-8 x) for x in 0..CUT to 2e-5: the quartic, three times squared."""
    # exp(-8 x) = exp(-x)^8, and x stays below CUT = 0.69, where a quartic suffices.
    e = [xi * EXPONENTIAL[4] + EXPONENTIAL[3] for xi in x]
    for c in EXPONENTIAL[2::-1]:
        e = [ei * xi + c for ei, xi in zip(e, x, strict=True)]
    for _ in range(3):
        e = [ei * ei for ei in e]
    return e


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


@dataclass(frozen=True)
class RayGroup:
    """``AT_ONCE`` vectors of a block's rays: where they lie in a plane, and cells from the tile's centre."""

    v: Lanes
    start: ir.Value | int
    """Byte offset of the first ray."""
    offsets: list[int]
    """Byte offsets of the vectors from there."""
    x: Vector
    y: Bundle

    def plane(self, base: ir.Value, number: int) -> Bundle:
        """Values of the group's rays in a plane [32] of the block at an address."""
        place = self.v.address(base, self.start)
        return Bundle(self.v.load(place, 4 * RAYS * number + offset) for offset in self.offsets)

    def keep(self, values: Bundle, base: ir.Value, number: int) -> None:
        """Store values of the group's rays in a plane of the block at an address."""
        for value, offset in zip(values.parts, self.offsets, strict=True):
            self.v.store(value, self.v.address(base, self.start), 4 * RAYS * number + offset)


class StillMeeting:
    """What a record does to rays from the reference point, and the gradients by its (X, Y, W) and FLAT.

    With Q1 = X^2 + Y^2 and Q2 = FLAT Q1 + W^2 (``records``), the exponent is Q1 / Q2 and the distance W / Q2.
    """

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
        # d(Q1 / Q2) / dQ2 = -exponent / Q2 and d(W / Q2) / dQ2 = -distance / Q2; then the chain rule through
        # Q2 = FLAT Q1 + W^2 and Q1 = X^2 + Y^2.
        by_q2 = -(by_exponent * self.exponent + by_distance * self.distance) * self.inverse
        twice_q1 = (by_exponent * self.inverse + self.flat * by_q2) * 2
        by_x, by_y = twice_q1 * self.x, twice_q1 * self.y
        by_w = by_distance * self.inverse + by_q2 * self.w * 2
        return [by_x * self.x, by_x * self.y, by_y * self.y, by_x * self.w, by_y * self.w,
                by_w * self.x, by_w * self.y, by_w * self.w, by_q2 * self.q1]  # fmt: skip


class MovingMeeting(StillMeeting):
    """The same for rays that start at s v, v being the sensor's motion, (xv, yv, wv) in the record's rows; exact.

    A start at s v moves the centre, in units of its distance, to (-s xv, -s yv, 1 - s wv). The numerator of the
    exponent is the squared cross product of this and the ray, a^2 + b^2 + FLAT c^2; Q2 does not change.
    """

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

    def sums(self, by_exponent: Bundle, by_distance: Bundle) -> list[Bundle]:
        """S_XX to S_FLAT; products with v count like those with a ray's direction."""
        x, y, w, flat, s = self.x, self.y, self.w, self.flat, self.s
        xv, yv, wv = self.drift
        by_along = by_distance * self.inverse
        # As without motion, with the numerators a^2 + b^2 + FLAT c^2 and ``along`` in place of Q1 and W.
        by_q2 = -(by_exponent * self.exponent + by_distance * self.distance) * self.inverse
        twice = by_exponent * self.inverse * 2
        by_a, by_b, by_c = twice * self.a, twice * self.b, twice * flat * self.c * s
        # ``distance`` is along / Q2 with along = W (1 - s wv) - s FLAT (X xv + Y yv).
        across, spread = by_along * s * flat, by_q2 * flat * 2
        by_left = by_a * x + by_b * y + by_along * w
        by_x = by_a * self.left + by_c * yv - across * xv + spread * x
        by_y = by_b * self.left - by_c * xv - across * yv + spread * y
        by_w = (by_a * xv + by_b * yv) * s + by_along * self.left + by_q2 * w * 2
        by_xv = by_a * s * w - by_c * y - across * x
        by_yv = by_b * s * w + by_c * x - across * y
        # wv enters through left = 1 - s wv alone.
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


Coefficient = Callable[[int], Vector]
"""Gives a row of a record's coefficients (``tiles``) in all lanes."""


def meeting_of(
    mode: int, group: RayGroup, coefficient: Coefficient, rays: ir.Value, refined: bool
) -> tuple[StillMeeting, Bundle]:
    """A record along the rays of a group, and its exponent with the fading of its opacity: Q1 / Q2 + FADE.

    Args:
        mode: projection mode.
        group: the rays.
        coefficient: gives a row of the record's coefficients (``tiles``) in all lanes.
        rays: address of the block's [RAY_PLANES,32]; not read for LINEAR ones.
        refined: whether distances need more than 14 bits (LiDARs).
    """
    rows = [[coefficient(start + k) for k in range(3)] for start in (C_X, C_Y, C_W)]
    many = len(group.offsets)
    flat, fade = Bundle([coefficient(C_FLAT)] * many), coefficient(C_FADE)
    if mode in LINEAR:
        # Values at the tile's centre, per cell along x, and per cell along y. The part along x is shared by the group's
        # vectors, whose cells differ in y only.
        x, y, w = (group.y * row[2] + (row[0] + row[1] * group.x) for row in rows)
    else:
        d = [group.plane(rays, plane) for plane in (DX, DY, DZ)]
        x, y, w = (d[0] * row[0] + d[1] * row[1] + d[2] * row[2] for row in rows)
    if mode == MOVING:
        # The rows of the record times the sensor's velocity: the same for all rays of a tile, hence a coefficient.
        drift = [Bundle([coefficient(C_DRIFT + c)] * many) for c in range(3)]
        meeting: StillMeeting = MovingMeeting(x, y, w, flat, group.plane(rays, PLACE), drift, refined)
    else:
        meeting = StillMeeting(x, y, w, flat, refined)
    return meeting, meeting.exponent + fade


def behind_near_plane(
    v: Lanes, mode: int, basis: ir.Value, group: RayGroup, distance: Bundle, near: ir.Value
) -> Bundle:
    """Whether hits lie no nearer than the near plane.

    Args:
        v: vectors.
        mode: projection mode.
        basis: address of the tile's basis; only read for LINEAR modes.
        group: the rays.
        distance: place of each hit along its ray, in lengths of the ray's direction.
        near: near plane (m, float32).
    """
    if mode not in LINEAR:
        return distance >= v.spread(near)
    d = [[v.broadcast(basis, 4 * (start + c)) for start in (B_D0, B_DX, B_DY)] for c in range(3)]
    # A pinhole's rays have z = 1 and not unit length, so t is not yet a distance.
    lengths = [group.y * c[2] + (c[0] + c[1] * group.x) for c in d]
    length = (lengths[0] * lengths[0] + lengths[1] * lengths[1] + lengths[2] * lengths[2]).sqrt()
    return distance * length >= v.spread(near)


def hits_of(
    v: Lanes, mode: int, output_kind: int, group: RayGroup, coefficient: Coefficient, rays: ir.Value, basis: ir.Value,
    near: ir.Value | None,
) -> tuple[StillMeeting, Bundle, Bundle]:  # fmt: skip
    """A record along the rays of a group, its alpha, and which rays it hits; alpha is undefined on all others.

    Args:
        v: vectors.
        mode: see ``meeting_of``, like group, coefficient and rays.
        output_kind: the distances of LIDAR are refined.
        group: see mode.
        coefficient: see mode.
        rays: see mode.
        basis: address of the tile's basis.
        near: near plane (m); None where no record reaches it.
    """
    meeting, exponent = meeting_of(mode, group, coefficient, rays, output_kind == LIDAR)
    hit = exponent < CUT
    if near is not None:
        hit = hit & behind_near_plane(v, mode, basis, group, meeting.distance, near)
    return meeting, Bundle(fading(exponent.parts)), hit


def initial_transmittance(v: Lanes, state: ir.Value, rays: ir.Value) -> list[Vector]:
    """The vectors of a block's transmittance before any record: 1 where there is a ray, else 0.

    Args:
        v: vectors.
        state: address of the block's state.
        rays: address of the block's [RAY_PLANES,32]; 0 where every cell has a ray.
    """
    b = v.b
    table = b.icmp_signed("!=", rays, ir.Constant(I64, 0))
    # Without a table any readable address will do: the values are not used.
    source = b.select(table, b.add(rays, ir.Constant(I64, 4 * RAYS * VALID)), state)
    return [Vector(b, b.select(table, v.load(source, 4 * LANES * k).value, v.number(1).value)) for k in range(VECTORS)]


def still_open(transmittance: list[Vector], output_kind: int) -> ir.Value:
    """An int64: 1 while any of the rays is not yet opaque, by the limit of the output kind, else 0."""
    most = functools.reduce(Vector.max, transmittance)
    return (most > (LIDAR_MIN_TRANSMITTANCE if output_kind == LIDAR else MIN_TRANSMITTANCE)).any()


Step = Callable[[RayGroup, ir.Value, Coefficient, list[Bundle]], list[Bundle]]
"""(rays, the record's number in the batch, its coefficients, sums so far) -> sums with the record."""


def run_records(
    v: Lanes,
    state: ir.Value,
    planes: int,
    numbers: ir.Value,
    count: ir.Value,
    coefficients: ir.Value,
    corner: tuple[ir.Value, ir.Value],
    output_kind: int,
    step: Step,
) -> ir.Value:
    """Take a list of records through a block's rays; returns an int64, 1 while any ray has transmittance left.

    Args:
        v: vectors.
        state: address of the block's [..,32].
        planes: how many of its first planes change from record to record; the first is the transmittance.
        numbers: address of the records' numbers in the batch, a byte each.
        count: how many, at least 1.
        coefficients: address of [COEFFICIENTS,BATCH].
        corner: x and y of the block's first cell, from the tile's centre.
        output_kind: CAMERA, NORMALS or LIDAR.
        step: what a record does to the sums.
    """
    b = v.b
    x = v.numbers([lane % WIDE for lane in range(LANES)]) + v.spread(corner[0])
    rows = [v.numbers([(k * LANES + lane) // WIDE for lane in range(LANES)]) for k in range(AT_ONCE)]

    def blend_part(part: ir.Value, clearest: list[Vector]) -> list[Vector]:
        """Take the list through ``AT_ONCE`` vectors; returns the largest transmittance of these and earlier parts."""
        first_row = v.spread(b.fadd(corner[1], b.sitofp(b.mul(part, ir.Constant(I64, AT_ONCE * LANES // WIDE)), F32)))
        start = b.mul(part, ir.Constant(I64, 4 * LANES * AT_ONCE))
        group = RayGroup(v, start, [4 * LANES * k for k in range(AT_ONCE)], x, Bundle(row + first_row for row in rows))

        def body(i: ir.Value, values: list[Vector]) -> list[Vector]:
            # Coefficients are stored by rows of BATCH records, so a record's are one broadcast each.
            number = b.zext(b.load(v.pointer(numbers, i), typ=I8, align=1), I64)
            where = v.address(coefficients, b.shl(number, ir.Constant(I64, 2)))
            sums = [Bundle(values[k : k + AT_ONCE]) for k in range(0, len(values), AT_ONCE)]
            changed = step(group, number, lambda k: v.broadcast(where, 4 * BATCH * k), sums)
            return [value for bundle in changed for value in bundle.parts]

        final = v.repeat(count, [value for plane in range(planes) for value in group.plane(state, plane).parts], body)
        for plane in range(planes):
            group.keep(Bundle(final[plane * AT_ONCE : (plane + 1) * AT_ONCE]), state, plane)
        return [functools.reduce(Vector.max, final[:AT_ONCE], *clearest)]

    # 32 rays are two (AVX-512) or four vectors; AT_ONCE of them go through the whole list, then the next ones. A block
    # stays open until the most transparent of its rays is opaque.
    return still_open(v.repeat(ir.Constant(I64, VECTORS // AT_ONCE), [v.number(0)], blend_part), output_kind)
