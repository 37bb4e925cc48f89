"""What radially symmetric lenses share: angles off the optical axis, and inverting an increasing function.

A distorted lens is used only where its radial function still rises at ``MINIMUM_SLOPE`` of its slope at the axis: past
that, two rays would meet in one pixel and a fold of the polynomial would draw ghosts into the image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float64
from numpy.polynomial import polynomial

MINIMUM_SLOPE = 0.05
TABLE_SIZE = 1025
NEWTON_STEPS = 8

Values = Float64[np.ndarray, " n"]


def angle_and_direction(xyz: Float64[np.ndarray, "n 3"]) -> tuple[Values, Float64[np.ndarray, "n 2"]]:
    """Angle off the optical axis and unit direction in the image plane; direction zero on the axis."""
    across = np.hypot(xyz[:, 0], xyz[:, 1])
    direction = xyz[:, :2] / np.where(across > 0, across, 1.0)[:, None]
    return np.arctan2(across, xyz[:, 2]), direction


def rays_at(angle_rad: Values, direction: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    """Unit rays at an angle off the optical axis towards a direction in the image plane."""
    rays = np.concatenate([direction * np.sin(angle_rad)[:, None], np.cos(angle_rad)[:, None]], axis=1)
    return rays


def first_positive_root(coefficients: Sequence[float] | np.ndarray) -> float:
    """Smallest real root above zero of a polynomial (coefficients from power 0 up); infinity where there is none."""
    trimmed = polynomial.polytrim(np.asarray(coefficients, np.float64))
    if len(trimmed) < 2:
        return np.inf
    roots = polynomial.polyroots(trimmed)
    scale = np.maximum(np.abs(roots), 1e-12)
    real = roots.real[(np.abs(roots.imag) < 1e-7 * scale) & (roots.real > 1e-9)]
    return float(real.min()) if len(real) else np.inf


def rising_limit(coefficients: Sequence[float] | np.ndarray) -> float:
    """Up to where a polynomial of slope above zero at 0 keeps ``MINIMUM_SLOPE`` of that slope."""
    slope = polynomial.polyder(np.asarray(coefficients, np.float64))
    slope[0] *= 1 - MINIMUM_SLOPE
    return first_positive_root(slope)


def invert_rising(
    function: Callable[[Values], Values], slope: Callable[[Values], Values], target: Values, upper: float
) -> Values:
    """Solve ``function(x) = target`` for x in [0, upper], where the function rises; targets outside give an end.

    A table gives the first guess, Newton steps the rest: quadratic from there on, so eight steps reach rounding.
    """
    grid = np.linspace(0.0, upper, TABLE_SIZE)
    x = np.interp(target, function(grid), grid)
    for _ in range(NEWTON_STEPS):
        step = (function(x) - target) / slope(x)
        x = np.clip(x - step, 0.0, upper)
        if len(x) == 0 or np.abs(step).max() < 1e-14 * upper:
            break
    return x
