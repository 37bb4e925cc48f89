"""Scenes by name, from whatever they come from."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from nurec_sim.errors import SceneInUseError
from nurec_sim.reconstruct import FeedForwardSettings, LiftSettings, OptimizeSettings
from nurec_sim.render.device import Renderer
from nurec_sim.render.device import make_renderer as renderer_on
from nurec_sim.serving.store.memory import Lease, LoadedScene, MemoryStats, SceneMemory, half_of_memory
from nurec_sim.serving.store.recipes import Progress, Recipe
from nurec_sim.serving.store.reconstruction_cache import ReconstructionCache
from nurec_sim.serving.store.sources import SceneCatalog, Source, default_cache_dir
from nurec_sim.types import GaussianScene


@dataclass(frozen=True)
class SceneEntry:
    """The current state of one available scene."""

    id: str
    kind: str
    """``memory``, ``archive`` or ``clip``."""
    file_bytes: int
    """Size of its file; 0 for folders and objects in memory."""
    loaded_bytes: int
    """Memory that it takes; 0 if it is not loaded."""
    users: int
    """Leases of it."""
    loading: bool


class SceneStore(SceneCatalog):
    """Scenes by id, from ``GaussianScene`` objects, ``.usdz`` archives and clips; safe to use from many threads.

    Ids are spelt ``clipgt-<id>``, as AlpaSim knows them from the archive; a scene also answers to its plain id, its
    file stem and ``clipgt-<file stem>``. A source that cannot be opened is kept as a fault, under its stem, and does
    not disturb the others.

    Rendering holds a ``lease`` of the scene: scenes in use stay in memory. Of the others the least recently used are
    evicted when there are more than ``capacity`` of them, or they take more than ``max_bytes``; the most recently used
    one stays, whatever its size.

    Args:
        sources: objects, or paths of archives (``.usdz``), clips, and folders of them.
        capacity: scenes kept in memory.
        max_bytes: memory for them: arrays of the scenes and of their renderers; None for half of the machine's.
        cache_dir: where reconstructed clips are kept, by content; None for ``default_cache_dir()``.
        method: reconstruction method of clips.
        settings: of the method; None for its defaults.
        refine: settings of an optimisation of every reconstructed clip; None for none.
        device: that renders; see ``render.choose_device``.
        threads: render threads on a CPU, None for all cores.
        make_renderer: makes the renderer of a scene; None for ``render.make_renderer`` with these two.
        on_progress: called with a line of text when something slow begins.
    """

    def __init__(
        self,
        sources: Iterable[GaussianScene | str | Path] = (),
        *,
        capacity: int = 10,
        max_bytes: int | None = None,
        cache_dir: Path | None = None,
        method: str = "lift",
        settings: LiftSettings | FeedForwardSettings | None = None,
        refine: OptimizeSettings | None = None,
        device: str = "auto",
        threads: int | None = None,
        make_renderer: Callable[[GaussianScene], Renderer] | None = None,
        on_progress: Callable[[str], None] | None = None,
    ) -> None:
        if capacity < 1:
            raise ValueError(f"a scene store needs room for at least 1 scene, got capacity {capacity}")
        if max_bytes is not None and max_bytes < 1:
            raise ValueError(f"a scene store needs room for at least 1 byte, got max_bytes {max_bytes}")
        super().__init__()
        self.memory = SceneMemory(capacity, half_of_memory() if max_bytes is None else max_bytes)
        self._kept = ReconstructionCache(cache_dir or default_cache_dir(), on_progress or (lambda text: None))
        self._recipe = Recipe(method, settings, refine=refine)
        self._make_renderer = make_renderer or partial(renderer_on, device=device, threads=threads)
        for source in sources:
            self.add(source)

    def remove(self, name: str) -> int:
        """Removes a scene; its file stays. Returns the bytes of memory freed.

        Raises:
            UnknownSceneError, ArchiveError: see ``resolve``.
            SceneInUseError: it is in use.
        """
        source = self.source(name)
        with self._lock:
            self._sources.pop(source.id, None)
        try:
            return self._unload(source.id)
        except SceneInUseError:
            with self._lock:
                self._sources.setdefault(source.id, source)
            raise

    @property
    def entries(self) -> tuple[SceneEntry, ...]:
        """The available scenes, in the order they were added."""
        return tuple(
            SceneEntry(source.id, source.kind, _file_bytes(source), *self.memory.state_of(source.id))
            for source in self.sources
        )

    @property
    def cache_dir(self) -> Path:
        """Where reconstructed clips are kept, and what else takes time to get again."""
        return self._kept.folder

    @property
    def capacity(self) -> int:
        """How many scenes are kept in memory."""
        return self.memory.capacity

    @property
    def max_bytes(self) -> int:
        """How much memory they may take."""
        return self.memory.max_bytes

    @property
    def loaded_ids(self) -> tuple[str, ...]:
        """Ids of the scenes in memory, least recently used first."""
        return self.memory.keys

    @property
    def stats(self) -> MemoryStats:
        """Counters since the start, and what is in memory now."""
        return self.memory.stats

    def lease(self, name: str, progress: Progress | None = None) -> Lease:
        """A lease of the scene of that name; loads or reconstructs it if it is not in memory.

        ::

            with store.lease("street") as loaded:
                (frame,) = loaded.renderer.sense([request])

        Concurrent callers wait for the same load. ``progress`` is called during a reconstruction with the stage and the
        fraction done. It may raise ``CancelledError`` to end it.

        Raises:
            UnknownSceneError: there is no such scene.
            ArchiveError, ClipError, ReconstructError, WeightsError: it cannot be loaded.
        """
        source = self.source(name)
        return self.memory.lease(source.id, lambda: self._load(source, progress))

    def lease_in_memory(self, name: str) -> Lease | None:
        """A lease of the scene of that name if it is in memory, else None; does not block.

        Raises:
            UnknownSceneError, ArchiveError: see ``resolve``.
        """
        return self.memory.lease_ready(self.resolve(name))

    def get(self, name: str, progress: Progress | None = None) -> LoadedScene:
        """As ``lease``, without keeping the scene in the cache."""
        with self.lease(name, progress) as loaded:
            return loaded

    def unload(self, name: str) -> int:
        """Removes a scene from memory; it is loaded again on the next request. Returns the bytes freed.

        Raises:
            UnknownSceneError, ArchiveError: see ``resolve``.
            SceneInUseError: it is in use.
        """
        return self._unload(self.resolve(name))

    def _unload(self, scene_id: str) -> int:
        freed = self.memory.drop(scene_id)
        if freed is None:
            _, users, _ = self.memory.state_of(scene_id)
            raise SceneInUseError(f"scene {scene_id!r} is in use ({users} calls); unload it when they have ended")
        return freed

    def replace(self, name: str, scene: GaussianScene) -> None:
        """Serves an edited copy instead of a scene until ``restore``; frames in progress are not affected.

        Raises:
            UnknownSceneError, ArchiveError: see ``resolve``.
        """
        source = replace(self.source(name), edited=scene)
        loaded = self._load(source, None)
        with self._lock:
            self._sources[source.id] = source
        self.memory.put(source.id, loaded)

    def restore(self, name: str) -> None:
        """Serves the original scene again; no effect if it was not replaced.

        Raises:
            UnknownSceneError, ArchiveError: see ``resolve``.
        """
        source = self.source(name)
        if source.edited is not None:
            with self._lock:
                self._sources[source.id] = replace(source, edited=None)
            self.memory.put(source.id, None)

    @property
    def edited_ids(self) -> tuple[str, ...]:
        """Ids of the scenes of which an edited copy is served."""
        with self._lock:
            return tuple(source.id for source in self._sources.values() if source.edited is not None)

    def _load(self, source: Source, progress: Progress | None) -> LoadedScene:
        scene = self._scene(source, progress)
        return LoadedScene(scene, self._make_renderer(scene))

    def _scene(self, source: Source, progress: Progress | None) -> GaussianScene:
        if source.edited is not None:
            return source.edited
        if isinstance(source.origin, GaussianScene):
            return source.origin
        if source.kind == "archive":
            from nurec_sim.scene import read_scene

            return read_scene(source.origin)
        recipe = source.recipe or self._recipe
        return self._kept.scene(source.origin, recipe, progress or (lambda stage, fraction: None))


def _file_bytes(source: Source) -> int:
    if isinstance(source.origin, GaussianScene) or not source.origin.is_file():
        return 0
    return source.origin.stat().st_size
