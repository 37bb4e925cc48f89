"""Threads that run kernels, and the scratch memory they work in."""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait

import numpy as np

from nurec_sim.compute.turns import current_turn

SPLIT = 16
"""Ranges per thread: enough to even out tiles of very different cost."""
KEPT = 4
"""Sets of scratch arrays that are kept for later frames."""

Scratch = Callable[[str, tuple[int, ...], type], np.ndarray]
"""Returns an uninitialised array of a name, a shape and a type."""


class Workers:
    """Threads that run kernel calls, the caller's among them; safe to use from many threads at once."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads - 1, thread_name_prefix="render") if threads > 1 else None

    def run_calls(self, calls: Sequence[tuple]) -> list:
        """The results of calls (function, argument, ...), in order; all have ended when this returns or fails.

        Between calls, the work rests when its turn is over (``turns``); its helpers are then free for others.

        Raises:
            CancelledError, DeadlinePassedError: see ``compute.turns.rest``.
        """
        results: list = [None] * len(calls)
        numbers = itertools.count()  # next() of it is atomic
        turn, begun_all = current_turn(), False

        def work() -> None:
            nonlocal begun_all
            # Threads take the next call when free, so calls of uneven cost balance; each writes its own result.
            while turn is None or not turn.is_over:
                if (number := next(numbers)) >= len(calls):
                    begun_all = True
                    return
                function, *arguments = calls[number]
                results[number] = function(*arguments)

        while True:
            self._together(work, min(self.threads, len(calls)) - 1)
            if begun_all:
                return results
            assert turn is not None
            turn.rest()

    def _together(self, work: Callable[[], None], helpers: int) -> None:
        """Does the work here and in as many other threads as are free; all have ended when this returns or fails."""
        futures = [self._pool.submit(work) for _ in range(helpers)] if self._pool is not None else []
        try:
            work()
        finally:
            # Helpers that are still busy with another caller's work have nothing left to do here.
            futures = [future for future in futures if not future.cancel()]
            wait(futures)
        for future in futures:
            future.result()

    def run(self, function: Callable, arguments: Sequence[tuple]) -> list:
        """``function`` of each tuple of arguments, in order."""
        return self.run_calls([(function, *each) for each in arguments])

    def ranges(self, count: int, least: int, most: int | None = None) -> list[tuple[int, int]]:
        """0..count cut into about ``SPLIT`` ranges per thread of at least ``least``, and at most about ``most``."""
        parts = max(1, min(self.threads * SPLIT if self.threads > 1 else 1, count // max(least, 1)))
        if most is not None:
            parts = max(parts, -(-count // max(most, 1)))
        edges = np.linspace(0, count, parts + 1).astype(np.int64)
        return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


class Buffers:
    """Large scratch arrays, kept between frames; each frame has a set of its own."""

    def __init__(self) -> None:
        self._free: list[dict[str, np.ndarray]] = []
        self._lock = threading.Lock()

    @contextlib.contextmanager
    def lend(self) -> Iterator[Scratch]:
        """A function that returns an uninitialised array of a name, a shape and a type, the caller's until the end."""
        with self._lock:
            arrays = self._free.pop() if self._free else {}

        def array(name: str, shape: tuple[int, ...], dtype: type) -> np.ndarray:
            size = int(np.prod(shape))
            if name not in arrays or arrays[name].size < size or arrays[name].dtype != dtype:
                # A fifth more than needed: the next frame rarely needs a new array.
                arrays[name] = np.empty(int(size * 1.2) + 64, dtype)
            return arrays[name][:size].reshape(shape)

        try:
            yield array
        finally:
            with self._lock:
                if len(self._free) < KEPT:
                    self._free.append(arrays)
