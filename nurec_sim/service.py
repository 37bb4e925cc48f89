"""What every procedure of the sensor interface does; ``server`` puts it on the network.

Semantics (public NuRec and AlpaSim behaviour): a frame [start, end) renders if it overlaps the scene's time, for
AlpaSim's first exposure may begin before the recording and a client's last instant [t, t + 1) end after it; what sticks
out is clamped in time, poses stay as they are. Actors listed in a request are drawn where it says, unknown ids are
ignored, and all others, static ones always, are drawn as recorded.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import nurec_sim
from nurec_sim import wire
from nurec_sim.ego_masks import EgoMasks
from nurec_sim.errors import NurecSimError, OutOfRangeError, RequestError, TooLargeError
from nurec_sim.render.requests import MAX_RAYS
from nurec_sim.scene_store import LoadedScene, SceneStore
from nurec_sim.sensors import fill_ftheta
from nurec_sim.types import CameraModel, FTheta, GaussianScene, LidarModel, SensorRequest
from nurec_sim.wire import common, sensorsim

log = logging.getLogger(__name__)

API_VERSION = (0, 54, 0)
"""The version of AlpaSim's interface whose messages ``protos/`` holds."""

_BURIED_M = 10_000.0
_LOADING_THREADS = 4
_BYTES_A_POINT = 24  # xyz, intensity, range, beam


@dataclass(frozen=True)
class ServiceOptions:
    """What a server allows and how it reads what the interface leaves open."""

    render_workers: int = 1
    """Frames rendered at the same time; each uses the renderer's threads."""
    max_pixels: int = MAX_RAYS
    """Pixels, or beams, of one frame; the renderer takes no more than the default."""
    max_batch_items: int = 64
    max_message_bytes: int = 64 << 20
    """Of a request or a reply; AlpaSim's clients take no more."""
    only_listed_actors: bool = False
    """Whether a request that lists actors hides the controllable ones that it does not list."""
    ego_mask_dir: Path | None = None
    allow_shut_down: bool = False
    warm_up: bool = False
    """Whether the first scene is loaded, and kernels are compiled, before somebody asks."""


@dataclass(frozen=True)
class _CameraJob:
    """One admitted camera request."""

    loaded: LoadedScene
    request: SensorRequest
    options: wire.ImageOptions
    pixels: int

    @property
    def planar_bytes(self) -> int:
        """Size of the reply if it is raw pixels, else 0: compressed images are small."""
        return 3 * self.pixels if self.options.format == wire.ImageFormat.RGB_UINT8_PLANAR else 0


class UnsupportedError(RequestError):
    """A procedure that the interface knows and this server does not offer."""


class SensorService:
    """The procedures, one coroutine each, by their names on the wire: message in, message out, errors raised.

    Args:
        store: the scenes.
        options: limits and choices.
        request_stop: called by ``shut_down``.
    """

    def __init__(self, store: SceneStore, options: ServiceOptions, request_stop: Callable[[], None]) -> None:
        self._store = store
        self._options = options
        self._request_stop = request_stop
        self._masks = EgoMasks(options.ego_mask_dir)
        self._loads: dict[str, asyncio.Future[LoadedScene]] = {}
        self._loading = ThreadPoolExecutor(_LOADING_THREADS, thread_name_prefix="scene")
        self._reading = ThreadPoolExecutor(1, thread_name_prefix="request")
        self._rendering = ThreadPoolExecutor(options.render_workers, thread_name_prefix="render")

    def close(self) -> None:
        """Drops what has not begun and waits for the rest."""
        for executor in (self._rendering, self._reading, self._loading):
            executor.shutdown(wait=True, cancel_futures=True)

    async def warm_up(self) -> None:
        """Loads the first scene and draws one image and one sweep of it; what fails is logged only."""
        try:
            loaded = await self._scene(self._store.ids[0])
            rig, ego = loaded.scene.rig, loaded.scene.ego
            start_us = max(loaded.scene.span_us[0], ego.start_us)

            def look(sensor: CameraModel | LidarModel, rig_from_sensor: np.ndarray) -> SensorRequest:
                pose = ego.at(start_us) @ rig_from_sensor
                return SensorRequest(loaded.scene.id, sensor, start_us, start_us + 1, np.stack([pose, pose]))

            for camera in list(rig.cameras.values())[:1]:
                request = look(camera, camera.rig_from_camera)
                await self._run(self._rendering, loaded.renderer.render_camera, request, ("rgb",))
            for lidar in list(rig.lidars.values())[:1]:
                await self._run(self._rendering, loaded.renderer.render_lidar, look(lidar, lidar.rig_from_lidar))
        except Exception as error:
            log.warning("the server could not warm up: %s", error)

    # ------------------------------------------------------------------------------------------------------ rendering

    async def render_rgb(self, request):
        """One image."""
        job = await self._admit_camera(request)
        self._check_images([job])
        return await self._render_camera(job)

    async def batch_render_rgb(self, batch):
        """Several images; what is wrong with one item is said in that item."""
        if len(batch.items) > self._options.max_batch_items:
            raise TooLargeError(f"a batch may have {self._options.max_batch_items} items, got {len(batch.items)}")
        admitted = await asyncio.gather(
            *(self._admit_camera(item.request) for item in batch.items), return_exceptions=True
        )
        self._check_images(job for job in admitted if isinstance(job, _CameraJob))
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
        loaded = await self._scene(request.scene_id)
        sensing, filter = await self._run(self._reading, wire.read_lidar_request, request)
        sensing = self._admit(sensing, loaded.scene)
        beams = len(sensing.sensor.elevation_rad) * len(sensing.sensor.azimuth_rad)
        self._check_pixels(beams, f"{len(sensing.sensor.elevation_rad)}x{len(sensing.sensor.azimuth_rad)} beams")
        self._check_reply(_BYTES_A_POINT * beams, "points", "beams")

        def render():
            reply = sensorsim.LidarRenderReturn()
            wire.write_lidar_frame(loaded.renderer.render_lidar(sensing, filter), reply)
            return reply

        return await self._run(self._rendering, render)

    async def render_aggregated(self, request):
        """Images and sweeps together; one that fails fails all, there is no place for its error in the reply."""
        count = len(request.rgb_requests) + len(request.lidar_requests)
        if count > self._options.max_batch_items:
            raise TooLargeError(f"a batch may have {self._options.max_batch_items} items, got {count}")
        jobs = await asyncio.gather(*(self._admit_camera(item) for item in request.rgb_requests))
        self._check_images(jobs)
        images = await asyncio.gather(*(self._render_camera(job) for job in jobs))
        sweeps = await asyncio.gather(*(self.render_lidar(item) for item in request.lidar_requests))
        return sensorsim.AggregatedRenderReturn(rgb_returns=images, lidar_returns=sweeps)

    async def _admit_camera(self, message) -> _CameraJob:
        loaded = await self._scene(message.scene_id)
        request, options = await self._run(self._reading, wire.read_camera_request, message, loaded.scene.rig.cameras)
        if options.ego_mask:
            self._masks.check(options.ego_mask)
        camera = request.sensor
        pixels = camera.width_px * camera.height_px
        self._check_pixels(pixels, f"{camera.width_px}x{camera.height_px} pixels")
        return _CameraJob(loaded, self._admit(request, loaded.scene), options, pixels)

    async def _finish(self, job: _CameraJob | Exception):
        if isinstance(job, BaseException):
            raise job
        return await self._render_camera(job)

    async def _render_camera(self, job: _CameraJob):
        def render():
            request = job.request
            if not job.options.apply_isp:
                # The correction is found by the camera's id; an id that no scene knows renders without.
                request = replace(request, sensor=replace(request.sensor, id=""))
            rgb = job.loaded.renderer.render_camera(request, outputs=("rgb",)).rgb
            if job.options.ego_mask:
                rgb = self._masks.lay_over(rgb, job.options.ego_mask)
            reply = sensorsim.RGBRenderReturn()
            wire.write_image(rgb, job.options, reply)
            return reply

        return await self._run(self._rendering, render)

    def _admit(self, request: SensorRequest, scene: GaussianScene) -> SensorRequest:
        first, last = scene.span_us  # the renderer takes the last instant [last, last + 1) too
        if request.start_us > last or request.end_us <= first:
            raise OutOfRangeError(
                f"the frame [{request.start_us}, {request.end_us}) us lies outside of scene {scene.id!r}, "
                f"which covers [{first}, {last}]"
            )
        known = {track.id: track for track in scene.tracks}
        actors = {track_id: pair for track_id, pair in request.actors.items() if track_id in known}
        if self._options.only_listed_actors and request.actors:
            buried = np.tile(np.eye(4), (2, 1, 1))
            buried[:, 2, 3] = -_BURIED_M
            actors |= {t.id: buried for t in scene.tracks if t.controllable and t.id not in actors}
        start_us, end_us = max(request.start_us, first), min(request.end_us, last + 1)
        return replace(request, start_us=start_us, end_us=end_us, actors=actors)

    def _check_pixels(self, count: int, text: str) -> None:
        if count > self._options.max_pixels:
            raise TooLargeError(
                f"a frame may have {self._options.max_pixels:,} pixels or beams, got {text} = {count:,}"
            )

    def _check_reply(self, size: int, what: str, fewer: str) -> None:
        if size > self._options.max_message_bytes:
            raise TooLargeError(
                f"the raw {what} of this reply may take {size:,} bytes of {self._options.max_message_bytes:,}; "
                f"ask for fewer {fewer}"
            )

    def _check_images(self, jobs: Iterable[_CameraJob]) -> None:
        self._check_reply(sum(job.planar_bytes for job in jobs), "pixels", "or smaller images, or for PNG or JPEG")

    async def _scene(self, name: str) -> LoadedScene:
        loaded = self._store.in_memory(name)
        if loaded is not None:
            return loaded
        # One thread a scene, however many clients wait; shielded, so that one who leaves does not end it for the rest.
        scene_id = self._store.resolve(name)
        if scene_id not in self._loads:
            load = asyncio.ensure_future(self._run(self._loading, self._store.get, scene_id))
            load.add_done_callback(lambda _: self._loads.pop(scene_id, None))
            self._loads[scene_id] = load
        return await asyncio.shield(self._loads[scene_id])

    @staticmethod
    async def _run(executor: ThreadPoolExecutor, function: Callable, *arguments):
        # If the client gives up, the await is cancelled, and with it a job that has not begun.
        return await asyncio.get_running_loop().run_in_executor(executor, function, *arguments)

    # ------------------------------------------------------------------------------------------------------ discovery

    async def get_version(self, request):
        """Version of this package and of the interface."""
        reply = common.VersionId(version_id=nurec_sim.__version__)
        api = reply.grpc_api_version
        api.major, api.minor, api.patch = API_VERSION
        return reply

    async def get_available_scenes(self, request):
        """Ids of all scenes."""
        return common.AvailableScenesReturn(scene_ids=self._store.ids)

    async def get_loaded_scenes(self, request):
        """Ids of the scenes in memory, and how many fit."""
        reply = sensorsim.LoadedScenesReturn(loaded_instance_capacity=self._store.capacity)
        for scene_id in self._store.loaded_ids:
            reply.scenes.add(scene_id=scene_id, loaded_instance_count=1, reusable_instance_count=1)
        return reply

    async def get_available_cameras(self, request):
        """Cameras of the rig at their native size, both F-theta polynomials filled in."""
        rig = (await self._scene(request.scene_id)).scene.rig
        reply = sensorsim.AvailableCamerasReturn()
        for camera in rig.cameras.values():
            entry = reply.available_cameras.add(logical_id=camera.id)
            wire.write_camera(_with_both_polynomials(camera), entry.intrinsics)
            wire.write_mounting(camera.rig_from_camera, entry.rig_to_camera)
        return reply

    async def get_available_lidars(self, request):
        """LiDARs of the rig."""
        rig = (await self._scene(request.scene_id)).scene.rig
        reply = sensorsim.AvailableLidarsReturn()
        for lidar in rig.lidars.values():
            entry = reply.available_lidars.add(logical_id=lidar.id)
            wire.write_lidar(lidar, entry.lidar_config)
            wire.write_mounting(lidar.rig_from_lidar, entry.rig_from_lidar)
        return reply

    async def get_available_trajectories(self, request):
        """The recorded path of the rig."""
        scene = (await self._scene(request.scene_id)).scene
        reply = sensorsim.AvailableTrajectoriesReturn()
        wire.write_trajectory(scene.ego, reply.available_trajectories.add().trajectory)
        return reply

    async def get_available_ego_masks(self, request):
        """Masks of the ego mask folder."""
        reply = sensorsim.AvailableEgoMasksReturn()
        for rig, camera in self._masks.ids:
            entry = reply.ego_mask_metadata.add().ego_mask_id
            entry.rig_config_id, entry.camera_logical_id = rig, camera
        return reply

    async def get_dynamic_objects(self, request):
        """All tracks of the scene."""
        scene = (await self._scene(request.scene_id)).scene
        reply = sensorsim.DynamicObjectsReturn()
        for track in scene.tracks:
            wire.write_track(track, reply.dynamic_objects.add())
        return reply

    async def get_external_asset_objects(self, request):
        """None: scenes hold no assets beyond their tracks."""
        self._store.resolve(request.scene_id)
        return sensorsim.ExternalAssetObjectsReturn()

    async def get_server_config(self, request):
        """The options of this server as text."""
        names = (*vars(self._options), "scenes", "scene_capacity")
        values = (*vars(self._options).values(), len(self._store.ids), self._store.capacity)
        return sensorsim.ServerConfigReturn(config={n: str(v) for n, v in zip(names, values, strict=True)})

    async def edit_assets(self, request):
        """Not offered."""
        raise UnsupportedError("assets cannot be replaced or inserted; move actors with a request's dynamic_objects")

    async def restore_model_parameters(self, request):
        """Not offered: nothing can be edited."""
        raise UnsupportedError("there is nothing to restore, since scenes cannot be edited")

    async def shut_down(self, request):
        """Stops the server, if it was started so that clients may."""
        if not self._options.allow_shut_down:
            raise UnsupportedError("this server was not started with permission to be shut down by clients")
        self._request_stop()
        return common.Empty()


def describe(error: Exception) -> str:
    """The text of an error that is fit for a client."""
    return str(error) if isinstance(error, NurecSimError) else f"internal error: {type(error).__name__}: {error}"


def _with_both_polynomials(camera: CameraModel) -> CameraModel:
    if not isinstance(camera.lens, FTheta):
        return camera
    far_x = max(camera.lens.cx_px, camera.width_px - camera.lens.cx_px)
    far_y = max(camera.lens.cy_px, camera.height_px - camera.lens.cy_px)
    return replace(camera, lens=fill_ftheta(camera.lens, float(np.hypot(far_x, far_y))))
