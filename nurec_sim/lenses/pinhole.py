"""The OpenCV pinhole camera with rational, tangential and thin-prism distortion.

With a = x/z, b = y/z, r2 = a*a + b*b and g = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)::

    a' = a g + 2 p1 a b + p2 (r2 + 2 a^2) + s1 r2 + s2 r2^2        u = fx a' + cx
    b' = b g + p1 (r2 + 2 b^2) + 2 p2 a b + s3 r2 + s4 r2^2        v = fy b' + cy
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float64
from numpy.polynomial import polynomial

from nurec_sim.lenses import radial
from nurec_sim.lenses.base import BaseLens, Mask, Points2, Points3, check_values
from nurec_sim.lenses.registry import register_lens

# Distorted lenses are cut off at this tangent of the angle off the axis (87 degrees).
WIDEST_TANGENT = 20.0
NEAREST_Z_M = 1e-6
# Where the denominator of g falls below this, a pole is near and the model is meaningless.
FAR_FROM_POLE = 0.1


@register_lens
@dataclass(frozen=True)
class Pinhole(BaseLens):
    """OpenCV pinhole: rational radial k1..k6, tangential p1 p2, thin prism s1..s4; corner-origin principal point."""

    kind: ClassVar[str] = "pinhole"
    perspective: ClassVar[bool] = True

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    radial: tuple[float, ...] = (0.0,) * 6
    tangential: tuple[float, ...] = (0.0,) * 2
    thin_prism: tuple[float, ...] = (0.0,) * 4

    @property
    def distorted(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return any(self.radial) or any(self.tangential) or any(self.thin_prism)

    @property
    def ideal_pinhole(self) -> Pinhole | None:
        """The lens itself, if it is not distorted."""
        return None if self.distorted else self

    @property
    def max_angle_rad(self) -> float:
        """A right angle: everything in front of the camera; the field of a distorted lens may end before."""
        return np.pi / 2

    def check(self) -> None:
        """Check the parameters.

        Raises:
            ValueError: a number is not finite, a focal length not positive, or a tuple not of its length.
        """
        super().check()
        for what, count in (("radial", 6), ("tangential", 2), ("thin_prism", 4)):
            check_values(what, getattr(self, what), count)

    def mirrored(self, width_px: float) -> Pinhole:
        """Terms that are odd in x change their signs."""
        # With x -> -x, terms of a' must be odd and those of b' even: p2, s1 and s2 change their signs.
        (p1, p2), (s1, s2, s3, s4) = self.tangential, self.thin_prism
        other_side = super().mirrored(width_px)
        return replace(other_side, tangential=(p1, -p2), thin_prism=(-s1, -s2, s3, s4))

    def project(self, xyz: Points3) -> tuple[Points2, Mask]:
        """Pixels of points, and whether each is in front and inside the field where the lens is one-to-one."""
        z = xyz[:, 2]
        valid = z > NEAREST_Z_M
        flat = xyz[:, :2] / np.where(valid, z, 1.0)[:, None]
        if self.distorted:
            inside = np.hypot(flat[:, 0], flat[:, 1]) <= _field(self)
            # Points outside the field could overflow the polynomials; the axis stands in, they are invalid anyway.
            flat = np.where((valid & inside)[:, None], flat, 0.0)
            flat, jacobian = _distort(self, flat)
            valid = valid & inside & _one_to_one(jacobian)
        return flat * (self.fx_px, self.fy_px) + (self.cx_px, self.cy_px), valid

    def unproject(self, uv: Points2) -> tuple[Points3, Mask]:
        """Unit rays of pixels, and whether each is inside the field of the lens."""
        flat = (uv - (self.cx_px, self.cy_px)) / (self.fx_px, self.fy_px)
        valid = np.ones(len(uv), bool)
        if self.distorted:
            flat, valid = _undistort(self, flat)
        rays = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True), valid


def _radial_parts(lens: Pinhole) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator of g as polynomials in r2."""
    k1, k2, k3, k4, k5, k6 = lens.radial
    return np.array([1.0, k1, k2, k3]), np.array([1.0, k4, k5, k6])


@functools.lru_cache(maxsize=64)
def _field(lens: Pinhole) -> float:
    """Largest r up to which r g(r2) rises (by ``radial.MINIMUM_SLOPE`` at least)."""
    top, bottom = _radial_parts(lens)
    # d(r N/D)/dr = (N D + 2 r2 (N' D - N D')) / D^2; a limit is where this falls to the smallest slope.
    turn = polynomial.polysub(
        polynomial.polymul(polynomial.polyder(top), bottom), polynomial.polymul(top, polynomial.polyder(bottom))
    )
    slope = polynomial.polyadd(polynomial.polymul(top, bottom), polynomial.polymul([0.0, 2.0], turn))
    excess = polynomial.polysub(slope, radial.MINIMUM_SLOPE * polynomial.polymul(bottom, bottom))
    return radial.first_below_zero(
        lambda r: np.minimum(polynomial.polyval(r * r, excess), polynomial.polyval(r * r, bottom) - FAR_FROM_POLE),
        WIDEST_TANGENT,
    )


def _distort(lens: Pinhole, flat: Points2) -> tuple[Points2, Float64[np.ndarray, "n 2 2"]]:
    """Distorted points of the plane z = 1, and the derivative of the map."""
    a, b = flat[:, 0], flat[:, 1]
    r2 = a * a + b * b
    top, bottom = (polynomial.polyval(r2, part) for part in _radial_parts(lens))
    top_slope, bottom_slope = (polynomial.polyval(r2, polynomial.polyder(part)) for part in _radial_parts(lens))
    gain = top / bottom
    gain_slope = (top_slope - gain * bottom_slope) / bottom  # by r2
    (p1, p2), (s1, s2, s3, s4) = lens.tangential, lens.thin_prism
    prism_a, prism_b = s1 + 2 * s2 * r2, s3 + 2 * s4 * r2  # slopes by r2
    distorted = np.stack(
        [
            a * gain + 2 * p1 * a * b + p2 * (r2 + 2 * a * a) + r2 * (s1 + s2 * r2),
            b * gain + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b + r2 * (s3 + s4 * r2),
        ],
        axis=1,
    )
    # d(a g)/db = a g' 2b = d(b g)/da, with g' the derivative by r2.
    cross = 2 * a * b * gain_slope
    jacobian = np.empty((len(flat), 2, 2))
    jacobian[:, 0, 0] = gain + 2 * a * a * gain_slope + 2 * p1 * b + 6 * p2 * a + 2 * a * prism_a
    jacobian[:, 0, 1] = cross + 2 * p1 * a + 2 * p2 * b + 2 * b * prism_a
    jacobian[:, 1, 0] = cross + 2 * p1 * a + 2 * p2 * b + 2 * a * prism_b
    jacobian[:, 1, 1] = gain + 2 * b * b * gain_slope + 6 * p1 * b + 2 * p2 * a + 2 * b * prism_b
    return distorted, jacobian


def _one_to_one(jacobian: Float64[np.ndarray, "n 2 2"]) -> Bool[np.ndarray, " n"]:
    """Where the map keeps its orientation with a margin: both stretch factors stay above the smallest slope."""
    determinant = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
    # Frobenius norm s, singular values s1 >= s2: det = s1 s2 and s1 <= s <= 1.42 s1, so the test bounds s2 from below.
    size = np.sqrt(np.sum(jacobian**2, axis=(1, 2)))
    return determinant > 0.5 * radial.MINIMUM_SLOPE * size


def _undistort(lens: Pinhole, target: Points2) -> tuple[Points2, Bool[np.ndarray, " n"]]:
    """Inverse of ``_distort`` by Newton: a radial solution first, which the small other terms then correct."""
    limit = _field(lens)
    radius = np.hypot(target[:, 0], target[:, 1])
    grid = np.linspace(0.0, limit, radial.TABLE_SIZE)
    top, bottom = (polynomial.polyval(grid * grid, part) for part in _radial_parts(lens))
    # Initial guess: the radial part alone, inverted by a table.
    guess = np.interp(radius, grid * top / bottom, grid)
    flat = target * (guess / np.where(radius > 0, radius, 1.0))[:, None]
    moving = np.arange(len(target))
    for _ in range(2 * radial.NEWTON_STEPS):
        place = flat[moving]
        value, jacobian = _distort(lens, place)
        step = _solve(jacobian, value - target[moving])
        place = place - step
        # Outside the field the polynomials are meaningless: continue from its rim.
        place *= np.minimum(1.0, limit / np.maximum(np.hypot(place[:, 0], place[:, 1]), 1e-12))[:, None]
        flat[moving] = place
        # Converged points leave the iteration.
        moving = moving[np.abs(step).max(axis=1, initial=0.0) > 1e-13]
        if len(moving) == 0:
            break
    value, jacobian = _distort(lens, flat)
    # Pixels outside the image of the field have no solution; the residual tells.
    found = np.abs(value - target).max(axis=1) < 1e-9 * np.maximum(1.0, radius)
    return flat, found & _one_to_one(jacobian)


def _solve(jacobian: Float64[np.ndarray, "n 2 2"], error: Points2) -> Points2:
    """Newton steps (2x2 inverse); bounded for singular matrices, which do not occur inside the field."""
    (a, b), (c, d) = jacobian[:, 0].T, jacobian[:, 1].T
    determinant = a * d - b * c
    determinant = np.where(np.abs(determinant) > 1e-6, determinant, 1e-6)
    return (
        np.stack([d * error[:, 0] - b * error[:, 1], a * error[:, 1] - c * error[:, 0]], axis=1) / determinant[:, None]
    )
