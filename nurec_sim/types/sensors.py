"""Cameras, LiDARs and the rig that carries them."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from nurec_sim.types.trajectories import Matrix4


class Shutter(enum.Enum):
    """Direction in which an image is exposed; rows or columns share one instant."""

    GLOBAL = "global"
    TOP_TO_BOTTOM = "top_to_bottom"
    LEFT_TO_RIGHT = "left_to_right"
    BOTTOM_TO_TOP = "bottom_to_top"
    RIGHT_TO_LEFT = "right_to_left"


@dataclass(frozen=True)
class Pinhole:
    """OpenCV pinhole: rational radial k1..k6, tangential p1 p2, thin prism s1..s4; corner-origin principal point."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    radial: tuple[float, ...] = (0.0,) * 6
    tangential: tuple[float, ...] = (0.0,) * 2
    thin_prism: tuple[float, ...] = (0.0,) * 4

    @property
    def distorted(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return any(self.radial) or any(self.tangential) or any(self.thin_prism)


@dataclass(frozen=True)
class Fisheye:
    """OpenCV fisheye: r = theta (1 + k1 theta^2 + .. + k4 theta^8); valid up to ``max_angle_rad`` off the axis."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    radial: tuple[float, ...] = (0.0,) * 4
    max_angle_rad: float = np.pi / 2


class FThetaReference(enum.Enum):
    """Which of the two F-theta polynomials is exact; the other one is only a first guess."""

    PIXELDIST_TO_ANGLE = "pixeldist_to_angle"
    ANGLE_TO_PIXELDIST = "angle_to_pixeldist"


@dataclass(frozen=True)
class FTheta:
    """F-theta: pixel distance and angle are polynomials of each other, coefficients from power 0 up.

    ``pixel = [[c, d], [e, 1]] @ (r(theta) * direction) + (cx, cy)``. The principal point here is corner-origin like
    every pixel of ours; formats that count pixel centres as whole numbers add 0.5 when they read
    (docs/scene_format.md). An empty polynomial is filled in by numeric inversion of the other one.
    """

    cx_px: float
    cy_px: float
    reference: FThetaReference
    pixeldist_to_angle: tuple[float, ...] = ()
    angle_to_pixeldist: tuple[float, ...] = ()
    max_angle_rad: float = np.pi / 2
    linear_cde: tuple[float, float, float] = (1.0, 0.0, 0.0)


class WindshieldReference(enum.Enum):
    """Which windshield polynomials are exact."""

    FORWARD = "forward"
    BACKWARD = "backward"


@dataclass(frozen=True)
class Windshield:
    """Bivariate windshield: angles (phi, theta) = asin(x), asin(y) of a ray, each mapped by a polynomial in both.

    Coefficients: for y-power 0 all x-powers, then y-power 1 with one x-power fewer, ... (6 of order 2, 15 of order 4).
    Forward takes the external ray to the one behind the glass (used before projecting); the inverse takes it back.
    """

    reference: WindshieldReference
    horizontal: tuple[float, ...]
    vertical: tuple[float, ...]
    horizontal_inverse: tuple[float, ...] = ()
    vertical_inverse: tuple[float, ...] = ()


Lens = Pinhole | Fisheye | FTheta


@dataclass(frozen=True, eq=False)
class CameraModel:
    """One camera of a rig: size, lens, shutter and where it sits."""

    id: str
    width_px: int
    height_px: int
    lens: Lens
    rig_from_camera: Matrix4
    shutter: Shutter = Shutter.GLOBAL
    windshield: Windshield | None = None


class Spin(enum.Enum):
    """Sense of rotation seen from above."""

    CLOCKWISE = "clockwise"
    COUNTERCLOCKWISE = "counterclockwise"


@dataclass(frozen=True, eq=False)
class LidarModel:
    """A spinning LiDAR as a grid of beams, rows from high to low, columns in the order they fire.

    A beam of row r, column c points to elevation ``elevation_rad[r]``, azimuth
    ``azimuth_rad[c] + row_azimuth_offset_rad[r]`` (counter-clockwise from x forward). Column c fires at the fraction
    ``c / (columns - 1)`` of the sweep.
    """

    id: str
    elevation_rad: Float64[np.ndarray, " rows"]
    azimuth_rad: Float64[np.ndarray, " columns"]
    row_azimuth_offset_rad: Float64[np.ndarray, " rows"]
    rig_from_lidar: Matrix4
    spin: Spin = Spin.CLOCKWISE
    frequency_hz: float = 10.0
    range_m: tuple[float, float] = (0.5, 200.0)


@dataclass(frozen=True)
class Box:
    """An upright cuboid in its parent's axes."""

    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float]


@dataclass(frozen=True)
class Rig:
    """The sensors of a car and its outline, all in the rig frame. Mappings keep the order of the log."""

    cameras: Mapping[str, CameraModel]
    lidars: Mapping[str, LidarModel]
    body: Box = Box((1.4, 0.0, 0.75), (4.9, 1.9, 1.5))
