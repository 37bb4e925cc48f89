"""Where a grid looks from during one exposure, as the kernels read it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim import geometry
from nurec_sim.render.cpu.blend.tiles import AFFINE, MOVING, ROLLING, TABLE
from nurec_sim.render.cpu.grid import PINHOLE, Grid
from nurec_sim.render.cpu.project.motion import motion_parameters
from nurec_sim.render.cpu.records import MACRO, view_parameters

GENTLE_TRAVEL_M = 0.03
GENTLE_TURN_RAD = 2e-3
"""Up to this motion over half a macro tile, a rolling shutter is rendered to first order about the tile's middle."""


@dataclass(frozen=True, eq=False)
class ExposureView:
    """A grid at its poses. The reference is the pose at ``grid.reference`` of the exposure.

    ``lines`` holds per line the rotation and translation of reference_from_line, then those of line_from_reference; a
    single line when nothing moves. A line's origin is ``place`` times the motion over the exposure.
    """

    grid: Grid
    world_from_reference: Float64[np.ndarray, "4 4"]
    world_from_line: Float64[np.ndarray, "l 4 4"]
    lines: Float32[np.ndarray, "l 24"]
    places: Float32[np.ndarray, " l"]
    motion: Float32[np.ndarray, " 8"]
    travel_m: float
    swing_rad: float
    ends_from_reference: Float64[np.ndarray, "2 4 4"]

    @classmethod
    def of(cls, grid: Grid, pair: Float64[np.ndarray, "2 4 4"]) -> ExposureView:
        """The view of a grid whose sensor moves from the first to the second pose."""
        pair = np.asarray(pair, np.float64)
        reference = geometry.interpolate_pose_pair(pair, np.array(grid.reference))
        # A sensor whose two poses are equal is rendered from one, which is faster and exact.
        still = len(grid.line_fraction) == 1 or np.array_equal(pair[0], pair[1])
        fractions = np.array([grid.reference]) if still else np.asarray(grid.line_fraction, np.float64)
        poses = reference[None] if still else geometry.interpolate_pose_pair(pair, fractions)
        reference_from_line = geometry.inverse(reference) @ poses
        line_from_reference = geometry.inverse(reference_from_line)
        parts = [m for pose in (reference_from_line, line_from_reference)
                 for m in (pose[:, :3, :3].reshape(-1, 9), pose[:, :3, 3])]  # fmt: skip
        places = fractions - grid.reference
        motion = np.zeros(8)
        if not still:
            turn = reference[:3, :3].T
            # Motion of the whole exposure in the reference frame: constant speed and turn rate between the two poses.
            motion[:3] = turn @ (pair[1, :3, 3] - pair[0, :3, 3])
            motion[3:6] = rotation_vector(turn @ (pair[1, :3, :3] @ pair[0, :3, :3].T) @ turn.T)
            motion[6:] = places[0], places[1] - places[0]
        # From the reference, the sensor gets at most this fraction of its motion away.
        far = float(np.abs(places).max())
        return cls(
            grid,
            reference,
            poses,
            np.concatenate(parts, axis=1).astype(np.float32),
            places.astype(np.float32),
            motion.astype(np.float32),
            float(np.linalg.norm(motion[:3])) * far,
            float(np.linalg.norm(motion[3:6])) * far,
            geometry.inverse(pair) @ reference,
        )

    @property
    def still(self) -> bool:
        """Whether all rays start from one pose."""
        return len(self.places) == 1

    @cached_property
    def projection_mode(self) -> int:
        """How the rays are weighed; see ``tiles``."""
        if self.still:
            return AFFINE if self.grid.kind == PINHOLE else TABLE
        if self.grid.kind != PINHOLE or self.grid.line_axis != 0:
            return MOVING
        # The error of the first order grows with the square of the motion within a tile, so it is judged per tile.
        over_half_a_tile = abs(float(self.motion[7])) * MACRO / 2
        travel, turn = (float(np.linalg.norm(self.motion[k : k + 3])) * over_half_a_tile for k in (0, 3))
        return ROLLING if travel <= GENTLE_TRAVEL_M and turn <= GENTLE_TURN_RAD else MOVING

    @cached_property
    def directions(self) -> Float32[np.ndarray, "h w 3"]:
        """Unit rays in the reference frame."""
        if self.still:
            return self.grid.direction
        return np.einsum("hwij,hwj->hwi", self.turns.reshape(-1, 3, 3)[self.grid.line], self.grid.direction)

    @cached_property
    def turns(self) -> Float32[np.ndarray, "l 9"]:
        """Rotation of each line into the reference frame."""
        return np.ascontiguousarray(self.lines[:, :9])

    @cached_property
    def ends(self) -> Float32[np.ndarray, "e 13"]:
        """Poses at the ends of a rolling exposure, places -0.5 and 0.5; none at one pose."""
        if self.still:
            return np.zeros((0, 13), np.float32)
        pose = self.ends_from_reference
        return np.concatenate([pose[:, :3, :3].reshape(2, 9), pose[:, :3, 3], [[-0.5], [0.5]]], axis=1).astype(
            np.float32
        )

    @cached_property
    def steps(self) -> Float32[np.ndarray, " 7"]:
        """See ``motion.motion_parameters``."""
        return motion_parameters(self.lines, self.grid.line_axis)

    @cached_property
    def parameters(self) -> Float32[np.ndarray, " 25"]:
        """See ``records.view_parameters``."""
        grid = self.grid
        height, width = grid.valid.shape
        return view_parameters(self.world_from_reference, grid.near_m, grid.by_range, self.travel_m, self.swing_rad,
                               grid.intrinsics.tolist(), (width, height))  # fmt: skip


def rotation_vector(rotation: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, " 3"]:
    """Axis times angle of a rotation by less than half a turn."""
    w, *xyz = geometry.quat_from_matrix(rotation)
    sine = np.linalg.norm(xyz)
    return np.asarray(xyz) * (2 * np.arctan2(sine, abs(w)) * np.sign(w or 1) / max(sine, 1e-300))
