"""Reconstruction of clips on request, with progress."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import AsyncGenerator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from nurec_sim.errors import CancelledError, NurecSimError, ReconstructError, RequestError
from nurec_sim.reconstruct import FeedForwardSettings, available_methods, load_method
from nurec_sim.serving.store import LoadedScene, Recipe, SceneStore
from nurec_sim.serving.store.sources import is_archive
from nurec_sim.serving.store.uploads import check_name
from nurec_sim.serving.wire import nurec_sim_v1 as v1

_LEAST_STEP = 0.005
"""Progress that is worth a message."""


class Reconstructions:
    """Reconstructs one clip after the other, in a thread of its own.

    Args:
        store: where the scenes are added.
        clip_dirs: folders whose clips may be named by their path.
    """

    def __init__(self, store: SceneStore, clip_dirs: Sequence[Path]) -> None:
        self._store = store
        self._clip_dirs = [folder.resolve() for folder in clip_dirs]
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="reconstruct")
        self._closing = threading.Event()
        self._offering = threading.Lock()
        self._awaited: dict[str, int] = {}
        """Clients that wait, by id of scenes that would not be offered without them."""

    def close(self) -> None:
        """Ends what is at work at its next step, and waits for that."""
        self._closing.set()
        self._thread.shutdown(wait=True, cancel_futures=True)

    async def run(self, request) -> AsyncGenerator:
        """The events of a ``ReconstructClipRequest``: progress, then the scene.

        When the client disconnects, the work stops at its next step, and the store is as before.
        """
        loop, left = asyncio.get_running_loop(), threading.Event()
        events: asyncio.Queue[tuple[str, float] | None] = asyncio.Queue()
        scene_id, is_new = await loop.run_in_executor(None, self._offer, request)
        said = ("", -1.0)

        def progress(stage: str, fraction: float) -> None:
            nonlocal said
            if left.is_set() or self._closing.is_set():
                raise CancelledError(f"the reconstruction of {scene_id!r} was cancelled at {fraction:.0%} ({stage})")
            if stage != said[0] or abs(fraction - said[1]) >= _LEAST_STEP:
                said = (stage, fraction)
                loop.call_soon_threadsafe(events.put_nowait, said)

        if is_new or scene_id in self._awaited:
            self._awaited[scene_id] = self._awaited.get(scene_id, 0) + 1
        job = self._thread.submit(self._store.get, scene_id, progress)
        work = asyncio.wrap_future(job)
        work.add_done_callback(lambda done: done.cancelled() or done.exception())  # looked at even if the client left
        work.add_done_callback(lambda _: events.put_nowait(None))
        work.add_done_callback(lambda _: self._forget_unawaited(scene_id))
        try:
            yield _progress("waiting for its turn", 0.0)
            while (step := await events.get()) is not None:
                yield _progress(*step)
            loaded = await work
            self._awaited.pop(scene_id, None)  # from now on it is a scene like any other
            yield _done(scene_id, loaded)
        finally:
            left.set()
            if scene_id in self._awaited:
                self._awaited[scene_id] -= 1
            if not job.cancel() and job.done():
                self._forget_unawaited(scene_id)

    def _forget_unawaited(self, scene_id: str) -> None:
        """Removes a scene when its work has ended and its clients have disconnected, unless it is in use."""
        if self._awaited.get(scene_id) == 0:
            del self._awaited[scene_id]
            with contextlib.suppress(NurecSimError):
                self._store.remove(scene_id)

    def _offer(self, request) -> tuple[str, bool]:
        """The id of the scene that the request is for, and whether it was not offered before."""
        if request.name:
            check_name(request.name)
        path, own_recipe = self._clip(request)
        recipe = _recipe(request) or own_recipe
        with self._offering:  # two clients that request the same clip share one scene
            for source in self._store.sources:
                if source.is_from(path) and source.recipe == recipe and request.name in ("", *source.names):
                    return source.id, False
            return self._store.offer(path, request.name, recipe), True

    def _clip(self, request) -> tuple[Path, Recipe | None]:
        kind = request.WhichOneof("clip")
        if kind is None:
            raise RequestError("a clip is missing: scene_id of a clip on offer, or path of one on the server")
        if kind == "scene_id":
            source = self._store.source(request.scene_id)
            if source.kind != "clip" or not isinstance(source.origin, Path):
                raise RequestError(f"scene {source.id!r} comes from no clip, so it cannot be reconstructed")
            return source.origin, source.recipe
        given = Path(request.path)
        if "\0" in request.path or not given.is_absolute():
            raise RequestError(f"path must be an absolute path on the server, got {request.path[:200]!r}")
        path = given.resolve()
        if not any(path.is_relative_to(folder) for folder in self._clip_dirs):
            # The same text for what exists and what does not: clients are not to explore the server's disk.
            raise RequestError(f"path {str(given)!r} does not lie in a folder that this server allows")
        if is_archive(path):
            raise RequestError(f"path {str(given)!r} names a scene, not a clip")
        return path, None


def _recipe(request) -> Recipe | None:
    """How a request wants it; None if it leaves that open."""
    known = available_methods()
    if not request.method:
        if request.profile or request.cameras:
            raise RequestError(f"profile and cameras need a method: {', '.join(known)}")
        return None
    if request.method not in known:  # a client must not make the server run a file
        raise ReconstructError(f"no reconstruction method {request.method!r}; have {known}")
    settings = None
    if load_method(request.method).settings is FeedForwardSettings:
        settings = FeedForwardSettings(profile=request.profile or None)
    elif request.profile:
        raise RequestError(f"method {request.method!r} uses no network, so no profile either; got {request.profile!r}")
    return Recipe(request.method, settings, tuple(request.cameras))


def _progress(stage: str, fraction: float):
    return v1.ReconstructClipEvent(progress=v1.ReconstructClipProgress(stage=stage, fraction=fraction))


def _done(scene_id: str, loaded: LoadedScene):
    static, dynamic = len(loaded.scene.static), len(loaded.scene.dynamic)
    done = v1.ReconstructClipDone(scene_id=scene_id, static_gaussians=static, dynamic_gaussians=dynamic)
    return v1.ReconstructClipEvent(done=done)
