"""F-theta polynomials fitted to others: the missing direction of an F-theta lens, or a lens of another kind."""

from __future__ import annotations

import dataclasses
from typing import TypeVar

import numpy as np

from nurec_sim.lenses import ftheta, radial
from nurec_sim.types import CameraModel, FTheta, FThetaReference, Lens

AnyLens = TypeVar("AnyLens", bound=Lens)

TERMS = 6
FIT_SAMPLES = 2000


def _fit(x: np.ndarray, y: np.ndarray) -> tuple[float, ...]:
    """Least-squares polynomial of ``TERMS`` terms through the origin."""
    scale = float(np.abs(x).max()) or 1.0
    powers = np.arange(1, TERMS)
    solution = np.linalg.lstsq((x[:, None] / scale) ** powers, y, rcond=None)[0]
    # Undo the scaling of x, which kept the powers comparable and the system well conditioned.
    return (0.0, *(float(value) for value in solution / scale**powers))


def fill_ftheta(lens: AnyLens, max_radius_px: float) -> AnyLens:
    """The same lens, if it is F-theta with both polynomials: a missing one is fitted up to ``max_radius_px``.

    Raises:
        ValueError: the lens has no polynomial, or ``max_radius_px`` is not positive.
    """
    if not max_radius_px > 0:
        raise ValueError(f"max_radius_px must be positive, got {max_radius_px}")
    if not isinstance(lens, FTheta):
        return lens
    reference, _ = ftheta.exact_polynomial(lens)
    if lens.pixeldist_to_angle and lens.angle_to_pixeldist:
        return lens
    distance = np.linspace(0.0, min(max_radius_px, ftheta.field(lens)[1]), FIT_SAMPLES)
    angle = ftheta.evaluate(lens, FThetaReference.PIXELDIST_TO_ANGLE, distance)
    if reference is FThetaReference.ANGLE_TO_PIXELDIST:
        return dataclasses.replace(lens, reference=reference, pixeldist_to_angle=_fit(distance, angle))
    return dataclasses.replace(lens, reference=reference, angle_to_pixeldist=_fit(angle, distance))


def fit_ftheta(camera: CameraModel) -> FTheta:
    """The F-theta lens closest to any lens, over the camera's image; for formats that know no other.

    Tangential and thin-prism distortion has no counterpart and is averaged away; a windshield stays with the camera.

    Raises:
        ValueError: no ray of the image is inside the lens' field.
    """
    if isinstance(camera.lens, FTheta):
        return fill_ftheta(camera.lens, float(np.hypot(camera.width_px, camera.height_px)))
    lens = camera.lens
    columns = np.linspace(0.0, camera.width_px, 65)
    rows = np.linspace(0.0, camera.height_px, 49)
    uv = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    rays, valid = lens.unproject(uv)
    if not valid.any():
        raise ValueError(f"camera {camera.id!r}: no pixel of the image lies in the field of its lens")
    stretch = lens.fx_px / lens.fy_px
    # F-theta distances are along the columns; ``linear_cde`` stretches the rows.
    distance = np.hypot((uv[valid, 0] - lens.cx_px) / stretch, uv[valid, 1] - lens.cy_px)
    angle, _ = radial.angle_and_direction(rays[valid])
    return FTheta(
        cx_px=lens.cx_px,
        cy_px=lens.cy_px,
        reference=FThetaReference.PIXELDIST_TO_ANGLE,
        pixeldist_to_angle=_fit(distance, angle),
        angle_to_pixeldist=_fit(angle, distance),
        max_angle_rad=float(angle.max()),
        linear_cde=(stretch, 0.0, 0.0),
    )
