"""The Gaussians of a scene as one table of values to optimise, and where they are at an instant."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64, Int32

from nurec_sim import geometry
from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct.optimize.adam import MEAN, OPACITY, QUAT, RGB, SCALE, VALUES, activate, adam_step
from nurec_sim.render.cpu.backward.frame import shared_workers
from nurec_sim.render.cpu.pack import morton_order
from nurec_sim.types import Gaussians, GaussianScene

OPACITIES = (0.005, 0.985)
"""A logit begins within these: outside of them its gradient is too small, or none (the renderer stops at 0.99)."""
NOWHERE = -1


@dataclass(frozen=True, eq=False)
class Drawn:
    """Gaussians at an instant in the world: what a frame renders, and how they were moved there (``adam_step``)."""

    mean_m: Float32[np.ndarray, "n 3"]
    quat_wxyz: Float32[np.ndarray, "n 4"]
    scale_m: Float32[np.ndarray, "n 3"]
    opacity: Float32[np.ndarray, " n"]
    rgb: Float32[np.ndarray, "n 3"]
    turns: Float64[np.ndarray, "t 4"]
    row_turn: Int32[np.ndarray, " n"]

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """What ``Frame.draw`` takes, colours last."""
        return self.mean_m, self.quat_wxyz, self.scale_m, self.opacity, self.rgb


class Parameters:
    """Values, moments and visits of all Gaussians of a scene: the static ones first, then the moving ones.

    Static Gaussians are kept in Morton order, so that neighbours in space are neighbours in memory. The mean of a
    rigid part of an actor is in its box; that of a Gaussian with knots is its middle knot, the others move along.

    Raises:
        ReconstructError: the scene has view-dependent colours.
    """

    def __init__(self, scene: GaussianScene) -> None:
        if scene.static.sh_rest is not None or scene.dynamic.gaussians.sh_rest is not None:
            raise ReconstructError(
                f"scene {scene.id!r} has view-dependent colours (spherical harmonics); "
                "only scenes with plain colours can be refined"
            )
        order = morton_order(scene.static.mean_m) if len(scene.static) else np.zeros(0, np.int64)
        self._scene = dataclasses.replace(scene, static=scene.static[order])
        self.static_count = len(order)
        everything = Gaussians.concatenate([self._scene.static, scene.dynamic.gaussians])
        self.values = _values(everything)
        count = len(everything)
        self.first, self.second = np.zeros((count, VALUES), np.float32), np.zeros((count, VALUES), np.float32)
        self.visits = np.zeros(count, np.int32)
        self._active = tuple(np.zeros((count, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (3,)))
        activate(np.arange(count, dtype=np.int32), self.values, *self._active)
        self._start_m = scene.dynamic.gaussians.mean_m.copy()

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.values)

    @cached_property
    def _rigid(self) -> np.ndarray:
        dynamic = self._scene.dynamic
        return np.zeros(len(dynamic), bool) if dynamic.in_box is None else dynamic.in_box

    def at(self, t_us: int) -> Drawn:
        """All Gaussians at an instant; the opacity of those that are not there is 0.

        The arrays are valid until the next call of ``at`` or ``step``.
        """
        mean, quat, scale, opacity, rgb = self._active
        dynamic, tracks, static = self._scene.dynamic, self._scene.tracks, self.static_count
        row_turn = np.full(len(self), NOWHERE, np.int32)
        turns = np.zeros((len(tracks), 4))
        if len(dynamic):
            values = self.values[static:].astype(np.float64)
            alive, knot_m, fade = dynamic.at(t_us)
            shown = np.zeros(len(dynamic))
            shown[alive] = fade
            place = values[:, MEAN : MEAN + 3].copy()
            free = ~self._rigid[alive]
            # The trajectory keeps its shape: the optimised middle knot shifts all knots alike.
            place[alive[free]] += knot_m[free] - self._start_m[alive[free]]
            turned = values[:, QUAT : QUAT + 4].copy()
            for index in np.unique(dynamic.track[self._rigid]):
                mine = np.flatnonzero(self._rigid & (dynamic.track == index))
                if not tracks[index].path.covers(t_us):
                    shown[mine] = 0
                    continue
                world_from_box = tracks[index].path.at(t_us)
                turns[index] = geometry.quat_from_matrix(world_from_box[:3, :3])
                place[mine] = geometry.transform_points(world_from_box, place[mine])
                turned[mine] = geometry.quat_multiply(np.broadcast_to(turns[index], (len(mine), 4)), turned[mine])
                row_turn[static + mine] = index
            mean[static:], quat[static:] = place, turned
            opacity[static:] = shown / (1 + np.exp(-values[:, OPACITY]))
        return Drawn(mean, quat, scale, opacity, rgb, turns, row_turn)

    def step(
        self,
        drawn: Drawn,
        rows: Int32[np.ndarray, " k"],
        gradients: tuple[np.ndarray, ...],
        rates: Float64[np.ndarray, " 14"],
        largest_m: float,
    ) -> None:
        """One step of Adam on the Gaussians ``rows`` that a frame has rendered.

        Args:
            drawn: what it has rendered.
            rows: which of them it shows.
            gradients: by the arrays of ``drawn``, see ``Frame.draw_back``.
            rates: learning rate of each value.
            largest_m: standard deviations end here.
        """
        workers = shared_workers(None)
        parts = [rows[low:high] for low, high in workers.ranges(len(rows), 4096)]
        workers.run(
            adam_step,
            [(part, self.values, self.first, self.second, self.visits, drawn.turns, drawn.row_turn, *gradients,
              drawn.scale_m, drawn.opacity, rates, largest_m) for part in parts],
        )  # fmt: skip
        workers.run(activate, [(part, self.values, *self._active) for part in parts])

    def scene(self) -> GaussianScene:
        """The scene with the present values."""
        everything, count = self.values, self.static_count
        dynamic = self._scene.dynamic
        moving = _with_values(dynamic.gaussians, everything[count:])
        shift = moving.mean_m - self._start_m
        return dataclasses.replace(
            self._scene,
            static=_with_values(self._scene.static, everything[:count]),
            dynamic=dataclasses.replace(dynamic, gaussians=moving, knot_m=dynamic.knot_m + shift[:, None]),
        )


def rate_columns(mean_m: float, quat: float, log_scale: float, logit_opacity: float, rgb: float) -> np.ndarray:
    """Learning rates per value, [14], in the order of ``adam.MEAN`` and the others.

    Args:
        mean_m: of means.
        quat: of quaternions.
        log_scale: of log standard deviations.
        logit_opacity: of opacity logits.
        rgb: of colours.
    """
    return np.repeat([mean_m, quat, log_scale, logit_opacity, rgb], [3, 4, 3, 1, 3]).astype(np.float64)


def _values(gaussians: Gaussians) -> Float32[np.ndarray, "n 14"]:
    values = np.zeros((len(gaussians), VALUES), np.float32)
    values[:, MEAN : MEAN + 3] = gaussians.mean_m
    norm = np.linalg.norm(gaussians.quat_wxyz, axis=1, keepdims=True)
    values[:, QUAT : QUAT + 4] = gaussians.quat_wxyz / np.maximum(norm, 1e-12)
    values[:, SCALE : SCALE + 3] = np.log(np.maximum(gaussians.scale_m, 1e-5))
    opacity = np.clip(gaussians.opacity.astype(np.float64), *OPACITIES)
    values[:, OPACITY] = np.log(opacity / (1 - opacity))
    values[:, RGB : RGB + 3] = gaussians.rgb
    return values


def _with_values(gaussians: Gaussians, values: Float32[np.ndarray, "n 14"]) -> Gaussians:
    """A layer with new values; quaternions have w >= 0, and normals turn with the Gaussians."""
    quat = values[:, QUAT : QUAT + 4].astype(np.float64)
    # q and -q are one rotation; layers hold the one with w >= 0.
    quat = np.where(quat[:, :1] < 0, -quat, quat)
    was = geometry.quat_normalize(gaussians.quat_wxyz.astype(np.float64))
    # q_new q_old^-1 (the conjugate of a unit quaternion) takes the old normal to the new one.
    turn = geometry.quat_multiply(quat, was * np.array([1.0, -1.0, -1.0, -1.0]))
    normal = np.einsum("nij,nj->ni", geometry.matrix_from_quat(turn), gaussians.normal.astype(np.float64))
    return dataclasses.replace(
        gaussians,
        mean_m=values[:, MEAN : MEAN + 3].copy(),
        quat_wxyz=quat.astype(np.float32),
        scale_m=np.exp(values[:, SCALE : SCALE + 3]),
        opacity=(1 / (1 + np.exp(-values[:, OPACITY].astype(np.float64)))).astype(np.float32),
        rgb=np.maximum(values[:, RGB : RGB + 3], 0),
        normal=normal.astype(np.float32),
    )
