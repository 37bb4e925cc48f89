"""Errors of a LiDAR's beams: the elevations of its calibration are off by hundredths of a degree, each its own way."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from nurec_sim.compute.angles import arctan2
from nurec_sim.compute.kernels import unchecked_inner, unchecked_kernel

BLOCK = 1024


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
        slope = np.diff(self.error_rad) / np.diff(self.elevation_rad)
        return _lowered(np.ascontiguousarray(xyz_m, np.float64), self.elevation_rad, self.error_rad, slope)


@unchecked_inner
def _sine_cosine(angle: float) -> tuple[float, float]:
    """Sine and cosine, of small angles by their series, whose next terms are below the last digit."""
    if abs(angle) > 0.02:
        return math.sin(angle), math.cos(angle)
    square = angle * angle
    sine = angle * (1 - square * (1 / 6) * (1 - square * (1 / 20) * (1 - square * (1 / 42))))
    return sine, 1 - square * 0.5 * (1 - square * (1 / 12) * (1 - square * (1 / 30)))


@unchecked_kernel
def _lowered(xyz: np.ndarray, knots: np.ndarray, errors: np.ndarray, slope: np.ndarray) -> Float64[np.ndarray, "n 3"]:
    last = len(knots) - 1
    # Blocks that fit into the fastest cache, their coordinates apart: compilers then do several angles at once.
    level, height, elevation = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    # Consecutive points are of one beam, or of the next, so that a search begins where the last one ended.
    low, result = 0, np.empty(xyz.shape)
    for start in range(0, len(xyz), BLOCK):
        part, count = xyz[start : start + BLOCK], min(BLOCK, len(xyz) - start)
        for i in range(count):
            level[i], height[i] = part[i, 0] * part[i, 0] + part[i, 1] * part[i, 1], part[i, 2]
        for i in range(count):
            level[i] = math.sqrt(level[i])
            elevation[i] = arctan2(height[i], level[i])
        for i in range(count):
            while low < last and elevation[i] >= knots[low + 1]:
                low += 1
            while low > 0 and elevation[i] < knots[low]:
                low -= 1
            error = errors[low]
            if low < last and elevation[i] > knots[low]:
                error += slope[low] * (elevation[i] - knots[low])
            # Sine and cosine of the true elevation, times the distance.
            sine, cosine = _sine_cosine(error)
            shrunk = (level[i] * cosine + height[i] * sine) / max(level[i], 1e-9)
            result[start + i, 0], result[start + i, 1] = part[i, 0] * shrunk, part[i, 1] * shrunk
            result[start + i, 2] = height[i] * cosine - level[i] * sine
    return result
