"""The bivariate windshield: glass in front of a lens refracts the two angles of a ray by polynomials in both.

A ray (x, y, z) has the angles phi = asin(x), theta = asin(y); behind the glass they are P_h(phi, theta) and
P_v(phi, theta). The polynomials named by ``reference`` are exact; the opposite direction is solved by Newton's method,
started from the other pair where it is given.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float64
from numpy.polynomial import polynomial

from nurec_sim.types import Windshield, WindshieldReference

NEWTON_STEPS = 12

Angles = Float64[np.ndarray, "n 2"]
Rays = Float64[np.ndarray, "n 3"]


def polynomial_order(count: int) -> int:
    """Order of a bivariate polynomial with ``count`` coefficients.

    Raises:
        ValueError: the count is not 1, 3, 6, 10, 15, 21, ...
    """
    # An order n has (n + 1)(n + 2) / 2 coefficients; solved for n.
    order = (math.isqrt(8 * count + 1) - 3) // 2
    if count < 1 or (order + 1) * (order + 2) // 2 != count:
        raise ValueError(f"a bivariate polynomial has 1, 3, 6, 10, 15 or 21 coefficients, got {count}")
    return order


def _grid(coefficients: tuple[float, ...]) -> Float64[np.ndarray, "p q"]:
    """Coefficients as a matrix [power of phi, power of theta]."""
    order = polynomial_order(len(coefficients))
    grid = np.zeros((order + 1, order + 1))
    start = 0
    for theta_power in range(order + 1):
        count = order + 1 - theta_power
        grid[:count, theta_power] = coefficients[start : start + count]
        start += count
    return grid


def _bend(pair: tuple[tuple[float, ...], tuple[float, ...]], angles: Angles) -> Angles:
    """Both polynomials of a pair (horizontal, vertical)."""
    return np.stack([polynomial.polyval2d(angles[:, 0], angles[:, 1], _grid(part)) for part in pair], axis=1)


def _unbend(pair: tuple[tuple[float, ...], tuple[float, ...]], target: Angles, guess: Angles) -> Angles:
    """Inverse of ``_bend``: the angles that it maps to ``target``, by Newton's method."""
    grids = [_grid(part) for part in pair]
    slopes = [(polynomial.polyder(grid, axis=0), polynomial.polyder(grid, axis=1)) for grid in grids]
    angles = guess
    for _ in range(NEWTON_STEPS):
        phi, theta = angles[:, 0], angles[:, 1]
        error = np.stack([polynomial.polyval2d(phi, theta, grid) for grid in grids], axis=1) - target
        (a, b), (c, d) = ([polynomial.polyval2d(phi, theta, part) for part in row] for row in slopes)
        determinant = a * d - b * c
        # Keeps the step finite where the Jacobian is singular; such rays fail the residual test of the caller.
        safe = np.where(np.abs(determinant) > 1e-6, determinant, 1e-6)
        step = np.stack([d * error[:, 0] - b * error[:, 1], a * error[:, 1] - c * error[:, 0]], axis=1) / safe[:, None]
        angles = np.clip(angles - step, -np.pi / 2, np.pi / 2)
        if len(step) == 0 or np.abs(step).max() < 1e-14:
            break
    return angles


def _angles_of(rays: Rays) -> Angles:
    return np.arcsin(np.clip(rays[:, :2] / np.linalg.norm(rays, axis=1, keepdims=True), -1.0, 1.0))


def _rays_of(angles: Angles) -> tuple[Rays, Bool[np.ndarray, " n"]]:
    flat = np.sin(angles)
    rest = 1.0 - np.sum(flat**2, axis=1)
    valid = (rest > 0) & (np.abs(angles) < np.pi / 2).all(axis=1)
    # x = sin(phi), y = sin(theta), z from unit length: only rays ahead (z > 0) have these angles.
    return np.concatenate([flat, np.sqrt(np.maximum(rest, 0.0))[:, None]], axis=1), valid


def _apply(glass: Windshield, rays: Rays, inward: bool) -> tuple[Rays, Bool[np.ndarray, " n"]]:
    forward = (glass.horizontal, glass.vertical)
    backward = (glass.horizontal_inverse, glass.vertical_inverse)
    wanted, other = (forward, backward) if inward else (backward, forward)
    exact_is_forward = glass.reference is WindshieldReference.FORWARD or not all(backward)
    ahead = rays[:, 2] > 0
    angles = _angles_of(np.where(ahead[:, None], rays, (0.0, 0.0, 1.0)))
    if exact_is_forward == inward:
        bent = _bend(wanted, angles)
        solved = ahead
    else:
        # The approximate inverse is the initial guess; glass bends rays little, so their own angles serve as well.
        guess = _bend(wanted, angles) if all(wanted) else angles
        bent = _unbend(other, angles, np.clip(guess, -np.pi / 2, np.pi / 2))
        solved = ahead & (np.abs(_bend(other, bent) - angles).max(axis=1, initial=0.0) < 1e-9)
    result, valid = _rays_of(bent)
    return result, solved & valid


def into_car(glass: Windshield, rays: Rays) -> tuple[Rays, Bool[np.ndarray, " n"]]:
    """Unit rays behind the glass of rays in front of it (towards the same scene), and where this is defined."""
    return _apply(glass, rays, inward=True)


def out_of_car(glass: Windshield, rays: Rays) -> tuple[Rays, Bool[np.ndarray, " n"]]:
    """Unit rays in front of the glass of rays behind it, and where this is defined."""
    return _apply(glass, rays, inward=False)


def check_windshield(name: str, glass: Windshield) -> None:
    """Check the coefficients of a windshield; ``name`` starts the error texts.

    Raises:
        ValueError: a wrong number of coefficients, one that is not finite, or a single inverse polynomial.
    """
    for what in ("horizontal", "vertical", "horizontal_inverse", "vertical_inverse"):
        values = getattr(glass, what)
        if not values and what.endswith("inverse"):
            continue
        if not np.isfinite(np.asarray(values, np.float64)).all():
            raise ValueError(f"{name}: windshield {what} must be finite, got {tuple(values)}")
        try:
            polynomial_order(len(values))
        except ValueError as error:
            raise ValueError(f"{name}: windshield {what}: {error}") from None
    if bool(glass.horizontal_inverse) != bool(glass.vertical_inverse):
        raise ValueError(f"{name}: a windshield has both inverse polynomials or none")
