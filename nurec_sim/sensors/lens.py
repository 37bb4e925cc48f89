"""Bare lenses of any kind: point to pixel, pixel to ray, and whether the coefficients make sense."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim.sensors import fisheye, ftheta, pinhole
from nurec_sim.types import Fisheye, FTheta, Lens, Pinhole

Points2 = Float64[np.ndarray, "n 2"]
Points3 = Float64[np.ndarray, "n 3"]
Mask = Bool[np.ndarray, " n"]


def project_lens(lens: Lens, xyz: Points3) -> tuple[Points2, Mask]:
    """Pixels of points seen by a bare lens, and whether each is in its field."""
    if isinstance(lens, Pinhole):
        return pinhole.project(lens, xyz)
    if isinstance(lens, Fisheye):
        return fisheye.project(lens, xyz)
    return ftheta.project(lens, xyz)


def unproject_lens(lens: Lens, uv_px: Points2) -> tuple[Points3, Mask]:
    """Unit rays of pixels of a bare lens, and whether each is in its field."""
    if isinstance(lens, Pinhole):
        return pinhole.unproject(lens, uv_px)
    if isinstance(lens, Fisheye):
        return fisheye.unproject(lens, uv_px)
    return ftheta.unproject(lens, uv_px)


def check_lens(name: str, lens: Lens) -> None:
    """Check the coefficients of a lens; ``name`` starts the error texts.

    Raises:
        ValueError: a wrong number of coefficients, one that is not finite, a focal length or an angle out of range.
    """
    if isinstance(lens, FTheta):
        _check_ftheta(name, lens)
        return
    if not isinstance(lens, (Pinhole, Fisheye)):
        raise ValueError(f"{name}: the lens must be a Pinhole, Fisheye or FTheta, got {type(lens).__name__}")
    _check_values(name, "focal length and principal point", (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px))
    if lens.fx_px <= 0 or lens.fy_px <= 0:
        raise ValueError(f"{name}: focal lengths must be positive, got {lens.fx_px}, {lens.fy_px}")
    if isinstance(lens, Pinhole):
        _check_values(name, "radial", lens.radial, count=6)
        _check_values(name, "tangential", lens.tangential, count=2)
        _check_values(name, "thin_prism", lens.thin_prism, count=4)
    else:
        _check_values(name, "radial", lens.radial, count=4)
        _check_angle(name, lens.max_angle_rad)


def _check_values(name: str, what: str, values: Sequence[float], count: int | None = None) -> None:
    if count is not None and len(values) != count:
        raise ValueError(f"{name}: {what} needs {count} coefficients, got {len(values)}")
    if not np.isfinite(np.asarray(values, np.float64)).all():
        raise ValueError(f"{name}: {what} must be finite, got {tuple(values)}")


def _check_angle(name: str, angle_rad: float) -> None:
    if not 0 < angle_rad <= np.pi:
        raise ValueError(f"{name}: max_angle_rad must lie in (0, pi], got {angle_rad}")


def _check_ftheta(name: str, lens: FTheta) -> None:
    _check_values(name, "principal point", (lens.cx_px, lens.cy_px))
    _check_values(name, "pixeldist_to_angle", lens.pixeldist_to_angle)
    _check_values(name, "angle_to_pixeldist", lens.angle_to_pixeldist)
    _check_values(name, "linear_cde", lens.linear_cde, count=3)
    _check_angle(name, lens.max_angle_rad)
    try:
        reference, coefficients = ftheta.exact_polynomial(lens)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    if len(coefficients) < 2 or coefficients[1] <= 0:
        raise ValueError(f"{name}: {reference.value} must rise from the axis outwards, got {coefficients}")
    c, d, e = lens.linear_cde
    if abs(c - d * e) < 1e-6:
        raise ValueError(f"{name}: linear_cde {lens.linear_cde} is a matrix without an inverse")
