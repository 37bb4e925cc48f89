"""Beam-wise comparison of simulated and recorded LiDAR sweeps.

Every recorded return is compared with one beam: from the sensor pose at its firing time, in its direction. Azimuths
snap to the nearest column of the scanner; the range at the exact elevation is interpolated between two dense rows
around it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from nurec_sim import sensors
from nurec_sim.evaluate.scores.surfaces import KINDS, Surfaces
from nurec_sim.types import LidarFrame, LidarModel

COPIED_RAD = np.radians(1.0)
"""A copied sweep tells the range of beams that have a return of it so near in direction."""
FSCORE_M = (0.05, 0.1, 0.2)
ROW_STEP_RAD = np.radians(0.05)
SAME_SURFACE = 0.05
"""Maximum relative range difference of two rows on the same surface."""


@dataclass(frozen=True)
class LidarScore:
    """Beams with a recorded return, and what the simulation measured along them.

    Attributes:
        xyz_m: recorded returns, each in the sensor frame at its firing time.
        simulated_m: simulated range of each beam, NaN without a return.
        intensity_error: simulated minus recorded intensity, NaN where either is unknown.
        surface: what each recorded return lies on.
    """

    xyz_m: Float64[np.ndarray, "beams 3"]
    simulated_m: Float64[np.ndarray, " beams"]
    intensity_error: Float64[np.ndarray, " beams"] | None = None
    surface: Surfaces | None = None

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

    @property
    def abs_perpendicular_m(self) -> Float64[np.ndarray, " returned"]:
        """Absolute distances of simulated returns from the recorded surface, along its normal; NaN where unknown."""
        if self.surface is None:
            return np.full(int(self.returned.sum()), np.nan)
        return self.abs_error_m * self.surface.incidence[self.returned]

    def __getitem__(self, chosen: Bool[np.ndarray, " beams"]) -> LidarScore:
        intensity = None if self.intensity_error is None else self.intensity_error[chosen]
        surface = None if self.surface is None else self.surface[chosen]
        return LidarScore(self.xyz_m[chosen], self.simulated_m[chosen], intensity, surface)

    def within(self, low_m: float, high_m: float) -> LidarScore:
        """The beams whose recorded range lies in [low, high)."""
        return self[(self.recorded_m >= low_m) & (self.recorded_m < high_m)]

    def on(self, kind: str) -> LidarScore:
        """The beams that returned from a kind of surface, see ``surfaces.KINDS``; none if surfaces are not known."""
        if self.surface is None:
            return self[np.zeros(self.beams, bool)]
        return self[self.surface.kind == KINDS.index(kind)]

    @staticmethod
    def pooled(scores: list[LidarScore]) -> LidarScore:
        """All beams of several sweeps as one."""
        if not scores:
            return LidarScore(np.zeros((0, 3)), np.zeros(0))
        errors = [score.intensity_error for score in scores if score.intensity_error is not None]
        surfaces = [score.surface for score in scores if score.surface is not None]
        return LidarScore(
            np.concatenate([score.xyz_m for score in scores]),
            np.concatenate([score.simulated_m for score in scores]),
            np.concatenate(errors) if len(errors) == len(scores) else None,
            Surfaces.concatenate(surfaces) if len(surfaces) == len(scores) else None,
        )


@dataclass(frozen=True)
class CloudScore:
    """Distances between a simulated cloud P and a recorded one G, metres, not squared.

    Attributes:
        precision: [P] from each simulated return to the nearest recorded one.
        coverage: [G] from each recorded return to the nearest simulated one.
    """

    precision: Float64[np.ndarray, " p"]
    coverage: Float64[np.ndarray, " g"]

    @staticmethod
    def of(simulated_m: Float64[np.ndarray, "p 3"], recorded_m: Float64[np.ndarray, "g 3"]) -> CloudScore:
        """Distances between two clouds; all NaN if one is empty."""
        from scipy.spatial import cKDTree

        if not len(simulated_m) or not len(recorded_m):
            return CloudScore(np.full(len(simulated_m), np.nan), np.full(len(recorded_m), np.nan))
        return CloudScore(cKDTree(recorded_m).query(simulated_m)[0], cKDTree(simulated_m).query(recorded_m)[0])

    def figures(self) -> dict[str, float]:
        """Chamfer distances and F-scores by the names of their conventions; NaN where they cannot be computed.

        ``cd_l1_sum`` is the sum of both means, ``cd_l2sq_sum`` that of the means of squares, ``cd_l2sq_gtnorm`` that of
        both sums of squares over the number of recorded returns; ``fscore@T`` the harmonic mean of the shares of both
        distances below T metres; ``count_ratio`` simulated returns by recorded ones.
        """
        p, g = self.precision, self.coverage
        if not len(g):
            return {}
        precision, coverage = (float(x.mean()) if len(x) else float("nan") for x in (p, g))
        squares = [float((x**2).mean()) if len(x) else float("nan") for x in (p, g)]
        found = {
            "precision_m": precision,
            "coverage_m": coverage,
            "cd_l1_sum": precision + coverage,
            "cd_l2sq_sum": sum(squares),
            "cd_l2sq_gtnorm": float(((p**2).sum() + (g**2).sum()) / len(g)) if len(p) else float("nan"),
            "count_ratio": len(p) / len(g),
        }
        for limit in FSCORE_M:
            near = [float((x < limit).mean()) if len(x) else 0.0 for x in (p, g)]
            found[f"fscore@{limit:.2f}"] = 2 * near[0] * near[1] / sum(near) if sum(near) else 0.0
        return found


def scanner_along(lidar: LidarModel, xyz_fired_m: Float64[np.ndarray, "n 3"]) -> LidarModel:
    """The scanner with dense rows at the elevations of recorded returns, given in the sensor frame at firing time."""
    elevation = _elevation(xyz_fired_m)
    low, high = np.floor(elevation.min() / ROW_STEP_RAD), np.ceil(elevation.max() / ROW_STEP_RAD)
    rows = np.arange(high + 1, low - 2, -1) * ROW_STEP_RAD
    # Interpolation needs only the two rows around each return; a full dense scanner would cost many times the beams.
    index = np.unique(np.floor(elevation / ROW_STEP_RAD).astype(np.int64))
    needed = np.isin(np.round(rows / ROW_STEP_RAD).astype(np.int64), np.concatenate([index, index + 1]))
    return dataclasses.replace(
        lidar, elevation_rad=rows[needed], row_azimuth_offset_rad=np.zeros(int(needed.sum())), blocked=np.zeros(0, int)
    )


def score_sweep(
    simulated: LidarFrame,
    xyz_fired_m: Float64[np.ndarray, "n 3"],
    intensity: Float32[np.ndarray, " n"] | None = None,
    surface: Surfaces | None = None,
) -> LidarScore:
    """Compares a sweep simulated with ``scanner_along`` with the recorded returns.

    Args:
        simulated: frame of that scanner, from the recorded poses.
        xyz_fired_m: recorded returns, each in the sensor frame at its firing time.
        intensity: of the recorded returns, 0..1.
        surface: what the recorded returns lie on.

    Returns:
        one beam per recorded return within the scanner's range.
    """
    lidar = simulated.lidar
    rows, columns = len(lidar.elevation_rad), len(lidar.azimuth_rad)
    planes = np.full((2, rows * columns), np.nan)
    planes[:, simulated.beam] = simulated.range_m, simulated.intensity
    image, shown = planes.reshape(2, rows, columns)
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
    error = None
    if intensity is not None:
        error = np.where(fraction < 0.5, shown[upper, column], shown[upper + 1, column]) - intensity[usable]
    return LidarScore(xyz, distance, error, None if surface is None else surface[usable])


def _elevation(xyz_m: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
    return np.arctan2(xyz_m[:, 2], np.hypot(xyz_m[:, 0], xyz_m[:, 1]))


def copied_sweep(
    xyz_m: Float64[np.ndarray, "n 3"], other_m: Float64[np.ndarray, "m 3"], surface: Surfaces | None = None
) -> LidarScore:
    """Another recorded sweep in place of a simulated one: what a scene should beat.

    The range of a beam is that of the other sweep's return nearest in direction; none where that is more than
    ``COPIED_RAD`` off.

    Args:
        xyz_m: recorded returns in the sensor's frame of one instant.
        other_m: returns of the other sweep in the same frame.
        surface: what the recorded returns lie on.
    """
    from scipy.spatial import cKDTree

    recorded, other = (np.linalg.norm(xyz, axis=1) for xyz in (xyz_m, other_m))
    usable, shown = recorded > 0, other > 0
    tree = cKDTree(other_m[shown] / other[shown, None])
    directions = xyz_m[usable] / recorded[usable, None]
    _, nearest = tree.query(directions, distance_upper_bound=2 * np.sin(COPIED_RAD / 2))
    distance = np.append(other[shown], np.nan)[nearest]
    return LidarScore(xyz_m[usable], distance, None, None if surface is None else surface[usable])
