"""Small corrections of camera poses: a turn and a shift per image, and an offset in time per camera, with priors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from nurec_sim.reconstruct.optimize.adam import RowAdam
from nurec_sim.reconstruct.optimize.settings import PosePriors
from nurec_sim.reconstruct.optimize.views import TrainingView


class PoseCorrections:
    """Turns (rotation vectors) and shifts in the world about each image's camera, and time offsets of the cameras.

    Args:
        views: the images.
        priors: standard deviations of what may be wrong.
    """

    def __init__(self, views: Sequence[TrainingView], priors: PosePriors) -> None:
        self._views, self._priors = views, priors
        self._names = sorted({view.camera.id for view in views})
        self._camera = [self._names.index(view.camera.id) for view in views]
        self._sigma = np.repeat([np.radians(priors.turn_deg), priors.shift_m], 3)
        self._speed = _speeds(views)
        # In standard deviations.
        self.values, self.offsets = np.zeros((len(views), 6)), np.zeros((len(self._names), 1))
        self.adam, self.offset_adam = RowAdam(self.values.shape), RowAdam(self.offsets.shape)

    def of(self, number: int) -> Float64[np.ndarray, " 6"]:
        """An image's correction: rotation vector (rad) and shift (m) in the world, the clock's part among them."""
        offset_s = self.offsets[self._camera[number], 0] * self._priors.time_s
        return self.values[number] * self._sigma + self._speed[number] * offset_s

    def pair(self, number: int) -> Float64[np.ndarray, "2 4 4"]:
        """Corrected poses of an image at the start and the end of its exposure."""
        poses, change = self._views[number].world_from_camera.copy(), self.of(number)
        poses[:, :3, :3] = Rotation.from_rotvec(change[:3]).as_matrix() @ poses[:, :3, :3]
        poses[:, :3, 3] += change[3:]
        return poses

    def step(
        self, number: int, pose: Float64[np.ndarray, "4 4"], by_pose: Float64[np.ndarray, "4 4"], rate: float
    ) -> None:
        """One step of Adam on an image's correction and on its camera's offset.

        Args:
            number: of the image.
            pose: as rendered, at the reference instant.
            by_pose: gradient of the loss by its matrix, see ``frame.pose_gradient``.
            rate: fraction of the learning rates at the start.
        """
        # A turn w changes R by [w] R, so the torque is what is antisymmetric in gradient R^T.
        around = by_pose[:3, :3] @ pose[:3, :3].T
        torque = [around[2, 1] - around[1, 2], around[0, 2] - around[2, 0], around[1, 0] - around[0, 1]]
        gradient = np.concatenate([torque, by_pose[:3, 3]])
        camera, weight = self._camera[number], 2 * self._priors.weight
        by_offset = self._priors.time_s * (self._speed[number] @ gradient) + weight * self.offsets[camera]
        by_values = self._sigma * gradient + weight * self.values[number]
        # Adam's first steps have this size whatever the gradient: in standard deviations.
        self.offset_adam.step(camera, self.offsets, by_offset, 0.02 * rate)
        self.adam.step(number, self.values, by_values, 0.1 * rate)

    def report(self) -> dict[str, Any]:
        """Corrections in plain JSON, per camera: time offset, and size of turns and shifts."""
        found = {}
        for camera, name in enumerate(self._names):
            mine = (self.values * self._sigma)[np.array(self._camera) == camera]
            turn, shift = np.degrees(np.linalg.norm(mine[:, :3], axis=1)), np.linalg.norm(mine[:, 3:], axis=1)
            found[name] = {
                "time_offset_ms": round(float(self.offsets[camera, 0]) * self._priors.time_s * 1e3, 3),
                "median_turn_deg": round(float(np.median(turn)), 4),
                "largest_turn_deg": round(float(turn.max()), 4),
                "median_shift_m": round(float(np.median(shift)), 4),
                "largest_shift_m": round(float(shift.max()), 4),
            }
        return found


def _speeds(views: Sequence[TrainingView]) -> Float64[np.ndarray, "n 6"]:
    """Turn rates (rad/s) and velocities (m/s) in the world of each image's camera, between the images beside it."""
    speeds = np.zeros((len(views), 6))
    for name in {view.camera.id for view in views}:
        mine = sorted((view.t_us, number) for number, view in enumerate(views) if view.camera.id == name)
        for place, (_, number) in enumerate(mine):
            (before_us, before), (after_us, after) = mine[max(place - 1, 0)], mine[min(place + 1, len(mine) - 1)]
            if after_us > before_us:
                old, new = (views[k].world_from_camera[0] for k in (before, after))
                turn = Rotation.from_matrix(new[:3, :3] @ old[:3, :3].T).as_rotvec()
                speeds[number] = np.concatenate([turn, new[:3, 3] - old[:3, 3]]) / ((after_us - before_us) / 1e6)
    return speeds
