"""The Gaussians of a scene as one table of values to optimise, and where they are at an instant."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from nurec_sim import geometry
from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct.optimize.adam import MEAN, OPACITY, QUAT, RGB, SCALE, VALUES, adam_step, bias_corrections
from nurec_sim.reconstruct.optimize.placing import place_moving, place_static
from nurec_sim.reconstruct.optimize.tracks import wrenches
from nurec_sim.render.cpu.backward.frame import shared_workers, zeros_by_gaussian
from nurec_sim.render.cpu.backward.repack import RawGaussians
from nurec_sim.render.cpu.pack import BLOCK, FIELDS, LOG_OPACITY, morton_order, to_blocks
from nurec_sim.types import Gaussians, GaussianScene

OPACITIES = (0.005, 0.985)
"""A logit begins within these: outside of them its gradient is too small, or none (the renderer stops at 0.99)."""
FLAT = 0.5
"""A Gaussian that is thinner than this share of its middle standard deviation is a disc, which lies on a surface."""
NOWHERE = -1


@dataclass(frozen=True, eq=False)
class Drawn:
    """Gaussians at an instant in the world: what a frame renders, and how they were moved there (``adam_step``)."""

    world: RawGaussians
    packed: Float32[np.ndarray, "blocks 21 256"]
    turns: Float64[np.ndarray, "t 4"]
    poses: Float64[np.ndarray, "t 4 4"]


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
        self._thickest, self._start = _thickest(self.values), self.values.copy()
        self.first, self.second = np.zeros((count, VALUES), np.float32), np.zeros((count, VALUES), np.float32)
        self.visits = np.zeros(count, np.int32)
        self._corrections = bias_corrections()
        self._world, self.gradients = zeros_by_gaussian(count), zeros_by_gaussian(count)
        self._packed = to_blocks(np.zeros((0, FIELDS), np.float32), -(-count // BLOCK), fill=LOG_OPACITY)
        self.values_changed()
        dynamic = scene.dynamic
        self._start_m = dynamic.gaussians.mean_m.copy()
        self._rigid = np.zeros(len(dynamic), bool) if dynamic.in_box is None else dynamic.in_box
        self._row_turn = np.full(count, NOWHERE, np.int32)
        self._row_turn[self.static_count :][self._rigid] = dynamic.track[self._rigid]

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.values)

    def at(self, t_us: int, pose: Callable[[int, int], np.ndarray] | None = None) -> Drawn:
        """All Gaussians at an instant; the opacity of those that are not there is 0.

        The arrays are valid until the next call of ``at`` or ``step``.

        Args:
            t_us: the instant.
            pose: gives world_from_box of a track, by its index, at an instant; None: by its path.
        """
        dynamic, tracks, static = self._scene.dynamic, self._scene.tracks, self.static_count
        turns, poses, covered = np.zeros((len(tracks), 4)), np.zeros((len(tracks), 4, 4)), np.zeros(len(tracks), bool)
        if len(dynamic):
            for index in np.unique(dynamic.track[self._rigid]):
                covered[index] = tracks[index].path.covers(t_us)
                if covered[index]:
                    poses[index] = tracks[index].path.at(t_us) if pose is None else pose(index, t_us)
                    turns[index] = geometry.quat_from_matrix(poses[index, :3, :3])
            fade, shift = np.zeros(len(dynamic), np.float32), np.zeros((len(dynamic), 3))
            fade[self._rigid] = covered[dynamic.track[self._rigid]]
            if not self._rigid.all():
                alive, knot_m, faded = dynamic.at(t_us)
                free = ~self._rigid[alive]
                # The trajectory keeps its shape: the optimised middle knot shifts all knots alike.
                shift[alive[free]] = knot_m[free] - self._start_m[alive[free]]
                fade[alive[free]] = faded[free]
            moving = np.arange(static, len(self), dtype=np.int32)
            self._parts(
                place_moving, moving,
                (static, self.values, poses, turns, self._row_turn, shift, fade, self._world, self._packed),
            )  # fmt: skip
        return Drawn(self._world, self._packed, turns, poses)

    def step(
        self,
        drawn: Drawn,
        rows: Int32[np.ndarray, " k"],
        rates: Float64[np.ndarray, " 14"],
        largest_m: float,
        opacity: float = 0.0,
        scale: float = 0.0,
        keep: Float64[np.ndarray, " 14"] | None = None,
        images_per_step: float = 1.0,
    ) -> None:
        """One step of Adam on the Gaussians ``rows`` that a frame has rendered, by ``gradients``, which end as 0.

        Args:
            drawn: what it has rendered.
            rows: which of them it shows.
            rates: learning rate of each value.
            largest_m: standard deviations end here.
            opacity: weight of their mean opacity in the loss.
            scale: weight of their mean sum of standard deviations (m) in the loss.
            keep: how strongly each value is held near the start (``adam_step``); None: not at all.
            images_per_step: number of images fitted divided by that of the steps so far, with this one.
        """
        kept = np.zeros(VALUES) if keep is None else keep
        pulls = np.array([opacity, scale], np.float32) / max(len(rows), 1)
        self._parts(
            adam_step, rows,
            (self.values, self.first, self.second, self.visits, self._corrections, drawn.turns, self._row_turn,
             self.gradients, drawn.world.scale, drawn.world.opacity, rates.astype(np.float32), pulls, largest_m,
             self._thickest, self._start, kept.astype(np.float32), np.float32(images_per_step)),
        )  # fmt: skip
        self._place(rows[rows < self.static_count])

    def wrenches(self, drawn: Drawn, rows: Int32[np.ndarray, " k"]) -> Float64[np.ndarray, "t 6"]:
        """Gradients by a turn and a shift of each track (``tracks.wrenches``), from ``gradients`` of some Gaussians."""
        sums, world, by = np.zeros((len(drawn.poses), 6)), drawn.world, self.gradients
        moving = rows[rows >= self.static_count]
        wrenches(moving, self._row_turn, drawn.poses, world.mean, world.quat, by.mean, by.quat, sums)
        return sums

    def values_changed(self) -> None:
        """To be called after ``values`` were written from outside."""
        self._place(np.arange(self.static_count, dtype=np.int32))

    def _place(self, rows: Int32[np.ndarray, " k"]) -> None:
        self._parts(place_static, rows, (self.values, self._world, self._packed))

    @staticmethod
    def _parts(kernel: Callable, rows: Int32[np.ndarray, " k"], arguments: tuple) -> None:
        """Run a kernel on some rows, in parts."""
        workers = shared_workers(None)
        workers.run(kernel, [(rows[low:high], *arguments) for low, high in workers.ranges(len(rows), 4096)])

    def static_gaussians(self, rows: Int64[np.ndarray, " k"]) -> Gaussians:
        """Some static Gaussians with their present values."""
        return _with_values(self._scene.static[rows], self.values[rows])

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


def per_value(mean: float, turn: float, log_scale: float, logit_opacity: float, rgb: float) -> np.ndarray:
    """A number for each of a Gaussian's values, [14], in the order of ``adam.MEAN`` and the others.

    Args:
        mean: of its mean.
        turn: of its rotation.
        log_scale: of its log standard deviations.
        logit_opacity: of the logit of its opacity.
        rgb: of its colour.
    """
    return np.repeat([mean, turn, log_scale, logit_opacity, rgb], [3, 4, 3, 1, 3]).astype(np.float64)


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


def _thickest(values: Float32[np.ndarray, "n 14"]) -> Float32[np.ndarray, "n 3"]:
    """Logs of the largest standard deviations: discs must not grow thicker, all other axes are free (infinity).

    A thick disc stops beams before its surface. The images do not need it: they see discs from the front.
    """
    log_scale = values[:, SCALE : SCALE + 3]
    thinnest, middle = np.sort(log_scale, axis=1)[:, :2].T
    rows = np.flatnonzero(thinnest < middle + np.log(FLAT))
    axis = log_scale[rows].argmin(axis=1)
    thickest = np.full(log_scale.shape, np.inf, np.float32)
    thickest[rows, axis] = log_scale[rows, axis]
    return thickest


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
