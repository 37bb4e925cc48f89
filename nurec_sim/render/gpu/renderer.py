"""Renders requests for one Gaussian scene on a GPU; what it draws is defined in ``render.spec``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nurec_sim.compute.turns import rest
from nurec_sim.errors import TooLargeError
from nurec_sim.render.cpu.pack import pack
from nurec_sim.render.cpu.sensor_tables import SensorCache
from nurec_sim.render.gpu.launcher import THREADS, CudaLauncher, Launcher
from nurec_sim.render.gpu.moving import MovingLayer
from nurec_sim.render.gpu.pipeline import ALPHA, Blocks, draw
from nurec_sim.render.gpu.views import Batch, GridTensors, SensorView, make_batch
from nurec_sim.render.requests import (
    SENSED_OUTPUTS,
    check_camera_call,
    check_lidar_call,
    check_outputs,
    check_request,
    ray_count,
)
from nurec_sim.types import (
    CameraFrame,
    CameraModel,
    GaussianScene,
    LidarFilter,
    LidarFrame,
    LidarModel,
    SensorFrame,
    SensorRequest,
)

if TYPE_CHECKING:
    import torch

GROUP_RAYS = 1 << 24
"""Pixels and beams that are drawn together, or of a single larger frame; some hundred bytes each."""


@dataclass(frozen=True, eq=False)
class Images:
    """Finished rays of a batch on the device; those of sensor k begin at ``first_ray[k]``.

    Of cameras: ``rgb`` [rays,3] uint8, ``depth`` and ``alpha`` [rays], ``label`` [rays] uint8, ``normal`` [rays,3]. Of
    LiDARs, in the order of the beams: ``returns`` [rays,6] with x, y, z in the sensor at the end of the sweep, range,
    intensity, and 1 where the beam returns. Rays of the other kind of sensor are not initialised, and there are none
    where a batch has no sensor of a kind.
    """

    first_ray: np.ndarray
    rgb: torch.Tensor
    depth: torch.Tensor
    alpha: torch.Tensor
    label: torch.Tensor
    normal: torch.Tensor
    returns: torch.Tensor


class GpuRenderer:
    """A scene made ready for rendering on a GPU, a ``render.Renderer``.

    Immutable but for caches; all methods can be called from many threads. Work is queued on torch's current stream.

    Args:
        scene: the world.
        device: a CUDA device such as ``cuda:1``, or a ``Launcher``.
        apply_isp: whether ``scene.isp`` of the request's sensor id is applied to requests that ask for it.

    Raises:
        GpuError: there is no such device, or the extra ``gpu`` is missing.
    """

    def __init__(self, scene: GaussianScene, device: str | Launcher = "cuda", apply_isp: bool = True) -> None:
        import torch

        self.scene = scene
        self.apply_isp = apply_isp
        self._launcher: Launcher = CudaLauncher(device) if isinstance(device, str) else device
        self.device = self._launcher.device
        self._static = Blocks.of(pack(scene.static), self.device)
        self._moving = MovingLayer.of(scene.dynamic, scene.tracks, self.device)
        self._sky = torch.from_numpy(np.ascontiguousarray(scene.sky, np.float32)).to(self.device)
        self._grids = SensorCache(lambda grid: GridTensors.of(grid, self.device))

    def sense(self, requests: Sequence[SensorRequest], outputs: Sequence[str] = SENSED_OUTPUTS) -> list[SensorFrame]:
        """One frame per request, in order: ``types.Sense``; cameras with ``rgb`` and what else ``outputs`` names.

        They are drawn together, in groups of up to ``GROUP_RAYS``.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``; or an unknown output.
        """
        check_outputs(outputs)
        frames: list[SensorFrame] = []
        group: list[SensorRequest] = []
        for number, request in enumerate(requests):
            group.append(request)
            if sum(map(ray_count, group)) >= GROUP_RAYS or number == len(requests) - 1:
                rest()
                frames += self._frames(group, outputs, LidarFilter())
                group = []
        return frames

    def render_camera(self, request: SensorRequest, outputs: Sequence[str] = SENSED_OUTPUTS) -> CameraFrame:
        """A camera frame with ``rgb`` and those of the other outputs that ``outputs`` names.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``; or an unknown output.
        """
        check_camera_call(request, outputs)
        frame = self._frames([request], outputs, LidarFilter())[0]
        assert isinstance(frame, CameraFrame)
        return frame

    def render_lidar(self, request: SensorRequest, filter: LidarFilter | None = None) -> LidarFrame:
        """A sweep: the beams that return by ``filter`` (``LidarFilter()`` if None); see ``spec.sweep_frame``.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``.
        """
        check_lidar_call(request)
        frame = self._frames([request], (), filter or LidarFilter())[0]
        assert isinstance(frame, LidarFrame)
        return frame

    def draw(self, requests: Sequence[SensorRequest], filter: LidarFilter | None = None) -> Images:
        """What ``sense`` draws, left on the device; at least one request.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``; or the GPU's memory is full.
        """
        import torch

        for request in requests:
            check_request(request, self.scene)
        try:
            return self._draw(requests, filter or LidarFilter())
        except torch.OutOfMemoryError as error:
            raise TooLargeError(f"{len(requests)} sensors at once are too many for the GPU: {error}") from None

    def _draw(self, requests: Sequence[SensorRequest], filter: LidarFilter) -> Images:
        batch = make_batch([self._view(request, k) for k, request in enumerate(requests)], self._sky)
        moving = self._moving.placed(self._launcher, batch, requests)
        drawn = draw(self._launcher, batch, self._static, moving)
        return self._finish(batch, drawn.planes, requests, filter)

    def _frames(
        self, requests: Sequence[SensorRequest], outputs: Sequence[str], filter: LidarFilter
    ) -> list[SensorFrame]:
        if not requests:
            return []
        images = self.draw(requests, filter)
        host = {name: getattr(images, name).cpu().numpy() for name in {"rgb", "returns", *outputs}}
        frames: list[SensorFrame] = []
        for k, request in enumerate(requests):
            part = slice(images.first_ray[k], images.first_ray[k + 1])
            if isinstance(request.sensor, CameraModel):
                frames.append(
                    _camera_frame(request, request.sensor, {name: plane[part] for name, plane in host.items()})
                )
            else:
                frames.append(_lidar_frame(request, request.sensor, host["returns"][part]))
        return frames

    def _view(self, request: SensorRequest, number: int) -> SensorView:
        """The sensor of the request of that number."""
        corrected = self.apply_isp and request.apply_isp
        isp = self.scene.response(request.sensor.id, request.middle_us) if corrected else None
        blocks = len(self._moving)
        return SensorView(self._grids.tables(request.sensor), request.world_from_sensor, isp, number * blocks, blocks)

    def _finish(
        self, batch: Batch, planes: torch.Tensor, requests: Sequence[SensorRequest], filter: LidarFilter
    ) -> Images:
        import torch

        lidars = [request.sensor for request in requests if isinstance(request.sensor, LidarModel)]
        image_rays = batch.ray_count if len(lidars) < len(requests) else 0
        beam_rays = batch.ray_count if lidars else 0

        def empty(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.empty(shape, dtype=dtype, device=self.device)

        images = Images(
            first_ray=batch.first_ray,
            rgb=empty(image_rays, 3, dtype=torch.uint8),
            depth=empty(image_rays),
            alpha=planes[ALPHA],
            label=empty(image_rays, dtype=torch.uint8),
            normal=empty(image_rays, 3),
            returns=empty(beam_rays, 6),
        )
        grid = (-(-batch.largest_grid // THREADS), len(requests))
        common = (batch.views, np.int64(batch.ray_count), planes)
        if image_rays:
            self._launcher.launch("finish_images", grid, *common, images.rgb, images.depth, images.label, images.normal)
        if beam_rays:
            limits = [r.sensor.range_m if isinstance(r.sensor, LidarModel) else (0.0, 0.0) for r in requests]
            range_m = torch.tensor(limits, dtype=torch.float32).to(self.device)
            farthest = -1.0 if filter.distance_threshold_m is None else float(filter.distance_threshold_m)
            thresholds = (float(filter.opacity_threshold), float(filter.raydrop_threshold), farthest)
            self._launcher.launch("finish_beams", grid, *common, range_m, *thresholds, images.returns)
        return images


def _camera_frame(request: SensorRequest, camera: CameraModel, planes: dict[str, np.ndarray]) -> CameraFrame:
    size = (camera.height_px, camera.width_px)
    image = {name: plane.reshape(*size, *plane.shape[1:]) for name, plane in planes.items() if name != "returns"}
    return CameraFrame(
        camera=camera,
        start_us=request.start_us,
        end_us=request.end_us,
        rgb=image["rgb"],
        depth_m=image.get("depth"),
        alpha=image.get("alpha"),
        label=image.get("label"),
        normal=image.get("normal"),
    )


def _lidar_frame(request: SensorRequest, lidar: LidarModel, returns: np.ndarray) -> LidarFrame:
    beam = np.flatnonzero(returns[:, 5] > 0)
    chosen = returns[beam]
    return LidarFrame(
        lidar=lidar,
        start_us=request.start_us,
        end_us=request.end_us,
        xyz_m=chosen[:, :3].copy(),
        range_m=chosen[:, 3].copy(),
        intensity=chosen[:, 4].copy(),
        beam=beam.astype(np.int32),
    )
