"""What all procedures share: scenes, loaded once for all clients, and thread pools."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from nurec_sim.errors import CancelledError
from nurec_sim.serving.calls import current_call
from nurec_sim.serving.sensor_service.images import EgoMasks
from nurec_sim.serving.sensor_service.options import ServiceOptions
from nurec_sim.serving.sensor_service.render_queue import RenderQueue
from nurec_sim.serving.sensor_service.scene_urls import SceneUrls
from nurec_sim.serving.store import Lease, LoadedScene, SceneStore
from nurec_sim.types import CameraModel, GaussianScene, LidarModel, SensorRequest

log = logging.getLogger(__name__)

_LOADING_THREADS = 4
_FETCHING_THREADS = 4  # of their own, so that a slow web does not hold up scenes that are here


class ServiceCore:
    """The scenes and threads of a service.

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
        self._urls = SceneUrls(store, options)
        self._loads: dict[str, asyncio.Future[LoadedScene]] = {}
        self._closing = False
        self._loading = ThreadPoolExecutor(_LOADING_THREADS, thread_name_prefix="scene")
        self._fetching = ThreadPoolExecutor(_FETCHING_THREADS, thread_name_prefix="fetch")
        self._reading = RenderQueue(1)  # one at a time, for what is read holds Python's lock, which all need
        self.renders = RenderQueue(options.render_workers)

    def close(self) -> None:
        """Cancels queued work and waits for running work; reconstructions stop at their next step."""
        self._closing = True
        for load in self._loads.values():
            load.cancel()
        self._reading.close()
        self.renders.close()
        for executor in (self._loading, self._fetching):
            executor.shutdown(wait=True, cancel_futures=True)

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

    async def offer_scene(self) -> None:
        """Offers the scene whose address came as metadata of the current call.

        Raises:
            RequestError, NotAllowedError, TooLargeError, ArchiveError: see ``SceneUrls.offer``.
        """
        metadata = current_call().metadata
        if self._urls.is_new(metadata):
            await self._run(self._fetching, self._urls.offer, metadata)

    async def lease(self, name: str) -> Lease:
        """The use of a scene, loaded if it has to be; the caller releases it.

        One thread loads it, however many clients wait; shielded, so that one who leaves does not end it for the rest.
        """
        while True:
            lease = self._store.lease_in_memory(name)
            if lease is not None:
                return lease
            scene_id = self._store.resolve(name)
            load = self._loads.get(scene_id)
            if load is None or load.done():  # awaiting what is done would not let anything else run
                load = asyncio.ensure_future(self._run(self._loading, self._store.get, scene_id, self._go_on))
                load.add_done_callback(partial(self._end_load, scene_id))
                self._loads[scene_id] = load
            await asyncio.shield(load)

    def _end_load(self, scene_id: str, load: asyncio.Future) -> None:
        if self._loads.get(scene_id) is load:
            del self._loads[scene_id]

    def _go_on(self, stage: str, fraction: float) -> None:
        if self._closing:
            raise CancelledError(f"the server is stopping; loading a scene was cancelled at {fraction:.0%} ({stage})")

    async def _scene(self, name: str) -> GaussianScene:
        """A scene, to be read only."""
        with await self.lease(name) as loaded:
            return loaded.scene

    @staticmethod
    async def _run(executor: ThreadPoolExecutor, function: Callable, *arguments):
        # A client that cancels its call cancels the await, and with it a job that has not begun.
        return await asyncio.get_running_loop().run_in_executor(executor, function, *arguments)


async def run_to_end(executor: ThreadPoolExecutor, function: Callable, *arguments):
    """Runs a function that must not be interrupted: a cancelled call still waits for its end."""
    work = asyncio.get_running_loop().run_in_executor(executor, function, *arguments)
    try:
        return await asyncio.shield(work)
    except asyncio.CancelledError:
        await asyncio.wait([work])
        raise
