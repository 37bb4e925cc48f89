"""The scenes that a server offers: named, loaded or reconstructed once on first use, and kept while there is room."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import nurec_sim
from nurec_sim.errors import ArchiveError, NurecSimError, UnknownSceneError
from nurec_sim.types import CameraFrame, GaussianScene, LidarFilter, LidarFrame, SensorRequest

log = logging.getLogger(__name__)

MAX_NAMES_IN_TEXT = 20
_MAX_SIDECAR_BYTES = 1 << 20

Progress = Callable[[str, float], None]


class SceneRenderer(Protocol):
    """What a server needs of ``render.Renderer``."""

    def render_camera(self, request: SensorRequest, outputs: tuple[str, ...] = ...) -> CameraFrame:
        """One image."""
        ...

    def render_lidar(self, request: SensorRequest, filter: LidarFilter | None = ...) -> LidarFrame:
        """One sweep."""
        ...


@dataclass(frozen=True)
class LoadedScene:
    """A scene in memory with its renderer."""

    scene: GaussianScene
    renderer: SceneRenderer


@dataclass(frozen=True)
class _Source:
    """Where one scene comes from: an object in memory, or a path of an archive or a clip."""

    id: str
    origin: GaussianScene | Path
    aliases: tuple[str, ...] = field(default=())


def default_cache_dir() -> Path:
    """Where reconstructions of clips are kept: ``$NUREC_SIM_CACHE``, else ``nurec_sim`` in the user's cache folder."""
    if chosen := os.environ.get("NUREC_SIM_CACHE"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "nurec_sim"


class SceneStore:
    """Scenes by id, from ``GaussianScene`` objects, ``.usdz`` archives and clips; safe to use from many threads.

    Ids are spelt ``clipgt-<id>``, as AlpaSim knows them from the archive; a scene also answers to its plain id, its
    file stem and ``clipgt-<file stem>``. A source that cannot be opened is kept as a fault, under its stem, and does
    not disturb the others.

    Args:
        sources: objects, or paths of archives (``.usdz``), clips, and folders of them.
        capacity: scenes kept in memory; the least recently used one goes first.
        cache_dir: where reconstructed clips are kept, by content; None for ``default_cache_dir()``.
        method: reconstruction method of clips.
        threads: render threads, None for all cores.
        make_renderer: makes the renderer of a scene; None for ``render.Renderer``.
        on_progress: called with a line of text when something slow begins.
    """

    def __init__(
        self,
        sources: Iterable[GaussianScene | str | Path] = (),
        *,
        capacity: int = 10,
        cache_dir: Path | None = None,
        method: str = "lift",
        threads: int | None = None,
        make_renderer: Callable[[GaussianScene], SceneRenderer] | None = None,
        on_progress: Callable[[str], None] | None = None,
    ) -> None:
        if capacity < 1:
            raise ValueError(f"a scene store needs room for at least 1 scene, got capacity {capacity}")
        self.capacity = capacity
        self._cache_dir = cache_dir or default_cache_dir()
        self._method = method
        self._threads = threads
        self._make_renderer = make_renderer
        self._on_progress = on_progress or (lambda text: None)
        self._lock = threading.Lock()
        self._sources: dict[str, _Source] = {}
        self._faults: dict[str, str] = {}
        self._loaded: OrderedDict[str, Future[LoadedScene]] = OrderedDict()
        for source in sources:
            self.add(source)

    def add(self, source: GaussianScene | str | Path) -> None:
        """Offers the scene, or all scenes of a folder; what cannot be opened becomes a fault."""
        for one in [source] if isinstance(source, GaussianScene) else find_sources(Path(source)):
            try:
                entry = _identify(one)
                with self._lock:
                    if entry.id in self._sources:
                        raise ArchiveError(f"{_describe(one)}: a scene of id {entry.id!r} is already served")
                    self._sources[entry.id] = entry
            except (NurecSimError, OSError) as error:
                text = f"{_describe(one)}: {error}" if isinstance(error, OSError) else str(error)
                log.warning("not served: %s", text)
                with self._lock:
                    self._faults[_stem(one)] = text

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the scenes on offer, in the order they were added."""
        with self._lock:
            return tuple(self._sources)

    @property
    def faults(self) -> Mapping[str, str]:
        """Why a source is not on offer, by file stem."""
        with self._lock:
            return dict(self._faults)

    @property
    def loaded_ids(self) -> tuple[str, ...]:
        """Ids of the scenes in memory, least recently used first."""
        with self._lock:
            return tuple(scene_id for scene_id, future in self._loaded.items() if future.done())

    def resolve(self, name: str) -> str:
        """The id of the scene that answers to ``name``.

        Raises:
            UnknownSceneError: there is none; the text lists what there is.
            ArchiveError: its source was refused; the text says why.
        """
        with self._lock:
            if name in self._sources:
                return name
            for entry in self._sources.values():
                if name in entry.aliases:
                    return entry.id
            fault = self._faults.get(name) or self._faults.get(name.removeprefix("clipgt-"))
            have = list(self._sources)
        if fault:
            raise ArchiveError(f"scene {name!r} cannot be served: {fault}")
        more = f" and {len(have) - MAX_NAMES_IN_TEXT} more" if len(have) > MAX_NAMES_IN_TEXT else ""
        raise UnknownSceneError(f"scene {name!r} is not served; have {have[:MAX_NAMES_IN_TEXT]}{more}")

    def in_memory(self, name: str) -> LoadedScene | None:
        """The scene that answers to ``name`` if that takes no waiting, else None.

        Raises:
            UnknownSceneError, ArchiveError: see ``resolve``.
        """
        scene_id = self.resolve(name)
        with self._lock:
            future = self._loaded.get(scene_id)
            if future is None or not future.done() or future.exception() is not None:
                return None
            self._loaded.move_to_end(scene_id)
            return future.result()

    def get(self, name: str, progress: Callable[[str, float], None] | None = None) -> LoadedScene:
        """The scene that answers to ``name``, loaded or reconstructed if it is not in memory.

        Callers that come while it loads wait for the same load. ``progress`` hears of a reconstruction: what is being
        done, and the fraction of it that is.

        Raises:
            UnknownSceneError: there is no such scene.
            ArchiveError, ClipError, ReconstructError: it cannot be loaded.
        """
        scene_id = self.resolve(name)
        with self._lock:
            future = self._loaded.get(scene_id)
            first = future is None
            if future is None:
                future = self._loaded[scene_id] = Future()
            self._loaded.move_to_end(scene_id)
        if first:
            try:
                future.set_result(self._load(self._sources[scene_id], progress))
            except BaseException as error:
                with self._lock:
                    del self._loaded[scene_id]
                future.set_exception(error)
            self._evict()
        return future.result()

    def _evict(self) -> None:
        with self._lock:
            done = [scene_id for scene_id, future in self._loaded.items() if future.done()]
            for scene_id in done[: max(0, len(self._loaded) - self.capacity)]:
                del self._loaded[scene_id]

    def _load(self, source: _Source, progress: Callable[[str, float], None] | None) -> LoadedScene:
        if isinstance(source.origin, GaussianScene):
            scene = source.origin
        elif _is_archive(source.origin):
            from nurec_sim.scene import read_scene

            scene = read_scene(source.origin)
        else:
            scene = self._reconstructed(source.origin, progress)
        if self._make_renderer is not None:
            return LoadedScene(scene, self._make_renderer(scene))
        from nurec_sim.render.renderer import Renderer

        return LoadedScene(scene, Renderer(scene, threads=self._threads))

    def _reconstructed(self, clip_path: Path, progress: Callable[[str, float], None] | None) -> GaussianScene:
        """The reconstruction of a clip, from the cache or made now; the same bits either way."""
        from nurec_sim.logs import open_clip
        from nurec_sim.reconstruct import reconstruct
        from nurec_sim.scene import read_scene, write_scene

        kept = self._cache_dir / f"{content_key(clip_path, self._method)}.usdz"
        if kept.exists():
            try:
                return read_scene(kept)
            except ArchiveError as error:
                log.warning("made again, its kept reconstruction is damaged: %s", error)
        self._on_progress(f"reconstructing {clip_path} ({self._method}) ...")
        scene = reconstruct(open_clip(clip_path), self._method, progress=progress)
        try:
            kept.parent.mkdir(parents=True, exist_ok=True)
            write_scene(scene, kept, overwrite=True)
        except OSError as error:
            log.warning("a reconstruction could not be kept at %s: %s", kept, error)
            return scene
        return read_scene(kept)


def find_sources(path: Path) -> list[Path]:
    """Archives and clips in a folder, at any depth; the path itself if it is one of them, or holds none."""
    from nurec_sim.logs.storage import META_FILE

    if not path.is_dir() or (path / META_FILE).exists():
        return [path]
    found = [*path.rglob("*.usdz"), *path.rglob("*.zip"), *(meta.parent for meta in path.rglob(META_FILE))]
    return sorted(found) or [path]


def content_key(clip_path: Path, method: str) -> str:
    """A name for what a reconstruction depends on: every file of the clip, the method, our version and its code."""
    digest = hashlib.sha256(f"{nurec_sim.__version__}\0{method}\0".encode())
    for source in sorted((Path(nurec_sim.__file__).parent / "reconstruct").glob("*.py")):
        digest.update(source.read_bytes())
    files = sorted(p for p in clip_path.rglob("*") if p.is_file()) if clip_path.is_dir() else [clip_path]
    for path in files:
        name = path.relative_to(clip_path).as_posix() if clip_path.is_dir() else ""
        with path.open("rb") as file:
            content = hashlib.file_digest(file, "sha256").hexdigest()
        digest.update(f"{name}\0{content}\0".encode())
    return f"{clip_path.stem}-{method}-{digest.hexdigest()[:24]}"


# --------------------------------------------------------------------------------------------------------------- names


def _is_archive(path: Path) -> bool:
    return path.suffix.lower() == ".usdz"


def _stem(source: GaussianScene | str | Path) -> str:
    return source.id if isinstance(source, GaussianScene) else Path(source).stem


def _describe(source: GaussianScene | str | Path) -> str:
    return f"scene {source.id!r}" if isinstance(source, GaussianScene) else str(source)


def _identify(source: GaussianScene | str | Path) -> _Source:
    """A source with its id and aliases, without loading it."""
    from nurec_sim.scene import alpasim_id

    if isinstance(source, GaussianScene):
        return _Source(alpasim_id(source.id), source, (source.id,))
    path = Path(source)
    if not path.exists():
        raise ArchiveError(f"{path} does not exist")
    if _is_archive(path):
        own_id = _archive_id(path)
    else:
        from nurec_sim.logs import open_clip

        own_id = open_clip(path).id
    return _Source(alpasim_id(own_id), path, (own_id, path.stem, alpasim_id(path.stem)))


def _archive_id(path: Path) -> str:
    """The id of the scene in an archive, from a sidecar."""
    from nurec_sim.scene.zip_package import Package

    with Package(path) as package:
        try:
            own_id = json.loads(bytes(package.read("data_info.json", _MAX_SIDECAR_BYTES)))["sequence_id"]
        except (ValueError, KeyError, TypeError) as error:
            raise ArchiveError(f"{path}: data_info.json does not say a sequence_id ({error})") from error
    if not isinstance(own_id, str) or not own_id:
        raise ArchiveError(f"{path}: the sequence_id in data_info.json must be a text, got {own_id!r}")
    return own_id
