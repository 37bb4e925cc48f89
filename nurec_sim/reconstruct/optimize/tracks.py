"""Small corrections of the tracks of rigid actors: a turn about the vertical and a shift, over time, with priors.

Labels of moving objects are off by centimetres to decimetres, another way in every frame: an actor whose parts were
gathered along its track is blurred, and its images do not fit each other. A correction is in the frame of the box and
linear between knots in time. What is the same at all knots would only move the box against its actor, so in the end it
goes to the actor's Gaussians; actors that stand are not corrected.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.optimize.adam import RowAdam
from nurec_sim.reconstruct.optimize.settings import TrackPriors
from nurec_sim.scene.transform import transformed
from nurec_sim.types import GaussianScene, Trajectory

KNOT_US = 500_000
MOVED_M = 0.5
"""A track that moves less than this is not corrected."""
RATE = 0.1
"""Adam's first steps have this size, in standard deviations of the priors."""


class TrackCorrections:
    """Corrections of a scene's tracks that move and that rigid Gaussians belong to.

    Args:
        scene: as the optimisation starts.
        priors: standard deviations of what may be wrong.
    """

    def __init__(self, scene: GaussianScene, priors: TrackPriors) -> None:
        self._tracks, self._priors = scene.tracks, priors
        self._sigma = np.array([np.radians(priors.turn_deg), *[priors.shift_m] * 3])
        dynamic = scene.dynamic
        rigid = dynamic.track[:0] if dynamic.in_box is None else np.unique(dynamic.track[dynamic.in_box])
        self._first: dict[int, int] = {}
        """First row of each corrected track."""
        rows = 0
        for index in rigid.tolist():
            path = scene.tracks[index].path
            if np.ptp(path.position_m, axis=0).max() >= MOVED_M:
                self._first[index] = rows
                rows += self._knots(index)
        # In standard deviations: turn, then shift along the axes of the box.
        self.values = np.zeros((rows, 4))
        self.adam = RowAdam(self.values.shape)

    def _knots(self, index: int) -> int:
        path = self._tracks[index].path
        return max(2, 1 + round((path.end_us - path.start_us) / KNOT_US))

    def _weights(self, index: int, t_us: int) -> list[tuple[int, float]]:
        """Rows of the knots around an instant, and their weights."""
        path, last = self._tracks[index].path, self._knots(index) - 1
        place = np.clip((t_us - path.start_us) / max(path.end_us - path.start_us, 1), 0, 1) * last
        before = min(int(place), last - 1)
        row = self._first[index] + before
        return [(row, 1 - (place - before)), (row + 1, place - before)]

    def pose(self, index: int, t_us: int) -> Float64[np.ndarray, "4 4"]:
        """world_from_box of a track at an instant, corrected."""
        return self._corrected(index, t_us, self.values)

    def _corrected(self, index: int, t_us: int, values: Float64[np.ndarray, "rows 4"]) -> Float64[np.ndarray, "4 4"]:
        pose = self._tracks[index].path.at(t_us)
        if index not in self._first:
            return pose
        return pose @ self._change(sum(weight * values[row] for row, weight in self._weights(index, t_us)))

    def _change(self, values: Float64[np.ndarray, " 4"]) -> Float64[np.ndarray, "4 4"]:
        turn, *shift = values * self._sigma
        change = geometry.pose_from_xyyaw(0.0, 0.0, turn)
        change[:3, 3] = shift
        return change

    def step(
        self, t_us: int, poses: Float64[np.ndarray, "t 4 4"], wrench: Float64[np.ndarray, "t 6"], rate: float
    ) -> None:
        """One step of Adam on the knots around an instant, of the tracks that an image shows.

        Args:
            t_us: the instant.
            poses: world_from_box of all tracks, as rendered.
            wrench: gradients of the loss by a turn about the axes of the world through the centre of each track's box,
                and by a shift (``wrenches``).
            rate: fraction of the learning rate at the start.
        """
        for index in self._first:
            if not wrench[index].any():
                continue
            turn = poses[index, :3, :3]
            gradient = self._sigma * np.concatenate([[wrench[index, :3] @ turn[:, 2]], wrench[index, 3:] @ turn])
            for row, weight in self._weights(index, t_us):
                if weight > 0:
                    prior = 2 * self._priors.weight * self.values[row]
                    self.adam.step(row, self.values, weight * gradient + prior, RATE * rate)

    def applied(self, scene: GaussianScene) -> GaussianScene:
        """A scene with corrected tracks, at the times that these have poses for.

        The mean of the knots that images have shown moves the actor's Gaussians in their box, and leaves the box; so
        the box keeps its label at knots that none has shown.
        """
        dynamic, tracks, values = scene.dynamic, list(scene.tracks), self.values.copy()
        gaussians, knot_m = dynamic.gaussians, dynamic.knot_m.copy()
        arrays = {name: getattr(gaussians, name).copy() for name in ("mean_m", "quat_wxyz", "normal")}
        for index, first in self._first.items():
            knots = slice(first, first + self._knots(index))
            shown = self.adam.visits[knots] > 0
            if not shown.any():
                continue
            mean = values[knots][shown].mean(axis=0)
            values[knots][~shown] = mean
            path, change = tracks[index].path, self._change(mean)
            poses = np.stack([self._corrected(index, t_us, values) for t_us in path.t_us.tolist()])
            tracks[index] = dataclasses.replace(
                tracks[index], path=Trajectory(path.t_us, poses @ geometry.inverse(change))
            )
            rows = np.flatnonzero((dynamic.track == index) & dynamic.in_box)
            moved = transformed(gaussians[rows], change)
            for name, array in arrays.items():
                array[rows] = getattr(moved, name)
            knot_m[rows] = moved.mean_m[:, None]
        dynamic = dataclasses.replace(dynamic, gaussians=dataclasses.replace(gaussians, **arrays), knot_m=knot_m)
        return dataclasses.replace(scene, dynamic=dynamic, tracks=tuple(tracks))

    def report(self) -> dict[str, Any]:
        """Sizes of the corrections in plain JSON, of the knots that images have shown."""
        sizes = self.values[self.adam.visits > 0] * self._sigma
        shift, turn = np.linalg.norm(sizes[:, 1:], axis=1), np.degrees(np.abs(sizes[:, 0]))
        return {
            "tracks": len(self._first),
            "median_shift_m": round(float(np.median(shift)), 4) if len(shift) else 0.0,
            "largest_shift_m": round(float(shift.max(initial=0)), 4),
            "median_turn_deg": round(float(np.median(turn)), 4) if len(turn) else 0.0,
            "largest_turn_deg": round(float(turn.max(initial=0)), 4),
        }


@kernel
def wrenches(rows, row_turn, poses, mean, quat, by_mean, by_quat, sums):
    """Gradients by a turn and a shift of each track, from those of its Gaussians.

    Moved by s and turned by w about c, a mean x becomes x + s + w x (x - c), a quaternion q becomes q + (0, w) q / 2.

    Args:
        rows: [k] Gaussians that an image shows.
        row_turn: [n] which of ``poses`` moves a Gaussian; -1 none.
        poses: [t,4,4] world_from_box.
        mean: [n,3] in the world.
        quat: [n,4] in the world.
        by_mean: [n,3] gradient.
        by_quat: [n,4] gradient.
        sums: [t,6] output, added to.
    """
    for row in range(len(rows)):
        i = rows[row]
        t = row_turn[i]
        if t < 0:
            continue
        x, y, z = mean[i, 0] - poses[t, 0, 3], mean[i, 1] - poses[t, 1, 3], mean[i, 2] - poses[t, 2, 3]
        a, b, c = by_mean[i, 0], by_mean[i, 1], by_mean[i, 2]
        w, p, q, r = quat[i, 0], quat[i, 1], quat[i, 2], quat[i, 3]
        gw, gp, gq, gr = by_quat[i, 0], by_quat[i, 1], by_quat[i, 2], by_quat[i, 3]
        sums[t, 0] += y * c - z * b + 0.5 * (-p * gw + w * gp - r * gq + q * gr)
        sums[t, 1] += z * a - x * c + 0.5 * (-q * gw + r * gp + w * gq - p * gr)
        sums[t, 2] += x * b - y * a + 0.5 * (-r * gw - q * gp + p * gq + w * gr)
        sums[t, 3] += a
        sums[t, 4] += b
        sums[t, 5] += c
