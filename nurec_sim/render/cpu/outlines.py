"""Vector code for the cone of directions in which a Gaussian is seen, and the boxes around it on a sensor's grid.

Seen from a point outside of it, the 1/255 ellipsoid of a Gaussian fills a cone. With f the unit direction of its
centre, a linear function j (perpendicular to f) of the tangent plane, (j.d) / (f.d), has exact bounds on that cone:
the roots of the dual conic, free of cancellation because j.f = 0. Charts then lead from tangents to places.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from llvmlite import ir

from nurec_sim.render.cpu.charts import (
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
    """Cones of a group of Gaussians, which ``place`` left in ``scratch``, around the directions ``f`` of their centres."""

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
        ahead = dot(self.forward, self.forward)
        along = self.scale * ahead
        self.bottom = along - 1
        self.divisor = 1 / self.bottom.min(-STEEP)
        largest = sigma[0].max(sigma[1]).max(sigma[2])
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
        root = (half * half - self.scale * dot(canonical, canonical) * self.bottom).max(0).sqrt()
        return (half + root) * self.divisor, (half - root) * self.divisor


@dataclass
class Box:
    """Cells (fractional, centres at +0.5) of a Gaussian, and how they change with the direction it is seen in.

    ``column_rate`` and ``row_rate`` are the most cells per radian.
    """

    column: tuple[Vector, Vector]
    row: tuple[Vector, Vector]
    column_rate: Vector
    row_rate: Vector


class LensTables:
    """A lens chart in memory."""

    def __init__(self, v: Lanes, params: ir.Value, places: ir.Value, bends: ir.Value) -> None:
        self.v, self.params, self.places, self.bends = v, params, places, bends

    def param(self, k: int) -> Vector:
        """A parameter of the chart, in all lanes."""
        return self.v.broadcast(self.params, 4 * k)

    def look(self, f: list[Vector]) -> LensTexels:
        """The texels nearest to unit directions."""
        return LensTexels(self, f)


class LensTexels:
    """The texels of a lens chart nearest to unit directions, and the way from them to the directions."""

    def __init__(self, tables: LensTables, f: list[Vector]) -> None:
        v, self.tables = tables.v, tables
        self.f = f
        self.divisor = 1 / (1 + f[2]).max(1e-6)
        self.s, self.t = f[0] * self.divisor, f[1] * self.divisor
        texels, middle = tables.param(TEXELS), tables.param(MIDDLE)
        self.texel = 1 / texels
        x, y = self.s * texels + middle, self.t * texels + middle
        self.inside = (x >= 0) & (x <= LENS_SIZE - 1) & (y >= 0) & (y <= LENS_SIZE - 1)
        column = (x + 0.5).floor().max(0).min(LENS_SIZE - 1)
        row = (y + 0.5).floor().max(0).min(LENS_SIZE - 1)
        self.ds, self.dt = (x - column) * self.texel, (y - row) * self.texel
        self.number = row * LENS_SIZE + column
        self.v = v

    def entry(self, k: int | Vector) -> Vector:
        """Value k of each texel."""
        return self.v.gather(self.tables.places, (self.number * 6 + k).integers())

    def place(self, axis: int) -> tuple[Vector, list[Vector]]:
        """Column (axis 0) or row (axis 1) of the directions, and its gradient by the direction, perpendicular to it."""
        by_s, by_t = self.entry(2 + 2 * axis), self.entry(3 + 2 * axis)
        inward = by_s * self.s + by_t * self.t
        gradient = [by_s - inward * self.f[0], by_t - inward * self.f[1], -inward * (1 + self.f[2])]
        return self.entry(axis) + by_s * self.ds + by_t * self.dt, [part * self.divisor for part in gradient]

    def bend(self, tangent: Vector) -> tuple[Vector, Vector, Mask]:
        """Largest bend within an angle, half of whose tangent is at most half of ``tangent``.

        Returns:
            Cells per squared radian, the angle from the direction to its texel at most, and where this is known.
        """
        rho2 = self.s * self.s + self.t * self.t
        half = tangent * 0.5
        room = 1 - half * rho2.sqrt()
        texels = half * (1 + rho2) / room.max(0.05) * self.tables.param(TEXELS) + 1.75
        b = self.v.b
        exponent = b.lshr(texels.bits(), spread(b, I32(23), INTS))
        window = self.v.from_integers(exponent) - 127.0  # its side of 2^(window + 1) texels holds all of them
        known = self.inside & (room > 0.05) & (window < WINDOWS) & (tangent < WIDE)
        entry = window.max(0).min(WINDOWS - 1) * (LENS_SIZE * LENS_SIZE) + self.number
        return self.v.gather(self.tables.bends, entry.integers()), self.texel * 1.45 / (1 + rho2), known


def lens_box(tables: LensTables, outline: Outline, texels: LensTexels, turned: Vector | None) -> Box:
    """Cells that a lens may see a Gaussian in; with ``turned``, rates hold for directions up to that angle away."""
    angle = outline.reach if turned is None else outline.reach + turned * 1.25
    bend, offset, known = texels.bend(angle)
    away = outline.reach + offset
    ends, rates = [], []
    for axis in range(2):
        place, gradient = texels.place(axis)
        low, high = outline.interval(gradient)
        slope = dot(gradient, gradient).sqrt()
        cubic = (slope + bend * away) * outline.reach * outline.reach * outline.reach * 0.3334
        pad = bend * away * away * 0.5 + cubic + tables.param(MISFIT)
        ends.append((known.where(place + low - pad, -EVERYWHERE), known.where(place + high + pad, EVERYWHERE)))
        rates.append(slope + bend * (angle + offset))
    return Box(ends[0], ends[1], rates[0], rates[1])


def outside_field(tables: LensTables, texels: LensTexels, reach: Vector) -> Mask:
    """Where round cones, ``reach`` the tangent of their angular radius, lie wholly outside of a lens's field."""
    cosine = 1 / (reach * reach + 1).sqrt()
    sine = reach * cosine
    cos_field, sin_field = tables.param(COS_FIELD), tables.param(SIN_FIELD)
    beyond = texels.f[2] < cos_field * cosine - sin_field * sine
    return beyond & (sin_field * cosine + cos_field * sine > 0) & (reach < WIDE)


class LidarTables:
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
        entry = (entry + 0.01).ceil() if upper else (entry - 0.01).floor()
        return self.v.gather(self.rows, entry.max(0).min(LIDAR_SIZE - 1).integers())


def lidar_box(tables: LidarTables, outline: Outline, near: Vector, turned: Vector | None) -> Box:
    """Cells that a LiDAR may see a Gaussian in, its columns within half a turn of ``near``.

    With ``turned``, rows and rates hold for directions up to that angle away.
    """
    x, y, z = outline.f
    flat = (x * x + y * y).max(1e-12).sqrt()
    inverse = 1 / flat
    left, right = outline.interval([-y * inverse, x * inverse, tables.v.number(0)])
    down, up = outline.interval([-z * x * inverse, -z * y * inverse, flat])
    known = outline.reach < WIDE

    # Azimuth: with (u, w) the tangents to the left and up, its tangent is u / (cos e - w sin e).
    least = flat - (down * z).max(up * z)
    around = ~(least > 1e-3) | ~known  # it reaches over the pole
    wide = 1 / least.max(1e-3)
    first, last = (left * wide).max(-HALF_PI), (right * wide).min(HALF_PI)
    per_radian = tables.param(PER_RADIAN)
    one, other = first * per_radian, last * per_radian
    column = tables.column(outline.f, near)
    low = column + one.min(other) - tables.param(MOST_AHEAD)
    high = column + one.max(other) - tables.param(LEAST_AHEAD)

    # Elevation: its sine is (sin e + w cos e) / sqrt(1 + u^2 + w^2).
    side = (-left).max(right)
    aside = 1 / (side * side + 1).sqrt()
    above = (z + up * flat) / (up * up + 1).sqrt()
    below = (z + down * flat) / (down * down + 1).sqrt()
    above, below = (above > 0).where(above, above * aside), (below < 0).where(below, below * aside)
    # Over the pole: all that lies within a round cone.
    cosine = 1 / (outline.reach * outline.reach + 1).sqrt()
    above = around.where((z > 0).where(1.0, (z + outline.reach * flat) * cosine), above)
    below = around.where((z < 0).where(-1.0, (z - outline.reach * flat) * cosine), below)
    slack = tables.v.number(0) if turned is None else turned
    above, below = known.where(above + slack, 1.0), known.where(below - slack, -1.0)

    rate = tables.v.number(0)
    if turned is not None:
        angle = outline.reach + turned
        rate = per_radian.abs() / (flat * (1 - angle * angle * 0.5) - z.abs() * angle).max(1e-3)
    columns = around.where(-EVERYWHERE, low), around.where(EVERYWHERE, high)
    return Box(columns, (tables.row(above, True), tables.row(below, False)), rate, tables.v.number(0))


def atan2(y: Vector, x: Vector) -> Vector:
    """Angle of (x, y) to about 1e-5 rad."""
    ax, ay = x.abs(), y.abs()
    a = ax.min(ay) / ax.max(ay).max(1e-30)
    s = a * a
    r = a * ((((s * 0.0208351 - 0.0851330) * s + 0.1801410) * s - 0.3302995) * s + 0.9998660)
    r = (ay > ax).where(HALF_PI - r, r)
    r = (x < 0).where(2 * HALF_PI - r, r)
    return (y < 0).where(-r, r)
