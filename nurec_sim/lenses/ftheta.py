"""The F-theta camera: pixel distance and angle off the axis are polynomials of each other.

``pixel = [[c, d], [e, 1]] @ (r(theta) * direction) + (cx, cy)``. The reference polynomial is exact; the other one is an
approximate inverse that formats store for speed, and is ignored here: the inverse is solved to rounding error. If the
reference is missing, the other one is used as the reference.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float64
from numpy.polynomial import polynomial

from nurec_sim.lenses import radial
from nurec_sim.lenses.base import BaseLens, Mask, Points2, Points3, check_angle, check_values
from nurec_sim.lenses.registry import register_lens


class FThetaReference(enum.Enum):
    """Which of the two F-theta polynomials is exact; the other one is its approximate inverse."""

    PIXELDIST_TO_ANGLE = "pixeldist_to_angle"
    ANGLE_TO_PIXELDIST = "angle_to_pixeldist"


@register_lens
@dataclass(frozen=True)
class FTheta(BaseLens):
    """F-theta: pixel distance and angle are polynomials of each other, coefficients from power 0 up.

    ``pixel = [[c, d], [e, 1]] @ (r(theta) * direction) + (cx, cy)``. The principal point here is corner-origin like
    every pixel of ours; formats that count pixel centres as whole numbers add 0.5 when they read
    (docs/scene_format.md). An empty polynomial is filled in by numeric inversion of the other one.
    """

    kind: ClassVar[str] = "ftheta"

    cx_px: float
    cy_px: float
    reference: FThetaReference
    pixeldist_to_angle: tuple[float, ...] = ()
    angle_to_pixeldist: tuple[float, ...] = ()
    max_angle_rad: float = np.pi / 2
    linear_cde: tuple[float, float, float] = (1.0, 0.0, 0.0)

    @property
    def fx_px(self) -> float:
        """Pixels per radian on the axis, along the rows."""
        return self.linear_cde[0] * self.fy_px

    @property
    def fy_px(self) -> float:
        """Pixels per radian on the axis, along the columns."""
        reference, coefficients = exact_polynomial(self)
        slope = coefficients[1]
        return slope if reference is FThetaReference.ANGLE_TO_PIXELDIST else 1 / slope

    def check(self) -> None:
        """Check the parameters.

        Raises:
            ValueError: a number is not finite, the angle out of range, no polynomial, one that does not rise from
                the axis outwards, or a matrix without an inverse.
        """
        check_values("principal point", (self.cx_px, self.cy_px))
        check_values("pixeldist_to_angle", self.pixeldist_to_angle)
        check_values("angle_to_pixeldist", self.angle_to_pixeldist)
        check_values("linear_cde", self.linear_cde, count=3)
        check_angle(self.max_angle_rad)
        reference, coefficients = exact_polynomial(self)
        if len(coefficients) < 2 or coefficients[1] <= 0:
            raise ValueError(f"{reference.value} must rise from the axis outwards, got {coefficients}")
        c, d, e = self.linear_cde
        if abs(c - d * e) < 1e-6:
            raise ValueError(f"linear_cde {self.linear_cde} is a matrix without an inverse")

    def scaled(self, sx: float, sy: float) -> FTheta:
        """The last matrix entry is fixed at 1, so the distance scales with the rows, and c and d absorb the rest."""
        c, d, e = self.linear_cde
        return dataclasses.replace(
            self,
            cx_px=self.cx_px * sx,
            cy_px=self.cy_px * sy,
            # theta(r) = sum k_n r^n with r -> r / sy; r(theta) scales by sy itself.
            pixeldist_to_angle=tuple(k / sy**power for power, k in enumerate(self.pixeldist_to_angle)),
            angle_to_pixeldist=tuple(k * sy for k in self.angle_to_pixeldist),
            linear_cde=(c * sx / sy, d * sx / sy, e),
        )

    def mirrored(self, width_px: float) -> FTheta:
        """Terms that are odd in x change their signs."""
        c, d, e = self.linear_cde
        return dataclasses.replace(super().mirrored(width_px), linear_cde=(c, -d, -e))

    def project(self, xyz: Points3) -> tuple[Points2, Mask]:
        """Pixels of points, and whether each is inside the field of the lens."""
        angle, direction = radial.angle_and_direction(xyz)
        valid = (angle <= field(self)[0]) & xyz.any(axis=1)
        distance = evaluate(self, FThetaReference.ANGLE_TO_PIXELDIST, angle)
        return (direction * distance[:, None]) @ _linear(self).T + (self.cx_px, self.cy_px), valid

    def unproject(self, uv: Points2) -> tuple[Points3, Mask]:
        """Unit rays of pixels, and whether each is inside the field of the lens."""
        flat = (uv - (self.cx_px, self.cy_px)) @ np.linalg.inv(_linear(self)).T
        distance = np.hypot(flat[:, 0], flat[:, 1])
        angle = evaluate(self, FThetaReference.PIXELDIST_TO_ANGLE, distance)
        direction = flat / np.where(distance > 0, distance, 1.0)[:, None]
        return radial.rays_at(angle, direction), distance <= field(self)[1]


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
    """Largest angle and largest pixel distance in the field of the lens."""
    reference, coefficients = exact_polynomial(lens)
    if reference is FThetaReference.ANGLE_TO_PIXELDIST:
        angle = radial.rising_limit(coefficients, lens.max_angle_rad)
        return angle, float(polynomial.polyval(angle, coefficients))
    # An upper bound: the distance at which the angle would reach its maximum at the smallest allowed slope.
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
