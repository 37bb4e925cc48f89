"""The OpenCV fisheye camera: distance from the centre theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.polynomial import polynomial

from nurec_sim.lenses import radial
from nurec_sim.lenses.base import BaseLens, Mask, Points2, Points3, check_values
from nurec_sim.lenses.registry import register_lens


@register_lens
@dataclass(frozen=True)
class Fisheye(BaseLens):
    """OpenCV fisheye: r = theta (1 + k1 theta^2 + .. + k4 theta^8); valid up to ``max_angle_rad`` off the axis."""

    kind: ClassVar[str] = "fisheye"

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    radial: tuple[float, ...] = (0.0,) * 4
    max_angle_rad: float = np.pi / 2

    def check(self) -> None:
        """Check the parameters.

        Raises:
            ValueError: a number is not finite, a focal length or the angle out of range, or not four coefficients.
        """
        super().check()
        check_values("radial", self.radial, count=4)

    def project(self, xyz: Points3) -> tuple[Points2, Mask]:
        """Pixels of points, and whether each is inside the field of the lens."""
        angle, direction = radial.angle_and_direction(xyz)
        valid = (angle <= _field(self)) & xyz.any(axis=1)
        distance = polynomial.polyval(np.minimum(angle, _field(self)), _polynomial(self))
        return direction * distance[:, None] * (self.fx_px, self.fy_px) + (self.cx_px, self.cy_px), valid

    def unproject(self, uv: Points2) -> tuple[Points3, Mask]:
        """Unit rays of pixels, and whether each is inside the field of the lens."""
        flat = (uv - (self.cx_px, self.cy_px)) / (self.fx_px, self.fy_px)
        distance = np.hypot(flat[:, 0], flat[:, 1])
        coefficients, field = _polynomial(self), _field(self)
        slope = polynomial.polyder(coefficients)
        angle = radial.invert_rising(
            lambda x: polynomial.polyval(x, coefficients), lambda x: polynomial.polyval(x, slope), distance, field
        )
        direction = flat / np.where(distance > 0, distance, 1.0)[:, None]
        return radial.rays_at(angle, direction), distance <= polynomial.polyval(field, coefficients)


def _polynomial(lens: Fisheye) -> np.ndarray:
    """Coefficients of the distance as a function of the angle, from power 0 up."""
    coefficients = np.zeros(10)
    coefficients[1] = 1.0
    # Odd powers only: theta, k1 theta^3, k2 theta^5, k3 theta^7, k4 theta^9.
    coefficients[3::2] = lens.radial
    return coefficients


@functools.lru_cache(maxsize=64)
def _field(lens: Fisheye) -> float:
    """Largest angle in the field of the lens."""
    return radial.rising_limit(_polynomial(lens), lens.max_angle_rad)
