"""Cameras, LiDARs and the sensor rig."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import cast

import numpy as np
from jaxtyping import Float64, Int64

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
    """The windshield polynomials that are exact; the others are their approximate inverse."""

    FORWARD = "forward"
    BACKWARD = "backward"


@dataclass(frozen=True)
class Windshield:
    """Bivariate windshield: each ray angle (phi, theta) = (asin(x), asin(y)) is mapped by a polynomial in both.

    Coefficients: for y-power 0 all x-powers, then y-power 1 with one x-power fewer, ... (6 of order 2, 15 of order 4).
    Forward maps an external ray to the ray behind the glass (applied before projection); the inverse maps it back.
    """

    reference: WindshieldReference
    horizontal: tuple[float, ...]
    vertical: tuple[float, ...]
    horizontal_inverse: tuple[float, ...] = ()
    vertical_inverse: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class CameraModel:
    """One camera of a rig: image size, lens, shutter and mounting pose."""

    id: str
    width_px: int
    height_px: int
    lens: Lens
    rig_from_camera: Matrix4
    shutter: Shutter = Shutter.GLOBAL
    windshield: Windshield | None = None

    @property
    def ideal_pinhole(self) -> Pinhole | None:
        """The lens as a pinhole without distortion; None if it has distortion, or a windshield bends its rays."""
        # The protocol ``Lens`` cannot name ``Pinhole``, which is defined on top of it: hence the cast.
        return None if self.windshield is not None else cast("Pinhole | None", self.lens.ideal_pinhole)


class Spin(enum.Enum):
    """Sense of rotation seen from above."""

    CLOCKWISE = "clockwise"
    COUNTERCLOCKWISE = "counterclockwise"


LIDAR_SECTORS = 180
"""Sectors of azimuth in which beams of a row are blocked or not."""


@dataclass(frozen=True, eq=False)
class LidarModel:
    """A spinning LiDAR as a grid of beams: rows from high to low, columns in firing order.

    The beam of row r and column c has elevation ``elevation_rad[r]`` and azimuth
    ``azimuth_rad[c] + row_azimuth_offset_rad[r]`` (counter-clockwise from x forward). Column c fires at the fraction
    ``c / (columns - 1)`` of the sweep.

    ``blocked`` names beams that never return, because the car's own body is in their way or their laser is weak:
    ``row * LIDAR_SECTORS + sector``, sectors of azimuth counter-clockwise from straight behind (-pi).
    """

    id: str
    elevation_rad: Float64[np.ndarray, " rows"]
    azimuth_rad: Float64[np.ndarray, " columns"]
    row_azimuth_offset_rad: Float64[np.ndarray, " rows"]
    rig_from_lidar: Matrix4
    spin: Spin = Spin.CLOCKWISE
    frequency_hz: float = 10.0
    range_m: tuple[float, float] = (0.5, 200.0)
    blocked: Int64[np.ndarray, " k"] = field(default_factory=lambda: np.zeros(0, np.int64))


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
