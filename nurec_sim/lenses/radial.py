"""What radially symmetric lenses share: angles off the optical axis, and inverting an increasing function.

A distorted lens is used only where the slope of its radial function is at least ``MINIMUM_SLOPE`` of that on the axis:
beyond, two rays would map to one pixel, and a fold of the polynomial would render ghosts into the image.
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
    # atan2 instead of acos: accurate near the axis, and valid behind the camera, up to pi.
    return np.arctan2(across, xyz[:, 2]), direction


def rays_at(angle_rad: Values, direction: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    """Unit rays at an angle off the optical axis towards a direction in the image plane."""
    rays = np.concatenate([direction * np.sin(angle_rad)[:, None], np.cos(angle_rad)[:, None]], axis=1)
    return rays


def first_below_zero(function: Callable[[Values], Values], upper: float) -> float:
    """Smallest x in [0, upper] at which a function becomes negative; ``upper`` if it never does.

    A scan and a bisection: unlike polynomial root finding, this is robust to vanishing leading coefficients.
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
    """Largest x, at most ``upper``, up to which a polynomial's slope is at least ``MINIMUM_SLOPE`` of that at 0."""
    slope = polynomial.polyder(np.asarray(coefficients, np.float64))
    # p'(x) - MINIMUM_SLOPE p'(0): only the constant term of the derivative changes.
    slope[0] *= 1 - MINIMUM_SLOPE
    return first_below_zero(lambda x: polynomial.polyval(x, slope), upper)


def invert_rising(
    function: Callable[[Values], Values], slope: Callable[[Values], Values], target: Values, upper: float
) -> Values:
    """Solve ``function(x) = target`` for x in [0, upper], where the function increases.

    A table gives the initial guess; from there Newton's method converges quadratically, so eight steps reach rounding
    error.

    Args:
        function: increasing on [0, upper], vectorised.
        slope: its derivative, vectorised and positive there.
        target: [n] function values; those outside the function's range yield 0 or ``upper``.
        upper: end of the interval.

    Returns:
        x [n].
    """
    grid = np.linspace(0.0, upper, TABLE_SIZE)
    x = np.interp(target, function(grid), grid)
    for _ in range(NEWTON_STEPS):
        step = (function(x) - target) / slope(x)
        # Clamped: outside the interval the polynomial may fall, and Newton would diverge.
        x = np.clip(x - step, 0.0, upper)
        if len(x) == 0 or np.abs(step).max() < 1e-14 * upper:
            break
    return x
