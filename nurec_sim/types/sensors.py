"""Cameras, LiDARs and the rig that carries them."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
from jaxtyping import Float64

from nurec_sim.lenses import Lens, Pinhole
from nurec_sim.types.trajectories import Matrix4


class Shutter(enum.Enum):
    """Direction in which an image is exposed; rows or columns share one instant."""

    GLOBAL = "global"
    TOP_TO_BOTTOM = "top_to_bottom"
    LEFT_TO_RIGHT = "left_to_right"
    BOTTOM_TO_TOP = "bottom_to_top"
    RIGHT_TO_LEFT = "right_to_left"


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

    @property
    def ideal_pinhole(self) -> Pinhole | None:
        """The lens as a pinhole without distortion; None where it is none, or behind a windshield."""
        # ``Lens`` cannot name the class in its own file: pinholes are lenses.
        return None if self.windshield is not None else cast("Pinhole | None", self.lens.ideal_pinhole)


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
