"""The render queue: frames are rendered in threads, with fair scheduling between clients."""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from nurec_sim.compute.turns import turn_of_thread
from nurec_sim.errors import CancelledError
from nurec_sim.serving.calls import Call, current_call
from nurec_sim.serving.sensor_service.fair_shares import FairShares, Job

T = TypeVar("T")

TURN_S = 0.01
"""Longest turn while others wait: long compared with the cost of switching, short for those who wait."""
LARGE_RAYS = 1 << 21
"""A job of more rays counts as large; an image of 1920 x 1080 does not."""
MOST_RAYS = 1 << 25
"""Limit for all small jobs that have started; large ones get twice as many, and one large job may always run."""
MOST_BEGUN = 64
"""Jobs, a thread each."""


class RenderQueue:
    """Runs functions in threads, a few at a time, with fair scheduling between clients.

    A function that calls ``compute.turns.rest`` stops there while others have their turn. Jobs that have begun hold
    memory, so there are bounds: of large ones, a client has one at a time. What its client cancelled, or has stopped
    waiting for, is not begun, and ends at its next rest.

    Args:
        workers: functions that run at the same time.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._threads = ThreadPoolExecutor(MOST_BEGUN, thread_name_prefix="render")
        self.lock = threading.Lock()
        self._shares = FairShares(TURN_S)
        self._works: dict[Job, _Work] = {}
        self._begun: Counter[tuple[str, ...]] = Counter()
        self._large: Counter[tuple[str, ...]] = Counter()
        self._small_rays = self._large_rays = 0
        self._closed = False
        self.offered = 0
        """Jobs that wait for a turn, started or not."""
        self._running = 0

    @property
    def waiting(self) -> int:
        """Functions that have not started."""
        return len(self._works) - self._begun.total()

    @property
    def running(self) -> int:
        """Functions that are running."""
        return self._running

    async def run(self, rays: int, function: Callable[..., T], *arguments: Any) -> T:
        """What ``function`` gives; if the await is cancelled, it is never called, or ends at its next rest.

        Args:
            rays: pixels and beams that it renders.
            function: called in another thread.
            arguments: its arguments.

        Raises:
            DeadlinePassedError: the deadline of the current call passed before it was done.
        """
        call = current_call()
        work = _Work(self, Job(call.client, rays), call, function, arguments)
        with self.lock:
            if self._closed:
                raise RuntimeError("the queue is closed")
            self._works[work.job] = work
            self._shares.join(work.job)
            self.offered += 1
            self._dispatch()
        try:
            result: T = await asyncio.wrap_future(work.future)
            return result
        except asyncio.CancelledError:
            self.cancel(work)
            raise

    def cancel(self, work: _Work) -> None:
        """Ends a job at its next rest, or before it begins."""
        with self.lock:
            work.cancelled = True
            if work.waits:
                self.stop_waiting(work)
                if not work.begun:
                    work.future.cancel()
                    self._forget(work)
            work.go_on.set()

    def close(self) -> None:
        """Cancels queued work and waits for running work."""
        with self.lock:
            self._closed = True
            unbegun = [work for work in self._works.values() if not work.begun]
        for work in unbegun:
            self.cancel(work)
        self._threads.shutdown(wait=True)

    # ---------------------------------------------------------------------- called by the work, which holds the lock

    def stop_waiting(self, work: _Work) -> None:
        """Removes a waiting job."""
        self._shares.withdraw(work.job)
        self.offered -= 1
        work.waits = False

    def give_place(self, work: _Work) -> None:
        """Ends a turn."""
        self._shares.settle(work.job, time.monotonic() - work.since_s)
        self._running -= 1
        work.has_place = False

    def charge(self, work: _Work, seconds: float) -> None:
        """Charges work that was done outside of turns."""
        self._shares.charge(work.job, seconds)

    def wait_for_place(self, work: _Work) -> None:
        """Makes a started job wait for a turn."""
        work.go_on.clear()
        work.waits = True
        self._shares.offer(work.job)
        self.offered += 1

    def share_out(self) -> None:
        """Starts turns while workers are free."""
        self._dispatch()

    def end(self, work: _Work) -> None:
        """Forgets a job that is done."""
        if work.has_place:
            self.give_place(work)
        self._begun[work.job.client] -= 1
        if work.job.rays > LARGE_RAYS:
            self._large[work.job.client] -= 1
            self._large_rays -= work.job.rays
        else:
            self._small_rays -= work.job.rays
        self._forget(work)
        self._dispatch()

    # ---------------------------------------------------------------------------------------------------------- inside

    def _forget(self, work: _Work) -> None:
        self._shares.leave(work.job)
        del self._works[work.job]
        for counts in (self._begun, self._large):
            if not counts[work.job.client]:
                del counts[work.job.client]

    def _may_run(self, job: Job) -> bool:
        if self._works[job].begun:
            return True
        if self._begun.total() >= MOST_BEGUN or self._begun[job.client] >= self._workers + 2:
            return False
        if job.rays > LARGE_RAYS:
            fits = not self._large_rays or self._large_rays + job.rays <= 2 * MOST_RAYS
            return fits and not self._large[job.client]
        return self._small_rays + job.rays <= MOST_RAYS

    def _dispatch(self) -> None:
        while self._running < self._workers and (job := self._shares.take(self._may_run)) is not None:
            work = self._works[job]
            self.offered -= 1
            self._running += 1
            work.waits, work.has_place, work.since_s = False, True, time.monotonic()
            if work.begun:
                work.go_on.set()
                continue
            work.begun = True
            self._begun[job.client] += 1
            if job.rays > LARGE_RAYS:
                self._large[job.client] += 1
                self._large_rays += job.rays
            else:
                self._small_rays += job.rays
            self._threads.submit(work.perform)


class _Work:
    """A job with what there is to do; as a ``compute.turns.Turn``, it rests while it is not its turn."""

    def __init__(
        self, queue: RenderQueue, job: Job, call: Call, function: Callable[..., Any], arguments: tuple
    ) -> None:
        self._queue, self.job, self._call = queue, job, call
        self._function, self._arguments = function, arguments
        self.future: Future = Future()
        self.begun = self.has_place = self.cancelled = False
        self.waits = True
        self.since_s = 0.0
        """When its turn began."""
        self.go_on = threading.Event()

    def perform(self) -> None:
        """Does the work."""
        error, result = None, None
        token = turn_of_thread.set(self)
        try:
            self._check()
            result = self._function(*self._arguments)
        except BaseException as raised:
            error = raised
        finally:
            turn_of_thread.reset(token)
        del self._function, self._arguments  # with all that they hold
        with self._queue.lock:
            self._queue.end(self)
        if not self.future.set_running_or_notify_cancel():
            return
        if error is not None:
            self.future.set_exception(error)
        else:
            self.future.set_result(result)

    @property
    def is_over(self) -> bool:
        """Whether another job is due, or the call was cancelled or has passed its deadline."""
        now = time.monotonic()
        over = self._queue.offered > 0 and now - self.since_s >= TURN_S
        return self.cancelled or over or now >= self._call.deadline_s

    def rest(self) -> None:
        """Waits for its next turn; see ``compute.turns.Turn``."""
        self._check()
        with self._queue.lock:
            self._queue.give_place(self)
        self._take_place()

    @contextlib.contextmanager
    def aside(self) -> Iterator[None]:
        """Releases its worker for the duration; see ``compute.turns.Turn``."""
        began_s = time.monotonic()
        with self._queue.lock:
            self._queue.give_place(self)
            self._queue.share_out()
        try:
            yield
        finally:
            with self._queue.lock:
                self._queue.charge(self, time.monotonic() - began_s)
        self._take_place()

    def _take_place(self) -> None:
        with self._queue.lock:
            if not self.cancelled:
                self._queue.wait_for_place(self)
            self._queue.share_out()
        while not self.cancelled and not self.go_on.wait(self._left_s()):
            with self._queue.lock:
                if self.waits and self._left_s() == 0:
                    self._queue.stop_waiting(self)
                    break
        self._check()

    def _left_s(self) -> float | None:
        """Time until the deadline; None if there is none."""
        deadline_s = self._call.deadline_s
        return None if deadline_s == math.inf else max(deadline_s - time.monotonic(), 0.0)

    def _check(self) -> None:
        if self.cancelled:
            raise CancelledError("the request for this frame was cancelled")
        self._call.check_deadline()
