"""Policies that write, exit, hang, raise everything: each fails its own rollout, and reaches nothing else."""

import ctypes
import itertools
import os
import pickle
import signal
import threading
import time
from dataclasses import dataclass

import numpy as np
import pytest
import worlds

from nurec_sim.errors import PolicyError
from nurec_sim.sim import Scenario, run_rollout
from nurec_sim.sim.policy_host import PolicyHost
from nurec_sim.sim.policy_thread import still_abandoned
from nurec_sim.sim.sealed import sealed
from nurec_sim.types import CameraFrame, EgoState, Needs, Plan

EVERYTHING = Needs(cameras=("front",), lidars=("any",), image_width_px=32, privileged=True)


def ahead(observation):
    steps = np.arange(1, 51)
    return Plan(observation.t_us + 100_000 * steps, np.column_stack([steps * 1.0, np.zeros(50), np.zeros(50)]))


class Acts:
    """Drives straight on; from its third plan on it does ``act`` first."""

    name = "acts"

    def __init__(self, act=lambda observation: None, needs=EVERYTHING):
        self.act, self.needs, self.plans = act, needs, 0

    def reset(self, rig, seed):
        self.rig = rig

    def plan(self, observation):
        self.plans += 1
        return (self.act(observation) if self.plans >= 3 else None) or ahead(observation)


def drive(policy, sense=None, timeout_s=20.0, **keys):
    world = worlds.parked_car_ahead(60.0, duration_s=4.0)
    scenario = Scenario(**{"name": "test", "duration_s": 4.0, **keys})
    return run_rollout(scenario, policy, sense or world.sense, world, plan_timeout_s=timeout_s)


@pytest.fixture(scope="module")
def honest():
    return drive(Acts())


def assert_same_drive(a, b):
    """All states, plans and actors that ``a`` has are in ``b`` too."""
    count = len(a.states)
    for one, other in zip(a.states, b.states, strict=False):
        assert np.array_equal(one.world_from_rig, other.world_from_rig) and one.speed_mps == other.speed_mps
    assert all(np.array_equal(a.actors[i], b.actors[i][:count], equal_nan=True) for i in b.actors)
    assert np.array_equal(a.recorded.world_from_body, b.recorded.world_from_body)
    assert np.array_equal(
        a.rig.cameras["front_wide"].rig_from_camera, b.rig.cameras["front_wide"].rig_from_camera
    )  # fmt: skip


# -------------------------------------------------------------------------------------------------------------- writing


def arrays_of(value, place="observation"):
    """Every array inside, by the way to it."""
    if isinstance(value, np.ndarray):
        yield place, value
    elif hasattr(value, "__dataclass_fields__"):
        for name in value.__dataclass_fields__:
            yield from arrays_of(getattr(value, name), f"{place}.{name}")
    elif hasattr(value, "items"):
        for key, item in value.items():
            yield from arrays_of(item, f"{place}[{key}]")
    elif isinstance(value, tuple):
        for index, item in enumerate(value):
            yield from arrays_of(item, f"{place}[{index}]")


def test_everything_that_a_policy_gets_is_read_only():
    policy, found = Acts(), {}

    def look(observation):
        found.update(arrays_of(observation))
        found.update(arrays_of(policy.rig, "rig"))
        for mapping in (observation.cameras, observation.lidars, policy.rig.cameras, policy.rig.lidars):
            with pytest.raises(TypeError):
                mapping["other"] = None
        assert all(type(items) is tuple for items in (observation.history, observation.actors))
        assert pickle.loads(pickle.dumps(observation)).cameras["front"].rgb.tolist() == (
            observation.cameras["front"].rgb.tolist()
        )

    policy.act = look
    rollout = drive(policy)
    assert rollout.status == "ok", rollout.error
    for place in ("ego.world_from_rig", "history[0].world_from_rig", "route_m", "cameras[front].rgb",
                  "cameras[front].camera.rig_from_camera", "lidars[any].xyz_m", "actors[0].rig_from_box"):  # fmt: skip
        assert f"observation.{place}" in found
    assert "rig.cameras[front_wide].rig_from_camera" in found
    for place, array in found.items():
        base = array
        while isinstance(base, np.ndarray):
            assert not base.flags.writeable, place
            with pytest.raises(ValueError):
                base.flags.writeable = True
            base = base.base
        assert isinstance(base, bytes), place


def test_a_policy_that_writes_fails_and_moves_nothing(honest):
    def write(observation):
        for state in observation.history:
            state.world_from_rig[:3, 3] += 1e6

    rollout = drive(Acts(write))
    assert rollout.status == "failed" and rollout.error == "ValueError: output array is read-only"
    assert [event.kind for event in rollout.events] == ["policy_error"]
    assert len(rollout.states) == 5 + 1 + 10
    assert_same_drive(rollout, honest)


def test_not_even_writing_past_the_lock_reaches_the_rollout(honest):
    """Fields of frozen dataclasses set by force, and memory overwritten by address, are those of copies."""
    policy = Acts()

    def force(observation):
        for _, array in [*arrays_of(observation), *arrays_of(policy.rig)]:
            ctypes.memset(array.ctypes.data, 0x41, array.nbytes)
        for state in (observation.ego, *observation.history):
            object.__setattr__(state, "speed_mps", 1e6)
        observation.cameras._items.clear()

    policy.act = force
    rollout = drive(policy)
    assert rollout.status == "ok" and len(rollout.states) == len(honest.states)
    assert_same_drive(rollout, honest)


def test_plans_are_copied_when_they_are_given():
    class Regrets(Acts):
        def plan(self, observation):
            if hasattr(self, "last"):
                self.last.pose[...] = 7.0
                self.last.t_us[...] = 0
            self.last = ahead(observation)
            return self.last

    rollout = drive(Regrets(), duration_s=2.0)
    assert rollout.status == "ok"
    for made_us, plan in rollout.plans:
        assert plan.t_us[0] == made_us + 100_000 and plan.pose[-1].tolist() == [50.0, 0.0, 0.0]


@pytest.mark.parametrize("plan", [Plan(None, None, True), Plan("abc", [[1]], True), Plan([1], [[2.0, 3.0]], True)])
def test_whatever_a_plan_to_stop_holds_the_rollout_can_be_kept(plan, tmp_path):
    from nurec_sim.runs import load_rollout, save_rollout

    rollout = drive(Acts(lambda observation: plan, Needs()))
    assert rollout.status == "ok" and rollout.events[0].kind == "stop_session"
    assert load_rollout(save_rollout(rollout, tmp_path / "r.npz")).plans[-1][1].stop_session


def test_frames_that_a_renderer_keeps_stay_as_they_are():
    """A renderer that gives the same frame twice, and a recorder that keeps it, see what was rendered."""
    world, kept, heard = worlds.straight_road(), {}, []

    def sense(requests):
        return [kept.setdefault(type(request.sensor), world.sense([request])[0]) for request in requests]

    def force(observation):
        frame = observation.cameras["front"]
        ctypes.memset(frame.rgb.ctypes.data, 0, frame.rgb.nbytes)

    scenario = Scenario(name="test", duration_s=4.0)
    run_rollout(scenario, Acts(force), sense, world, on_frames=lambda t, frames: heard.append(frames["front"]))
    assert heard and all(isinstance(frame, CameraFrame) and frame.rgb.min() > 0 for frame in heard)


def test_sealing_keeps_values_types_and_empty_arrays():
    @dataclass(frozen=True)
    class Other:
        pose: np.ndarray
        names: dict

    pose = np.arange(16.0).reshape(4, 4).T  # not contiguous
    value = sealed((EgoState(5, pose, 1.0), Other(np.zeros((0, 2), np.int32), {"a": [1, np.float32(2)]})))
    assert type(value[0]) is EgoState and np.array_equal(value[0].world_from_rig, pose)
    assert value[1].pose.shape == (0, 2) and value[1].pose.dtype == np.int32
    assert value[1].names["a"] == (1, 2.0) and dict(value[1].names) == {"a": (1, 2.0)}


# ------------------------------------------------------------------------------------------------- exiting and raising


class Unspeakable(BaseException):
    def __str__(self):
        raise KeyboardInterrupt


def raising(error):
    def act(observation):
        raise error

    return act


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (SystemExit(0), "SystemExit: 0"),
        (KeyboardInterrupt(), "KeyboardInterrupt: "),
        (GeneratorExit(), "GeneratorExit: "),
        (StopIteration(3), "StopIteration: 3"),
        (TimeoutError("socket"), "TimeoutError: socket"),
        (Unspeakable(), "Unspeakable"),
    ],
)
def test_whatever_a_policy_raises_fails_its_rollout_only(error, text, honest):
    rollout = drive(Acts(raising(error)))
    assert (rollout.status, rollout.error) == ("failed", text)
    assert [event.kind for event in rollout.events] == ["policy_error"]
    assert_same_drive(rollout, honest)
    resets = Acts()
    resets.reset = lambda rig, seed: raising(error)(None)
    assert (drive(resets).status, drive(resets).error) == ("failed", text)


def test_code_that_hides_in_a_plan_or_in_needs_fails_too():
    class Trap(Plan):
        @property
        def stop_session(self):
            raise SystemExit(3)

    rollout = drive(Acts(lambda observation: Trap.__new__(Trap)))
    assert rollout.error == "SystemExit: 3" and rollout.events[0].kind == "policy_error"
    rollout = drive(Acts(needs=Needs(cameras=("front",), image_width_px="wide")))
    assert rollout.status == "failed" and "its needs cannot be met: TypeError" in rollout.error


def test_a_real_interrupt_still_ends_the_run():
    """Ctrl-C while the policy thinks: the main thread hears it at once."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where pytest runs in the background
    asleep = threading.Event()
    interrupt = threading.Timer(0.3, lambda: os.kill(os.getpid(), signal.SIGINT))
    interrupt.start()
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        drive(Acts(lambda observation: asleep.wait(20)))
    assert time.monotonic() - begun < 10
    asleep.set()
    signal.signal(signal.SIGINT, before)


# -------------------------------------------------------------------------------------------------------------- hanging


def test_a_policy_that_hangs_fails_in_time_and_python_loops_are_ended(honest):
    def spin(observation):
        for _ in itertools.count():
            pass

    rollout = drive(Acts(spin), timeout_s=1.0)
    assert rollout.status == "failed"
    assert rollout.error == "plan() did not finish within 1 s; --plan-timeout (plan_timeout_s) sets the limit"
    assert_same_drive(rollout, honest)
    until = time.monotonic() + 10
    while still_abandoned() and time.monotonic() < until:
        time.sleep(0.01)
    assert still_abandoned() == 0


def test_a_policy_that_hung_is_made_anew_for_the_next_rollout():
    release, made = threading.Event(), []

    def make():
        hangs = not made
        made.append(Acts((lambda observation: release.wait(30) and None) if hangs else lambda observation: None))
        return made[-1]

    host = PolicyHost(make, timeout_s=0.5)
    assert "did not finish within 0.5 s" in drive(host).error
    assert drive(host).status == "ok" and len(made) == 2
    host.close()
    release.set()


def test_an_object_that_still_hangs_is_not_asked_again():
    release, policy = threading.Event(), Acts()
    policy.act = lambda observation: release.wait(30) and None
    host = PolicyHost(lambda: policy, timeout_s=0.5)
    assert "did not finish within 0.5 s" in drive(host).error
    plans, before = policy.plans, time.monotonic()
    assert drive(host).error == "it is still busy with a call that timed out"
    assert policy.plans == plans and time.monotonic() - before < 5
    release.set()
    host.close()


def test_making_a_policy_has_a_limit_and_may_not_exit():
    release = threading.Event()
    with pytest.raises(PolicyError, match="creating the policy did not finish within 0.2 s"):
        PolicyHost(lambda: release.wait(30), timeout_s=0.2)
    release.set()
    with pytest.raises(PolicyError, match="KeyboardInterrupt"):
        PolicyHost(lambda: raising(KeyboardInterrupt())(None))
    with pytest.raises(ValueError, match="above 0, got 0"):
        PolicyHost(Acts, timeout_s=0)


def test_threads_end_with_their_rollouts():
    before = threading.active_count()
    for _ in range(3):
        drive(Acts(needs=Needs()), duration_s=1.0)
    until = time.monotonic() + 5
    while threading.active_count() > before and time.monotonic() < until:
        time.sleep(0.01)
    assert threading.active_count() <= before
