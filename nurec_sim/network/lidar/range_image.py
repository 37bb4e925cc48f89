"""A sweep as the LiDAR branch takes it: an image over beams, with the motion during the sweep removed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from nurec_sim.types import LidarModel

FULL_TURN = 0.98
"""Share of a turn from which on the last column adjoins the first."""


@dataclass(frozen=True, eq=False)
class RangeImage:
    """The returns of a sweep over the beams of its LiDAR, rows from high to low, columns in firing order.

    Attributes:
        xyz_m: returns in the axes of the LiDAR at one instant of the sweep, metres; 0 for beams without one.
        eye_m: where the LiDAR was when each column was fired, in the same axes.
        returned: which beams returned.
        intensity: 0..1, NaN where unknown.
        elevation_rad: of each row.
        row_step_rad: mean angle from each row to its neighbours.
        column_step_rad: angle between neighbouring columns.
        full_turn: whether the last column adjoins the first.
    """

    xyz_m: Float32[np.ndarray, "rows columns 3"]
    eye_m: Float32[np.ndarray, "columns 3"]
    returned: Bool[np.ndarray, "rows columns"]
    intensity: Float32[np.ndarray, "rows columns"]
    elevation_rad: Float64[np.ndarray, " rows"]
    row_step_rad: Float64[np.ndarray, " rows"]
    column_step_rad: float
    full_turn: bool

    @classmethod
    def over(
        cls,
        lidar: LidarModel,
        xyz_m: Float32[np.ndarray, "rows columns 3"],
        eye_m: Float64[np.ndarray, "columns 3"],
        returned: Bool[np.ndarray, "rows columns"],
        intensity: Float32[np.ndarray, "rows columns"],
    ) -> RangeImage:
        """The image over the beams of a LiDAR; arguments as the attributes."""
        azimuth = lidar.azimuth_rad
        step = abs(float(azimuth[-1] - azimuth[0])) / max(len(azimuth) - 1, 1) or 2 * np.pi
        return cls(
            np.where(returned[..., None], xyz_m, 0).astype(np.float32),
            np.asarray(eye_m, np.float32),
            returned,
            np.asarray(intensity, np.float32),
            lidar.elevation_rad,
            row_steps(lidar.elevation_rad),
            step,
            bool(step * len(azimuth) > FULL_TURN * 2 * np.pi),
        )


def row_steps(falling_rad: Float64[np.ndarray, " rows"]) -> Float64[np.ndarray, " rows"]:
    """Mean angle from each row to its neighbours; one degree for a single row."""
    if len(falling_rad) < 2:
        return np.full(len(falling_rad), np.radians(1.0))
    gap = -np.diff(falling_rad)
    return (np.append(gap, gap[-1]) + np.insert(gap, 0, gap[0])) / 2
