"""What all procedures share: scenes on loan, threads to work in, limits."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

from nurec_sim.errors import CancelledError, TooLargeError
from nurec_sim.serving.calls import current_call
from nurec_sim.serving.sensor_service.ego_masks import EgoMasks
from nurec_sim.serving.sensor_service.options import ServiceOptions
from nurec_sim.serving.sensor_service.render_queue import RenderQueue
from nurec_sim.serving.sensor_service.scene_urls import SceneUrls
from nurec_sim.serving.store import Lease, LoadedScene, SceneStore
from nurec_sim.types import GaussianScene

T = TypeVar("T")

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
        self._asked_rays: Counter[tuple[str, ...]] = Counter()
        """Pixels and beams of calls in progress, by client."""

    def close(self) -> None:
        """Drops what has not begun and waits for the rest; reconstructions end at their next step."""
        self._closing = True
        for load in self._loads.values():
            load.cancel()
        self._reading.close()
        self.renders.close()
        for executor in (self._loading, self._fetching):
            executor.shutdown(wait=True, cancel_futures=True)

    async def prepare(self) -> None:
        """What comes before every procedure: offers the scene whose address came beside the request.

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
        """What a scene holds, for those who only read it."""
        with await self.lease(name) as loaded:
            return loaded.scene

    @staticmethod
    async def _run(executor: ThreadPoolExecutor, function: Callable, *arguments):
        # A client that cancels its call cancels the await, and with it a job that has not begun.
        return await asyncio.get_running_loop().run_in_executor(executor, function, *arguments)

    def _check_batch(self, count: int) -> None:
        if count > self._options.max_batch_items:
            raise TooLargeError(f"a batch may have {self._options.max_batch_items} items, got {count}")

    async def _read(self, actors: int, function: Callable[..., T], *arguments) -> T:
        """What reading a request gives, when it is its client's turn."""
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
        """Counts what the current call costs while it is in progress.

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


async def run_to_end(executor: ThreadPoolExecutor, function: Callable, *arguments):
    """What a function gives that must not be left half-way: a client that leaves waits for its end all the same."""
    work = asyncio.get_running_loop().run_in_executor(executor, function, *arguments)
    try:
        return await asyncio.shield(work)
    except asyncio.CancelledError:
        await asyncio.wait([work])
        raise
