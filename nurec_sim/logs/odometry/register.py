"""Registration of a sweep with the surfaces of earlier ones: point to plane, robust (Chen and Medioni 1992).

Residuals are weighted by a Geman-McClure kernel, as in KISS-ICP (Vizzo et al. 2023), so that what moves counts little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from nurec_sim import geometry
from nurec_sim.logs.odometry.static_points import Points
from nurec_sim.types import Matrix4

NEIGHBOURS = 10
PLANE_M = 0.5
"""Neighbours further away than this do not tell the plane at a point."""
FLATNESS = 0.12
"""Largest ratio of a surface's thickness to its extent, as standard deviations."""
REACH_M = (1.5, 0.8, 0.4)
"""Largest distances between a point and its partner, one after the other."""
ROUNDS = 6
KERNEL_M = 0.15
NOISE_M = 0.05
PRIOR_M, PRIOR_RAD = 0.15, np.radians(0.3)
"""Standard deviations of the motion that GPS and IMU give between two sweeps; it counts where surfaces do not tell."""
STILL_M = 2e-4


@dataclass(frozen=True, eq=False)
class Surface:
    """Points with the normals of the planes around them."""

    points: Points
    normals: Float64[np.ndarray, "n 3"]

    def moved(self, pose: Matrix4) -> Surface:
        """The surface in the frame to which ``pose`` takes it."""
        return Surface(geometry.transform_points(pose, self.points), self.normals @ pose[:3, :3].T)


@dataclass(frozen=True, eq=False)
class Registration:
    """A pose, the median distance to the planes there, and the share of points that have a partner."""

    pose: Matrix4
    residual_m: float
    share: float


def surface_of(points: Points, chosen: Points) -> Surface:
    """The flat surroundings of ``chosen`` among ``points``, by principal components."""
    distance, near = cKDTree(points).query(chosen, k=NEIGHBOURS, distance_upper_bound=PLANE_M)
    enough = np.isfinite(distance).sum(axis=1) >= NEIGHBOURS // 2 + 1
    chosen, near, valid = chosen[enough], near[enough], np.isfinite(distance[enough])
    around = np.where(valid[..., None], points[np.minimum(near, len(points) - 1)], 0.0)
    count = valid.sum(axis=1)[:, None]
    centred = np.where(valid[..., None], around - (around.sum(axis=1) / count)[:, None], 0.0)
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred) / count[..., None])
    # A line of one beam has no plane: its second extent vanishes as well.
    flat = (spread[:, 0] < FLATNESS**2 * spread[:, 2]) & (spread[:, 1] > 4 * spread[:, 0])
    return Surface(chosen[flat], axes[flat, :, 0])


def register(points: Points, target: Surface, guess: Matrix4) -> Registration:
    """The pose that lays points on a surface, starting at ``guess``, which counts as a prior.

    Args:
        points: [n,3], in the frame whose pose is sought.
        target: in the frame in which it is sought.
        guess: the pose as GPS and IMU give it.
    """
    tree = cKDTree(target.points)
    prior = np.diag([1 / PRIOR_RAD**2] * 3 + [1 / PRIOR_M**2] * 3)
    pose, off = guess, np.zeros(6)
    residual, share = np.array([np.inf]), 0.0
    for reach in REACH_M:
        for _ in range(ROUNDS):
            place = geometry.transform_points(pose, points)
            distance, near = tree.query(place, distance_upper_bound=reach)
            found = np.isfinite(distance)
            share = float(found.mean()) if len(found) else 0.0
            if found.sum() < 6:
                return Registration(guess, float("nan"), share)
            normal, partner = target.normals[near[found]], target.points[near[found]]
            # About the sensor rather than the origin of the world: rotations and translations are then of like size.
            arm = place[found] - pose[:3, 3]
            residual = np.einsum("ni,ni->n", normal, place[found] - partner)
            weight = (KERNEL_M**2 / (KERNEL_M**2 + residual**2)) ** 2 / NOISE_M**2
            rows = np.concatenate([np.cross(arm, normal), normal], axis=1)
            information = rows.T @ (weight[:, None] * rows) + prior
            step = -np.linalg.solve(information, rows.T @ (weight * residual) + prior @ off)
            off += step
            turn = Rotation.from_rotvec(step[:3]).as_matrix()
            pose = geometry.pose(turn @ pose[:3, :3], pose[:3, 3] + step[3:])
            if np.abs(step[3:]).max() < STILL_M and np.abs(step[:3]).max() < STILL_M / 10:
                break
    return Registration(pose, float(np.median(np.abs(residual))), share)
