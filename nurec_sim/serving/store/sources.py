"""Sources of scenes, and the catalogue of scenes by name."""

from __future__ import annotations

import json
import logging
import os
import re
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from nurec_sim.errors import ArchiveError, NurecSimError, UnknownSceneError
from nurec_sim.serving.store.recipes import Recipe
from nurec_sim.types import GaussianScene

log = logging.getLogger(__name__)

MAX_NAMES_IN_TEXT = 20
_MAX_SIDECAR_BYTES = 1 << 20


@dataclass(frozen=True)
class Source:
    """Where one scene comes from.

    ``origin`` is an object in memory, or the path of an archive or a clip; ``recipe`` how the clip becomes a scene,
    None for the store's own way.
    """

    id: str
    origin: GaussianScene | Path
    aliases: tuple[str, ...] = ()
    recipe: Recipe | None = None
    edited: GaussianScene | None = None
    """What is served instead, until it is restored."""

    @property
    def names(self) -> tuple[str, ...]:
        """All its names."""
        return (self.id, *self.aliases)

    def is_from(self, path: Path) -> bool:
        """Whether it comes from the file or folder ``path``, however that is spelt."""
        return isinstance(self.origin, Path) and self.origin.resolve() == path.resolve()

    @property
    def kind(self) -> str:
        """``memory``, ``archive`` or ``clip``."""
        if isinstance(self.origin, GaussianScene):
            return "memory"
        return "archive" if is_archive(self.origin) else "clip"


def default_cache_dir() -> Path:
    """Where reconstructions of clips are kept: ``$NUREC_SIM_CACHE``, else ``nurec_sim`` in the user's cache folder."""
    if chosen := os.environ.get("NUREC_SIM_CACHE"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "nurec_sim"


def find_sources(path: Path) -> list[Path]:
    """Archives and clip folders in a folder, at any depth; the path itself if it is a log or holds none of them.

    Names that begin with a dot are skipped: such files may be incomplete.
    """
    from nurec_sim.logs import is_log
    from nurec_sim.logs.storage import META_FILE

    if not path.is_dir() or is_log(path):
        return [path]
    found = [*path.rglob("*.usdz"), *path.rglob("*.zip"), *(meta.parent for meta in path.rglob(META_FILE))]
    seen = [each for each in found if not any(part.startswith(".") for part in each.relative_to(path).parts)]
    return sorted(seen) or [path]


def identify(source: GaussianScene | str | Path, name: str = "", recipe: Recipe | None = None) -> Source:
    """A source with its id and aliases, without loading it; ``name`` instead of its own id if it is given.

    Raises:
        ArchiveError, ClipError: it cannot be opened.
    """
    from nurec_sim.scene import alpasim_id

    if isinstance(source, GaussianScene):
        return Source(alpasim_id(source.id), source, (source.id,))
    path = Path(source)
    own = own_id(path)
    if name:
        return Source(alpasim_id(name), path, (name,), recipe)
    others = _metadata_id(path) if is_archive(path) else ()
    return Source(alpasim_id(own), path, (own, path.stem, alpasim_id(path.stem), *others), recipe)


def own_id(path: Path) -> str:
    """The id that an archive or a log gives itself.

    Raises:
        ArchiveError, ClipError: it cannot be opened.
    """
    from nurec_sim.logs import is_log, open_clip

    if not path.exists() and not is_log(path):
        raise ArchiveError(f"{path} does not exist")
    return _archive_id(path) if is_archive(path) else open_clip(path).id


def is_archive(path: Path) -> bool:
    """Whether a path is to be read as a scene archive; everything else is a clip."""
    from nurec_sim.scene import SCENE_SUFFIXES

    return path.suffix.lower() in SCENE_SUFFIXES


def stem_of(source: GaussianScene | str | Path) -> str:
    """The name under which a fault of the source is kept."""
    return source.id if isinstance(source, GaussianScene) else Path(source).stem


def describe(source: GaussianScene | str | Path) -> str:
    """The source in a text for people."""
    return f"scene {source.id!r}" if isinstance(source, GaussianScene) else str(source)


def _archive_id(path: Path) -> str:
    """The id of the scene in an archive, from a sidecar; other programs' files may have none."""
    from nurec_sim.files.zip_package import Package
    from nurec_sim.scene.archive import MANIFEST

    if path.suffix.lower() != ".usdz":
        return path.stem
    with Package(path) as package:
        if not {MANIFEST, "data_info.json"} & set(package.names):
            return path.stem
        try:
            own_id = json.loads(bytes(package.read("data_info.json", _MAX_SIDECAR_BYTES)))["sequence_id"]
        except (ValueError, KeyError, TypeError) as error:
            raise ArchiveError(f"{path}: data_info.json does not say a sequence_id ({error})") from error
    if not isinstance(own_id, str) or not own_id:
        raise ArchiveError(f"{path}: the sequence_id in data_info.json must be a text, got {own_id!r}")
    return own_id


def _metadata_id(path: Path) -> tuple[str, ...]:
    """The id that AlpaSim reads from an archive's ``metadata.yaml``, which may be another in other programs' files."""
    from nurec_sim.files.zip_package import Package

    if path.suffix.lower() != ".usdz":
        return ()
    with Package(path) as package:
        if "metadata.yaml" not in package.names:
            return ()
        text = package.read("metadata.yaml", _MAX_SIDECAR_BYTES).decode("utf-8", "replace")
    return tuple(re.findall(r"""^scene_id:[ ]*["']?([^"'\s]+)["']?[ ]*$""", text, re.MULTILINE)[:1])


class SceneCatalog:
    """The available scenes, by name; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sources: dict[str, Source] = {}
        self._faults: dict[str, str] = {}

    def add(self, source: GaussianScene | str | Path) -> tuple[str, ...]:
        """Adds the scene, or all scenes of a folder, and returns their ids; what cannot be opened becomes a fault."""
        added = []
        for one in [source] if isinstance(source, GaussianScene) else find_sources(Path(source)):
            try:
                added.append(self.offer(one))
            except (NurecSimError, OSError) as error:
                text = f"{describe(one)}: {error}" if isinstance(error, OSError) else str(error)
                log.warning("not served: %s", text)
                with self._lock:
                    self._faults[stem_of(one)] = text
        return tuple(added)

    def offer(self, source: GaussianScene | Path, name: str = "", recipe: Recipe | None = None) -> str:
        """Adds one scene and returns its id; raises where ``add`` records a fault.

        Args:
            source: an object, or the path of an archive or a clip.
            name: its id, if it is not to be its own.
            recipe: how it becomes a scene if it is a clip; None for the store's way.

        Raises:
            ArchiveError, ClipError: it cannot be opened, or its id is taken.
        """
        entry = identify(source, name, recipe)
        with self._lock:
            if entry.id in self._sources:
                raise ArchiveError(f"{describe(source)}: a scene of id {entry.id!r} is already served")
            self._sources[entry.id] = entry
        return entry.id

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the available scenes, in the order they were added."""
        with self._lock:
            return tuple(self._sources)

    @property
    def sources(self) -> tuple[Source, ...]:
        """The sources of the available scenes, in the order they were added."""
        with self._lock:
            return tuple(self._sources.values())

    @property
    def faults(self) -> Mapping[str, str]:
        """Why a source is not available, by file stem."""
        with self._lock:
            return dict(self._faults)

    def resolve(self, name: str) -> str:
        """The id of the scene that answers to ``name``.

        Raises:
            UnknownSceneError: there is none; the text lists the scenes.
            ArchiveError: its source was refused; the text says why.
        """
        return self.source(name).id

    def source(self, name: str) -> Source:
        """Where the scene that answers to ``name`` comes from.

        Raises:
            UnknownSceneError, ArchiveError: see ``resolve``.
        """
        with self._lock:
            if name in self._sources:
                return self._sources[name]
            for entry in self._sources.values():
                if name in entry.aliases:
                    return entry
            fault = self._faults.get(name) or self._faults.get(name.removeprefix("clipgt-"))
            have = list(self._sources)
        if fault:
            raise ArchiveError(f"scene {name!r} cannot be served: {fault}")
        more = f" and {len(have) - MAX_NAMES_IN_TEXT} more" if len(have) > MAX_NAMES_IN_TEXT else ""
        raise UnknownSceneError(f"scene {name!r} is not served; have {have[:MAX_NAMES_IN_TEXT]}{more}")
