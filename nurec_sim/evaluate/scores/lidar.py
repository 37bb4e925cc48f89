"""Beam-wise comparison of simulated and recorded LiDAR sweeps.

Every recorded return is compared with one beam: from the sensor pose at its firing time, in its direction. Azimuths
snap to the nearest column of the scanner; the range at the exact elevation is interpolated between two dense rows
around it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim import sensors
from nurec_sim.types import LidarFrame, LidarModel

ROW_STEP_RAD = np.radians(0.05)
SAME_SURFACE = 0.05
"""Maximum relative range difference of two rows on the same surface."""


@dataclass(frozen=True)
class LidarScore:
    """Beams with a recorded return, and what the simulation measured along them.

    Attributes:
        xyz_m: recorded returns, each in the sensor frame at its firing time.
        simulated_m: simulated range of each beam, NaN without a return.
    """

    xyz_m: Float64[np.ndarray, "beams 3"]
    simulated_m: Float64[np.ndarray, " beams"]

    @property
    def beams(self) -> int:
        """Beams with a recorded return."""
        return len(self.xyz_m)

    @property
    def recorded_m(self) -> Float64[np.ndarray, " beams"]:
        """Recorded ranges."""
        return np.linalg.norm(self.xyz_m, axis=1)

    @property
    def returned(self) -> Bool[np.ndarray, " beams"]:
        """Mask of beams with a simulated return."""
        return np.isfinite(self.simulated_m)

    @property
    def abs_error_m(self) -> Float64[np.ndarray, " returned"]:
        """Absolute range errors of beams with a simulated return."""
        return np.abs(self.simulated_m - self.recorded_m)[self.returned]

    @property
    def recall(self) -> float:
        """Share of recorded returns whose beam has a simulated return; NaN without beams."""
        return float(self.returned.mean()) if self.beams else float("nan")

    @property
    def median_abs_error_m(self) -> float:
        """Median over the simulated returns; NaN without any."""
        return float(np.median(self.abs_error_m)) if self.returned.any() else float("nan")

    def within(self, low_m: float, high_m: float) -> LidarScore:
        """The beams whose recorded range lies in [low, high)."""
        chosen = (self.recorded_m >= low_m) & (self.recorded_m < high_m)
        return LidarScore(self.xyz_m[chosen], self.simulated_m[chosen])

    def chamfer(self) -> tuple[float, float]:
        """Mean distance from simulated returns to recorded ones (precision) and back (coverage), metres, not squared.

        The simulated cloud is that of the beams with a recorded return. NaN if either cloud is empty.
        """
        from scipy.spatial import cKDTree

        back = self.returned
        if not back.any():
            return float("nan"), float("nan")
        simulated = self.xyz_m[back] * (self.simulated_m[back] / self.recorded_m[back])[:, None]
        precision = cKDTree(self.xyz_m).query(simulated)[0].mean()
        coverage = cKDTree(simulated).query(self.xyz_m)[0].mean()
        return float(precision), float(coverage)

    @staticmethod
    def pooled(scores: list[LidarScore]) -> LidarScore:
        """All beams of several sweeps as one; not for ``chamfer``, as their frames differ."""
        xyz = np.concatenate([np.zeros((0, 3)), *(score.xyz_m for score in scores)])
        return LidarScore(xyz, np.concatenate([np.zeros(0), *(score.simulated_m for score in scores)]))


def scanner_along(lidar: LidarModel, xyz_fired_m: Float64[np.ndarray, "n 3"]) -> LidarModel:
    """The scanner with dense rows at the elevations of recorded returns, given in the sensor frame at firing time."""
    elevation = _elevation(xyz_fired_m)
    low, high = np.floor(elevation.min() / ROW_STEP_RAD), np.ceil(elevation.max() / ROW_STEP_RAD)
    rows = np.arange(high + 1, low - 2, -1) * ROW_STEP_RAD
    # Interpolation needs only the two rows around each return; a full dense scanner would cost many times the beams.
    index = np.unique(np.floor(elevation / ROW_STEP_RAD).astype(np.int64))
    needed = np.isin(np.round(rows / ROW_STEP_RAD).astype(np.int64), np.concatenate([index, index + 1]))
    return dataclasses.replace(lidar, elevation_rad=rows[needed], row_azimuth_offset_rad=np.zeros(int(needed.sum())))


def score_sweep(simulated: LidarFrame, xyz_fired_m: Float64[np.ndarray, "n 3"]) -> LidarScore:
    """Compares a sweep simulated with ``scanner_along`` with the recorded returns.

    Args:
        simulated: frame of that scanner, from the recorded poses.
        xyz_fired_m: recorded returns, each in the sensor frame at its firing time.

    Returns:
        one beam per recorded return within the scanner's range.
    """
    lidar = simulated.lidar
    rows, columns = len(lidar.elevation_rad), len(lidar.azimuth_rad)
    flat = np.full(rows * columns, np.nan)
    flat[simulated.beam] = simulated.range_m
    image = flat.reshape(rows, columns)
    recorded = np.linalg.norm(xyz_fired_m, axis=1)
    usable = np.isfinite(recorded) & (recorded >= lidar.range_m[0]) & (recorded <= lidar.range_m[1])
    xyz = xyz_fired_m[usable]
    _, column, _ = sensors.beam_coordinates(lidar, xyz)
    column = np.round(np.nan_to_num(column)).astype(np.int64) % columns
    # Elevations descend with the row, hence the negation for the search.
    upper = np.clip(np.searchsorted(-lidar.elevation_rad, -_elevation(xyz), side="right") - 1, 0, rows - 2)
    above, below = lidar.elevation_rad[upper], lidar.elevation_rad[upper + 1]
    fraction = np.clip((above - _elevation(xyz)) / (above - below), 0, 1)
    first, second = image[upper, column], image[upper + 1, column]
    # Across a depth edge the mean of two surfaces lies on neither: interpolate on one surface only, otherwise take the
    # nearer row, and the other one if that has no return.
    nearest = np.where(fraction < 0.5, first, second)
    other = np.where(fraction < 0.5, second, first)
    same = np.abs(first - second) < SAME_SURFACE * np.minimum(first, second)
    distance = np.where(same, first + fraction * (second - first), np.where(np.isfinite(nearest), nearest, other))
    return LidarScore(xyz, distance)


def _elevation(xyz_m: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
    return np.arctan2(xyz_m[:, 2], np.hypot(xyz_m[:, 0], xyz_m[:, 1]))
