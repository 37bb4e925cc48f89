"""Renders requests for one Gaussian scene on the CPU; what it draws is defined in ``render.spec``."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

from nurec_sim import geometry
from nurec_sim.errors import RequestError
from nurec_sim.render.cpu.composite import composite
from nurec_sim.render.cpu.grid import Grid, grid_key, make_grid
from nurec_sim.render.cpu.pack import PackedGaussians, pack
from nurec_sim.render.cpu.pipeline import Buffers, View, Workers, draw
from nurec_sim.render.layers import moving_gaussians
from nurec_sim.render.rays import reference_pose
from nurec_sim.render.requests import CAMERA_OUTPUTS, check_request
from nurec_sim.render.spec import beam_range, sweep_frame
from nurec_sim.types import CameraFrame, CameraModel, GaussianScene, LidarFrame, SensorFrame, SensorRequest

IDENTITY_ISP = np.eye(3, 4, dtype=np.float32)
KEPT_GRIDS = 24


class Renderer:
    """A scene made ready for rendering. Immutable but for caches; all methods can be called from many threads.

    Args:
        scene: the world.
        threads: of this renderer; as many as the process may use if None.
        apply_isp: whether ``scene.isp`` of the request's sensor id is applied.
    """

    def __init__(self, scene: GaussianScene, threads: int | None = None, apply_isp: bool = True) -> None:
        if threads is not None and threads < 1:
            raise ValueError(f"a renderer needs at least 1 thread, got {threads}")
        self.scene = scene
        self.apply_isp = apply_isp
        self._workers = Workers(threads or _usable_cores())
        self._buffers = Buffers()
        self._static = pack(scene.static)
        self._sky = np.ascontiguousarray(scene.sky, np.float32)
        self._isp = {name: np.asarray(matrix, np.float32) for name, matrix in scene.isp.items()}
        self._grids: OrderedDict[tuple, Grid] = OrderedDict()
        self._grids_lock = threading.Lock()

    def sense(self, requests: Sequence[SensorRequest]) -> list[SensorFrame]:
        """One frame per request, in order: ``types.Sense``.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``.
        """
        return [
            self.render_camera(request) if isinstance(request.sensor, CameraModel) else self.render_lidar(request)
            for request in requests
        ]

    def render_camera(self, request: SensorRequest, outputs: Sequence[str] = CAMERA_OUTPUTS) -> CameraFrame:
        """A camera frame with ``rgb`` and those of depth, alpha and label that ``outputs`` names.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``; or an unknown output.
        """
        unknown = sorted(set(outputs) - set(CAMERA_OUTPUTS))
        if unknown:
            raise RequestError(f"unknown outputs {unknown}; have {list(CAMERA_OUTPUTS)}")
        check_request(request, self.scene)
        if not isinstance(request.sensor, CameraModel):
            raise RequestError(f"render_camera needs a camera, sensor {request.sensor.id!r} is a LiDAR")
        grid = self._grid(request)
        view = View.of(grid, request.world_from_sensor)
        planes = draw(grid, view, self._layers(request, grid), False, self._workers, self._buffers)
        height, width = grid.valid.shape
        rgb, label = np.empty((height, width, 3), np.uint8), np.empty((height, width), np.uint8)
        depth, alpha = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
        isp = self._isp.get(request.sensor.id, IDENTITY_ISP) if self.apply_isp else IDENTITY_ISP
        turn = view.world_from_line[:, :3, :3].astype(np.float32)
        line = grid.line if len(turn) > 1 else np.zeros_like(grid.line)
        self._workers.run(
            composite,
            [(first, last, planes, grid.direction, grid.valid, line, turn, self._sky, isp, rgb, depth, alpha, label)
             for first, last in self._workers.ranges(height, 16)],
        )  # fmt: skip
        return CameraFrame(
            camera=request.sensor,
            start_us=request.start_us,
            end_us=request.end_us,
            rgb=rgb,
            depth_m=depth if "depth" in outputs else None,
            alpha=alpha if "alpha" in outputs else None,
            label=label if "label" in outputs else None,
        )

    def render_lidar(self, request: SensorRequest, opacity_threshold: float = 0.5) -> LidarFrame:
        """A sweep: a return per beam whose alpha exceeds ``opacity_threshold`` and whose range the sensor can measure.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``.
        """
        check_request(request, self.scene)
        if isinstance(request.sensor, CameraModel):
            raise RequestError(f"render_lidar needs a LiDAR, sensor {request.sensor.id!r} is a camera")
        grid = self._grid(request)
        view = View.of(grid, request.world_from_sensor)
        planes = draw(grid, view, self._layers(request, grid), True, self._workers, self._buffers)
        assert grid.beam is not None
        planes = _by_beam(planes, grid.beam).astype(np.float64)
        alpha = planes[4]
        distance = beam_range(planes[6], planes[3], alpha)
        intensity = planes[0] / np.maximum(planes[1], 1e-12)
        direction = np.moveaxis(_by_beam(np.moveaxis(grid.direction, 2, 0), grid.beam), 0, 2)
        # Beams of a column share its pose; the grid's line of a beam is its column.
        poses = np.broadcast_to(view.world_from_line, (alpha.shape[1], 4, 4))
        world_direction = np.einsum("cij,rcj->rci", poses[:, :3, :3], direction.astype(np.float64))
        origin = np.broadcast_to(poses[None, :, :3, 3], world_direction.shape)
        return sweep_frame(request, alpha, distance, intensity, origin, world_direction, opacity_threshold)

    def _layers(self, request: SensorRequest, grid: Grid) -> list[PackedGaussians]:
        """The static layer, and the dynamic one as it is at the reference instant."""
        if len(self.scene.dynamic) == 0:
            return [self._static]
        pose, t_us = reference_pose(request, grid.reference)
        actors = {
            name: geometry.interpolate_pose_pair(np.asarray(pair, np.float64), np.array(grid.reference))
            for name, pair in request.actors.items()
        }
        moving = moving_gaussians(self.scene.dynamic, self.scene.tracks, t_us, actors, pose[:3, 3])
        return [self._static, pack(moving, sort=False)]

    def _grid(self, request: SensorRequest) -> Grid:
        """Tables of the request's sensor, the latest ``KEPT_GRIDS`` kept."""
        key = grid_key(request.sensor)
        with self._grids_lock:
            grid = self._grids.get(key)
            if grid is not None:
                self._grids.move_to_end(key)
                return grid
        grid = make_grid(request.sensor)
        with self._grids_lock:
            self._grids[key] = grid
            while len(self._grids) > KEPT_GRIDS:
                self._grids.popitem(last=False)
        return grid


def _usable_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _by_beam(planes: np.ndarray, beam: np.ndarray) -> np.ndarray:
    """Planes [p,h,w] in the order of the LiDAR's beams instead of the grid's cells."""
    result = np.empty_like(planes)
    result.reshape(len(planes), -1)[:, beam.reshape(-1)] = planes.reshape(len(planes), -1)
    return result
