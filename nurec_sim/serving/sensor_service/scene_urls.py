"""Scenes that clients name by URL, in the metadata of any request.

``x-nre-scene-url`` is ``file://`` or ``http(s)://`` and ends in ``.usdz``; ``x-nre-scene-id`` is the id under which
the scene is served afterwards, by default the archive's own. A ``file://`` URL may name files in the scene folders
only; the reply does not reveal whether files exist elsewhere.
"""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from urllib.parse import unquote, urlsplit

from nurec_sim.errors import NotAllowedError, NurecSimError, RequestError, UnknownSceneError
from nurec_sim.serving.sensor_service.downloads import DownloadCache, is_web
from nurec_sim.serving.sensor_service.options import ServiceOptions
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.store.sources import Source, identify

URL_KEY, ID_KEY = "x-nre-scene-url", "x-nre-scene-id"

_ID = re.compile(r"[A-Za-z0-9_-]{1,200}")
_MAX_URL = 2048


class SceneUrls:
    """Adds scenes to a store by URL; thread-safe.

    Args:
        store: where they are offered.
        options: whether web URLs are allowed, download limits, and folders that ``file://`` URLs may name.
    """

    def __init__(self, store: SceneStore, options: ServiceOptions) -> None:
        self._store = store
        self._allow_web = options.allow_remote_scenes
        self._places = None if options.allow_any_file else _places(store, options.scene_dirs)
        self._cache = DownloadCache(
            options.download_cache_dir or store.cache_dir / "downloads",
            options.download_cache_size,
            options.max_download_bytes,
            options.download_timeout_s,
        )
        self._offered: dict[tuple[str, str], tuple[str, Path]] = {}  # address and name: id and file
        self._turns: dict[str, threading.Lock] = {}

    def is_new(self, metadata: Mapping[str, str]) -> bool:
        """Whether metadata names a scene that ``offer`` has to add; does not block."""
        return URL_KEY in metadata and self._served(_key(metadata)) is None

    def offer(self, metadata: Mapping[str, str]) -> None:
        """Adds the scene that metadata names to the store; downloads it if it is on the web.

        Raises:
            RequestError: the URL or the id is malformed, or there is no such file.
            NotAllowedError: it is a web URL, and this server does not download scenes.
            TooLargeError: it is larger than allowed.
            ArchiveError: it cannot be opened, or another scene has the name.
        """
        url, name = key = _key(metadata)
        _check(url, name)
        if is_web(url) and not self._allow_web:
            raise NotAllowedError(f"this server fetches no scenes from the web, got {url}; use a file:// address")
        with self._turn(url):
            if self._served(key) is not None:
                return
            path = self._cache.fetch(url) if is_web(url) else self._local_path(url)
            source = self._offer(path, name)
            assert isinstance(source.origin, Path)
            self._offered[key] = (source.id, source.origin)
            if is_web(url):
                self._make_room()

    def _local_path(self, url: str) -> Path:
        """The file of a URL; the error is the same for files that do not exist and files that are not allowed."""
        parts = urlsplit(url)
        if parts.netloc not in ("", "localhost"):
            raise RequestError(f"{URL_KEY}: a file:// address names a file of the server, without a host; got {url!r}")
        path = Path(unquote(parts.path))
        try:
            real = path.resolve(strict=True)
            allowed = self._places is None or any(real.is_relative_to(place) for place in self._places)
            if allowed and real.is_file():
                return path
        except (OSError, ValueError, RuntimeError):  # absent, no name of a file, or a link that leads to itself
            pass
        raise RequestError(
            f"{URL_KEY}: {url!r} is no file in the scene folders of this server; whoever starts it may add folders "
            "with --scene-dirs, or all with --allow-any-file"
        )

    @contextlib.contextmanager
    def _turn(self, url: str) -> Iterator[None]:
        """One thread at a time for each URL; locks without users are removed."""
        while True:
            lock = self._turns.setdefault(url, threading.Lock())
            with lock:
                if self._turns.get(url) is not lock:  # its last holder removed it
                    continue
                try:
                    yield
                finally:
                    del self._turns[url]
                return

    def _served(self, key: tuple[str, str]) -> str | None:
        """The id of a scene that was added before and whose file still exists."""
        scene_id, path = self._offered.get(key, ("", Path()))
        if not scene_id or not path.exists():
            return None
        try:
            return scene_id if self._store.source(scene_id).origin == path else None
        except NurecSimError:
            return None

    def _offer(self, path: Path, name: str) -> Source:
        with contextlib.suppress(UnknownSceneError):
            source = self._store.source(name or identify(path).id)
            if source.is_from(path):  # served since the start, or downloaded again after removal
                return source
        return self._store.source(self._store.offer(path, name))

    def _make_room(self) -> None:
        """Removes scenes whose files were removed, unless they are being rendered."""
        removed = set(self._cache.make_room())
        for key, (scene_id, path) in list(self._offered.items()):
            if path in removed:
                with contextlib.suppress(NurecSimError):
                    self._store.remove(scene_id)
                del self._offered[key]


def _key(metadata: Mapping[str, str]) -> tuple[str, str]:
    return metadata[URL_KEY], metadata.get(ID_KEY, "")


def _check(url: str, name: str) -> None:
    if name and not _ID.fullmatch(name):
        raise RequestError(f"{ID_KEY} must be 1 to 200 of the letters A-Z a-z 0-9 _ -, got {name[:80]!r}")
    try:
        parts = urlsplit(url)
    except ValueError as error:
        raise RequestError(f"{URL_KEY} is no address: {error}") from error
    fits = parts.scheme in ("file", "http", "https") and parts.path.lower().endswith(".usdz")
    if not fits or len(url) > _MAX_URL or not url.isprintable() or (is_web(url) and not parts.hostname):
        raise RequestError(
            f"{URL_KEY} must be a file:// or http(s):// address that ends in .usdz, of up to {_MAX_URL} letters; "
            f"got {url[:80]!r}"
        )


def _places(store: SceneStore, given: tuple[Path, ...] | None) -> tuple[Path, ...]:
    """Folders and files that ``file://`` URLs may name, with links resolved.

    A scene of the store may be a link: then the file that it points to is allowed beside the folder of the link.
    """
    if given is None:
        files = [source.origin for source in store.sources if isinstance(source.origin, Path)]
        given = tuple(place for file in files for place in (file.absolute().parent, file))
    return tuple(dict.fromkeys(place.resolve() for place in given))
