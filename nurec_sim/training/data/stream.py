"""Stream of training samples, prefetched by worker processes.

Sample k of a run with seed s is determined by s, k and the clips on disk. Its clip is the one with the largest hash of
(s, k, clip) (rendezvous hashing), so adding or removing a clip changes only the samples of that clip: once the cache is
full and is not refreshed, a resumed run gets exactly the samples of an uninterrupted one.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import numpy as np

from nurec_sim.errors import ClipError
from nurec_sim.files.closing import Closing
from nurec_sim.training.data.clips import CachedClip, ready_clips
from nurec_sim.training.data.sample import TrainingSample
from nurec_sim.training.data.windows import WindowSettings, sample_window
from nurec_sim.training.workers import work_in_background

AHEAD = 3
"""Samples prefetched per worker."""
LOADER_NICENESS = 5
EMPTY_PAUSE_S = 1.0
GIVEN_UP_AFTER = 8
"""Maximum number of unreadable clips tried for one sample."""


def clip_order(seed: int, index: int, clips: Sequence[str]) -> list[str]:
    """Clips in the order of preference of a sample."""

    def rank(clip: str) -> bytes:
        return hashlib.blake2b(f"{seed}/{index}/{clip}".encode(), digest_size=8).digest()

    return sorted(clips, key=rank, reverse=True)


def draw_sample(folder: Path, settings: WindowSettings, seed: int, index: int) -> TrainingSample:
    """Sample ``index`` of a run; unreadable clips are skipped.

    Args:
        folder: folder of complete clips.
        settings: how samples are taken from clips.
        seed: seed of the run.
        index: number of the sample, counted over all ranks.

    Raises:
        ClipError: there are no clips, or none of the first few can be read.
    """
    problem: ClipError | None = None
    for name in clip_order(seed, index, ready_clips(folder))[:GIVEN_UP_AFTER]:
        try:
            return sample_window(np.random.default_rng([seed, index, 0x5A]), CachedClip(folder / name), settings)
        except ClipError as error:
            problem = error
    raise problem or ClipError(f"no training clips in {folder}")


class SampleStream(Closing):
    """Endless samples of steps ``start``, ``start + 1``, ... of one rank; a context manager, or call ``close``.

    Args:
        folder: folder of complete clips (``ClipCache.clips``).
        settings: how samples are taken from clips.
        seed: seed of the run.
        start: first step; step n of rank r is sample ``n * world_size + r``.
        workers: spawned processes that prefetch samples; 0 uses one thread of this process.
        rank: rank of this process.
        world_size: number of processes.
        wait_s: time limit for the first clip.
        check: polled while waiting; an exception ends the wait.

    Raises:
        ValueError: a number is out of range.
    """

    def __init__(
        self,
        folder: Path,
        settings: WindowSettings,
        seed: int,
        start: int = 0,
        workers: int = 0,
        rank: int = 0,
        world_size: int = 1,
        wait_s: float = 600.0,
        check: Callable[[], None] | None = None,
    ) -> None:
        if min(seed, start, workers, rank) < 0 or rank >= world_size:
            raise ValueError("seed, start, workers and rank must not be negative, and rank below world_size; got "
                             f"{seed}, {start}, {workers}, {rank} of {world_size}")  # fmt: skip
        self._folder, self._settings, self._seed, self._wait_s = folder, settings, seed, wait_s
        self._check = check or (lambda: None)
        self._next, self._stride = start * world_size + rank, world_size
        self._depth = AHEAD * max(workers, 1)
        self._ahead: deque[Future[TrainingSample]] = deque()
        self._workers: Executor = (
            ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_prepare_worker)
            if workers
            else ThreadPoolExecutor(1, "samples")
        )

    def __iter__(self) -> Iterator[TrainingSample]:
        return self

    def __next__(self) -> TrainingSample:
        """The next sample.

        Raises:
            ClipError: no clip appeared within ``wait_s``, or the clips cannot be read.
        """
        deadline = time.monotonic() + self._wait_s
        while not self._ahead and not ready_clips(self._folder) and time.monotonic() < deadline:
            self._check()
            time.sleep(EMPTY_PAUSE_S)
        while len(self._ahead) < self._depth:
            coming = self._workers.submit(draw_sample, self._folder, self._settings, self._seed, self._next)
            self._ahead.append(coming)
            self._next += self._stride
        return self._ahead.popleft().result()

    def close(self) -> None:
        """Ends the workers and discards prefetched samples."""
        self._ahead.clear()
        self._workers.shutdown(wait=True, cancel_futures=True)


def _prepare_worker() -> None:
    import torch

    work_in_background(LOADER_NICENESS)
    torch.set_num_threads(1)  # training itself needs the cores
