"""The cache of loaded scenes: loaded once for concurrent callers, leased while in use, evicted by least recent use."""

from __future__ import annotations

import os
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from types import TracebackType
from typing import Any

from nurec_sim.errors import CancelledError
from nurec_sim.render.device import Renderer
from nurec_sim.types import GaussianScene, Track

_CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


@dataclass(frozen=True)
class LoadedScene:
    """A scene in memory with its renderer."""

    scene: GaussianScene
    renderer: Renderer

    @cached_property
    def times_us(self) -> tuple[int, int]:
        """First and last time for which a frame may be requested.

        Clients take their times from the recorded path, which may reach a little farther than the sensors' data.
        """
        (first, last), ego = self.scene.span_us, self.scene.ego
        return min(first, ego.start_us), max(last, ego.end_us)

    @cached_property
    def tracks(self) -> dict[str, Track]:
        """The scene's tracks by id."""
        return {track.id: track for track in self.scene.tracks}


@dataclass(frozen=True)
class MemoryStats:
    """Counters since the start, and the current content of the cache."""

    hits: int = 0
    """Requests for scenes that were in memory."""
    loads: int = 0
    failed_loads: int = 0
    evictions: int = 0
    """Scenes evicted for others; not those that were unloaded on request."""
    load_s: float = 0.0
    """Time of all loads, reconstructions among them."""
    loaded: int = 0
    loaded_bytes: int = 0
    in_use: int = 0
    """Scenes with a lease."""


@dataclass
class _Entry:
    """A scene that is in memory or being loaded."""

    future: Future[LoadedScene] = field(default_factory=Future)
    bytes: int = 0
    users: int = 0
    begun: bool = False

    @property
    def ready(self) -> bool:
        return self.future.done() and self.future.exception() is None


class Lease:
    """Keeps a scene in memory until ``release``, or the end of a ``with`` block."""

    def __init__(self, loaded: LoadedScene, release: Callable[[], None]) -> None:
        self.loaded = loaded
        self._release: Callable[[], None] | None = release

    def release(self) -> None:
        """Ends the lease; may be called more than once."""
        release, self._release = self._release, None
        if release is not None:
            release()

    def __enter__(self) -> LoadedScene:
        return self.loaded

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.release()


class SceneMemory:
    """A least-recently-used cache of scenes, bounded by count and bytes.

    Scenes in use and the most recently used one are never evicted, so the bounds may be exceeded for a while.
    Thread-safe.

    Args:
        capacity: how many.
        max_bytes: how much memory for all of them.
    """

    def __init__(self, capacity: int, max_bytes: int) -> None:
        self.capacity, self.max_bytes = capacity, max_bytes
        self._lock = threading.Lock()
        self._entries: OrderedDict[str, _Entry] = OrderedDict()
        self._stats = MemoryStats()

    def lease(self, key: str, load: Callable[[], LoadedScene]) -> Lease:
        """A lease of a scene, which is loaded if it is not in memory; concurrent callers wait for the same load.

        Raises:
            Exception: whatever ``load`` raises, in all callers that wait; a cancelled load is restarted by the next.
        """
        while True:
            with self._lock:
                entry = self._entries.setdefault(key, _Entry())
                first, entry.begun = not entry.begun, True
                entry.users += 1
                self._entries.move_to_end(key)
                if entry.ready:
                    self._count(hits=1)
            if first:
                self._load(key, entry, load)
            try:
                return Lease(entry.future.result(), partial(self._end_use, entry))
            except BaseException as error:
                self._end_use(entry)
                if first or not isinstance(error, CancelledError):
                    raise

    def lease_ready(self, key: str) -> Lease | None:
        """A lease of a scene that is in memory, else None; does not block."""
        with self._lock:
            entry = self._entries.get(key)
            if entry is None or not entry.ready:
                return None
            entry.users += 1
            self._entries.move_to_end(key)
            self._count(hits=1)
        return Lease(entry.future.result(), partial(self._end_use, entry))

    def put(self, key: str, loaded: LoadedScene | None) -> None:
        """Replaces an entry, or removes it if None; existing leases stay valid."""
        with self._lock:
            self._entries.pop(key, None)
            if loaded is None:
                return
            entry = self._entries[key] = _Entry(bytes=array_bytes(loaded), begun=True)
            entry.future.set_result(loaded)
        self._make_room()

    def drop(self, key: str) -> int | None:
        """Removes a scene that is neither used nor loading; returns its bytes, 0 if there is none, None if it stays."""
        with self._lock:
            entry = self._entries.get(key)
            if entry is None:
                return 0
            if entry.users or not entry.future.done():
                return None
            del self._entries[key]
            return entry.bytes

    @property
    def keys(self) -> tuple[str, ...]:
        """Scenes in memory, least recently used first."""
        with self._lock:
            return tuple(key for key, entry in self._entries.items() if entry.ready)

    def state_of(self, key: str) -> tuple[int, int, bool]:
        """Bytes of a scene (0 if it is not in memory), its users, and whether it is being loaded."""
        with self._lock:
            entry = self._entries.get(key)
            return (0, 0, False) if entry is None else (entry.bytes, entry.users, not entry.future.done())

    @property
    def stats(self) -> MemoryStats:
        """Counters since the start, and what is in memory now."""
        with self._lock:
            ready = [entry for entry in self._entries.values() if entry.ready]
            return replace(
                self._stats,
                loaded=len(ready),
                loaded_bytes=sum(entry.bytes for entry in ready),
                in_use=sum(entry.users > 0 for entry in ready),
            )

    def _load(self, key: str, entry: _Entry, load: Callable[[], LoadedScene]) -> None:
        began = time.perf_counter()
        try:
            loaded = load()
        except BaseException as error:
            with self._lock:
                if self._entries.get(key) is entry:
                    del self._entries[key]
                    if isinstance(error, CancelledError) and entry.users > 1:
                        self._entries[key] = _Entry()  # keeps the entry until a waiting caller starts again
                self._count(failed_loads=1)
            entry.future.set_exception(error)
            return
        with self._lock:
            self._count(loads=1, load_s=time.perf_counter() - began)
        entry.future.set_result(loaded)
        self._measure()
        self._make_room()

    def _measure(self) -> None:
        """Measures all scenes: renderers grow with the number of sensors that they have rendered."""
        with self._lock:
            ready = [entry for entry in self._entries.values() if entry.ready]
        for entry in ready:
            entry.bytes = array_bytes(entry.future.result())

    def _end_use(self, entry: _Entry) -> None:
        with self._lock:
            entry.users -= 1
        if not entry.users:
            self._make_room()

    def _make_room(self) -> None:
        with self._lock:
            sizes = {key: entry.bytes for key, entry in self._entries.items()}
            for key in list(sizes)[:-1]:
                if len(sizes) <= self.capacity and sum(sizes.values()) <= self.max_bytes:
                    break
                if self._entries[key].future.done() and not self._entries[key].users:
                    del self._entries[key], sizes[key]
                    self._count(evictions=1)

    def _count(self, **more: float) -> None:
        self._stats = replace(self._stats, **{name: getattr(self._stats, name) + n for name, n in more.items()})


def array_bytes(*things: Any) -> int:
    """Bytes of the arrays and tensors that objects of ours hold, at any depth; each buffer counts once."""
    total, seen, stack = 0, set(), list(things)
    while stack:
        thing = stack.pop()
        while getattr(thing, "base", None) is not None and hasattr(thing.base, "nbytes"):
            thing = thing.base  # a view keeps its base alive
        if id(thing) in seen:
            continue
        seen.add(id(thing))
        if isinstance(getattr(thing, "nbytes", None), int):
            total += thing.nbytes
        elif isinstance(thing, Mapping):
            stack += list(thing.values())
        elif isinstance(thing, (list, tuple)):
            stack += thing
        elif type(thing).__module__.startswith("nurec_sim.") and hasattr(thing, "__dict__"):
            stack += list(vars(thing).values())
    return total


def half_of_memory() -> int:
    """Half of the memory that this process may use, in bytes: of the machine, or of its container if that is less."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        total = min(total, int(_CGROUP_LIMIT.read_text()))
    except (OSError, ValueError):  # no container, or one without a limit ("max")
        pass
    return total // 2
