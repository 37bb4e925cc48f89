"""Renders requests for one Gaussian scene on the CPU; images are defined in ``render.spec``."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np

from nurec_sim import geometry
from nurec_sim.compute.cores import usable_cores
from nurec_sim.compute.turns import rest
from nurec_sim.render.cpu.blend.composite import CameraPixels, CameraRays, composite
from nurec_sim.render.cpu.blend.responses import CAMERA, LIDAR, NORMALS
from nurec_sim.render.cpu.blend.sweep import SweepFilter, SweepRays, SweepReturns, sweep_returns
from nurec_sim.render.cpu.blend.tiles import AFFINE, ROLLING
from nurec_sim.render.cpu.moving import PackedMoving
from nurec_sim.render.cpu.pack import PackedGaussians, pack
from nurec_sim.render.cpu.pipeline import NO_TABLE, FrameStats, Picture, blocks_in_view, draw
from nurec_sim.render.cpu.sensor_tables import SensorCache, SensorTables
from nurec_sim.render.cpu.view import ExposureView
from nurec_sim.render.cpu.workers import Buffers, Scratch, Workers
from nurec_sim.render.ego import EgoOverlays
from nurec_sim.render.lod import Detail, check_detail
from nurec_sim.render.rays import actors_at, reference_pose
from nurec_sim.render.requests import SENSED_OUTPUTS, check_outputs, check_request
from nurec_sim.render.single import SingleFrames
from nurec_sim.types import CameraFrame, CameraModel, GaussianScene, LidarFilter, LidarFrame, SensorFrame, SensorRequest

IDENTITY_ISP = np.eye(3, 4, dtype=np.float32)
GROUP_BYTES = 256 << 20
"""Scratch memory of the frames that go through the stages together, or of a single larger one."""
SLICE_RAYS = 1 << 16
"""Rays finished in one call of a kernel, about a millisecond of work."""


@dataclass(frozen=True, eq=False)
class _Begun:
    """A frame on its way."""

    request: SensorRequest
    sensor: SensorTables
    picture: Picture


class CpuRenderer(SingleFrames):
    """A scene prepared for rendering. Immutable but for caches; all methods can be called from many threads.

    Args:
        scene: the world.
        threads: number of threads that work on a frame, including the caller's; as many as the process may use if None.
        apply_isp: whether ``scene.isp`` of the request's sensor id is applied to requests that ask for it.
        detail_px: level of detail: distant static Gaussians are rendered merged where the error is no more than about a
            square of this side, in pixels or beams; 0 renders all of them. 0.15 keeps 50 dB where surfaces have
            several layers and 45 where they have one (``lod``). Merging takes seconds per million Gaussians.

    Raises:
        ValueError: less than one thread, or a negative or infinite ``detail_px``.
    """

    def __init__(
        self, scene: GaussianScene, threads: int | None = None, apply_isp: bool = True, detail_px: float = 0.0
    ) -> None:
        if threads is not None and threads < 1:
            raise ValueError(f"a renderer needs at least 1 thread, got {threads}")
        check_detail(detail_px)
        self.scene = scene
        self.apply_isp = apply_isp
        self._workers = Workers(threads or usable_cores())
        self._buffers = Buffers()
        self._static = Detail.of(scene.static, detail_px) if detail_px else pack(scene.static)
        self._moving = PackedMoving.of(scene.dynamic, scene.tracks)
        self._sky = np.ascontiguousarray(scene.sky, np.float32)
        self._sensors = SensorCache(SensorTables)
        self._ego = EgoOverlays(scene.ego_images, scene.rig)

    def sense(self, requests: Sequence[SensorRequest], outputs: Sequence[str] = SENSED_OUTPUTS) -> list[SensorFrame]:
        """One frame per request, in order: ``types.Sense``; cameras with ``rgb`` and what else ``outputs`` names.

        Frames go through the stages in groups that fit ``GROUP_BYTES``.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``; or an unknown output.
        """
        check_outputs(outputs)
        return self.measure(requests, outputs)[0]

    def _frames(
        self, requests: Sequence[SensorRequest], outputs: Sequence[str], filter: LidarFilter
    ) -> list[SensorFrame]:
        return self.measure(requests, outputs, filter)[0]

    def measure(
        self,
        requests: Sequence[SensorRequest],
        outputs: Sequence[str] = SENSED_OUTPUTS,
        filter: LidarFilter | None = None,
    ) -> tuple[list[SensorFrame], list[FrameStats]]:
        """Frames as of ``sense``, and what each of them took.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``.
        """
        for request in requests:
            check_request(request, self.scene)
        frames: list[SensorFrame] = []
        stats: list[FrameStats] = []
        with ExitStack() as loans:
            scratches: list[Scratch] = []
            group: list[_Begun] = []
            for number, request in enumerate(requests):
                rest()
                # One set of scratch arrays per frame of a group, reused by the next group.
                if len(group) == len(scratches):
                    scratches.append(loans.enter_context(self._buffers.lend()))
                group.append(self._begin(request, outputs, scratches[len(group)]))
                # Frames of a group are held in memory together until their last stage.
                held = sum(begun.picture.scratch_bytes for begun in group)
                if held >= GROUP_BYTES or number == len(requests) - 1:
                    frames += self._finish(group, outputs, filter or LidarFilter())
                    stats += [begun.picture.stats for begun in group]
                    group = []
        return frames, stats

    def _begin(self, request: SensorRequest, outputs: Sequence[str], scratch: Scratch) -> _Begun:
        sensor = self._sensors.tables(request.sensor)
        view = ExposureView.of(sensor.grid, request.world_from_sensor)
        output_kind = (
            LIDAR if not isinstance(request.sensor, CameraModel) else NORMALS if "normal" in outputs else CAMERA
        )
        rays = NO_TABLE if view.projection_mode in (AFFINE, ROLLING) else sensor.rays
        layers = self._layers(request, sensor, view, scratch)
        return _Begun(request, sensor, Picture(view, rays, output_kind, layers, scratch))

    def _finish(self, group: Sequence[_Begun], outputs: Sequence[str], filter: LidarFilter) -> list[SensorFrame]:
        planes = draw([begun.picture for begun in group], self._workers)
        began = time.perf_counter()
        frames: list[SensorFrame] = [
            self._camera_frame(begun.request, begun.picture, begun.sensor, plane, outputs)
            if isinstance(begun.request.sensor, CameraModel)
            else self._lidar_frame(begun.request, begun.picture, plane, filter)
            for begun, plane in zip(group, planes, strict=True)
        ]
        for begun in group:
            begun.picture.stats.seconds["finish"] = time.perf_counter() - began
        return frames

    def _camera_frame(
        self, request: SensorRequest, picture: Picture, sensor: SensorTables, planes: np.ndarray, outputs: Sequence[str]
    ) -> CameraFrame:
        assert isinstance(request.sensor, CameraModel)
        grid, view = sensor.grid, picture.view
        height, width = grid.valid.shape
        pixels = CameraPixels(
            rgb=np.empty((height, width, 3), np.uint8),
            depth=np.empty((height, width), np.float32),
            alpha=np.empty((height, width), np.float32),
            label=np.empty((height, width), np.uint8),
            normal=np.empty((height, width, 3) if picture.output_kind == NORMALS else (0, 0, 3), np.float32),
        )
        # The correction may vary over time: the one at the middle of the exposure applies.
        corrected = self.apply_isp and request.apply_isp
        response = self.scene.response(request.sensor.id, request.middle_us) if corrected else None
        isp = IDENTITY_ISP if response is None else np.ascontiguousarray(response, np.float32)
        turn = view.world_from_line[:, :3, :3].astype(np.float32)
        # Distances of directions with z = 1 are depths already.
        linear = view.projection_mode in (AFFINE, ROLLING)
        ray_z = np.zeros((0, 0), np.float32) if linear else sensor.ray_z
        rays = CameraRays(ray_z, grid.direction, grid.valid, grid.line, turn)
        self._workers.run(
            composite,
            [(first, last, planes, rays, self._sky, isp, pixels)
             for first, last in self._workers.ranges(height, 16, SLICE_RAYS // width)],
        )  # fmt: skip
        frame = CameraFrame(
            camera=request.sensor,
            start_us=request.start_us,
            end_us=request.end_us,
            rgb=pixels.rgb,
            depth_m=pixels.depth if "depth" in outputs else None,
            alpha=pixels.alpha if "alpha" in outputs else None,
            label=pixels.label if "label" in outputs else None,
            normal=pixels.normal if "normal" in outputs else None,
        )
        return self._ego.over(frame) if request.show_ego else frame

    def _lidar_frame(
        self, request: SensorRequest, picture: Picture, planes: np.ndarray, filter: LidarFilter
    ) -> LidarFrame:
        assert not isinstance(request.sensor, CameraModel)
        grid = picture.view.grid
        assert grid.beam is not None
        rows, columns = grid.beam.shape
        # Points are reported in the sensor's frame at the end of the sweep.
        end_from_line = (
            geometry.inverse(np.asarray(request.world_from_sensor[1], np.float64)) @ picture.view.world_from_line
        )
        offset_m = np.inf if filter.distance_threshold_m is None else filter.distance_threshold_m
        thresholds = (*request.sensor.range_m, filter.raydrop_threshold, filter.opacity_threshold, offset_m)
        returns = SweepReturns(
            np.empty(rows * columns, np.float32),
            np.empty(rows * columns, np.float32),
            np.empty((rows * columns, 3), np.float32),
            np.empty(rows * columns, np.int32),
        )
        rays = SweepRays(grid.direction, grid.valid, grid.beam, grid.line, np.ascontiguousarray(end_from_line[:, :3]))
        limits = SweepFilter(*map(float, thresholds))
        parts = self._workers.ranges(rows, 4, SLICE_RAYS // columns)
        counts = self._workers.run(
            sweep_returns, [(first, last, planes, rays, limits, returns) for first, last in parts]
        )
        found = [
            slice(first * columns, first * columns + count) for (first, _), count in zip(parts, counts, strict=True)
        ]
        range_m, intensity, xyz, beam = (np.concatenate([values[part] for part in found]) for values in returns)
        return LidarFrame(request.sensor, request.start_us, request.end_us, xyz, range_m, intensity, beam)

    def _layers(
        self, request: SensorRequest, sensor: SensorTables, view: ExposureView, scratch: Scratch
    ) -> list[tuple[PackedGaussians, np.ndarray]]:
        """The static layer, and the dynamic one as it is at the reference instant, with their blocks in view."""
        eye = view.world_from_reference[:3, 3]
        if isinstance(self._static, Detail):
            layers = self._static.layers(eye, sensor.spacing_rad, lambda layer: blocks_in_view(view, layer))
        else:
            layers = [(self._static, blocks_in_view(view, self._static))]
        if len(self.scene.dynamic):
            _, t_us = reference_pose(request, view.grid.reference)
            actors = actors_at(request, view.grid.reference, self._moving.track_of)
            # Actors hold still during an exposure, at the reference instant (``spec``).
            moving = self._moving.at(t_us, actors, request.hidden, eye, self._workers, scratch)
            layers.append((moving, blocks_in_view(view, moving)))
        return layers
