"""Ego and actor boxes of a rollout seen from above: rounded outlines and the exact distance between them.

A rounded outline is a rectangle grown by a disk, so the gap between two of them is the distance between the two
rectangles minus both radii: no polygons, no tolerance. Shrink and rounding are AlpaSim's (docs/metrics.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim import geometry
from nurec_sim.types import Box, Rollout

SHRINK = 0.02
"""Relative shrinking of box length and width."""
ROUNDNESS = 0.5
"""Corner radius relative to half of the shorter side."""


@dataclass(frozen=True)
class BoxPath:
    """One upright box over time; poses are NaN while it is absent."""

    world_from_box: Float64[np.ndarray, "t 4 4"]
    size_m: tuple[float, float, float]

    @property
    def present(self) -> Bool[np.ndarray, " t"]:
        """Times at which the box has a pose."""
        return np.isfinite(self.world_from_box).all(axis=(1, 2))

    @property
    def length_width_m(self) -> tuple[float, float]:
        """Length and width after shrinking."""
        return self.size_m[0] * (1 - SHRINK), self.size_m[1] * (1 - SHRINK)

    @property
    def radius_m(self) -> float:
        """Corner radius."""
        return ROUNDNESS * min(self.length_width_m) / 2

    @property
    def core_m(self) -> tuple[float, float]:
        """Length and width of the rectangle that, grown by the radius, gives the rounded outline."""
        length, width = self.length_width_m
        return length - 2 * self.radius_m, width - 2 * self.radius_m

    def at(self, index: np.ndarray | slice | list[int]) -> BoxPath:
        """The box at selected times."""
        return BoxPath(self.world_from_box[index], self.size_m)


def body_boxes(world_from_rig: Float64[np.ndarray, "t 4 4"], body: Box) -> BoxPath:
    """The body of a car whose rig frame follows ``world_from_rig``; the box centre is off the rig's origin."""
    rig_from_box = geometry.pose(np.eye(3), np.asarray(body.center_m, np.float64))
    return BoxPath(np.asarray(world_from_rig, np.float64) @ rig_from_box, body.size_m)


def ego_boxes(rollout: Rollout) -> BoxPath:
    """The ego's body at every state."""
    return body_boxes(rollout.world_from_rig, rollout.rig.body)


def actor_boxes(rollout: Rollout) -> dict[str, BoxPath]:
    """Every actor's box at every state, in the order of the rollout.

    Raises:
        ValueError: an actor's poses are not one per state.
    """
    count = len(rollout.states)
    paths = {}
    for actor, poses in rollout.actors.items():
        poses = np.asarray(poses, np.float64)
        if poses.shape != (count, 4, 4):
            raise ValueError(f"actor '{actor}' has poses of shape {poses.shape}; the rollout has {count} states")
        paths[actor] = BoxPath(poses, rollout.actor_sizes_m[actor])
    return paths


def heights_overlap(a: BoxPath, b: BoxPath) -> Bool[np.ndarray, " t"]:
    """Whether the height intervals of two boxes overlap; excludes bridges above the road."""
    gap = np.abs(a.world_from_box[:, 2, 3] - b.world_from_box[:, 2, 3])
    return gap < (a.size_m[2] + b.size_m[2]) / 2


def outline_gap(a: BoxPath, b: BoxPath) -> Float64[np.ndarray, " t"]:
    """Distance between two rounded outlines seen from above, 0 when they touch or overlap, NaN while one is absent."""
    distance = rectangle_distance(a.world_from_box, a.core_m, b.world_from_box, b.core_m)
    return np.maximum(distance - a.radius_m - b.radius_m, 0.0)


def rectangle_distance(
    world_from_a: Float64[np.ndarray, "*n 4 4"],
    size_a_m: tuple[float, float],
    world_from_b: Float64[np.ndarray, "*n 4 4"],
    size_b_m: tuple[float, float],
) -> Float64[np.ndarray, "*n"]:
    """Distance between upright rectangles (length, width) in the plane, 0 when they overlap.

    Disjoint convex polygons are closest at a corner of one of them, and rectangles are disjoint if and only if an axis
    of one of them separates them (separating axis theorem).

    Args:
        world_from_a: poses of the centres of A; only x, y and yaw are used.
        size_a_m: length and width of A.
        world_from_b: poses of the centres of B.
        size_b_m: length and width of B.

    Returns:
        metres; NaN where a pose is NaN.
    """
    distance_a, apart_a = _corners_to_rectangle(world_from_a, size_a_m, world_from_b, size_b_m)
    distance_b, apart_b = _corners_to_rectangle(world_from_b, size_b_m, world_from_a, size_a_m)
    distance = np.minimum(distance_a, distance_b)
    # Corners may all lie outside although the rectangles overlap (a cross), hence the test for a separating axis.
    return np.where(np.isnan(distance) | apart_a | apart_b, distance, 0.0)


def _corners_to_rectangle(world_from_a, size_a_m, world_from_b, size_b_m):
    """Least distance from A's corners to rectangle B, and whether an axis of B separates the two."""
    corners = geometry.box_corners_xy(world_from_a, *size_a_m)
    yaw = geometry.yaw_of(world_from_b)[..., None]
    offset = corners - np.asarray(world_from_b)[..., None, :2, 3]
    along = offset[..., 0] * np.cos(yaw) + offset[..., 1] * np.sin(yaw)
    across = offset[..., 1] * np.cos(yaw) - offset[..., 0] * np.sin(yaw)
    half_length, half_width = size_b_m[0] / 2, size_b_m[1] / 2
    # Distance from a point to an axis-aligned rectangle in its own frame: excess over the half extents, per axis.
    outside = np.hypot(np.maximum(np.abs(along) - half_length, 0), np.maximum(np.abs(across) - half_width, 0))
    apart = (along.min(-1) > half_length) | (along.max(-1) < -half_length)
    apart |= (across.min(-1) > half_width) | (across.max(-1) < -half_width)
    return outside.min(axis=-1), apart
