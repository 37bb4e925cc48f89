"""Terrain as a sum of long waves, smooth enough to place cars on tangent planes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from nurec_sim.world.plan.parts import plan_part


@plan_part
class Wave:
    """One sine: its height, its length, the direction in which it runs, and its phase at the origin."""

    amplitude_m: float
    length_m: float
    direction_rad: float
    phase_rad: float


@plan_part
class Terrain:
    """Height over the plane z = 0 as a sum of waves; without waves the ground is flat."""

    waves: tuple[Wave, ...] = ()

    def height_m(self, xy: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n"]:
        """Height of the ground (the road surface; sidewalks and grass lie a kerb higher)."""
        xy = np.asarray(xy, np.float64)
        height = np.zeros(xy.shape[:-1])
        for wave in self.waves:
            height += wave.amplitude_m * np.sin(self._phase(wave, xy))
        return height

    def gradient(self, xy: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """Rise per metre towards x and towards y."""
        xy = np.asarray(xy, np.float64)
        gradient = np.zeros_like(xy)
        for wave in self.waves:
            # The derivative of A sin(2 pi s / L) along the wave's direction.
            steep = wave.amplitude_m * 2 * np.pi / wave.length_m * np.cos(self._phase(wave, xy))
            gradient += steep[..., None] * np.array([np.cos(wave.direction_rad), np.sin(wave.direction_rad)])
        return gradient

    def poses(
        self,
        xy: Float64[np.ndarray, "n 2"],
        yaw_rad: Float64[np.ndarray, " n"],
        above_m: Float64[np.ndarray, " n"],
        *,
        upright: bool = False,
    ) -> Float64[np.ndarray, "n 4 4"]:
        """Poses of bodies on the ground.

        Args:
            xy: points on the ground.
            yaw_rad: heading, seen from above.
            above_m: how far the body's origin lies above its ground point, along the body's own z axis.
            upright: z axis straight up instead of square to the ground (people).
        """
        xy, yaw_rad = np.asarray(xy, np.float64), np.asarray(yaw_rad, np.float64)
        slope = np.zeros_like(xy) if upright else self.gradient(xy)
        heading = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=1)
        # forward rises with the slope along the heading, up = (-slope, 1) is square to the ground and thus to forward.
        forward = np.concatenate([heading, (slope * heading).sum(axis=1, keepdims=True)], axis=1)
        up = np.concatenate([-slope, np.ones((len(xy), 1))], axis=1)
        forward /= np.linalg.norm(forward, axis=1, keepdims=True)
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        pose = np.tile(np.eye(4), (len(xy), 1, 1))
        pose[:, :3, 0], pose[:, :3, 1], pose[:, :3, 2] = forward, np.cross(up, forward), up
        pose[:, :2, 3], pose[:, 2, 3] = xy, self.height_m(xy)
        pose[:, :3, 3] += up * np.asarray(above_m, np.float64)[:, None]
        return pose

    @staticmethod
    def _phase(wave: Wave, xy: np.ndarray) -> np.ndarray:
        along = xy[..., 0] * np.cos(wave.direction_rad) + xy[..., 1] * np.sin(wave.direction_rad)
        return 2 * np.pi * along / wave.length_m + wave.phase_rad


FLAT = Terrain()
"""The plane z = 0."""
