"""Rendering procedures.

Semantics (public NuRec and AlpaSim behaviour): a frame [start, end) renders if it overlaps the scene's time, because
AlpaSim's first exposure may begin before the recording and a client's last instant [t, t + 1) end after it; times
outside the scene are clamped, poses are not. Actors listed in a request are drawn at its poses, unknown ids are
ignored, and all other actors are drawn as recorded.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from nurec_sim.errors import NurecSimError, OutOfRangeError, RequestError, TooLargeError
from nurec_sim.serving import wire
from nurec_sim.serving.calls import current_call
from nurec_sim.serving.sensor_service.core import ServiceCore
from nurec_sim.serving.sensor_service.images import ImageReplies
from nurec_sim.serving.store import LoadedScene
from nurec_sim.serving.wire import sensorsim
from nurec_sim.types import CameraModel, LidarFilter, LidarFrame, LidarModel, SensorRequest

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
        self.images = ImageReplies(self._masks, self._options.render_workers)
        self._asked_rays: Counter[tuple[str, ...]] = Counter()
        """Pixels and beams of calls in progress, by client."""

    async def render_rgb(self, request):
        """One image."""
        with contextlib.ExitStack() as held:
            job = await self.admit_camera(request, held)
            self._check_images([job])
            with self.spending(job.pixels):
                (reply,) = _raise_first(await self._render_all([job]))
            return reply

    async def batch_render_rgb(self, batch):
        """Several images; an item that fails has the error in its own reply."""
        self._check_batch(len(batch.items))
        self._check_sizes(item.request for item in batch.items)
        with contextlib.ExitStack() as held:
            admitted = await asyncio.gather(
                *(self.admit_camera(item.request, held) for item in batch.items), return_exceptions=True
            )
            jobs = [job for job in admitted if isinstance(job, CameraJob)]
            self._check_images(jobs)
            with self.spending(sum(job.pixels for job in jobs)):
                rendered = iter(await self._render_all(jobs))
            results = [next(rendered) if isinstance(job, CameraJob) else job for job in admitted]
        reply = sensorsim.BatchRGBRenderReturn()
        for item, result in zip(batch.items, results, strict=True):
            entry = reply.items.add(camera_name=item.camera_name)
            if isinstance(result, Exception):
                if not isinstance(result, NurecSimError):
                    log.error("batch item %r failed", item.camera_name, exc_info=result)
                entry.error_message, entry.error_code = wire.text_of(result), wire.number_of(result)
            else:
                entry.success = True
                entry.result.CopyFrom(result)
        return reply

    async def render_lidar(self, request):
        """One sweep."""
        with contextlib.ExitStack() as held:
            job = await self.admit_lidar(request, held)
            self.check_reply(BYTES_A_POINT * job.beams, "points", "beams")
            with self.spending(job.beams):
                return await self._render_lidar(job)

    async def render_aggregated(self, request):
        """Images and sweeps together; one failure fails the call, because the reply has no field for single errors."""
        self._check_batch(len(request.rgb_requests) + len(request.lidar_requests))
        self._check_sizes(request.rgb_requests)
        with contextlib.ExitStack() as held:
            jobs = await _all(self.admit_camera(item, held) for item in request.rgb_requests)
            sweeps = await _all(self.admit_lidar(item, held) for item in request.lidar_requests)
            self._check_images(jobs)
            self.check_reply(BYTES_A_POINT * sum(sweep.beams for sweep in sweeps), "points", "beams")
            with self.spending(sum(job.pixels for job in jobs) + sum(sweep.beams for sweep in sweeps)):
                rgb_returns = _raise_first(await self._render_all(jobs))
                lidar_returns = await _all(self._render_lidar(sweep) for sweep in sweeps)
        return sensorsim.AggregatedRenderReturn(rgb_returns=rgb_returns, lidar_returns=lidar_returns)

    async def admit_camera(self, message, held: contextlib.ExitStack) -> CameraJob:
        """Parses a request and leases its scene until ``held`` is closed."""
        loaded = await self._borrow(message.scene_id, held)
        return await self._read(len(message.dynamic_objects), self._read_camera, message, loaded)

    async def admit_lidar(self, message, held: contextlib.ExitStack) -> LidarJob:
        """Parses a request and leases its scene until ``held`` is closed."""
        loaded = await self._borrow(message.scene_id, held)
        return await self._read(len(message.dynamic_objects), self._read_lidar, message, loaded)

    async def _borrow(self, name: str, held: contextlib.ExitStack) -> LoadedScene:
        # A scene in memory is found by its id at once; other names and loading are the store's.
        return held.enter_context(self._store.memory.lease_ready(name) or await self.lease(name))

    def _read_camera(self, message, loaded: LoadedScene) -> CameraJob:
        request, options = wire.read_camera_request(message, loaded.scene.rig.cameras)
        if options.ego_mask == ("", request.sensor.id) and not self._masks.has(request.sensor.id):
            # No mask is named: what the scene itself knows of the ego vehicle, which may be nothing.
            request, options = replace(request, show_ego=True), replace(options, ego_mask=None)
        if options.ego_mask:
            options = replace(options, ego_mask=self._masks.find(options.ego_mask))
        camera = request.sensor
        assert isinstance(camera, CameraModel)
        pixels = camera.width_px * camera.height_px
        self._check_pixels(pixels, f"{camera.width_px}x{camera.height_px} pixels")
        return CameraJob(loaded, self._admit(request, loaded), options, pixels)

    def _read_lidar(self, message, loaded: LoadedScene) -> LidarJob:
        request, filter = wire.read_lidar_request(message)
        lidar = request.sensor
        assert isinstance(lidar, LidarModel)
        rows, columns = len(lidar.elevation_rad), len(lidar.azimuth_rad)
        self._check_pixels(rows * columns, f"{rows}x{columns} beams")
        return LidarJob(loaded, self._admit(request, loaded), filter, rows * columns)

    async def _render_all(self, jobs: Sequence[CameraJob]) -> list[Any]:
        """An ``RGBRenderReturn``, or an error, for each job; those of one scene are rendered together."""
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
        """Replies, or errors, to jobs of one scene; the renderer checks a request before it renders any."""
        try:
            frames = jobs[0].loaded.renderer.sense([job.request for job in jobs], ("rgb",))
        except RequestError as error:
            return [error] if len(jobs) == 1 else [reply for job in jobs for reply in self._draw([job])]
        return self.images.of(frames, [job.options for job in jobs])

    async def _render_lidar(self, job: LidarJob):
        def render():
            reply = sensorsim.LidarRenderReturn()
            wire.write_lidar_frame(job.render(), reply)
            return reply

        return await self.renders.run(job.beams, render)

    def _admit(self, request: SensorRequest, loaded: LoadedScene) -> SensorRequest:
        """The request for the renderer: times clamped to the scene, unknown actors dropped."""
        scene, (first, last) = loaded.scene, loaded.times_us
        if request.start_us > last or request.end_us <= first:
            raise OutOfRangeError(
                f"the frame [{request.start_us}, {request.end_us}) us lies outside of scene {scene.id!r}, "
                f"which covers [{first}, {last}]"
            )
        span_start, span_end = scene.span_us  # the renderer takes the last instant [end, end + 1) too
        start_us = min(max(request.start_us, span_start), span_end)
        end_us = max(min(request.end_us, span_end + 1), start_us + 1)
        actors = request.actors
        if unknown := sorted(actors.keys() - loaded.tracks.keys()):
            log.info("scene %s has no %d of the actors listed, as %r", scene.id, len(unknown), unknown[0])
            actors = {track_id: pair for track_id, pair in actors.items() if track_id in loaded.tracks}
        hidden: frozenset[str] = frozenset()
        if self._options.only_listed_actors and request.actors:
            hidden = frozenset(key for key, track in loaded.tracks.items() if track.controllable and key not in actors)
        return replace(request, start_us=start_us, end_us=end_us, actors=actors, hidden=hidden)

    def _check_batch(self, count: int) -> None:
        if count > self._options.max_batch_items:
            raise TooLargeError(f"a batch may have {self._options.max_batch_items} items, got {count}")

    async def _read(self, actors: int, function: Callable[..., T], *arguments) -> T:
        """Parses a request, in turn with other clients."""
        if actors > self._options.max_actors:
            raise TooLargeError(
                f"a frame may place {self._options.max_actors:,} actors (max_actors), got {actors:,} dynamic_objects"
            )
        return await self._reading.run(actors, function, *arguments)

    def _check_pixels(self, count: int, text: str) -> None:
        if count > self._options.max_pixels:
            raise TooLargeError(
                f"a frame may have {self._options.max_pixels:,} pixels or beams, got {text} = {count:,}"
            )

    def check_rays(self, rays: int) -> None:
        """Refuses a call that asks for too many pixels and beams.

        Raises:
            TooLargeError: how many it may ask for.
        """
        if rays > self._options.max_call_rays:
            raise TooLargeError(
                f"a call may ask for {self._options.max_call_rays:,} pixels and beams in all (max_call_rays), "
                f"got {rays:,}; ask for fewer or smaller frames"
            )

    @contextlib.contextmanager
    def spending(self, rays: int) -> Iterator[None]:
        """Counts the pixels and beams of the current call while it is in progress.

        Args:
            rays: pixels and beams of all its frames.

        Raises:
            TooLargeError: more than a call may ask for, or than its client may together with its other calls.
        """
        self.check_rays(rays)
        options, client = self._options, current_call().client
        others = self._asked_rays[client]
        if others and others + rays > options.max_client_rays:
            raise TooLargeError(
                f"the calls of a connection may ask for {options.max_client_rays:,} pixels and beams at a time "
                f"(max_client_rays); {others:,} are in progress, and this call asks for {rays:,}; try again later"
            )
        self._asked_rays[client] += rays
        try:
            yield
        finally:
            self._asked_rays[client] -= rays
            if not self._asked_rays[client]:
                del self._asked_rays[client]

    def check_reply(self, size: int, what: str, fewer: str) -> None:
        """Refuses a reply that would not fit a message, before it is made.

        Raises:
            TooLargeError: what is too large, and what to ask for instead.
        """
        if size > self._options.max_message_bytes:
            raise TooLargeError(
                f"the raw {what} of this reply may take {size:,} bytes of {self._options.max_message_bytes:,}; "
                f"ask for fewer {fewer}"
            )

    def _check_sizes(self, messages: Iterable[Any]) -> None:
        """Refuses a call with too many pixels before its requests are parsed."""
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
    """The results of all tasks, after all have ended; raises the first error."""
    return _raise_first(await asyncio.gather(*tasks, return_exceptions=True))
