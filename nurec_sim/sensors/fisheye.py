"""The OpenCV fisheye camera: distance from the centre theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)."""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Bool, Float64
from numpy.polynomial import polynomial

from nurec_sim.sensors import radial
from nurec_sim.types import Fisheye

Points2 = Float64[np.ndarray, "n 2"]


def _polynomial(lens: Fisheye) -> np.ndarray:
    """Coefficients of the distance as a function of the angle, from power 0 up."""
    coefficients = np.zeros(10)
    coefficients[1] = 1.0
    coefficients[3::2] = lens.radial
    return coefficients


@functools.lru_cache(maxsize=64)
def _field(lens: Fisheye) -> float:
    """Largest angle that the lens sees."""
    return radial.rising_limit(_polynomial(lens), lens.max_angle_rad)


def project(lens: Fisheye, xyz: Float64[np.ndarray, "n 3"]) -> tuple[Points2, Bool[np.ndarray, " n"]]:
    """Pixels of points, and whether each is inside the field of the lens."""
    angle, direction = radial.angle_and_direction(xyz)
    valid = (angle <= _field(lens)) & xyz.any(axis=1)
    distance = polynomial.polyval(np.minimum(angle, _field(lens)), _polynomial(lens))
    return direction * distance[:, None] * (lens.fx_px, lens.fy_px) + (lens.cx_px, lens.cy_px), valid


def unproject(lens: Fisheye, uv: Points2) -> tuple[Float64[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Unit rays of pixels, and whether the lens sees anything there."""
    flat = (uv - (lens.cx_px, lens.cy_px)) / (lens.fx_px, lens.fy_px)
    distance = np.hypot(flat[:, 0], flat[:, 1])
    coefficients, field = _polynomial(lens), _field(lens)
    slope = polynomial.polyder(coefficients)
    angle = radial.invert_rising(
        lambda x: polynomial.polyval(x, coefficients), lambda x: polynomial.polyval(x, slope), distance, field
    )
    direction = flat / np.where(distance > 0, distance, 1.0)[:, None]
    return radial.rays_at(angle, direction), distance <= polynomial.polyval(field, coefficients)
