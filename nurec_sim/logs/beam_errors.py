"""Errors of a LiDAR's beams: the elevations of its calibration are off by hundredths of a degree, each its own way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64


@dataclass(frozen=True, eq=False)
class BeamErrors:
    """By how much the points of a log are too high, in the frame of their LiDAR.

    Attributes:
        elevation_rad: elevations over the x-y plane, ascending; errors are linear in between.
        error_rad: recorded minus true elevation there.
    """

    elevation_rad: Float64[np.ndarray, " k"]
    error_rad: Float64[np.ndarray, " k"]

    def removed(self, xyz_m: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Recorded points moved to where they were measured, at the same range and azimuth."""
        level = np.hypot(xyz_m[:, 0], xyz_m[:, 1])
        elevation = np.arctan2(xyz_m[:, 2], level)
        true = elevation - np.interp(elevation, self.elevation_rad, self.error_rad)
        distance = np.hypot(level, xyz_m[:, 2])
        shrunk = distance * np.cos(true) / np.maximum(level, 1e-9)
        return np.column_stack([xyz_m[:, :2] * shrunk[:, None], distance * np.sin(true)])
