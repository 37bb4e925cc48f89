"""The procedures that render.

Semantics (public NuRec and AlpaSim behaviour): a frame [start, end) renders if it overlaps the scene's time, for
AlpaSim's first exposure may begin before the recording and a client's last instant [t, t + 1) end after it; what sticks
out is clamped in time, poses stay as they are. Actors listed in a request are drawn where it says, unknown ids are
ignored, and all others, static ones always, are drawn as recorded.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from nurec_sim import wire
from nurec_sim.errors import NurecSimError, OutOfRangeError
from nurec_sim.scene_store import LoadedScene
from nurec_sim.service.core import ServiceCore
from nurec_sim.service.options import describe
from nurec_sim.types import CameraFrame, CameraModel, GaussianScene, LidarFilter, LidarFrame, LidarModel, SensorRequest
from nurec_sim.wire import sensorsim

log = logging.getLogger(__name__)

T = TypeVar("T")

_BURIED_M = 10_000.0
BYTES_A_POINT = 24  # xyz, intensity, range, beam


@dataclass(frozen=True)
class CameraJob:
    """One admitted camera request."""

    loaded: LoadedScene
    request: SensorRequest
    options: wire.ImageOptions
    pixels: int

    @property
    def planar_bytes(self) -> int:
        """Size of the reply if it is raw pixels, else 0: compressed images are small."""
        return 3 * self.pixels if self.options.format == wire.ImageFormat.RGB_UINT8_PLANAR else 0

    def render(self, outputs: tuple[str, ...]) -> CameraFrame:
        """The frame, with or without the camera's colour correction."""
        request = self.request
        if not self.options.apply_isp:
            # The correction is found by the camera's id; an id that no scene knows renders without.
            request = replace(request, sensor=replace(request.sensor, id=""))
        return self.loaded.renderer.render_camera(request, outputs=outputs)


@dataclass(frozen=True)
class LidarJob:
    """One admitted LiDAR request."""

    loaded: LoadedScene
    request: SensorRequest
    filter: LidarFilter
    beams: int

    def render(self) -> LidarFrame:
        """The sweep."""
        return self.loaded.renderer.render_lidar(self.request, self.filter)


class Rendering(ServiceCore):
    """Images and sweeps."""

    async def warm_up(self) -> None:
        """Loads the first scene and draws one image and one sweep of it; what fails is logged only."""
        try:
            with await self.lease(self._store.ids[0]) as loaded:
                rig, ego = loaded.scene.rig, loaded.scene.ego
                start_us = max(loaded.scene.span_us[0], ego.start_us)

                def look(sensor: CameraModel | LidarModel, rig_from_sensor: np.ndarray) -> SensorRequest:
                    pose = ego.at(start_us) @ rig_from_sensor
                    return SensorRequest(loaded.scene.id, sensor, start_us, start_us + 1, np.stack([pose, pose]))

                for camera in list(rig.cameras.values())[:1]:
                    request = look(camera, camera.rig_from_camera)
                    await self.renders.run(loaded.renderer.render_camera, request, ("rgb",))
                for lidar in list(rig.lidars.values())[:1]:
                    await self.renders.run(loaded.renderer.render_lidar, look(lidar, lidar.rig_from_lidar))
        except Exception as error:
            log.warning("the server could not warm up: %s", error)

    async def render_rgb(self, request):
        """One image."""
        with ExitStack() as held:
            job = await self.admit_camera(request, held)
            self._check_images([job])
            return await self._render_camera(job)

    async def batch_render_rgb(self, batch):
        """Several images; what is wrong with one item is said in that item."""
        self._check_batch(len(batch.items))
        with ExitStack() as held:
            admitted = await asyncio.gather(
                *(self.admit_camera(item.request, held) for item in batch.items), return_exceptions=True
            )
            self._check_images(job for job in admitted if isinstance(job, CameraJob))
            results = await asyncio.gather(*(self._finish(job) for job in admitted), return_exceptions=True)
        reply = sensorsim.BatchRGBRenderReturn()
        for item, result in zip(batch.items, results, strict=True):
            entry = reply.items.add(camera_name=item.camera_name)
            if isinstance(result, Exception):
                if not isinstance(result, NurecSimError):
                    log.error("batch item %r failed", item.camera_name, exc_info=result)
                entry.error_message, entry.error_code = describe(result), wire.number_of(result)
            else:
                entry.success = True
                entry.result.CopyFrom(result)
        return reply

    async def render_lidar(self, request):
        """One sweep."""
        with ExitStack() as held:
            job = await self.admit_lidar(request, held)
            self.check_reply(BYTES_A_POINT * job.beams, "points", "beams")
            return await self._render_lidar(job)

    async def render_aggregated(self, request):
        """Images and sweeps together; one that fails fails all, there is no place for its error in the reply."""
        self._check_batch(len(request.rgb_requests) + len(request.lidar_requests))
        with ExitStack() as held:
            jobs = await _all(self.admit_camera(item, held) for item in request.rgb_requests)
            sweeps = await _all(self.admit_lidar(item, held) for item in request.lidar_requests)
            self._check_images(jobs)
            self.check_reply(BYTES_A_POINT * sum(sweep.beams for sweep in sweeps), "points", "beams")
            rgb_returns = await _all(self._render_camera(job) for job in jobs)
            lidar_returns = await _all(self._render_lidar(sweep) for sweep in sweeps)
        return sensorsim.AggregatedRenderReturn(rgb_returns=rgb_returns, lidar_returns=lidar_returns)

    async def admit_camera(self, message, held: ExitStack) -> CameraJob:
        """Checks a request and borrows its scene until ``held`` ends."""
        loaded = held.enter_context(await self.lease(message.scene_id))
        request, options = await self._run(self._reading, wire.read_camera_request, message, loaded.scene.rig.cameras)
        if options.ego_mask:
            options = replace(options, ego_mask=self._masks.find(options.ego_mask))
        camera = request.sensor
        pixels = camera.width_px * camera.height_px
        self._check_pixels(pixels, f"{camera.width_px}x{camera.height_px} pixels")
        return CameraJob(loaded, self._admit(request, loaded.scene), options, pixels)

    async def admit_lidar(self, message, held: ExitStack) -> LidarJob:
        """Checks a request and borrows its scene until ``held`` ends."""
        loaded = held.enter_context(await self.lease(message.scene_id))
        request, filter = await self._run(self._reading, wire.read_lidar_request, message)
        rows, columns = len(request.sensor.elevation_rad), len(request.sensor.azimuth_rad)
        self._check_pixels(rows * columns, f"{rows}x{columns} beams")
        return LidarJob(loaded, self._admit(request, loaded.scene), filter, rows * columns)

    async def _finish(self, job: CameraJob | BaseException):
        if isinstance(job, BaseException):
            raise job
        return await self._render_camera(job)

    async def _render_camera(self, job: CameraJob):
        return await self.renders.run(lambda: self.finish_image(job.render(("rgb",)), job.options))

    async def _render_lidar(self, job: LidarJob):
        def render():
            reply = sensorsim.LidarRenderReturn()
            wire.write_lidar_frame(job.render(), reply)
            return reply

        return await self.renders.run(render)

    def finish_image(self, frame: CameraFrame, options: wire.ImageOptions):
        """An ``RGBRenderReturn``: the colours of a frame with the ego mask over them, in the format asked for."""
        rgb = self._masks.lay_over(frame.rgb, options.ego_mask) if options.ego_mask else frame.rgb
        reply = sensorsim.RGBRenderReturn()
        wire.write_image(rgb, options, reply)
        return reply

    def _admit(self, request: SensorRequest, scene: GaussianScene) -> SensorRequest:
        """The request as the renderer takes it: in the scene's time, with actors that the scene knows."""
        span_start, span_end = scene.span_us  # the renderer takes the last instant [end, end + 1) too
        # Clients take their times from the trajectory, which may reach a little farther than the sensors' data.
        first, last = min(span_start, scene.ego.start_us), max(span_end, scene.ego.end_us)
        if request.start_us > last or request.end_us <= first:
            raise OutOfRangeError(
                f"the frame [{request.start_us}, {request.end_us}) us lies outside of scene {scene.id!r}, "
                f"which covers [{first}, {last}]"
            )
        start_us = min(max(request.start_us, span_start), span_end)
        end_us = max(min(request.end_us, span_end + 1), start_us + 1)
        return replace(request, start_us=start_us, end_us=end_us, actors=self._actors(request, scene))

    def _actors(self, request: SensorRequest, scene: GaussianScene) -> dict[str, np.ndarray]:
        known = {track.id for track in scene.tracks}
        actors = {track_id: pair for track_id, pair in request.actors.items() if track_id in known}
        if len(actors) < len(request.actors):
            unknown = sorted(request.actors.keys() - known)
            log.info("scene %s has no %d of the actors listed, as %r", scene.id, len(unknown), unknown[0])
        if self._options.only_listed_actors and request.actors:
            buried = np.tile(np.eye(4), (2, 1, 1))
            buried[:, 2, 3] = -_BURIED_M
            actors |= {t.id: buried for t in scene.tracks if t.controllable and t.id not in actors}
        return actors

    def _check_images(self, jobs: Iterable[CameraJob]) -> None:
        self.check_reply(sum(job.planar_bytes for job in jobs), "pixels", "or smaller images, or for PNG or JPEG")


async def _all(tasks: Iterable[Awaitable[T]]) -> list[T]:
    """What all give once all have ended, so that none is left behind; raises what the first to fail raised."""
    results = await asyncio.gather(*tasks, return_exceptions=True)
    for result in results:
        if isinstance(result, BaseException):
            raise result
    return [result for result in results if not isinstance(result, BaseException)]
