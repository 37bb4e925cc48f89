"""The F-theta camera: pixel distance and angle off the axis are polynomials of each other.

``pixel = [[c, d], [e, 1]] @ (r(theta) * direction) + (cx, cy)``. The reference polynomial is exact and the other one
only a first guess that formats carry for speed, so it is not read here: the inverse is solved to rounding. Where the
reference is missing, the other one is the reference.
"""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Bool, Float64
from numpy.polynomial import polynomial

from nurec_sim.sensors import radial
from nurec_sim.types import FTheta, FThetaReference

Points2 = Float64[np.ndarray, "n 2"]


def exact_polynomial(lens: FTheta) -> tuple[FThetaReference, tuple[float, ...]]:
    """The polynomial that defines the lens, and which one it is.

    Raises:
        ValueError: the lens has no polynomial.
    """
    if lens.reference is FThetaReference.ANGLE_TO_PIXELDIST:
        order = (FThetaReference.ANGLE_TO_PIXELDIST, FThetaReference.PIXELDIST_TO_ANGLE)
    else:
        order = (FThetaReference.PIXELDIST_TO_ANGLE, FThetaReference.ANGLE_TO_PIXELDIST)
    for reference in order:
        coefficients: tuple[float, ...] = getattr(lens, reference.value)
        if coefficients:
            return reference, coefficients
    raise ValueError("an F-theta lens needs pixeldist_to_angle or angle_to_pixeldist; both are empty")


@functools.lru_cache(maxsize=64)
def field(lens: FTheta) -> tuple[float, float]:
    """Largest angle and largest pixel distance that the lens sees."""
    reference, coefficients = exact_polynomial(lens)
    if reference is FThetaReference.ANGLE_TO_PIXELDIST:
        angle = radial.rising_limit(coefficients, lens.max_angle_rad)
        return angle, float(polynomial.polyval(angle, coefficients))
    # Rising at the smallest slope all the way, the angle would reach its maximum here.
    furthest = lens.max_angle_rad / (radial.MINIMUM_SLOPE * coefficients[1])
    rising = radial.rising_limit(coefficients, furthest)
    distance = radial.first_below_zero(lambda x: lens.max_angle_rad - polynomial.polyval(x, coefficients), rising)
    return float(polynomial.polyval(distance, coefficients)), distance


def evaluate(lens: FTheta, wanted: FThetaReference, x: np.ndarray) -> np.ndarray:
    """Distance of angles or angles of distances, by the exact polynomial or its inverse, inside the field."""
    reference, coefficients = exact_polynomial(lens)
    angle, distance = field(lens)
    upper_in = angle if wanted is FThetaReference.ANGLE_TO_PIXELDIST else distance
    x = np.clip(x, 0.0, upper_in)
    if reference is wanted:
        return polynomial.polyval(x, coefficients)
    upper_out = distance if wanted is FThetaReference.ANGLE_TO_PIXELDIST else angle
    slope = polynomial.polyder(coefficients)
    return radial.invert_rising(
        lambda y: polynomial.polyval(y, coefficients), lambda y: polynomial.polyval(y, slope), x, upper_out
    )


def _linear(lens: FTheta) -> Float64[np.ndarray, "2 2"]:
    """The matrix [[c, d], [e, 1]]."""
    c, d, e = lens.linear_cde
    return np.array([[c, d], [e, 1.0]])


def project(lens: FTheta, xyz: Float64[np.ndarray, "n 3"]) -> tuple[Points2, Bool[np.ndarray, " n"]]:
    """Pixels of points, and whether each is inside the field of the lens."""
    angle, direction = radial.angle_and_direction(xyz)
    valid = (angle <= field(lens)[0]) & xyz.any(axis=1)
    distance = evaluate(lens, FThetaReference.ANGLE_TO_PIXELDIST, angle)
    return (direction * distance[:, None]) @ _linear(lens).T + (lens.cx_px, lens.cy_px), valid


def unproject(lens: FTheta, uv: Points2) -> tuple[Float64[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Unit rays of pixels, and whether the lens sees anything there."""
    flat = (uv - (lens.cx_px, lens.cy_px)) @ np.linalg.inv(_linear(lens)).T
    distance = np.hypot(flat[:, 0], flat[:, 1])
    angle = evaluate(lens, FThetaReference.PIXELDIST_TO_ANGLE, distance)
    direction = flat / np.where(distance > 0, distance, 1.0)[:, None]
    return radial.rays_at(angle, direction), distance <= field(lens)[1]
