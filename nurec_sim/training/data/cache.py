"""A folder of training clips that worker processes fill and refresh in the background of a training run.

Towns are rendered by spawned processes, a few towns each: MuJoCo and OpenGL stay out of the training process, a crash
ends only one worker, and leaked memory is freed with it. Clips are in ``<folder>/<hash of the settings>/``.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import multiprocessing
import os
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from nurec_sim.errors import ClipError, WriteError
from nurec_sim.files.closing import Closing
from nurec_sim.files.new_files import writing
from nurec_sim.training.data.clips import UNFINISHED_PREFIX, CachedClip, ready_clips
from nurec_sim.training.data.generate import ClipSettings, clip_ids, generate_town, town_of
from nurec_sim.training.workers import work_in_background

Progress = Callable[[int, int], None]
"""Called with (complete clips, requested clips)."""
Report = Callable[[str], None]
"""Called with a message about an error that does not stop the work."""

TOWNS_PER_PROCESS = 3
"""Starting a process costs about two seconds of CPU time."""
TRIALS = 3
"""Attempts per batch of towns if its process fails."""
POLL_S = 0.5


class ClipCache(Closing):
    """The clips of one folder and one settings hash, filled by worker processes after ``start``.

    A later run reuses existing clips. Unreadable clips are deleted when the cache is opened. Towns are generated as a
    whole, so there may be a few clips more than requested.

    Args:
        folder: parent folder of the clips of all settings.
        settings: settings of the clips.
        size: number of clips to keep.
        first_town: number of the first town; the following numbers come next.
        report: called with messages about damaged clips and failing workers.

    Raises:
        ValueError: ``size`` is not positive or ``first_town`` negative.
    """

    def __init__(
        self, folder: str | Path, settings: ClipSettings, size: int, first_town: int = 0, report: Report | None = None
    ) -> None:
        if size < 1 or first_town < 0:
            raise ValueError(f"a cache needs room for a clip and towns from 0 on, got {size} and {first_town}")
        self.settings, self.size = settings, size
        self.clips = Path(folder) / settings.hash
        """Where the complete clips lie."""
        self._first_town, self._report = first_town, report or (lambda line: None)
        self._plans: dict[str, str] = {}
        self._fault: WriteError | None = None
        self._threads: list[threading.Thread] = []
        self._stop = threading.Event()
        self._lock = threading.Lock()
        with writing(self.clips):
            self.clips.mkdir(parents=True, exist_ok=True)
        self._drop_unfinished()
        self._drop_damaged()

    def clip_ids(self) -> list[str]:
        """Complete clips, sorted."""
        return ready_clips(self.clips)

    def clip(self, clip_id: str) -> CachedClip:
        """One of them.

        Raises:
            ClipError: it does not exist (any more), or is damaged.
        """
        return CachedClip(self.clips / clip_id)

    def check(self) -> None:
        """Raises the error that ended the generation of clips, if any.

        Raises:
            WriteError: clips cannot be written.
        """
        if self._fault is not None:
            raise self._fault

    def data_hash(self) -> str:
        """SHA-256 over the sorted ids of the clips and the hashes of their town plans."""
        digest = hashlib.sha256()
        for clip_id in self.clip_ids():
            if clip_id not in self._plans:
                self._plans[clip_id] = self.clip(clip_id).plan_hash
            digest.update(f"{clip_id} {self._plans[clip_id]}\n".encode())
        return digest.hexdigest()

    def start(self, workers: int = 1, refresh: bool = False, backend: str | None = None, niceness: int = 10) -> None:
        """Fills the cache in the background.

        Args:
            workers: number of concurrent processes.
            refresh: continue when it is full: each new clip replaces the oldest one.
            backend: see ``world.TrueWorld``.
            niceness: niceness of the workers, so that training takes precedence.

        Raises:
            RuntimeError: already started, or ``backend`` does not work here.
        """
        from nurec_sim.world import pick_backend

        if self._threads:
            raise RuntimeError("this cache is being filled already")
        name, towns = pick_backend(backend), self._wanted_towns(refresh)
        for number in range(workers):
            arguments = (towns, refresh, name, niceness)
            thread = threading.Thread(target=self._work, args=arguments, name=f"clips-{number}", daemon=True)
            self._threads.append(thread)
            thread.start()

    def fill(self, workers: int = 1, progress: Progress | None = None, backend: str | None = None) -> None:
        """Generates clips until the cache is full, and blocks until then.

        Raises:
            ClipError: the workers gave up before.
            WriteError: clips cannot be written.
        """
        try:
            self.start(workers, backend=backend, niceness=0)
            while any(thread.is_alive() for thread in self._threads):
                self._stop.wait(POLL_S)
                if progress is not None:
                    progress(len(self.clip_ids()), self.size)
        finally:
            self.close()
        self.check()
        if len(self.clip_ids()) < self.size:
            raise ClipError(f"{self.clips} holds {len(self.clip_ids())} of {self.size} clips; its workers failed")

    def close(self) -> None:
        """Ends the workers; their unfinished clips are lost, all others remain."""
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._threads, self._stop = [], threading.Event()
        self._drop_unfinished()

    def _wanted_towns(self, refresh: bool) -> Iterator[tuple[int, ...]]:
        """Numbers of the towns to generate, in batches for one process each."""
        ready = self.clip_ids()
        first, end = self._first_town, self._first_town - -self.size // self.settings.clips_per_town
        numbers: Iterable[int] = range(first, end)
        if refresh:
            beyond = max([end, *(town_of(clip_id) + 1 for clip_id in ready)])
            numbers = itertools.chain(() if len(ready) >= self.size else numbers, itertools.count(beyond))
        missing = (town for town in numbers if not set(clip_ids(town, self.settings)) <= set(ready))
        while batch := tuple(itertools.islice(missing, TOWNS_PER_PROCESS)):
            yield batch

    def _work(self, towns: Iterator[tuple[int, ...]], refresh: bool, backend: str, niceness: int) -> None:
        """Runs worker processes one after the other until no towns are left."""
        while not self._stop.is_set():
            with self._lock:
                batch = next(towns, None)
            if batch is None:
                return
            for trial in range(1, TRIALS + 1):
                status = self._run(batch, backend, niceness, refresh)
                if self._stop.is_set() or status == 0:
                    break
                if self._fault is not None:
                    self._report(f"no more towns are generated: {self._fault}")
                    return
                self._report(f"generating towns {list(batch)} ended with status {status}, trial {trial} of {TRIALS}")

    def _run(self, batch: tuple[int, ...], backend: str, niceness: int, refresh: bool) -> int | None:
        """Runs a process that generates a few towns; returns its exit status."""
        context = multiprocessing.get_context("spawn")
        faults, theirs = context.Pipe(duplex=False)
        process = context.Process(
            target=_draw_towns, args=(batch, self.settings, self.clips, backend, niceness, theirs), daemon=True
        )
        process.start()
        theirs.close()
        while process.is_alive() and not self._stop.is_set():
            process.join(POLL_S)
            if refresh:
                self._drop_oldest()
        with faults, contextlib.suppress(EOFError):
            if faults.poll():
                self._fault = faults.recv()
        return _ended(process)

    def _drop_oldest(self) -> None:
        with self._lock:
            names = self.clip_ids()
            age = {name: (self.clips / name).stat().st_mtime_ns for name in names}
            for name in sorted(names, key=lambda name: (age[name], name))[: max(len(names) - self.size, 0)]:
                shutil.rmtree(self.clips / name, ignore_errors=True)

    def _drop_unfinished(self) -> None:
        """Deletes unfinished clips of dead workers."""
        for path in self.clips.glob(f"{UNFINISHED_PREFIX}*"):
            owner = path.name.removeprefix(UNFINISHED_PREFIX).partition("-")[0]
            if not owner.isdigit() or not is_alive(int(owner)):
                shutil.rmtree(path, ignore_errors=True)

    def _drop_damaged(self) -> None:
        for clip_id in self.clip_ids():
            try:
                self.clip(clip_id)
            except ClipError as error:
                self._report(f"dropped a damaged clip: {error}")
                shutil.rmtree(self.clips / clip_id, ignore_errors=True)


def _ended(process: BaseProcess) -> int | None:
    if process.is_alive():
        process.terminate()
    process.join()
    status = process.exitcode
    process.close()
    return status


def is_alive(process_id: int) -> bool:
    """Whether a process exists on this machine."""
    try:
        os.kill(process_id, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def _draw_towns(
    towns: tuple[int, ...], settings: ClipSettings, folder: Path, backend: str, niceness: int, faults: Connection
) -> None:
    """Main function of a worker process; sends write errors through ``faults``."""
    work_in_background(niceness)
    try:
        for town in towns:
            for _ in generate_town(town, settings, folder, backend):
                pass
    except WriteError as error:
        faults.send(error)
        raise SystemExit(1) from None
