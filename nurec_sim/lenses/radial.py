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
SCAN_SIZE = 4097
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


def first_below_zero(function: Callable[[Values], Values], upper: float) -> float:
    """Smallest x in [0, upper] from which on a function is negative; ``upper`` where it never is.

    A scan and a bisection: unlike the roots of a polynomial this does not care for vanishing leading coefficients.
    """
    grid = np.linspace(0.0, upper, SCAN_SIZE)
    below = np.flatnonzero(function(grid) < 0)
    if len(below) == 0:
        return upper
    if below[0] == 0:
        return 0.0
    low, high = grid[below[0] - 1], grid[below[0]]
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if function(np.array([middle]))[0] < 0 else (middle, high)
    return float(low)


def rising_limit(coefficients: Sequence[float] | np.ndarray, upper: float) -> float:
    """Up to where, at most ``upper``, a polynomial keeps ``MINIMUM_SLOPE`` of its slope at 0."""
    slope = polynomial.polyder(np.asarray(coefficients, np.float64))
    slope[0] *= 1 - MINIMUM_SLOPE
    return first_below_zero(lambda x: polynomial.polyval(x, slope), upper)


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
