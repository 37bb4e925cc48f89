"""False obstacles: simulated LiDAR returns where recorded beams passed freely.

Beside the driven path there are no recorded images to compare with, but space that beams crossed is known to be empty.
A return in it is a surface that does not exist: a floater for which a policy would brake. Grazing beams pass close to
surfaces, so a return counts only at a distance from all recorded returns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from nurec_sim import geometry
from nurec_sim.types import MOVABLE_LABELS, Track

BEAMS = 3
"""Minimum number of recorded sweeps with a beam that passed the point."""
AWAY_M = 0.4
"""A simulated return closer than this to a recorded one may lie on the same surface."""
COLUMNS = 1440
STEP_RAD = 2 * np.pi / COLUMNS
"""Angular cells of the range image of a recorded sweep."""
BESIDE_M = 0.1
"""A beam passes a point if it passes within this distance, or through the point's cell."""
RADII = (0, 1, 2, 4)
"""Neighbourhood radii in cells whose beams pass a point; 4 cells are 0.1 m at 5.7 m."""
MARGIN_M, MARGIN_SHARE = 0.5, 0.03
"""A beam passes a point if it ends farther by this margin, the accuracy of poses and of grazing beams."""
BOX_MARGIN_M = 0.3
FARTHEST_M = 40.0
"""Beyond this range recorded points are too sparse."""
_THINNED_M = 0.1


@dataclass(frozen=True)
class FiredSweep:
    """A recorded sweep as its sensor fired it.

    Attributes:
        xyz_fired_m: returns, each in the sensor frame at its firing time.
        fraction: firing times, from 0 at the sweep's start to 1 at its end.
        world_from_lidar: sensor poses at the start and the end.
    """

    xyz_fired_m: Float64[np.ndarray, "n 3"]
    fraction: Float64[np.ndarray, " n"]
    world_from_lidar: Float64[np.ndarray, "2 4 4"]


class RecordedBeams:
    """Recorded sweeps as range images, and their returns as one point cloud.

    Args:
        sweeps: sweeps of one log.
        ends_world_m: their returns in the world.
    """

    def __init__(self, sweeps: Sequence[FiredSweep], ends_world_m: Float64[np.ndarray, "m 3"]) -> None:
        from scipy.spatial import cKDTree

        self._sweeps = [_RangeImage(sweep) for sweep in sweeps]
        _, first = np.unique(np.floor(ends_world_m / _THINNED_M).astype(np.int64), axis=0, return_index=True)
        self._ends = cKDTree(ends_world_m[first])

    def free(self, xyz_world_m: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Points that beams of ``BEAMS`` sweeps passed, away from all recorded returns."""
        free = ~np.isfinite(self._ends.query(xyz_world_m, distance_upper_bound=AWAY_M)[0])
        free[free] = self.passed(xyz_world_m[free]) >= BEAMS
        return free

    def passed(self, xyz_world_m: Float64[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
        """Number of sweeps with a beam that passed each point and ended beyond it."""
        return sum((sweep.passed(xyz_world_m) for sweep in self._sweeps), np.zeros(len(xyz_world_m), np.int64))


class _RangeImage:
    """Longest beam in the neighbourhood of each angular cell, 0 without any, and the firing time of each column."""

    def __init__(self, sweep: FiredSweep) -> None:
        distance, row, column = _cells(sweep.xyz_fired_m)
        self.poses, self.low = sweep.world_from_lidar, int(row.min(initial=0))
        image = np.zeros((int(row.max(initial=0)) - self.low + 1, COLUMNS), np.float32)
        np.maximum.at(image, (row - self.low, column), distance.astype(np.float32))
        self.around = np.stack([_longest_around(image, radius) for radius in RADII])
        beams = np.bincount(column, minlength=COLUMNS)
        fired = np.bincount(column, sweep.fraction, minlength=COLUMNS) / np.maximum(beams, 1)
        self.fraction = np.where(beams > 0, fired, 0.5)

    def passed(self, xyz_world_m: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        # The sensor moves while it spins: the direction to a point depends on the firing time, which depends on the
        # direction. Fixed-point iteration: from the middle of the sweep, two steps are accurate enough.
        fraction = np.full(len(xyz_world_m), 0.5)
        for _ in range(3):
            lidar_from_world = geometry.inverse(geometry.interpolate_pose_pair(self.poses, fraction))
            xyz = np.einsum("nij,nj->ni", lidar_from_world[:, :3, :3], xyz_world_m) + lidar_from_world[:, :3, 3]
            distance, row, column = _cells(xyz)
            fraction = self.fraction[column]
        row = row - self.low
        inside = (row >= 0) & (row < self.around.shape[1]) & (distance < FARTHEST_M)
        # The radius grows with the angle that BESIDE_M subtends at the point's distance.
        wide = np.searchsorted(RADII, BESIDE_M / np.maximum(distance, BESIDE_M) / STEP_RAD, side="right") - 1
        reach = np.zeros(len(xyz_world_m))
        reach[inside] = self.around[wide[inside], row[inside], column[inside]]
        return reach > distance * (1 + MARGIN_SHARE) + MARGIN_M


def _longest_around(image: Float32[np.ndarray, "rows columns"], radius: int) -> Float32[np.ndarray, "rows columns"]:
    """Maximum filter over rows and columns; azimuth wraps around."""
    import cv2

    wide = np.pad(image, ((0, 0), (radius, radius)), mode="wrap")
    longest = cv2.dilate(wide, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8))
    return longest[:, radius : radius + image.shape[1]]


def false_obstacles(
    xyz_world_m: Float64[np.ndarray, "n 3"], beams: RecordedBeams, tracks: Sequence[Track], t_us: int
) -> tuple[int, int]:
    """Number of returns in space known to be free, and number of counted returns (outside the boxes of movable actors).

    Args:
        xyz_world_m: simulated returns.
        beams: recorded beams.
        tracks: labelled actors; returns in their boxes are not counted, since free space there changes over time.
        t_us: time of the simulated sweep.
    """
    counted = ~in_boxes(xyz_world_m, tracks, t_us)
    return int(beams.free(xyz_world_m[counted]).sum()), int(counted.sum())


def _cells(
    xyz_m: Float64[np.ndarray, "n 3"],
) -> tuple[Float64[np.ndarray, " n"], Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    """Distance, and row (elevation) and column (azimuth) of the angular cell of each point."""
    elevation = np.arctan2(xyz_m[:, 2], np.hypot(xyz_m[:, 0], xyz_m[:, 1]))
    azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0])
    column = np.floor((azimuth + np.pi) / STEP_RAD).astype(np.int64) % COLUMNS
    return np.linalg.norm(xyz_m, axis=1), np.floor(elevation / STEP_RAD).astype(np.int64), column


def in_boxes(xyz_world_m: Float64[np.ndarray, "n 3"], tracks: Sequence[Track], t_us: int) -> Bool[np.ndarray, " n"]:
    """Points in the boxes of movable objects at an instant, with a margin."""
    inside = np.zeros(len(xyz_world_m), bool)
    for track in tracks:
        if track.label in MOVABLE_LABELS and track.path.covers(t_us):
            local = geometry.transform_points(geometry.inverse(track.path.at(t_us)), xyz_world_m)
            inside |= (np.abs(local) <= np.asarray(track.size_m) / 2 + BOX_MARGIN_M).all(axis=1)
    return inside
