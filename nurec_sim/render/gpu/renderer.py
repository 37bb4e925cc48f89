"""Renders requests for one Gaussian scene on a GPU; what it draws is defined in ``render.spec``."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nurec_sim import geometry
from nurec_sim.errors import RequestError
from nurec_sim.render.cpu.grid import grid_key, make_grid
from nurec_sim.render.cpu.pack import PackedGaussians, pack
from nurec_sim.render.gpu.launcher import THREADS, CudaLauncher, Launcher
from nurec_sim.render.gpu.pipeline import ALPHA, Blocks, draw
from nurec_sim.render.gpu.views import Batch, GridTensors, SensorView, make_batch
from nurec_sim.render.layers import moving_gaussians
from nurec_sim.render.rays import reference_pose
from nurec_sim.render.requests import CAMERA_OUTPUTS, check_request
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

KEPT_GRIDS = 24


@dataclass(frozen=True, eq=False)
class Images:
    """Finished rays of a batch on the device; those of sensor k begin at ``first_ray[k]``.

    Of cameras: ``rgb`` [rays,3] uint8, ``depth`` and ``alpha`` [rays], ``label`` [rays] uint8, ``normal`` [rays,3]. Of
    LiDARs, in the order of the beams: ``returns`` [rays,6] with x, y, z in the sensor at the end of the sweep, range,
    intensity, and 1 where the beam returns. What the other kind of sensor would have is not initialised.
    """

    first_ray: np.ndarray
    rgb: torch.Tensor
    depth: torch.Tensor
    alpha: torch.Tensor
    label: torch.Tensor
    normal: torch.Tensor
    returns: torch.Tensor


class GpuRenderer:
    """A scene made ready for rendering on a GPU, with the methods of ``render.Renderer``.

    Immutable but for caches; all methods can be called from many threads. Work is queued on torch's current stream.

    Args:
        scene: the world.
        device: a CUDA device such as ``cuda:1``, or a ``Launcher``.
        apply_isp: whether ``scene.isp`` of the request's sensor id is applied.

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
        self._sky = torch.from_numpy(np.ascontiguousarray(scene.sky, np.float32)).to(self.device)
        self._grids: OrderedDict[tuple, GridTensors] = OrderedDict()
        self._lock = threading.Lock()

    def sense(self, requests: Sequence[SensorRequest]) -> list[SensorFrame]:
        """One frame per request, in order: ``types.Sense``. All are drawn together.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``.
        """
        return self._frames(requests, CAMERA_OUTPUTS, LidarFilter())

    def render_camera(self, request: SensorRequest, outputs: Sequence[str] = CAMERA_OUTPUTS) -> CameraFrame:
        """A camera frame with ``rgb`` and those of the other outputs that ``outputs`` names.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``; or an unknown output.
        """
        unknown = sorted(set(outputs) - set(CAMERA_OUTPUTS))
        if unknown:
            raise RequestError(f"unknown outputs {unknown}; have {list(CAMERA_OUTPUTS)}")
        if isinstance(request.sensor, LidarModel):
            raise RequestError(f"render_camera needs a camera, sensor {request.sensor.id!r} is a LiDAR")
        frame = self._frames([request], outputs, LidarFilter())[0]
        assert isinstance(frame, CameraFrame)
        return frame

    def render_lidar(self, request: SensorRequest, filter: LidarFilter | None = None) -> LidarFrame:
        """A sweep: the beams that return by ``filter`` (``LidarFilter()`` if None); see ``spec.sweep_frame``.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``.
        """
        if isinstance(request.sensor, CameraModel):
            raise RequestError(f"render_lidar needs a LiDAR, sensor {request.sensor.id!r} is a camera")
        frame = self._frames([request], (), filter or LidarFilter())[0]
        assert isinstance(frame, LidarFrame)
        return frame

    def draw(self, requests: Sequence[SensorRequest], filter: LidarFilter | None = None) -> Images:
        """What ``sense`` draws, left on the device; at least one request.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``.
        """
        for request in requests:
            check_request(request, self.scene)
        batch, moving = self._batch(requests)
        drawn = draw(self._launcher, batch, self._static, moving)
        return self._finish(batch, drawn.planes, requests, filter or LidarFilter())

    def _frames(
        self, requests: Sequence[SensorRequest], outputs: Sequence[str], filter: LidarFilter
    ) -> list[SensorFrame]:
        if not requests:
            return []
        images = self.draw(requests, filter)
        cameras = any(isinstance(request.sensor, CameraModel) for request in requests)
        planes = {
            "rgb": images.rgb, "depth": images.depth, "alpha": images.alpha, "label": images.label,
            "normal": images.normal,
        }  # fmt: skip
        wanted = {"rgb", *outputs} if cameras else ()
        host = {name: planes[name].cpu().numpy() for name in wanted}
        lidars = any(isinstance(request.sensor, LidarModel) for request in requests)
        returns = images.returns.cpu().numpy() if lidars else np.zeros((0, 6), np.float32)
        frames: list[SensorFrame] = []
        for k, request in enumerate(requests):
            part = slice(images.first_ray[k], images.first_ray[k + 1])
            if isinstance(request.sensor, CameraModel):
                frames.append(_camera_frame(request, request.sensor, {name: a[part] for name, a in host.items()}))
            else:
                frames.append(_lidar_frame(request, request.sensor, returns[part]))
        return frames

    def _batch(self, requests: Sequence[SensorRequest]) -> tuple[Batch, Blocks]:
        """The sensors of the requests, and the moving layer as each of them sees it."""
        sensors, layers, first_block = [], [], 0
        for request in requests:
            tensors = self._grid(request)
            layer = self._moving(request, tensors.grid.reference)
            isp = self.scene.isp.get(request.sensor.id) if self.apply_isp else None
            sensors.append(SensorView(tensors, request.world_from_sensor, isp, first_block, len(layer)))
            layers.append(layer)
            first_block += len(layer)
        full = [Blocks.of(layer, self.device) for layer in layers if len(layer)]
        return make_batch(sensors, self._sky), Blocks.joined(full) if full else Blocks.none(self.device)

    def _moving(self, request: SensorRequest, reference: float) -> PackedGaussians:
        """The dynamic layer at the reference instant."""
        pose, t_us = reference_pose(request, reference)
        actors = {
            name: geometry.interpolate_pose_pair(np.asarray(pair, np.float64), np.array(reference))
            for name, pair in request.actors.items()
        }
        return pack(moving_gaussians(self.scene.dynamic, self.scene.tracks, t_us, actors, pose[:3, 3]), sort=False)

    def _finish(
        self, batch: Batch, planes: torch.Tensor, requests: Sequence[SensorRequest], filter: LidarFilter
    ) -> Images:
        import torch

        rays = batch.ray_count

        def empty(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.empty(shape, dtype=dtype, device=self.device)

        images = Images(
            first_ray=batch.first_ray,
            rgb=empty(rays, 3, dtype=torch.uint8),
            depth=empty(rays),
            alpha=planes[ALPHA],
            label=empty(rays, dtype=torch.uint8),
            normal=empty(rays, 3),
            returns=empty(rays, 6),
        )
        grid = (-(-batch.largest_grid // THREADS), len(requests))
        common = (batch.views, np.int64(rays), planes)
        self._launcher.launch("finish_images", grid, *common, images.rgb, images.depth, images.label, images.normal)
        limits = [r.sensor.range_m if isinstance(r.sensor, LidarModel) else (0.0, 0.0) for r in requests]
        range_m = torch.tensor(limits, dtype=torch.float32).to(self.device)
        farthest = -1.0 if filter.distance_threshold_m is None else float(filter.distance_threshold_m)
        thresholds = (float(filter.opacity_threshold), float(filter.raydrop_threshold), farthest)
        self._launcher.launch("finish_beams", grid, *common, range_m, *thresholds, images.returns)
        return images

    def _grid(self, request: SensorRequest) -> GridTensors:
        """Tables of the request's sensor, the latest ``KEPT_GRIDS`` kept."""
        key = grid_key(request.sensor)
        with self._lock:
            tensors = self._grids.get(key)
            if tensors is not None:
                self._grids.move_to_end(key)
                return tensors
        tensors = GridTensors.of(make_grid(request.sensor), self.device)
        with self._lock:
            self._grids[key] = tensors
            while len(self._grids) > KEPT_GRIDS:
                self._grids.popitem(last=False)
        return tensors


def _camera_frame(request: SensorRequest, camera: CameraModel, planes: dict[str, np.ndarray]) -> CameraFrame:
    size = (camera.height_px, camera.width_px)
    image = {name: plane.reshape(*size, *plane.shape[1:]) for name, plane in planes.items()}
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
