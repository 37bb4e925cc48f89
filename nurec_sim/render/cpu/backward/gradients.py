"""Differentiable rendering for torch: images and LiDAR sweeps with gradients by Gaussians, sensor and actor poses.

Images are those of ``render.spec`` before rounding; ``docs/gradients.md`` defines the gradients and their limits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from nurec_sim import geometry, sensors
from nurec_sim.errors import RequestError
from nurec_sim.render import torch_maths
from nurec_sim.render.cpu.backward.frame import SENSORS, Frame
from nurec_sim.render.cpu.sensor_tables import SensorTables
from nurec_sim.render.spec import MIN_ALPHA, SURFACE_ALPHA
from nurec_sim.types import CameraModel, Gaussians, LidarModel


@dataclass(frozen=True, eq=False)
class GaussianTensors:
    """Gaussians as tensors on the CPU; the meaning and the units of the fields are those of ``types.Gaussians``.

    Quaternions may have any norm. Neighbours in space should be neighbours in memory, which renders faster.
    """

    mean_m: Float[Tensor, "n 3"]
    quat_wxyz: Float[Tensor, "n 4"]
    scale_m: Float[Tensor, "n 3"]
    opacity: Float[Tensor, " n"]
    rgb: Float[Tensor, "n 3"]
    sh_rest: Float[Tensor, "n k 3"] | None = None
    intensity: Float[Tensor, " n"] | None = None
    ray_drop: Float[Tensor, " n"] | None = None

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.mean_m)

    @classmethod
    def of(cls, gaussians: Gaussians) -> GaussianTensors:
        """Float32 copies of a layer's values."""
        names = [field.name for field in fields(cls)]
        given = {name: value for name in names if (value := getattr(gaussians, name)) is not None}
        return cls(**{name: torch.tensor(value, dtype=torch.float32) for name, value in given.items()})

    def moved(self, new_from_old: Float[Tensor, "4 4"], eye_m: Float[Tensor, " 3"] | None = None) -> GaussianTensors:
        """The Gaussians carried along by a rigid motion, such as an actor's ``world_from_actor``.

        Args:
            new_from_old: the motion; gradients reach it.
            eye_m: where they will be seen from. View-dependent colours turn with an actor, so they are evaluated here
                and the result has none; needed where there are any.

        Raises:
            RequestError: there are view-dependent colours and no ``eye_m``.
        """
        turn, shift = new_from_old[:3, :3].to(self.mean_m), new_from_old[:3, 3].to(self.mean_m)
        rgb = self.rgb
        if self.sh_rest is not None:
            if eye_m is None:
                raise RequestError("moved() needs eye_m for Gaussians with view-dependent colours")
            rgb = torch_maths.view_colour(rgb, self.sh_rest, self.mean_m - (eye_m.to(shift) - shift) @ turn)
        return replace(
            self,
            mean_m=self.mean_m @ turn.T + shift,
            quat_wxyz=torch_maths.quat_multiply(torch_maths.quat_from_matrix(turn), self.quat_wxyz),
            rgb=rgb,
            sh_rest=None,
        )

    @classmethod
    def joined(cls, parts: Sequence[GaussianTensors]) -> GaussianTensors:
        """All parts one after the other.

        Raises:
            RequestError: some parts have view-dependent colours or intensities and others don't.
        """
        values: dict[str, Tensor | None] = {}
        for field in fields(cls):
            column = [getattr(part, field.name) for part in parts]
            missing = sum(value is None for value in column)
            if 0 < missing < len(column):
                raise RequestError(f"cannot join Gaussians with and without {field.name}")
            values[field.name] = None if missing else torch.cat(column)
        return cls(**values)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class CameraImages:
    """``rgb`` is not clipped or rounded; ``depth`` in metres along the optical axis, 0 where alpha is below 0.5."""

    rgb: Float[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"]
    alpha: Float[Tensor, "h w"]


@dataclass(frozen=True, eq=False)
class LidarImages:
    """Rows x columns of beams: ``range`` of the return and weighted mean ``distance`` in metres, 0 where there is none.

    The range is where half of the beam has been stopped, else the mean distance. ``intensity`` is the weighted mean
    over the Gaussians whose intensity is known; ``ray_drop`` over all, 0 for Gaussians without one.
    """

    range: Float[Tensor, "h w"]
    distance: Float[Tensor, "h w"]
    intensity: Float[Tensor, "h w"]
    alpha: Float[Tensor, "h w"]
    ray_drop: Float[Tensor, "h w"]


def render_camera(
    gaussians: GaussianTensors,
    camera: CameraModel,
    world_from_camera: Float[Tensor, "4 4"] | Float[Tensor, "2 4 4"],
    sky: Float[Tensor, "6 s s 3"] | Float[Tensor, " 3"] | None = None,
    threads: int | None = None,
) -> CameraImages:
    """A differentiable camera image.

    Args:
        gaussians: the world.
        camera: any lens and shutter.
        world_from_camera: one pose, or those at the start and the end of the exposure.
        sky: cubemap or a single colour behind the Gaussians; black if None.
        threads: as many as the process may use if None; results do not depend on it.

    Raises:
        RequestError: shapes, devices or values of the arguments do not fit; the camera is malformed.
    """
    if not isinstance(camera, CameraModel):
        raise RequestError(f"render_camera needs a CameraModel, got {type(camera).__name__}")
    _check(gaussians, sky)
    sensor = _sensor(camera, sensors.check_camera)
    reference, pair = _poses(world_from_camera, sensor)
    # View-dependent colours are evaluated in torch, so gradients reach their coefficients and the eye.
    colour = gaussians.rgb
    if gaussians.sh_rest is not None:
        offset = gaussians.mean_m.double() - reference[:3, 3]
        colour = torch_maths.view_colour(colour, gaussians.sh_rest, offset.to(colour.dtype))
    frame = Frame(sensor, pair, False, threads)
    features, alpha, distance, _ = _draw(gaussians, colour, reference, frame)
    rgb = features
    if sky is not None:
        behind = sky[:, None, None] if sky.ndim == 1 else _Sky.apply(sky, reference, frame)
        clear = 1 - alpha if sensor.all_valid else torch.from_numpy(sensor.grid.valid > 0) * (1 - alpha)
        # Multiplied and added in one pass over the image.
        rgb = torch.addcmul(rgb, clear, behind.to(rgb.dtype))
    depth = distance / alpha.clamp(min=MIN_ALPHA)
    if frame.ray_z is not None:
        depth = (depth * torch.from_numpy(frame.ray_z)).clamp(min=0)
    depth = torch.where(alpha >= SURFACE_ALPHA, depth, 0)
    return CameraImages(rgb.permute(1, 2, 0), depth, alpha)


def render_lidar(
    gaussians: GaussianTensors,
    lidar: LidarModel,
    world_from_lidar: Float[Tensor, "4 4"] | Float[Tensor, "2 4 4"],
    threads: int | None = None,
) -> LidarImages:
    """A differentiable sweep, a value per beam; beams are not filtered.

    Args:
        gaussians: the world.
        lidar: any spinning row and column model.
        world_from_lidar: one pose, or those at the start and the end of the sweep.
        threads: as many as the process may use if None; results do not depend on it.

    Raises:
        RequestError: shapes, devices or values of the arguments do not fit; the LiDAR is malformed.
    """
    if not isinstance(lidar, LidarModel):
        raise RequestError(f"render_lidar needs a LidarModel, got {type(lidar).__name__}")
    _check(gaussians)
    sensor = _sensor(lidar, sensors.check_lidar)
    reference, pair = _poses(world_from_lidar, sensor)
    value = gaussians.intensity
    if value is None:
        value = torch.full_like(gaussians.opacity, torch.nan)
    known = torch.isfinite(value)
    drop = torch.zeros_like(value) if gaussians.ray_drop is None else gaussians.ray_drop
    features = torch.stack([torch.where(known, value, 0), known.to(value.dtype), drop], dim=-1)
    planes = _draw(gaussians, features, reference, Frame(sensor, pair, True, threads))
    # From grid cells, whose rows may be rolled, to beams.
    cells = torch.from_numpy(sensor.cell_of_beam)
    sums, alpha, distance, half = (plane.flatten(-2)[..., cells].reshape(plane.shape) for plane in planes)
    mean = distance / alpha.clamp(min=MIN_ALPHA)
    intensity, lost = sums[0] / sums[1].clamp(min=1e-12), sums[2] / alpha.clamp(min=MIN_ALPHA)
    return LidarImages(torch.where(half > 0, half, mean), mean, intensity, alpha, lost)


class _Draw(torch.autograd.Function):
    """Blended planes of a frame by Gaussians and the reference pose: features, alpha, distance, half."""

    @staticmethod
    def forward(ctx, mean, quat, scale, opacity, features, world_from_sensor, frame: Frame):
        """Render a frame.

        Args:
            ctx: autograd's context.
            mean: see ``GaussianTensors``, like the next three.
            quat: see mean.
            scale: see mean.
            opacity: see mean.
            features: [n,3] what is summed along a ray.
            world_from_sensor: [4,4] reference pose; only its gradient is used, the frame has the poses.
            frame: the frame.
        """
        # The rendered planes stay in the frame: ``draw_back`` reads them again.
        frame.draw(*(_array(tensor) for tensor in (mean, quat, scale, opacity, features)))
        ctx.save_for_backward(mean, quat, scale, opacity)
        ctx.frame, ctx.dtypes = frame, [t.dtype for t in (mean, quat, scale, opacity, features, world_from_sensor)]
        ctx.set_materialize_grads(False)
        height, width = frame.sensor.grid.valid.shape
        planes = torch.from_numpy(frame.planes)[:, :height, :width]
        return planes[1:4], planes[0], planes[4], planes[5]

    @staticmethod
    @once_differentiable
    def backward(ctx, by_features, by_alpha, by_distance, by_half):
        """Gradients of the inputs.

        Args:
            ctx: autograd's context.
            by_features: [3,h,w] gradients of the loss; None where an output is not used, as for the next three.
            by_alpha: [h,w].
            by_distance: [h,w].
            by_half: [h,w].
        """
        parts = {1: by_features, 0: by_alpha, 4: by_distance, 5: by_half}
        by_planes = ctx.frame.empty_planes()
        height, width = ctx.frame.sensor.grid.valid.shape
        for plane, part in parts.items():
            if part is not None:
                by_planes[plane : plane + (len(part) if part.ndim == 3 else 1), :height, :width] = part.numpy()
        results = ctx.frame.draw_back(*(_array(tensor) for tensor in ctx.saved_tensors), by_planes)
        return *(torch.from_numpy(g).to(dtype) for g, dtype in zip(results, ctx.dtypes, strict=True)), None


class _Sky(torch.autograd.Function):
    """Colours of a cubemap behind the rays, by the cubemap and the reference pose."""

    @staticmethod
    def forward(ctx, sky, world_from_sensor, frame: Frame):
        """Look the sky up.

        Args:
            ctx: autograd's context.
            sky: [6,s,s,3] cubemap.
            world_from_sensor: [4,4] reference pose; only its gradient is used, the frame has the poses.
            frame: the frame.
        """
        ctx.save_for_backward(sky)
        ctx.frame, ctx.dtypes = frame, (sky.dtype, world_from_sensor.dtype)
        return torch.from_numpy(frame.draw_sky(_array(sky)))

    @staticmethod
    @once_differentiable
    def backward(ctx, by_behind):
        results = ctx.frame.draw_sky_back(_array(ctx.saved_tensors[0]), by_behind.contiguous().numpy())
        return *(torch.from_numpy(g).to(dtype) for g, dtype in zip(results, ctx.dtypes, strict=True)), None


def _draw(
    gaussians: GaussianTensors,
    features: Float[Tensor, "n 3"],
    reference: Float[Tensor, "4 4"],
    frame: Frame,
) -> tuple[Tensor, ...]:
    """Planes of a frame, zero where there are no rays: features, alpha, distance, half."""
    planes = _Draw.apply(gaussians.mean_m, gaussians.quat_wxyz, gaussians.scale_m, gaussians.opacity, features,
                         reference, frame)  # fmt: skip
    if frame.sensor.all_valid:
        return planes
    # Cells without a ray must not pass a gradient on, either.
    valid = torch.from_numpy(frame.sensor.grid.valid > 0)
    return tuple(torch.where(valid, plane, 0) for plane in planes)


def _sensor(model: CameraModel | LidarModel, check: Callable[..., None]) -> SensorTables:
    try:
        check(model)
    except ValueError as error:
        raise RequestError(str(error)) from None
    return SENSORS.tables(model)


def _poses(poses: Tensor, sensor: SensorTables) -> tuple[Float[Tensor, "4 4"], Float[np.ndarray, "2 4 4"]]:
    """The reference pose, which carries gradients, and the plain pair of poses."""
    if poses.shape not in ((4, 4), (2, 4, 4)):
        raise RequestError(f"a sensor needs one pose [4,4] or two [2,4,4], got {list(poses.shape)}")
    both = poses.double().expand(2, 4, 4)
    pair = both.detach().numpy().copy()
    for pose in pair:
        if not np.isfinite(pose).all() or not geometry.is_rotation(pose[:3, :3]):
            raise RequestError("a sensor's pose must be finite and rigid, a rotation and a translation")
    fraction = sensor.grid.reference
    reference = torch.from_numpy(geometry.interpolate_pose_pair(pair, np.array(fraction)))
    # The reference moves along with the poses that it lies between, each by its share.
    moved = [both[k] @ torch.from_numpy(geometry.inverse(pair[k])) @ reference for k in range(2)]
    return moved[0] * (1 - fraction) + moved[1] * fraction, pair


def _check(gaussians: GaussianTensors, sky: Tensor | None = None) -> None:
    n = len(gaussians.mean_m)
    allowed: dict[str, list[list]] = {
        "mean_m": [[n, 3]],
        "quat_wxyz": [[n, 4]],
        "scale_m": [[n, 3]],
        "opacity": [[n]],
        "rgb": [[n, 3]],
        "sh_rest": [[n, 3, 3], [n, 8, 3], [n, 15, 3]],
        "intensity": [[n]],
        "ray_drop": [[n]],
        "sky": [[3], [6, "s", "s", 3]],
    }
    values = {**{field.name: getattr(gaussians, field.name) for field in fields(gaussians)}, "sky": sky}
    for name, value in values.items():
        if value is None:
            continue
        if value.device.type != "cpu" or not value.is_floating_point():
            raise RequestError(
                f"{name} must be a floating-point tensor on the CPU, got {value.dtype} on {value.device}"
            )
        shape = list(value.shape)
        if name == "sky" and value.ndim == 4 and shape == [6, shape[1], shape[1], 3]:
            continue
        if shape not in allowed[name]:
            raise RequestError(f"{name} must be {' or '.join(map(str, allowed[name]))}, got {shape}")


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().to(torch.float32).contiguous().numpy()
