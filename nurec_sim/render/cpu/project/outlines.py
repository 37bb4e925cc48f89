"""Vector code for the cone of directions in which a Gaussian is seen, and the boxes around it on a sensor's grid.

Seen from a point outside of it, the 1/255 ellipsoid of a Gaussian fills a cone. With f the unit direction of its
centre, a linear function j (perpendicular to f) of the tangent plane, (j.d) / (f.d), has exact bounds on that cone:
the roots of the dual conic, free of cancellation because j.f = 0. Charts then lead from tangents to places.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from llvmlite import ir

from nurec_sim.render.cpu.project.charts import (
    AZIMUTH,
    COS_FIELD,
    LEAST_AHEAD,
    LENS_SIZE,
    LIDAR_SIZE,
    MIDDLE,
    MISFIT,
    MOST_AHEAD,
    PER_RADIAN,
    PERIOD,
    SIN_FIELD,
    SINES,
    TEXELS,
    WINDOWS,
)
from nurec_sim.render.cpu.records import CENTRE, LOG_255, LOG_P, ROTATION, SIGMA, STEP, dot
from nurec_sim.render.cpu.simd import I32, INTS, Lanes, Mask, Vector, spread

EVERYWHERE = 1e9
WIDE = 1.5
"""Tangent of the angular radius from which a Gaussian is taken to cover the whole grid."""
HALF_PI = math.pi / 2
STEEP = 1e-2
"""Cones that come nearer than this to a half space, in the sense of 1 - (k2 Sigma_ff) / m^2, are not bounded."""


class Outline:
    """Cones of the group that ``place`` left in ``scratch``, around the unit directions ``f`` of its centres."""

    def __init__(self, v: Lanes, scratch: ir.Value) -> None:
        def part(k: int) -> Vector:
            return v.load(scratch, STEP * k)

        centre, sigma = [part(CENTRE + k) for k in range(3)], [part(SIGMA + k) for k in range(3)]
        k2 = (part(LOG_P) + LOG_255) * 2
        self.axes = [[part(ROTATION + 3 * row + k) * sigma[k] for k in range(3)] for row in range(3)]
        self.distance = dot(centre, centre).max(1e-20).sqrt()
        inverse = 1 / self.distance
        self.f = [component * inverse for component in centre]
        self.forward = self._canonical(self.f)
        self.scale = k2 * inverse * inverse
        # f^T Sigma f: the variance along the line of sight.
        ahead = dot(self.forward, self.forward)
        along = self.scale * ahead
        # k2 Sigma_ff / m^2 - 1: negative while the plane through the eye perpendicular to f misses the ellipsoid.
        self.bottom = along - 1
        self.divisor = 1 / self.bottom.min(-STEEP)
        largest = sigma[0].max(sigma[1]).max(sigma[2])
        # The variance across it is at most the trace less that along it, and at most the largest axis.
        across = (dot(sigma, sigma) - ahead).max(0).min(largest * largest)
        reach = -(self.scale * across).sqrt() * (1 + along.sqrt()) * self.divisor
        self.reach = (self.bottom < -STEEP).where(reach, EVERYWHERE)
        """Tangent of the angular radius of a round cone that holds this one."""
        self.nearest = self.distance * (1 - along.sqrt())
        """No point of the ellipsoid is nearer than this (m)."""

    def _canonical(self, direction: list[Vector]) -> list[Vector]:
        return [sum((direction[row] * self.axes[row][k] for row in (1, 2)), direction[0] * self.axes[0][k])
                for k in range(3)]  # fmt: skip

    def interval(self, j: list[Vector]) -> tuple[Vector, Vector]:
        """Least and largest (j.d) / (f.d) of the directions d of the cone, for j perpendicular to f."""
        canonical = self._canonical(j)
        half = self.scale * dot(canonical, self.forward)
        # Roots of bottom t^2 - 2 half t + k2 j^T Sigma j / m^2 = 0.
        root = (half * half - self.scale * dot(canonical, canonical) * self.bottom).max(0).sqrt()
        return (half + root) * self.divisor, (half - root) * self.divisor


@dataclass
class CellBox:
    """Cells (fractional, centres at +0.5) that a group of Gaussians may be seen in: lowest and highest."""

    column: tuple[Vector, Vector]
    row: tuple[Vector, Vector]

    def store(self, v: Lanes, target: ir.Value) -> None:
        """Write the ends to [4,LANES] floats."""
        for k, end in enumerate((*self.column, *self.row)):
            v.store(end, target, STEP * k)


class LensChart:
    """A lens chart in memory."""

    def __init__(self, v: Lanes, params: ir.Value, places: ir.Value, bends: ir.Value) -> None:
        self.v, self.params, self.places, self.bends = v, params, places, bends

    def param(self, k: int) -> Vector:
        """A parameter of the chart, in all lanes."""
        return self.v.broadcast(self.params, 4 * k)


class Texels:
    """The texels of a lens chart nearest to unit directions ``f``, and the way (``ds``, ``dt``) from them to these."""

    def __init__(self, lens: LensChart, f: list[Vector]) -> None:
        self.lens, self.f = lens, f
        self.inverse = 1 / (1 + f[2]).max(1e-6)
        self.s, self.t = f[0] * self.inverse, f[1] * self.inverse
        density, middle = lens.param(TEXELS), lens.param(MIDDLE)
        x, y = self.s * density + middle, self.t * density + middle
        self.inside = (x >= 0) & (x <= LENS_SIZE - 1) & (y >= 0) & (y <= LENS_SIZE - 1)
        column, row = ((p + 0.5).floor().max(0).min(LENS_SIZE - 1) for p in (x, y))
        self.side = 1 / density
        self.ds, self.dt = (x - column) * self.side, (y - row) * self.side
        self.number = row * LENS_SIZE + column

    def entry(self, k: int | Vector) -> Vector:
        """Value k of each texel."""
        return self.lens.v.gather(self.lens.places, (self.number * 6 + k).integers())

    def place(self, axis: int) -> tuple[Vector, list[Vector]]:
        """Column (axis 0) or row (axis 1) of the directions, and its gradient by the direction, perpendicular to it."""
        by_s, by_t = self.entry(2 + 2 * axis), self.entry(3 + 2 * axis)
        inward = by_s * self.s + by_t * self.t
        # Chain rule through p = (x, y) / (1 + z), projected perpendicular to f.
        gradient = [by_s - inward * self.f[0], by_t - inward * self.f[1], -inward * (1 + self.f[2])]
        return self.entry(axis) + by_s * self.ds + by_t * self.dt, [part * self.inverse for part in gradient]

    def bend(self, tangent: Vector) -> tuple[Vector, Mask]:
        """Largest bend within twice the angle whose tangent is half of ``tangent``, and where it is known."""
        v, rho2 = self.lens.v, self.s * self.s + self.t * self.t
        half = tangent * 0.5
        room = 1 - half * rho2.sqrt()
        # A circle of tangent ``half`` on the sphere is a circle in the plane, displaced outwards: hence the division by
        # room.
        texels = half * (1 + rho2) / room.max(0.05) * self.lens.param(TEXELS) + 1.75
        # floor(log2) from the float's exponent bits: which of the windows of 2^k texels is wide enough.
        exponent = v.b.lshr(texels.bits(), spread(v.b, I32(23), INTS))
        window = v.from_integers(exponent) - 127.0  # 2^(window + 1) texels to each side hold all of them
        known = self.inside & (room > 0.05) & (window < WINDOWS) & (tangent < WIDE)
        entry = window.max(0).min(WINDOWS - 1) * (LENS_SIZE * LENS_SIZE) + self.number
        return v.gather(self.lens.bends, entry.integers()), known

    def offset(self) -> Vector:
        """Angle from a direction to its texel, at most."""
        return self.side * 1.45 / (1 + self.s * self.s + self.t * self.t)


class LensCone:
    """Where a lens sees the cones of a group of Gaussians."""

    def __init__(self, lens: LensChart, outline: Outline) -> None:
        self.lens, self.outline, self.texels = lens, outline, Texels(lens, outline.f)
        self.offset = self.texels.offset()
        self.places, self.slopes, self.intervals = [], [], []
        for axis in range(2):
            place, gradient = self.texels.place(axis)
            self.places.append(place)
            self.slopes.append(dot(gradient, gradient).sqrt())
            self.intervals.append(outline.interval(gradient))

    def box(self, turned: Vector | None = None) -> tuple[CellBox, list[Vector]]:
        """The box, and the most columns and rows per radian for directions up to the angle ``turned`` away.

        The place of the centre, its gradient times the tangents of the cone, and a pad for what bends: half the
        largest second derivative times the square of the angle from the texel, and the cube by which a tangent
        exceeds its angle.
        """
        reach = self.outline.reach
        angle = reach if turned is None else reach + turned * 1.25
        bend, known = self.texels.bend(angle)
        # From the texel, whose gradient is used, to the cone's farthest direction.
        away = reach + self.offset
        ends, rates = [], []
        for place, slope, (low, high) in zip(self.places, self.slopes, self.intervals, strict=True):
            cube = (slope + bend * away) * reach * reach * reach * 0.3334
            pad = bend * away * away * 0.5 + cube + self.lens.param(MISFIT)
            ends.append((known.where(place + low - pad, -EVERYWHERE), known.where(place + high + pad, EVERYWHERE)))
            rates.append(slope + bend * (angle + self.offset))
        return CellBox(*ends), rates

    def outside(self, turned: Vector | None = None) -> Mask:
        """Which cones lie wholly outside of the lens's field, even turned by an angle."""
        reach = self.outline.reach
        if turned is not None:
            most = turned * 1.25
            reach = (reach + most) / (1 - reach * most).max(0.1)
        # ``reach`` is a tangent; tangents of sums by the addition theorem above.
        cosine = 1 / (reach * reach + 1).sqrt()
        sine = reach * cosine
        cos_field, sin_field = self.lens.param(COS_FIELD), self.lens.param(SIN_FIELD)
        # f_z < cos(field + reach); valid while their sum is below pi, which the sine's sign tells.
        beyond = self.outline.f[2] < cos_field * cosine - sin_field * sine
        return beyond & (sin_field * cosine + cos_field * sine > 0) & (reach < WIDE)


class LidarChart:
    """A LiDAR chart in memory."""

    def __init__(self, v: Lanes, params: ir.Value, rows: ir.Value) -> None:
        self.v, self.params, self.rows = v, params, rows

    def param(self, k: int) -> Vector:
        """A parameter of the chart, in all lanes."""
        return self.v.broadcast(self.params, 4 * k)

    def column(self, f: list[Vector], near: Vector) -> Vector:
        """Place of directions along the columns, within half a turn of ``near``."""
        column = (atan2(f[1], f[0]) - self.param(AZIMUTH)) * self.param(PER_RADIAN) + 0.5
        period = self.param(PERIOD)
        return column - period * ((column - near) / period + 0.5).floor()

    def row(self, sine: Vector, upper: bool) -> Vector:
        """A row at or beyond (``upper``: above, else below) those of a sine of elevation."""
        entry = (sine + 1) * self.param(SINES)
        # Rounded to the entry on the safe side; 0.01 of an entry covers float32.
        entry = (entry + 0.01).ceil() if upper else (entry - 0.01).floor()
        return self.v.gather(self.rows, entry.max(0).min(LIDAR_SIZE - 1).integers())


class LidarCone:
    """Where a LiDAR sees the cones of a group of Gaussians: columns within half a turn of ``near``."""

    def __init__(self, lidar: LidarChart, outline: Outline, near: Vector) -> None:
        self.lidar, self.outline = lidar, outline
        x, y, z = outline.f
        reach = outline.reach
        self.flat = flat = (x * x + y * y).max(1e-12).sqrt()
        inverse = 1 / flat
        left, right = outline.interval([-y * inverse, x * inverse, lidar.v.number(0)])
        down, up = outline.interval([-z * x * inverse, -z * y * inverse, flat])
        self.known = known = reach < WIDE

        # Azimuth: with (u, w) the tangents to the left and up, its tangent is u / (cos e - w sin e).
        # cos e - w sin e is linear in w, so its least value lies at an end.
        least = flat - (down * z).max(up * z)
        around = ~(least > 1e-3) | ~known  # it reaches over the pole
        wide = lidar.param(PER_RADIAN) / least.max(1e-3)
        quarter = lidar.param(PER_RADIAN).abs() * HALF_PI
        one, other = left * wide, right * wide
        column = lidar.column(outline.f, near)
        low = column + one.min(other).max(-quarter) - lidar.param(MOST_AHEAD)
        high = column + one.max(other).min(quarter) - lidar.param(LEAST_AHEAD)
        self.columns = around.where(-EVERYWHERE, low), around.where(EVERYWHERE, high)

        # Elevation: its sine is (sin e + w cos e) / sqrt(1 + u^2 + w^2); over the pole, that of a round cone.
        side = (-left).max(right)
        aside = 1 / (side * side + 1).sqrt()
        above, below = (z + up * flat) / (up * up + 1).sqrt(), (z + down * flat) / (down * down + 1).sqrt()
        above, below = (above > 0).where(above, above * aside), (below < 0).where(below, below * aside)
        cosine = 1 / (reach * reach + 1).sqrt()
        self.above = around.where((z > 0).where(1.0, (z + reach * flat) * cosine), above)
        self.below = around.where((z < 0).where(-1.0, (z - reach * flat) * cosine), below)

    def rows(self, turned: Vector | float) -> tuple[Vector, Vector]:
        """First and last row of directions up to an angle away from the cone."""
        above, below = self.known.where(self.above + turned, 1.0), self.known.where(self.below - turned, -1.0)
        return self.lidar.row(above, True), self.lidar.row(below, False)

    def rate(self, turned: Vector) -> Vector:
        """Most columns per radian for directions up to an angle away from the cone."""
        angle = self.outline.reach + turned
        # cos(e + a) >= cos e (1 - a^2 / 2) - |sin e| a: azimuth changes fastest at the highest elevation reached.
        lowest_cosine = self.flat * (1 - angle * angle * 0.5) - self.outline.f[2].abs() * angle
        return self.lidar.param(PER_RADIAN).abs() / lowest_cosine.max(1e-3)


def atan2(y: Vector, x: Vector) -> Vector:
    """Angle of (x, y) to about 1e-5 rad."""
    ax, ay = x.abs(), y.abs()
    a = ax.min(ay) / ax.max(ay).max(1e-30)
    s = a * a
    # Minimax polynomial of the arctangent on 0..1 (Abramowitz and Stegun 1964, 4.4.47), then the octants.
    r = a * ((((s * 0.0208351 - 0.0851330) * s + 0.1801410) * s - 0.3302995) * s + 0.9998660)
    r = (ay > ax).where(HALF_PI - r, r)
    r = (x < 0).where(2 * HALF_PI - r, r)
    return (y < 0).where(-r, r)
