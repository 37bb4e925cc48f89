"""The procedures that render.

Semantics (public NuRec and AlpaSim behaviour): a frame [start, end) renders if it overlaps the scene's time, for
AlpaSim's first exposure may begin before the recording and a client's last instant [t, t + 1) end after it; what sticks
out is clamped in time, poses stay as they are. Actors listed in a request are drawn where it says, unknown ids are
ignored, and all others, static ones always, are drawn as recorded.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from nurec_sim.compute.turns import aside, rest
from nurec_sim.errors import NurecSimError, OutOfRangeError
from nurec_sim.render.cpu.workers import Workers
from nurec_sim.render.requests import check_request, ray_count
from nurec_sim.serving import wire
from nurec_sim.serving.sensor_service.core import ServiceCore
from nurec_sim.serving.sensor_service.options import describe
from nurec_sim.serving.sensor_service.render_queue import LARGE_RAYS
from nurec_sim.serving.store import LoadedScene
from nurec_sim.serving.wire import sensorsim
from nurec_sim.types import (
    CameraFrame,
    CameraModel,
    GaussianScene,
    LidarFilter,
    LidarFrame,
    LidarModel,
    SensorRequest,
)

log = logging.getLogger(__name__)

T = TypeVar("T")

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

    def __init__(self, *arguments) -> None:
        super().__init__(*arguments)
        self._encoders = Workers(self._options.render_workers)

    async def warm_up(self) -> None:
        """Loads the first scene and draws one image and one sweep of it; what fails is logged only."""
        try:
            with await self.lease(self._store.ids[0]) as loaded:
                rig, ego = loaded.scene.rig, loaded.scene.ego
                start_us = max(loaded.scene.span_us[0], ego.start_us)

                def look(sensor: CameraModel | LidarModel, rig_from_sensor: np.ndarray) -> SensorRequest:
                    pose = ego.at(start_us) @ rig_from_sensor
                    return SensorRequest(loaded.scene.id, sensor, start_us, start_us + 1, np.stack([pose, pose]))

                first = [look(camera, camera.rig_from_camera) for camera in list(rig.cameras.values())[:1]]
                first += [look(lidar, lidar.rig_from_lidar) for lidar in list(rig.lidars.values())[:1]]
                await self.renders.run(0, loaded.renderer.sense, first, ("rgb",))
        except Exception as error:
            log.warning("the server could not warm up: %s", error)

    async def render_rgb(self, request):
        """One image."""
        with ExitStack() as held:
            job = await self.admit_camera(request, held)
            self._check_images([job])
            (reply,) = _raise_first(await self._render_cameras([job]))
            return reply

    async def batch_render_rgb(self, batch):
        """Several images; what is wrong with one item is said in that item."""
        self._check_batch(len(batch.items))
        self._check_sizes(item.request for item in batch.items)
        with ExitStack() as held:
            admitted = await asyncio.gather(
                *(self.admit_camera(item.request, held) for item in batch.items), return_exceptions=True
            )
            jobs = [job for job in admitted if isinstance(job, CameraJob)]
            self._check_images(jobs)
            rendered = iter(await self._render_cameras(jobs))
            results = [next(rendered) if isinstance(job, CameraJob) else job for job in admitted]
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
            with self.spending(job.beams):
                return await self._render_lidar(job)

    async def render_aggregated(self, request):
        """Images and sweeps together; one that fails fails all, there is no place for its error in the reply."""
        self._check_batch(len(request.rgb_requests) + len(request.lidar_requests))
        self._check_sizes(request.rgb_requests)
        with ExitStack() as held:
            jobs = await _all(self.admit_camera(item, held) for item in request.rgb_requests)
            sweeps = await _all(self.admit_lidar(item, held) for item in request.lidar_requests)
            self._check_images(jobs)
            self.check_reply(BYTES_A_POINT * sum(sweep.beams for sweep in sweeps), "points", "beams")
            with self.spending(sum(job.pixels for job in jobs) + sum(sweep.beams for sweep in sweeps)):
                rgb_returns = _raise_first(await self._render_all(jobs))
                lidar_returns = await _all(self._render_lidar(sweep) for sweep in sweeps)
        return sensorsim.AggregatedRenderReturn(rgb_returns=rgb_returns, lidar_returns=lidar_returns)

    async def admit_camera(self, message, held: ExitStack) -> CameraJob:
        """Checks a request and borrows its scene until ``held`` ends."""
        loaded = held.enter_context(await self.lease(message.scene_id))
        return await self._read(len(message.dynamic_objects), self._read_camera, message, loaded)

    async def admit_lidar(self, message, held: ExitStack) -> LidarJob:
        """Checks a request and borrows its scene until ``held`` ends."""
        loaded = held.enter_context(await self.lease(message.scene_id))
        return await self._read(len(message.dynamic_objects), self._read_lidar, message, loaded)

    def _read_camera(self, message, loaded: LoadedScene) -> CameraJob:
        request, options = wire.read_camera_request(message, loaded.scene.rig.cameras)
        if options.ego_mask:
            options = replace(options, ego_mask=self._masks.find(options.ego_mask))
        camera = request.sensor
        assert isinstance(camera, CameraModel)
        self._check_pixels(ray_count(request), f"{camera.width_px}x{camera.height_px} pixels")
        return CameraJob(loaded, self._admit(request, loaded.scene), options, ray_count(request))

    def _read_lidar(self, message, loaded: LoadedScene) -> LidarJob:
        request, filter = wire.read_lidar_request(message)
        lidar = request.sensor
        assert isinstance(lidar, LidarModel)
        rows, columns = len(lidar.elevation_rad), len(lidar.azimuth_rad)
        self._check_pixels(ray_count(request), f"{rows}x{columns} beams")
        return LidarJob(loaded, self._admit(request, loaded.scene), filter, ray_count(request))

    async def _render_cameras(self, jobs: Sequence[CameraJob]) -> list[Any]:
        """An ``RGBRenderReturn``, or an error, for each job; all of them are one call."""
        with self.spending(sum(job.pixels for job in jobs)):
            return await self._render_all(jobs)

    async def _render_all(self, jobs: Sequence[CameraJob]) -> list[Any]:
        """As ``_render_cameras``; those of one scene are rendered together."""
        groups: dict[int, list[int]] = {}
        for number, job in enumerate(jobs):
            groups.setdefault(id(job.loaded), []).append(number)
        asked = [[jobs[number] for number in numbers] for numbers in groups.values()]
        works = [self.renders.run(sum(job.pixels for job in group), self._draw, group) for group in asked]
        results: list[Any] = [None] * len(jobs)
        for numbers, done in zip(groups.values(), await asyncio.gather(*works, return_exceptions=True), strict=True):
            for place, number in enumerate(numbers):
                results[number] = done if isinstance(done, BaseException) else done[place]
        return results

    def _draw(self, jobs: Sequence[CameraJob]) -> list[Any]:
        """Replies, or errors, to jobs of one scene."""
        frames = jobs[0].loaded.renderer.sense([job.request for job in jobs], ("rgb",))
        return self.finish_images(frames, [job.options for job in jobs])

    async def _render_lidar(self, job: LidarJob):
        def render():
            reply = sensorsim.LidarRenderReturn()
            wire.write_lidar_frame(job.render(), reply)
            return reply

        return await self.renders.run(job.beams, render)

    def finish_images(self, frames: Sequence[Any], options: Sequence[wire.ImageOptions]) -> list[Any]:
        """An ``RGBRenderReturn``, or an error, for each frame: its colours in the format asked for."""
        calls = [(self._finished, *pair) for pair in zip(frames, options, strict=True)]
        if all(frame.rgb.size <= 3 * LARGE_RAYS for frame in frames):
            return self._encoders.run_calls(calls)
        results = []
        for first in range(0, len(calls), self._encoders.threads):
            rest()
            with aside():  # an encoder cannot be interrupted
                results += self._encoders.run_calls(calls[first : first + self._encoders.threads])
        return results

    def _finished(self, frame: CameraFrame, options: wire.ImageOptions):
        """An ``RGBRenderReturn``, with the ego mask over the image, or what went wrong."""
        try:
            rgb = self._masks.lay_over(frame.rgb, options.ego_mask) if options.ego_mask else frame.rgb
            reply = sensorsim.RGBRenderReturn()
            wire.write_image(rgb, options, reply)
            return reply
        except Exception as error:
            return error

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
        actors = self._actors(request, scene)
        hidden: frozenset[str] = frozenset()
        if self._options.only_listed_actors and request.actors:
            hidden = frozenset(track.id for track in scene.tracks if track.controllable and track.id not in actors)
        admitted = replace(request, start_us=start_us, end_us=end_us, actors=actors, hidden=hidden)
        check_request(admitted, scene)
        return admitted

    def _actors(self, request: SensorRequest, scene: GaussianScene) -> dict[str, np.ndarray]:
        known = {track.id for track in scene.tracks}
        actors = {track_id: pair for track_id, pair in request.actors.items() if track_id in known}
        if len(actors) < len(request.actors):
            unknown = sorted(request.actors.keys() - known)
            log.info("scene %s has no %d of the actors listed, as %r", scene.id, len(unknown), unknown[0])
        return actors

    def _check_sizes(self, messages: Iterable[Any]) -> None:
        """Refuses a call that names more pixels than it may have, before anything of it is read."""
        self.check_rays(sum(message.resolution_w * message.resolution_h for message in messages))

    def _check_images(self, jobs: Iterable[CameraJob]) -> None:
        self.check_reply(sum(job.planar_bytes for job in jobs), "pixels", "or smaller images, or for PNG or JPEG")


def _raise_first(results: list[Any]) -> list[Any]:
    """The results, if none of them is an error."""
    for result in results:
        if isinstance(result, BaseException):
            raise result
    return results


async def _all(tasks: Iterable[Awaitable[T]]) -> list[T]:
    """What all give once all have ended, so that none is left behind; raises what the first to fail raised."""
    return _raise_first(await asyncio.gather(*tasks, return_exceptions=True))
