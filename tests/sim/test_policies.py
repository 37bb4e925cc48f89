"""The shipped policies: the conformance kit on each, and what each is for."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import worlds
from doc_examples import names_of

from nurec_sim import geometry
from nurec_sim.plugins import available_policies, load_policy
from nurec_sim.sim import Scenario, run_rollout
from nurec_sim.sim.conformance import check_policy
from nurec_sim.types import ActorState, Needs, Plan, Rig


def drive(name, world, **keys):
    return run_rollout(Scenario(**{"name": "test", "duration_s": 8.0, **keys}), load_policy(name), world.sense, world)


def lateral(rollout, world):
    return geometry.project_to_polyline(rollout.world_from_rig[:, :2, 3], world.ego.position_m[:, :2])[1]


@pytest.mark.parametrize("name", available_policies())
def test_shipped_policies_conform(name):
    assert check_policy(load_policy(name)) == []


def test_the_kit_finds_what_is_wrong():
    class Bad:
        name = "bad"
        needs = Needs()
        count = 0

        def reset(self, rig, seed): ...

        def plan(self, observation):
            self.count += 1
            times = np.arange(1, 31)
            pose = np.column_stack([times / 10, np.full(30, self.count * 0.01), np.zeros(30)])
            return Plan(observation.t_us + 100_000 * times, pose)

    faults = " | ".join(check_policy(Bad()))
    for text in ("should reach 5 s ahead", "a second run after reset"):
        assert text in faults
    Bad.plan = lambda self, observation: observation.route_m.fill(0)
    assert all("ValueError: assignment destination is read-only" in fault for fault in check_policy(Bad()))
    Bad.plan = lambda self, observation: None
    assert all("must return a nurec_sim.types.Plan" in fault for fault in check_policy(Bad()))
    Bad.needs, Bad.name = None, ""
    assert check_policy(Bad()) == ["name must be a non-empty string", "needs must be a nurec_sim.types.Needs"]


@pytest.mark.parametrize("name", ["route_follower", "lidar_aeb", "blind_route"])
def test_route_drivers_keep_to_the_route_in_a_curve(name):
    world = worlds.curve()
    rollout = drive(name, world)
    assert rollout.status == "ok" and np.abs(lateral(rollout, world)).max() < 0.6
    assert geometry.arc_length(rollout.world_from_rig[:, :2, 3])[-1] > 50


@pytest.mark.parametrize("name", ["route_follower", "lidar_aeb", "lidar_cruise"])
def test_a_parked_car_stops_who_keeps_to_the_route(name):
    rollout = drive(name, worlds.parked_car_ahead())
    gap = 45.0 - 2.25 - 3.85 - rollout.world_from_rig[-1, 0, 3]
    assert rollout.status == "ok" and rollout.states[-1].speed_mps < 0.5 and 0.3 < gap < 6.0


@pytest.mark.parametrize("name", ["camera_road_follower", "camera_brake", "fusion"])
def test_the_camera_brakes_for_a_parked_car(name):
    world = worlds.parked_car_ahead()
    rollout = drive(name, world, duration_s=5.0)
    gap = 45.0 - 2.25 - 3.85 - rollout.world_from_rig[:, 0, 3]
    speed = np.array([state.speed_mps for state in rollout.states])
    assert rollout.status == "ok" and gap.min() > 0.0
    assert np.all(speed**2 / (2 * 8.0) < gap) and speed[-1] < 5.0


@pytest.mark.slow
def test_the_camera_follows_a_curve_it_only_sees():
    world = worlds.curve(radius_m=45.0)
    rollout = drive("camera_road_follower", world)
    _, offset = geometry.project_to_polyline(rollout.world_from_rig[:, :2, 3], world.road_m)
    assert rollout.status == "ok" and np.abs(offset).max() < world.road_width_m / 2
    assert geometry.arc_length(rollout.world_from_rig[:, :2, 3])[-1] > 40


def test_the_camera_reads_nothing_but_its_image():
    world = worlds.parked_car_ahead()
    elsewhere = replace(worlds.straight_road(), tracks=())
    seen = run_rollout(Scenario(name="a", duration_s=3.0), load_policy("camera_road_follower"), world.sense, world)
    fooled = run_rollout(
        Scenario(name="a", duration_s=3.0), load_policy("camera_road_follower"), world.sense, elsewhere
    )
    assert seen.world_from_rig.tobytes() == fooled.world_from_rig.tobytes()


def test_lidar_sees_no_obstacle_in_empty_sloping_ground():
    from nurec_sim.policies.lidar_aeb import above_ground

    rng = np.random.default_rng(0)
    xy = rng.uniform([3, -8], [50, 8], (4000, 2))
    ground = np.column_stack([xy, 0.06 * xy[:, 0] + rng.normal(0, 0.03, len(xy))])
    assert above_ground(ground).mean() < 0.01
    box = np.column_stack([np.full(50, 20.0), np.linspace(-0.5, 0.5, 50), np.linspace(1.6, 2.6, 50)])
    assert above_ground(np.concatenate([ground, box]))[-50:].mean() > 0.8


def test_route_follower_lets_pass_who_does_not_cross():
    steps = np.arange(81)
    oncoming = worlds.car("oncoming", np.array([[200.0, 3.5], [0.0, 3.5], [-200.0, 3.5]]), 8.0 * steps / 10 + 60)
    world = replace(worlds.straight_road(), tracks=(oncoming,))
    rollout = drive("route_follower", world)
    assert min(state.speed_mps for state in rollout.states) > 9.5


def test_route_follower_waits_for_a_crossing_pedestrian():
    steps = np.arange(81)
    walker = worlds.car("walker", np.array([[40.0, -8.0], [40.0, 0.0], [40.0, 12.0]]), 1.4 * steps / 10 + 2.5)
    walker = replace(walker, size_m=(0.6, 0.6, 1.8), label="person")
    world = replace(worlds.straight_road(), tracks=(walker,))
    rollout = drive("route_follower", world)
    boxes = rollout.actors["walker"][:, :2, 3]
    ahead = boxes[:, 0] - rollout.world_from_rig[:, 0, 3]
    inside = (np.abs(boxes[:, 1]) < 1.25) & (ahead > -1.4) & (ahead < 4.15)
    assert not inside.any() and min(state.speed_mps for state in rollout.states) < 6.0


def test_the_blind_one_drives_into_a_parked_car():
    rollout = drive("blind_route", worlds.parked_car_ahead())
    assert rollout.world_from_rig[-1, 0, 3] > 45.0 and rollout.states[-1].speed_mps > 9.0


def test_a_line_beside_another_is_to_its_left():
    from nurec_sim.policies.blind_route_noisy import beside

    assert beside(np.array([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0]]), 0.5)[:, 1] == pytest.approx([0.5] * 3)
    assert beside(np.array([[0.0, 0.0], [0.0, 2.0]]), 0.5)[:, 0] == pytest.approx([-0.5] * 2)


def test_errors_of_the_noisy_driver_wander_as_an_ornstein_uhlenbeck_process():
    """Variance 1; correlation exp(-t / 2 s) after t; given by the seed alone."""
    policy = load_policy("blind_route_noisy")

    def errors(seed):
        policy.reset(None, seed)
        found = []
        for k in range(8000):
            policy.wander(500_000 * k)
            found.append(policy.errors.copy())
        return np.array(found)

    first = errors(4)
    assert first.std(axis=0) == pytest.approx([1, 1], abs=0.1) and first.mean(axis=0) == pytest.approx([0, 0], abs=0.15)
    assert (first[1:] * first[:-1]).mean(axis=0) == pytest.approx([np.exp(-0.25)] * 2, abs=0.1)
    assert (first[4:] * first[:-4]).mean(axis=0) == pytest.approx([np.exp(-1)] * 2, abs=0.1)
    assert (errors(4)[:50] == first[:50]).all() and (errors(5)[0] != first[0]).all()


def test_a_bad_detector_overlooks_and_misplaces():
    policy = load_policy("noisy_perception")
    policy.reset(Rig({}, {}), 1)
    car = ActorState("car", "automobile", (4.5, 1.8, 1.5), np.eye(4), np.zeros(2))
    seen = [policy.detected(car, 100_000 * k) for k in range(2000)]
    place = np.array([actor.rig_from_box[:3, 3] for actor in seen if actor is not None])
    assert len(place) / 2000 == pytest.approx(0.7, abs=0.04)
    assert place.std(axis=0) == pytest.approx([0.5, 0.5, 0.0], abs=0.04)
    again = policy.detected(car, 100_000 * 3)
    assert again is None if seen[3] is None else (again.rig_from_box == seen[3].rig_from_box).all()


def test_the_documents_policy_keeps_the_contract():
    assert check_policy(names_of("policies.md")["Creep"]()) == []


@pytest.mark.parametrize("name", ["e2e_1cam", "e2e_2cam"])
def test_networks_keep_to_the_route_in_a_world_that_they_have_never_seen(name):
    world = worlds.curve()
    rollout = drive(name, world, duration_s=6.0)
    assert rollout.status == "ok" and np.abs(lateral(rollout, world)).max() < 2.0
    assert geometry.arc_length(rollout.world_from_rig[:, :2, 3])[-1] > 15


def test_networks_look_at_their_images():
    """Another image, another plan; and the shipped files are small."""
    policy, world = load_policy("e2e_1cam"), worlds.straight_road()
    seen = []

    def dark(requests):
        seen.extend(request.sensor.id for request in requests)
        return [replace(frame, rgb=frame.rgb // 4) for frame in world.sense(requests)]

    scenario = Scenario(name="test", duration_s=1.0)
    plain, other = (run_rollout(scenario, policy, sense, world) for sense in (world.sense, dark))
    assert not np.array_equal(plain.plans[0][1].pose, other.plans[0][1].pose)
    assert set(seen) == {"front_wide"} and policy.weights_file.stat().st_size < 1_500_000


def test_a_network_without_its_weights_says_what_makes_them(tmp_path):
    policy, world = load_policy("e2e_1cam"), worlds.straight_road()

    class Lost(type(policy)):
        weights_file = tmp_path / "none.safetensors"

    rollout = run_rollout(Scenario(name="test", duration_s=1.0), Lost(), world.sense, world)
    assert rollout.status == "failed" and "nurec-sim train makes it" in rollout.error
    Lost.weights_file.write_bytes(load_policy("e2e_2cam").weights_file.read_bytes())
    rollout = run_rollout(Scenario(name="test", duration_s=1.0), Lost(), world.sense, world)
    assert "is not of an end-to-end policy with 1 cameras" in rollout.error
    Lost.weights_file.write_bytes(b"no")
    rollout = run_rollout(Scenario(name="test", duration_s=1.0), Lost(), world.sense, world)
    assert "is damaged or no .safetensors file" in rollout.error


def test_networks_answer_with_the_same_bytes_on_any_number_of_threads():
    """Single precision without rounding fails this with OpenBLAS."""
    code = (
        "import numpy as np; from nurec_sim.plugins import load_policy; p = load_policy('e2e_4cam'); p.reset(None, 0); "
        "r = np.random.default_rng(0); "
        "print([p.outputs(r.integers(0, 256, (4, 64, 128, 3), np.uint8), r.standard_normal(12).astype(np.float32))"
        ".tobytes().hex() for _ in range(4)])"
    )
    answers = [
        subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, "OPENBLAS_NUM_THREADS": count, "OMP_NUM_THREADS": count},
            check=True, capture_output=True, text=True,
        ).stdout
        for count in ("1", "2")
    ]  # fmt: skip
    assert answers[0] == answers[1] and len(answers[0]) > 100
