"""A driver on the far side of a wire in our loop: the same rollout as at home, failed rows when something breaks."""

import re
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import grpc
import numpy as np
import pytest
import worlds
from driving_calls import TIMES, Steady, answering, driver, like_alpasim, wait_until
from repetition import slow_after
from serving_world import scene

from nurec_sim import plugins, runs
from nurec_sim.errors import ScenarioError, ServerError
from nurec_sim.serving.driver import DriverOptions, DriverServer, RemotePolicy
from nurec_sim.serving.driver import remote_policy as remote_module
from nurec_sim.sim import make_scenario, run_rollout
from nurec_sim.sim.conformance import check_policy
from nurec_sim.types import Needs, Plan

POLICIES = ("camera_road_follower", "lidar_aeb", "route_follower", "log_replay", "constant_velocity")
SHORT = make_scenario({"name": "short", "duration_s": 2.0})


def rollout(policy, world, scenario=SHORT):
    return run_rollout(scenario, policy, world.sense, world, seed=3)


def plans_of(found):
    assert found.status == "ok", found.error
    return b"".join(plan.t_us.tobytes() + plan.pose.tobytes() for _, plan in found.plans)


def other_wire(monkeypatch):
    """Makes remote policies say nothing that AlpaSim's messages have no room for."""
    begin, outcome = RemotePolicy._begin, RemotePolicy._outcome
    monkeypatch.setattr(RemotePolicy, "_begin", lambda self, name, request: begin(self, name, like_alpasim(request)))
    monkeypatch.setattr(RemotePolicy, "_outcome", lambda self, name, call: like_alpasim(outcome(self, name, call)))


@pytest.mark.parametrize("world", [worlds.curve(), worlds.hill(), worlds.parked_car_ahead()], ids=lambda w: w.id)
@pytest.mark.parametrize("name", slow_after(2, POLICIES))
def test_a_remote_rollout_equals_the_local_one_bit_for_bit(name, world):
    local = rollout(plugins.load_policy(name), world)
    with DriverServer(lambda: plugins.load_policy(name), port=0) as address, RemotePolicy(address) as remote:
        assert remote.needs == plugins.load_policy(name).needs
        far = rollout(remote, world)
        again = rollout(remote, world)
    assert plans_of(local) == plans_of(far) == plans_of(again)
    assert np.array_equal(local.world_from_rig, far.world_from_rig)


@pytest.mark.parametrize("name", ["constant_velocity", "camera_road_follower"])
def test_without_our_additions_float32_is_the_only_difference(name, monkeypatch):
    world = worlds.hill()
    local = rollout(plugins.load_policy(name), world)
    other_wire(monkeypatch)
    with DriverServer(lambda: plugins.load_policy(name), port=0) as address:
        far = rollout(plugins.load_policy(f"grpc://{address}?cameras=front_wide"), world)
    assert far.status == "ok", far.error
    for (_, here), (_, there) in zip(local.plans, far.plans, strict=True):
        np.testing.assert_array_equal(here.t_us, there.t_us)
        np.testing.assert_allclose(here.pose, there.pose, atol=1e-4)
    assert plans_of(local) != plans_of(far)


def test_another_image_width_is_kept():
    scenario = make_scenario({"name": "small", "duration_s": 1.5, "sensors": {"image_width_px": 128}})
    world = worlds.curve()
    local = rollout(plugins.load_policy("camera_road_follower"), world, scenario)
    with DriverServer(lambda: plugins.load_policy("camera_road_follower"), port=0) as address:
        far = rollout(plugins.load_policy(f"grpc://{address}"), world, scenario)
    assert plans_of(local) == plans_of(far)


def test_a_remote_policy_keeps_the_contract_of_policies():
    with driver(Steady) as stub, RemotePolicy(stub.address) as remote:
        assert check_policy(remote) == []
        assert len(stub.made) == 7


def test_what_a_url_may_say():
    with driver(Steady) as stub:
        url = f"grpc://{stub.address}"
        policy = plugins.load_policy(f"{url}?cameras=left,front&width=200&lidars=any")
        assert policy.needs == Needs(cameras=("left", "front"), lidars=("any",), image_width_px=200)
        assert policy.name == f"steady@{stub.address}"
        policy.close()
        for bad, text in (
            (f"{url}?camera=front", r"must look like grpc://host:port.*unknown: \['camera'\]"),
            (f"{url}?width=wide", "must look like grpc://host:port.*invalid literal"),
            (f"{url}?timeout=-1", "must look like"),
            ("grpc://localhost", "must look like"),
            ("grpc://:80", "must look like"),
            ("grpc://localhost:port", "must look like"),
            (f"{url}/path", "must look like"),
        ):
            with pytest.raises(ScenarioError, match=text):
                plugins.load_policy(bad)


def test_nobody_at_the_address_is_said_in_time():
    with pytest.raises(ServerError, match=r"driver 127.0.0.1:9 did not answer within 0.2 s: get_policy"):
        RemotePolicy("127.0.0.1:9", connect_timeout_s=0.2)


DYING = """
import os
from nurec_sim.policies.constant_velocity import ConstantVelocity
class Dying(ConstantVelocity):
    def plan(self, observation):
        if observation.t_us > 2_400_000:
            os._exit(9)
        return super().plan(observation)
"""


def test_a_driver_that_dies_gives_a_failed_rollout_with_what_was_driven(tmp_path):
    (tmp_path / "dying.py").write_text(DYING)
    command = [sys.executable, "-m", "nurec_sim.cli", "drive-grpc", str(tmp_path / "dying.py"), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            address = process.stdout.readline().split()[-1]
            with RemotePolicy(address, timeout_s=10) as remote:
                found = rollout(remote, worlds.straight_road())
                again = rollout(remote, worlds.straight_road())
        finally:
            process.kill()
    assert found.status == "failed" and len(found.plans) == 2 and len(found.states) == 16
    assert found.events[-1].kind == "policy_error"
    assert found.error.startswith(f"ServerError: driver {address} cannot be reached: drive: UNAVAILABLE")
    assert again.status == "failed" and len(again.plans) == 0
    assert again.error.startswith(f"ServerError: driver {address} cannot be reached: start_session: UNAVAILABLE")


def test_many_rollouts_at_once_do_not_mix():
    road = [worlds.straight_road(), worlds.curve(), worlds.hill(), worlds.parked_car_ahead()]
    local = [plans_of(rollout(plugins.load_policy("lidar_aeb"), world)) for world in road]
    with DriverServer(lambda: plugins.load_policy("lidar_aeb"), port=0) as address, ThreadPoolExecutor(4) as pool:

        def drive(world):
            with RemotePolicy(address) as remote:
                return plans_of(rollout(remote, world))

        assert list(pool.map(drive, road)) == local


def test_a_driver_that_forgot_the_session_refuses():
    with driver(Steady, idle_s=0.5) as stub, RemotePolicy(stub.address) as remote:
        world = worlds.straight_road()

        class Pausing:
            name, needs = remote.name, remote.needs
            reset = remote.reset

            def plan(self, observation):
                plan = remote.plan(observation)
                # The thread of a session ends with it.
                wait_until(lambda: not [t for t in threading.enumerate() if t.name.startswith("policy-")])
                return plan

        found = rollout(Pausing(), world)
    assert found.status == "failed" and len(found.plans) == 1
    assert "refused: submit_egomotion_observation: NOT_FOUND: session" in found.error


@pytest.mark.parametrize(
    ("plan_of", "error"),
    [
        (lambda o: 1 / 0, "PlanError: driver .*: policy 'odd' failed: ZeroDivisionError: division by zero"),
        (lambda o: Plan(o.t_us + TIMES, np.full((50, 3), np.nan)), "policy 'odd': plan poses must be finite"),
    ],
)
def test_what_a_far_policy_says_is_the_error_of_the_rollout(plan_of, error):
    with driver(answering(plan_of)) as stub, RemotePolicy(stub.address) as remote:
        found = rollout(remote, worlds.straight_road())
        assert found.status == "failed"
        with pytest.raises(AssertionError, match=error):
            plans_of(found)
        assert rollout(remote, worlds.straight_road()).status == "failed"  # a new session, the same mistake


def test_a_far_policy_that_stops_ends_the_rollout():
    stop = answering(lambda o: Plan(o.t_us + TIMES, np.zeros((50, 3)), stop_session=True))
    with driver(stop) as stub, RemotePolicy(stub.address) as remote:
        found = rollout(remote, worlds.straight_road())
    assert found.status == "ok" and len(found.plans) == 1 and found.events[-1].kind == "stop_session"


def test_a_slow_driver_is_given_up():
    release = threading.Event()

    def wait(observation):
        release.wait(10)

    with driver(answering(wait)) as stub, RemotePolicy(stub.address, timeout_s=0.5) as remote:
        found = rollout(remote, worlds.straight_road())
        release.set()
    assert (
        found.error
        == f"ServerError: driver {stub.address} did not answer within 0.5 s: drive: "
        + (found.error.split("drive: ")[1])
    )


def test_sessions_end_with_the_next_rollout_and_with_the_policy():
    with driver(Steady, max_sessions=1) as stub:
        remote = RemotePolicy(stub.address)
        for _ in range(3):
            assert rollout(remote, worlds.straight_road()).status == "ok"
        remote.close()
        with RemotePolicy(stub.address) as other:
            assert rollout(other, worlds.straight_road()).status == "ok"


def test_only_what_may_be_said_twice_is_repeated():
    config = remote_module._service_config()
    names = {entry["method"] for entry in config["methodConfig"][0]["name"]}
    assert {"drive", "start_session", "close_session", "shut_down"} & names == set()
    assert "submit_image_observation" in names and DriverOptions().max_sessions == 8
    assert grpc.StatusCode.UNAVAILABLE.name in config["methodConfig"][0]["retryPolicy"]["retryableStatusCodes"]


def test_the_example_of_the_documentation_runs():
    text = (Path(__file__).parents[2] / "docs" / "egodriver.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(compile(example, "egodriver.md", "exec"), {})  # it asserts itself


def test_a_dead_driver_is_a_row_of_the_table(tmp_path):
    world = scene()
    server = DriverServer(Steady, port=0)
    address = server.start()
    with RemotePolicy(address) as remote:
        server.stop()
        scenario = make_scenario({"name": "short", "duration_s": 1.0})
        folder = runs.execute([world], scenario, [remote, "constant_velocity"], lambda _: None, tmp_path, video=False)
    (text,) = [path.read_text() for path in folder.rglob("error.txt")]
    assert text.startswith(f"ServerError: driver {address} cannot be reached: start_session: UNAVAILABLE")
    _, *rows = runs.headline(folder)
    assert {row[0]: row[3] for row in rows} == {f"steady@{address}": "1", "constant_velocity": "0"}
