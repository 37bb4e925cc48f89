"""Policies that fail: the call gets a status that says why, the session and the server live on."""

import math
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from driving_calls import (
    NOW_US,
    TIMES,
    Steady,
    answering,
    drive_message,
    driver,
    ego_message,
    opening,
    status,
    times_of,
    wait_until,
    xy_of,
)
from grpc import StatusCode as Code

from nurec_sim.types import Plan

NOTHING = np.zeros((0, 3))


def ready(stub, session="s"):
    stub.start_session(opening(session), timeout=10)
    stub.submit_egomotion_observation(ego_message(session=session), timeout=10)


def raises(error):
    def plan_of(observation):
        raise error

    return plan_of


def straight(times, **change):
    pose = np.zeros((len(times), 3))
    pose[:, 0] = 0.5 * np.arange(1, len(times) + 1)
    return replace(Plan(NOW_US + np.asarray(times), pose), **change)


@pytest.mark.parametrize(
    ("plan_of", "text"),
    [
        (raises(ValueError("no road")), "policy 'odd' failed: ValueError: no road"),
        (raises(SystemExit(3)), "policy 'odd' failed: SystemExit: 3"),
        (raises(KeyboardInterrupt()), "policy 'odd' failed: KeyboardInterrupt"),
        (lambda o: None, "policy 'odd': the policy must return a nurec_sim.types.Plan, got NoneType"),
        (lambda o: Plan(np.zeros(0, np.int64), NOTHING), "the plan is empty"),
        (lambda o: straight(TIMES, pose=np.full((50, 3), math.nan)), "plan poses must be finite; pose 0"),
        (lambda o: straight(TIMES, pose=np.full((50, 3), math.inf)), "plan poses must be finite"),
        (lambda o: straight(TIMES, pose=np.full((50, 3), 2e4)), "plan positions must lie within 10000 m"),
        (lambda o: straight(TIMES, pose=np.zeros((49, 3))), "a plan needs t_us [k] and pose [k,3]"),
        (lambda o: straight(TIMES, t_us=NOW_US + TIMES / 7), "plan times must be integer microseconds"),
        (lambda o: straight(TIMES, t_us=NOW_US + TIMES[::-1]), "plan times must increase"),
        (lambda o: straight(TIMES - 10_000_000), "the plan is too late"),
        (lambda o: straight(TIMES[:20]), "the plan ends 2.000 s ahead; it must reach at least 2.5 s"),
        (lambda o: straight(TIMES, pose="left"), "plan poses must be numbers"),
        (lambda o: straight(TIMES, t_us=[[1], [2, 3]]), "plan poses must be numbers"),
    ],
)
def test_nonsense_is_told_and_the_session_goes_on(plan_of, text):
    with driver(answering(plan_of)) as stub:
        ready(stub)
        code, said = status(stub.drive, drive_message())
        assert code is Code.ABORTED and text in said and said.startswith("policy 'odd'")
        assert len(stub.drive(drive_message(), timeout=10).trajectory.poses) == 51


def test_a_policy_that_cannot_be_reset_opens_no_session():
    class Broken(Steady):
        name = "broken"

        def reset(self, rig, seed):
            if seed == 1:
                raise RuntimeError("wrong car")

    with driver(Broken, max_sessions=1) as stub:
        code, text = status(stub.start_session, opening(seed=1))
        assert (code, text) == (Code.ABORTED, "policy 'broken' failed: RuntimeError: wrong car")
        stub.start_session(opening(seed=2), timeout=10)


@pytest.mark.parametrize(
    ("plan", "last_x"),
    [(straight(TIMES, stop_session=True), 25.0), (Plan(np.zeros(0, np.int64), NOTHING, stop_session=True), 0.0)],
)
def test_a_policy_that_stops_answers_something_that_can_be_driven(plan, last_x):
    with driver(answering(lambda observation: plan)) as stub:
        ready(stub)
        answer = stub.drive(drive_message(), timeout=10)
        assert answer.terminate_session
        assert times_of(answer)[[0, -1]].tolist() == [NOW_US, NOW_US + 5_000_000]
        assert xy_of(answer)[-1].tolist() == [last_x, 0.0]


def test_a_plan_that_begins_in_the_past_is_answered_as_it_is():
    with driver(answering(lambda observation: straight(TIMES - 300_000))) as stub:
        ready(stub)
        assert times_of(stub.drive(drive_message(), timeout=10)).tolist() == (NOW_US + TIMES - 300_000).tolist()


class Slow(Steady):
    """Waits to be let through."""

    name = "slow"
    gate = threading.Event()
    planning = 0

    def plan(self, observation):
        type(self).planning += 1
        assert self.gate.wait(20)
        return super().plan(observation)


@pytest.fixture
def slow():
    Slow.gate.clear()
    Slow.planning = 0
    yield Slow
    Slow.gate.set()


def miss_deadline(stub, slow, session="s"):
    """Calls whose time is up before their plan is made, until one of them has been begun."""
    begun = slow.planning
    while slow.planning == begun:
        assert status(stub.drive, drive_message(session=session), timeout=0.3)[0] is Code.DEADLINE_EXCEEDED


def test_a_slow_policy_misses_its_deadline_holds_up_nobody_and_goes_on(slow):
    with driver(slow) as stub:
        ready(stub)
        ready(stub, "other")
        began = time.monotonic()
        miss_deadline(stub, slow)
        assert time.monotonic() - began < 5
        stub.submit_egomotion_observation(ego_message(), timeout=5)
        # One call that was cancelled before its turn is never planned; the thread of the session is still busy.
        assert status(stub.drive, drive_message(), timeout=0.3)[0] is Code.DEADLINE_EXCEEDED
        miss_deadline(stub, slow, "other")
        assert slow.planning == 2
        slow.gate.set()
        assert len(stub.drive(drive_message(), timeout=10).trajectory.poses) == 51
        assert slow.planning == 3


def test_a_policy_may_think_only_so_long(slow):
    with driver(slow, plan_timeout_s=0.3) as stub:
        ready(stub)
        assert status(stub.drive, drive_message()) == (
            Code.DEADLINE_EXCEEDED,
            "policy 'slow' has not answered within 0.3 s",
        )


def test_a_policy_that_hangs_does_not_keep_the_server(slow):
    with driver(slow) as stub:
        ready(stub)
        miss_deadline(stub, slow)
        began = time.monotonic()
    assert time.monotonic() - began < 10  # the policy would hang for longer
    slow.gate.set()
    wait_until(lambda: not [t for t in threading.enumerate() if t.name.startswith("policy-")])


def test_threads_of_closed_sessions_end():
    with driver() as stub:
        for i in range(5):
            ready(stub, f"session-{i}")
        assert len([t for t in threading.enumerate() if t.name.startswith("policy-")]) == 5
    wait_until(lambda: not [t for t in threading.enumerate() if t.name.startswith("policy-")])
