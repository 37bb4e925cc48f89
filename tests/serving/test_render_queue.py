"""Work in turns: places, rests, bounds of what has begun, cancelled work."""

import asyncio
import threading
import time

import pytest

from nurec_sim.compute.turns import aside, current_turn, rest
from nurec_sim.errors import CancelledError, DeadlinePassedError
from nurec_sim.render.cpu.workers import Workers
from nurec_sim.serving.calls import Call, enter_call
from nurec_sim.serving.sensor_service.render_queue import LARGE_RAYS, MOST_RAYS, TURN_S, RenderQueue


def run(workers, main):
    """Runs ``main(queue)`` in an event loop."""

    async def begin():
        queue = RenderQueue(workers)
        try:
            return await asyncio.wait_for(main(queue), 30)
        finally:
            queue.close()
            assert (queue.waiting, queue.running, queue.offered) == (0, 0, 0)

    return asyncio.run(begin())


def start(queue, client, rays, function, deadline_s=float("inf")):
    async def ask():
        enter_call(Call("", f"ipv4:{client}:1", deadline_s=deadline_s))
        return await queue.run(rays, function)

    return asyncio.create_task(ask())


async def until(condition):
    while not condition():
        await asyncio.sleep(0.002)


def test_a_small_job_of_another_client_is_done_while_a_large_one_rests():
    done = threading.Event()

    def large():
        end = time.monotonic() + 20
        while not done.is_set():
            assert time.monotonic() < end
            rest()
        return "large"

    async def main(queue):
        slow = start(queue, "a", 33_000_000, large)
        await until(lambda: queue.running)
        assert await start(queue, "b", 1, lambda: "small") == "small"
        assert queue.running == 1 and queue.waiting == 0
        done.set()
        return await slow

    assert run(1, main) == "large"


@pytest.mark.parametrize("rests", [True, False])
def test_kernels_stop_soon_after_their_client_has_left(rests):
    """The calls of a kernel are the places at which a frame rests, whether or not somebody else waits."""
    count, ended = [], []

    def frame():
        try:
            Workers(2).run_calls([(lambda: (count.append(1), time.sleep(0.005)),)] * 100_000)
        except CancelledError:
            ended.append(time.monotonic())
            raise

    async def main(queue):
        others = [start(queue, "b", 1, lambda: [rest() for _ in iter(lambda: time.sleep(0.001), 0)])] if rests else []
        task = start(queue, "a", 1, frame)
        await until(lambda: len(count) > 3)
        left = time.monotonic()
        for cancelled in (task, *others):
            cancelled.cancel()
        await until(lambda: ended)
        return ended[0] - left

    assert run(1, main) < 10  # a kernel's call is over in milliseconds, the frame in minutes


def test_a_deadline_ends_work_that_rests():
    async def main(queue):
        def forever():
            while True:
                time.sleep(0.001)
                rest()

        with pytest.raises(DeadlinePassedError):
            await start(queue, "a", 1, forever, deadline_s=time.monotonic() + 0.05)

    run(1, main)


def test_what_was_cancelled_before_its_turn_is_not_begun():
    gate, begun = threading.Event(), []

    async def main(queue):
        first = start(queue, "a", 1, lambda: gate.wait(20))
        await until(lambda: queue.running)
        second = start(queue, "a", 1, lambda: begun.append(2))
        await until(lambda: queue.waiting)
        second.cancel()
        await until(lambda: not queue.waiting)
        gate.set()
        await first

    run(1, main)
    assert not begun


def test_begun_jobs_are_bounded():
    """Two large jobs of different clients fit, a third does not, nor a second of the same; small ones still begin."""
    gate, begun = threading.Event(), []

    def hold(name):
        def work():
            begun.append(name)
            with aside():
                gate.wait(20)

        return work

    async def main(queue):
        asked = [("a", MOST_RAYS, "a1"), ("a", MOST_RAYS, "a2"), ("b", MOST_RAYS, "b1"), ("c", MOST_RAYS, "c1")]
        tasks = [start(queue, client, rays, hold(name)) for client, rays, name in asked]
        await until(lambda: len(begun) == 2)
        tasks.append(start(queue, "c", LARGE_RAYS, hold("small")))
        await until(lambda: len(begun) == 3)
        await asyncio.sleep(3 * TURN_S)
        assert sorted(begun) == ["a1", "b1", "small"] and queue.waiting == 2
        gate.set()
        await asyncio.gather(*tasks)

    run(1, main)
    assert sorted(begun) == ["a1", "a2", "b1", "c1", "small"]


def test_errors_reach_who_asked_and_the_place_is_free_again():
    async def main(queue):
        with pytest.raises(ZeroDivisionError):
            await start(queue, "a", 1, lambda: 1 / 0)
        return await start(queue, "a", 1, lambda: current_turn() is not None)

    assert run(1, main)
    rest()  # outside of a queue there is nothing to wait for
    assert current_turn() is None
