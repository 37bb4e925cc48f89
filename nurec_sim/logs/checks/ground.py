"""Checks that the ground seen by the LiDAR is where the rig frame requires it: at z = 0 below the rear axle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from nurec_sim.logs.checks.measure import Measure
from nurec_sim.logs.checks.sampling import Points, SampledSweep
from nurec_sim.logs.clip import Clip
from nurec_sim.types import Box

ALLOWED_HEIGHT_M = 0.2
ALLOWED_TILT_DEG = 6.0
AHEAD_M, BESIDE_M, ABOVE_M = 12.0, 6.0, 3.0
CELL_M = 0.3
THICKNESS_M = 0.08
STEEPEST = np.cos(np.radians(20.0))
TRIPLES = 400
FEWEST_CELLS = 60
SHARE_BELOW = 0.1
"""Nothing is below the ground: at most this fraction of all cells may be lower than the plane."""


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """A plane in the rig frame: z = height_m + slope . (x, y)."""

    height_m: float
    slope: Float64[np.ndarray, " 2"]

    @property
    def tilt_deg(self) -> float:
        """Angle between the plane and the rig's xy plane."""
        return float(np.degrees(np.arctan(np.linalg.norm(self.slope))))

    def above(self, points: Points) -> Float64[np.ndarray, " n"]:
        """Height of points over the plane, along z."""
        return points[:, 2] - self.height_m - points[:, :2] @ self.slope


def find_ground(points: Points, body: Box) -> GroundPlane | None:
    """The ground plane around the car, or None if no plane is dominant.

    Points are thinned to one per cell, so that planes are weighted by area rather than by point density. The plane with
    the most cells wins (RANSAC, Fischler and Bolles 1981) if almost nothing is below it; least squares refine it.

    Args:
        points: [n,3] in the rig frame.
        body: outline of the car, whose own returns are excluded.
    """
    x, y, z = points.T
    own = (np.abs(x - body.center_m[0]) < body.size_m[0] / 2 + 0.2) & (np.abs(y) < body.size_m[1] / 2 + 0.2)
    near = (np.abs(x - body.center_m[0]) < AHEAD_M) & (np.abs(y) < BESIDE_M) & (np.abs(z) < ABOVE_M) & ~own
    cells = points[near]
    _, first = np.unique(np.floor(cells / CELL_M).astype(np.int64), axis=0, return_index=True)
    cells = cells[np.sort(first)]
    if len(cells) < FEWEST_CELLS:
        return None
    corners = cells[np.random.default_rng(0).integers(0, len(cells), (TRIPLES, 3))]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Normals point up; triples that are collinear or too steep for a road are discarded.
    normal *= np.where(normal[:, 2:] < 0, -1.0, 1.0)
    length = np.linalg.norm(normal, axis=1)
    level = (length > 1e-6) & (normal[:, 2] > STEEPEST * length)
    if not level.any():
        return None
    normal, corners = normal[level] / length[level, None], corners[level]
    distance = cells @ normal.T - np.sum(normal * corners[:, 0], axis=1)
    on, below = np.abs(distance) < THICKNESS_M, distance < -3 * THICKNESS_M
    # A plane through car roofs or a raised kerb has many cells below it.
    votes = np.where(below.sum(axis=0) <= SHARE_BELOW * len(cells), on.sum(axis=0), 0)
    best = int(np.argmax(votes))
    if votes[best] < FEWEST_CELLS:
        return None
    floor = cells[on[:, best]]
    equations = np.column_stack([np.ones(len(floor)), floor[:, :2]])
    height, *slope = np.linalg.lstsq(equations, floor[:, 2], rcond=None)[0]
    return GroundPlane(float(height), np.array(slope))


def check_ground(clip: Clip, sweeps: Sequence[SampledSweep]) -> list[Measure]:
    """Height and tilt of the ground below the rear axle, the median of the sweeps, one row per LiDAR."""
    rows = []
    for name in clip.rig.lidars:
        what = f"ground below the rear axle, LiDAR {name!r}"
        ground = usual_ground([find_ground(each.rig_m, clip.rig.body) for each in sweeps if each.lidar_id == name])
        if ground is None:
            rows.append(Measure(what, "cannot tell: no level ground stands out near the car"))
        else:
            text = f"z = {ground.height_m:+.2f} m, tilted by {ground.tilt_deg:.1f} degrees"
            rows.append(Measure(what, text, tuple(_faults(name, ground))))
    return rows


def usual_ground(planes: Sequence[GroundPlane | None]) -> GroundPlane | None:
    """Component-wise median of the planes that were found; None if none was."""
    found = [plane for plane in planes if plane is not None]
    if not found:
        return None
    height = float(np.median([plane.height_m for plane in found]))
    return GroundPlane(height, np.median([plane.slope for plane in found], axis=0))


def _faults(name: str, ground: GroundPlane) -> list[str]:
    faults = []
    if abs(ground.height_m) > ALLOWED_HEIGHT_M:
        faults.append(
            f"LiDAR {name!r}: the ground below the rear axle lies at z = {ground.height_m:+.2f} m in the rig frame, "
            f"allowed is {ALLOWED_HEIGHT_M} m around 0; ground_z_in_ego_m in calib.json may be off by as much, "
            "or the LiDAR's pose is wrong"
        )
    if ground.tilt_deg > ALLOWED_TILT_DEG:
        faults.append(
            f"LiDAR {name!r}: the ground around the car is tilted by {ground.tilt_deg:.1f} degrees against the rig "
            f"frame, allowed are {ALLOWED_TILT_DEG:g}; the LiDAR's or the ego's rotation is wrong"
        )
    return faults
