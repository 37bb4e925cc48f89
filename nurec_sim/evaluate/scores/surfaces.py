"""What recorded LiDAR returns lie on, from the sweep alone: level ground, standing surfaces, rough things, actors.

A plane is fitted to each return and its neighbours by direction. On grazing ground a centimetre of height is decimetres
of range, so ranges are judged along the normal there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

KINDS = ("ground", "standing", "rough", "actors")
"""Level planes, other planes, returns that fit no plane (vegetation, edges, wires), and boxes of movable objects."""
NEIGHBOURS = 16
ROWS_APART = 2.5
"""Angle between rows over that between columns, about, of common scanners; makes neighbours span several rows."""
LEVEL = 0.9
"""Least vertical part of the normal of ground."""
FLAT_M, FLAT_SHARE = 0.03, 0.003
"""Largest deviation from the plane, as a distance plus a share of the range."""
ALONG_M, ALONG_SHARE = 0.2, 0.01
"""The same along the beam."""
THINNEST = 0.02
"""Least width of the neighbours by their length: those of one row fix no plane."""


@dataclass(frozen=True)
class Surfaces:
    """What returns lie on.

    Attributes:
        kind: index into ``KINDS``.
        incidence: cosine of the angle between beam and normal, NaN where rough.
    """

    kind: Int64[np.ndarray, " n"]
    incidence: Float64[np.ndarray, " n"]

    def __getitem__(self, chosen: np.ndarray) -> Surfaces:
        return Surfaces(self.kind[chosen], self.incidence[chosen])

    @staticmethod
    def concatenate(parts: list[Surfaces]) -> Surfaces:
        """All returns one after the other."""
        return Surfaces(np.concatenate([p.kind for p in parts]), np.concatenate([p.incidence for p in parts]))


def surfaces_of(
    xyz_m: Float64[np.ndarray, "n 3"], up: Float64[np.ndarray, " 3"], actors: Bool[np.ndarray, " n"]
) -> Surfaces:
    """Surfaces of the returns of a sweep.

    Args:
        xyz_m: returns in the sensor's frame, as fired.
        up: the world's vertical in that frame.
        actors: returns in boxes of movable objects.
    """
    from scipy.spatial import cKDTree

    distance = np.linalg.norm(xyz_m, axis=1)
    kind, incidence = np.full(len(xyz_m), KINDS.index("rough")), np.full(len(xyz_m), np.nan)
    if len(xyz_m) > NEIGHBOURS:
        azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0])
        elevation = np.arctan2(xyz_m[:, 2], np.hypot(xyz_m[:, 0], xyz_m[:, 1]))
        # The small seam behind the car has neighbours on one side only.
        near = cKDTree(np.column_stack([azimuth, elevation / ROWS_APART])).query(
            np.column_stack([azimuth, elevation / ROWS_APART]), NEIGHBOURS
        )[1]
        offset = xyz_m[near] - xyz_m[near].mean(axis=1, keepdims=True)
        spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset) / NEIGHBOURS)
        spread = np.sqrt(np.maximum(spread, 0))
        normal = axes[:, :, 0]
        facing = np.abs(np.einsum("ni,ni->n", xyz_m, normal) / np.maximum(distance, 1e-9))
        flat = (spread[:, 0] < FLAT_M + FLAT_SHARE * distance) & (spread[:, 1] > THINNEST * spread[:, 2])
        # Scattered ranges along a bundle of beams resemble a plane seen from its edge.
        flat &= spread[:, 0] < (ALONG_M + ALONG_SHARE * distance) * facing
        level = np.abs(normal @ up) > LEVEL
        kind[flat] = np.where(level[flat], KINDS.index("ground"), KINDS.index("standing"))
        incidence[flat] = facing[flat]
    kind[actors] = KINDS.index("actors")
    return Surfaces(kind, incidence)
