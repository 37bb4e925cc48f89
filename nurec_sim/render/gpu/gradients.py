"""Differentiable rendering for torch on a GPU: ``render.cpu.backward.gradients`` for several sensors in one launch.

Gradients reach means, rotations, scales, opacities, colours and intensities, and poses of sensors. What switches a hit
on or off has none: the cut at 1/255, the near plane, the end of a ray at 1e-4, the cap of the opacity at 0.99, and
which Gaussian stops the second half of a beam.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from nurec_sim import geometry
from nurec_sim.errors import RequestError
from nurec_sim.render import torch_maths
from nurec_sim.render.cpu.backward.gradients import CameraImages, GaussianTensors, LidarImages
from nurec_sim.render.cpu.grid import make_grid
from nurec_sim.render.cpu.pack import BLOCK, MAX_OPACITY, MIN_SCALE_M
from nurec_sim.render.cpu.view import rotation_vector
from nurec_sim.render.gpu.batch import Batch, make_batch
from nurec_sim.render.gpu.launcher import CudaLauncher, Launcher
from nurec_sim.render.gpu.pipeline import ALPHA, DISTANCE, HALF, Blocks, Drawn, Room, Rooms, draw, draw_backward
from nurec_sim.render.gpu.sky_lookup import sky_colour
from nurec_sim.render.gpu.tensors import blocks_of
from nurec_sim.render.gpu.views import GridTensors, view_rows
from nurec_sim.render.spec import MIN_ALPHA, SURFACE_ALPHA
from nurec_sim.types import CameraModel, LidarModel

DIFFERENTIABLE = 6
"""The first planes: features, distance, alpha, half."""


class DifferentiableRenderer:
    """Renders Gaussians for a set of sensors, with gradients.

    Args:
        sensors: cameras, or LiDARs; all of them are rendered in one launch.
        device: a CUDA device, or a ``Launcher``.

    Raises:
        GpuError: there is no such device, or the extra ``gpu`` is missing.
        RequestError: there are no sensors, or both cameras and LiDARs, which sum different features.
    """

    def __init__(self, sensors: Sequence[CameraModel] | Sequence[LidarModel], device: str | Launcher = "cuda") -> None:
        if len({type(sensor) for sensor in sensors}) != 1:
            raise RequestError("give cameras, or LiDARs, at least one, but not both")
        self._launcher: Launcher = CudaLauncher(device) if isinstance(device, str) else device
        self.device = self._launcher.device
        self._grids = [GridTensors.of(make_grid(sensor), self.device) for sensor in sensors]
        self._lidar = isinstance(sensors[0], LidarModel)
        self._rooms = Rooms()
        self._no_sky = torch.zeros((6, 1, 1, 3), device=self.device)

    def render(
        self,
        gaussians: GaussianTensors,
        world_from_sensor: Sequence[Float[Tensor, "4 4"] | Float[Tensor, "2 4 4"]],
        sky: Float[Tensor, "6 s s 3"] | Float[Tensor, " 3"] | None = None,
    ) -> list[CameraImages] | list[LidarImages]:
        """What each sensor sees; the same as ``render.cpu.backward.gradients``.

        Args:
            gaussians: the world, on this device. Colours that depend on the view are evaluated for the first sensor's
                eye, so all sensors must be in one place where there are any.
            world_from_sensor: per sensor one pose, or those at the start and the end of its exposure.
            sky: cubemap or a single colour behind the Gaussians; black if None. Not for LiDARs.

        Raises:
            RequestError: a pose is malformed.
        """
        references, pairs = zip(
            *(_poses(poses, grid.grid.reference) for poses, grid in zip(world_from_sensor, self._grids, strict=True)),
            strict=True,
        )
        rows = view_rows(self._grids)
        rows["sky"], rows["sky_size"] = self._no_sky.data_ptr(), 1
        views, poses = (self._launcher.upload(array) for array in (rows.view(np.uint8), np.array(pairs)))
        batch = make_batch(self._launcher, self._grids, rows, views, poses, self._no_sky)
        planes = _Blend.apply(
            self._launcher, batch, self._rooms, gaussians.mean_m, gaussians.quat_wxyz, gaussians.scale_m,
            gaussians.opacity, self._features(gaussians, references[0]), *references,
        )  # fmt: skip
        parts = [planes[:, batch.first_ray[k] : batch.first_ray[k + 1]] for k in range(batch.view_count)]
        if self._lidar:
            return [_sweep(part, grid) for part, grid in zip(parts, self._grids, strict=True)]
        return [
            _image(part, grid, reference, pair, sky)
            for part, grid, reference, pair in zip(parts, self._grids, references, pairs, strict=True)
        ]

    def _features(self, gaussians: GaussianTensors, reference: Float64[Tensor, "4 4"]) -> Float[Tensor, "n 3"]:
        """Colours, or intensity, whether it is known, and the probability of a drop."""
        if self._lidar:
            value = gaussians.intensity
            if value is None:
                value = torch.full_like(gaussians.opacity, torch.nan)
            known = torch.isfinite(value)
            drop = torch.zeros_like(value) if gaussians.ray_drop is None else gaussians.ray_drop
            return torch.stack([torch.where(known, value, 0), known.to(value.dtype), drop], dim=-1)
        if gaussians.sh_rest is None:
            return gaussians.rgb
        offset = gaussians.mean_m.double() - reference[:3, 3].to(self.device)
        return torch_maths.view_colour(gaussians.rgb, gaussians.sh_rest, offset.to(gaussians.rgb.dtype))


def _image(
    planes: Tensor, tensors: GridTensors, reference: Tensor, pair: Float64[np.ndarray, "2 4 4"], sky: Tensor | None
) -> CameraImages:
    shape = tensors.grid.valid.shape
    features, distance, alpha = planes[:3], planes[DISTANCE].reshape(shape), planes[ALPHA].reshape(shape)
    rgb = features.reshape(3, *shape).permute(1, 2, 0)
    if sky is not None:
        direction, instant = tensors.rays[..., :3], tensors.rays[..., 3:]
        swing = torch.as_tensor(rotation_vector(pair[0, :3, :3].T @ pair[1, :3, :3]), device=planes.device)
        # A moving sensor's rays turn about the sensor's own axes before the reference pose applies.
        turned = _turned(direction.double(), instant.double() * swing) @ reference[:3, :3].T.to(planes.device)
        behind = sky if sky.ndim == 1 else sky_colour(sky, turned.to(sky.dtype))
        lit = (direction != 0).any(dim=-1)
        rgb = rgb + (lit * (1 - alpha))[..., None] * behind.to(rgb.dtype)
    depth = (distance / alpha.clamp(min=MIN_ALPHA) * tensors.rays[..., 2]).clamp(min=0)
    return CameraImages(rgb, torch.where(alpha >= SURFACE_ALPHA, depth, 0), alpha)


def _sweep(planes: Tensor, tensors: GridTensors) -> LidarImages:
    cell_of_beam = torch.argsort(tensors.beam.reshape(-1))
    # From grid cells, whose rows may be rolled, to beams.
    planes = planes[:, cell_of_beam].reshape(DIFFERENTIABLE, *tensors.grid.valid.shape)
    half, alpha = planes[HALF], planes[ALPHA]
    mean = planes[DISTANCE] / alpha.clamp(min=MIN_ALPHA)
    intensity, lost = planes[0] / planes[1].clamp(min=1e-12), planes[2] / alpha.clamp(min=MIN_ALPHA)
    return LidarImages(torch.where(half > 0, half, mean), mean, intensity, alpha, lost)


def _turned(vectors: Float64[Tensor, "h w 3"], rotation: Float64[Tensor, "h w 3"]) -> Float64[Tensor, "h w 3"]:
    """Vectors turned by rotation vectors."""
    angle = rotation.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    axis = rotation / angle
    across = torch.linalg.cross(axis, vectors)
    return vectors + angle.sin() * across + (1 - angle.cos()) * torch.linalg.cross(axis, across)


def _poses(poses: Tensor, fraction: float) -> tuple[Float64[Tensor, "4 4"], Float64[np.ndarray, "2 4 4"]]:
    """The reference pose, which carries gradients, and the plain pair of poses."""
    if poses.shape not in ((4, 4), (2, 4, 4)):
        raise RequestError(f"a sensor needs one pose [4,4] or two [2,4,4], got {list(poses.shape)}")
    both = poses.double().cpu().expand(2, 4, 4)
    pair = both.detach().numpy().copy()
    for pose in pair:
        if not np.isfinite(pose).all() or not geometry.is_rotation(pose[:3, :3]):
            raise RequestError("a sensor's pose must be finite and rigid, a rotation and a translation")
    reference = torch.from_numpy(geometry.interpolate_pose_pair(pair, np.array(fraction)))
    # The reference moves along with the poses that it lies between, each by its share.
    moved = [both[k] @ torch.from_numpy(geometry.inverse(pair[k])) @ reference for k in range(2)]
    return moved[0] * (1 - fraction) + moved[1] * fraction, pair


class _Blend(torch.autograd.Function):
    """The first six planes of ``pipeline.draw`` by Gaussians and the views' reference poses."""

    @staticmethod
    def forward(
        ctx: Any,
        launcher: Launcher,
        batch: Batch,
        rooms: Rooms,
        mean: Tensor,
        quat: Tensor,
        scale: Tensor,
        opacity: Tensor,
        features: Tensor,
        *references: Tensor,
    ) -> Tensor:
        """Render the batch, again with more room until it fits.

        Args:
            ctx: autograd's context.
            launcher: runs the kernels.
            batch: the sensors.
            rooms: room that earlier batches needed.
            mean: see ``GaussianTensors``, like the next three.
            quat: see mean.
            scale: see mean.
            opacity: see mean.
            features: [n,3] what is summed along a ray.
            references: [4,4] reference pose of each sensor; only their gradients are used, the batch has the poses.
        """
        static = blocks_of(mean, quat, scale, opacity, features, launcher.device)

        def attempt(room: Room) -> tuple[np.ndarray, Drawn]:
            drawn = draw(launcher, batch, static, Blocks.none(launcher.device), room, keep_rows=True)
            return launcher.read(drawn.totals), drawn

        drawn = rooms.until_it_fits(batch.ray_count, Room.first(batch.view_count * len(static) * BLOCK), attempt)
        ctx.save_for_backward(mean, quat, scale, opacity)
        ctx.stages = launcher, batch, static, drawn
        ctx.references = references
        ctx.feature_kind = features.dtype
        return drawn.planes[:DIFFERENTIABLE].clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        launcher, batch, static, drawn = ctx.stages
        mean, quat, scale, opacity = ctx.saved_tensors
        rows, by_view = draw_backward(
            launcher, batch, static, drawn, grads[0].float(), each_view=any(ctx.needs_input_grad[8:])
        )
        rows = rows[:, : len(opacity)]
        length = quat.float().norm(dim=1, keepdim=True).clamp(min=1e-12)
        unit = quat.float() / length
        # The kernels see unit quaternions: project out the part along q, divide by the norm.
        turn = (rows[3:7].T - unit * (unit * rows[3:7].T).sum(dim=1, keepdim=True)) / length
        chance = opacity.float()
        # The kernels' gradient is by the logarithm; the cap at MAX_OPACITY has none.
        by_opacity = torch.where((chance <= MAX_OPACITY) & (rows[10] != 0), rows[10] / chance, 0)
        results = (
            rows[0:3].T.to(mean.dtype),
            turn.to(quat.dtype),
            torch.where(scale > MIN_SCALE_M, rows[7:10].T, 0).to(scale.dtype),
            by_opacity.to(opacity.dtype),
            rows[11:14].T.to(ctx.feature_kind),
        )
        poses: list[Tensor | None] = [
            pose_gradient(mean, unit, part[:, : len(opacity)], reference)
            for part, reference in zip(by_view, ctx.references, strict=False)
        ]
        return None, None, None, *results, *(poses or [None] * len(ctx.references))


def pose_gradient(mean: Tensor, unit_quat: Tensor, rows: Tensor, reference: Tensor) -> Float64[Tensor, "4 4"]:
    """Gradient by one view's ``world_from_reference``; only its part along rigid motions means anything.

    To move the sensor is to move all Gaussians the other way.
    """
    used = rows[10] != 0  # the rest may not even be finite
    force, spin = rows[0:3].T[used].double(), rows[3:7].T[used].double()
    arm = mean[used].double() - reference[:3, 3].to(mean.device)
    axes = torch.eye(4, dtype=torch.float64, device=mean.device)[1:]
    q = unit_quat[used].double()
    # A turn w of a Gaussian changes its quaternion by (0, w) q / 2.
    own = torch.stack([(spin * torch_maths.quat_multiply(axis.expand_as(q), q)).sum(dim=1) for axis in axes], dim=1) / 2
    x, y, z = -(torch.linalg.cross(arm, force) + own).sum(dim=0).cpu()
    turn = torch.stack([torch.stack(row) for row in ((0 * x, -z, y), (z, 0 * x, -x), (-y, x, 0 * x))])
    gradient = torch.zeros_like(reference)
    gradient[:3, :3] = 0.5 * turn @ reference[:3, :3]
    gradient[:3, 3] = -force.sum(dim=0).cpu()
    return gradient
