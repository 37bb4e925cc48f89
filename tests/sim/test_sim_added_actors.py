"""Added actors: their paths by hand, what is refused, and that the bundled ones are hit by those who do not look."""

from dataclasses import replace

import numpy as np
import pytest
import worlds

from nurec_sim import geometry
from nurec_sim.errors import ScenarioError
from nurec_sim.plugins import load_policy
from nurec_sim.sim import load_scenario, make_scenario, run_rollout
from nurec_sim.sim.added_actors import Body, added_tracks
from nurec_sim.sim.flat_world import START_US

CAR, PERSON = Body("automobile", (4.5, 1.8, 1.5)), Body("person", (0.9, 0.6, 1.7))


def scenario(actor, **more):
    return make_scenario({"name": "a", "duration_s": 6.0, "added_actors": {"x": {"asset": "sedan", **actor}}, **more})


def path(actor, world=None, body=CAR, ground=None):
    (track,) = added_tracks(scenario(actor), world or worlds.straight_road(), {"x": body}, ground)
    return lambda *seconds: track.path.at(START_US + np.rint(1e6 * np.array(seconds)).astype(np.int64))


def test_a_lane_change_and_braking_by_hand():
    """10 m/s: sideways 3.5 m in 2 s rise for a quarter of it, at 7/3 m/s between, and 7 / 24 m are left after 1 / 4."""
    at = path({"along_m": 12, "lateral_m": 3.5, "speed_fraction": 1.0, "moves": [
        {"at_s": 1, "over_s": 2, "lateral_m": 0}, {"at_s": 3, "over_s": 2, "speed_mps": 4.0}]})  # fmt: skip
    poses = at(0.0, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0)
    # Braking from 10 to 4 m/s in 2 s: 8.5 m in the first second, 5.5 m in the second, then 4 m/s.
    assert poses[:, 0, 3] == pytest.approx([12, 22, 27, 32, 37, 42, 50.5, 56, 60], abs=0.01)
    assert poses[:, 1, 3] == pytest.approx([3.5, 3.5, 3.5 * 5 / 6, 1.75, 3.5 / 6, 0, 0, 0, 0], abs=1e-3)
    assert poses[:, 2, 3] == pytest.approx(0.75)
    assert geometry.yaw_of(poses)[[0, 3, 6]] == pytest.approx([0, -np.arctan(7 / 30), 0], abs=2e-3)


def test_a_walker_crosses_where_the_recorded_car_will_be():
    """4 s at 10 m/s and 2 m more; he faces left, also before he walks, and stands upright on a hill."""
    at = path({"ego_at_s": 4, "along_m": 2, "lateral_m": -3, "moves": [{"at_s": 2, "over_s": 4, "lateral_m": 3}]},
              worlds.hill(slope=0.1), PERSON)  # fmt: skip
    poses = at(0.0, 2.0, 4.0)
    # The path is measured on the map, so 40 m and 2 m are horizontal; the ground is 10 % of that high.
    assert poses[:, :2, 3] == pytest.approx(np.array([[42, -3], [42, -3], [42, 0]]), abs=0.02)
    assert poses[:, 2, 3] == pytest.approx(4.2 + 0.85, abs=0.01)
    assert geometry.yaw_of(poses) == pytest.approx(np.pi / 2, abs=1e-3)
    assert poses[:, :3, 2] == pytest.approx(np.tile([0, 0, 1.0], (3, 1)), abs=1e-9)


def test_a_car_leans_with_the_hill_and_follows_a_better_ground():
    up = np.array([-0.1, 0, 1]) / np.hypot(0.1, 1)
    pose = path({"along_m": 30, "speed_mps": -5}, worlds.hill(slope=0.1))(0.0)[0]
    assert pose[:3, 2] == pytest.approx(up, abs=1e-9) and pose[:3, 0] @ [-1, 0, -0.1] > 0.99
    assert pose[:3, 3] == pytest.approx(np.array([30, 0, 3]) + 0.75 * up, abs=1e-6)
    raised = path({"along_m": 30}, worlds.hill(slope=0.1), ground=lambda xy, z: z + 0.2)(0.0)[0]
    assert raised[:3, 3] == pytest.approx(np.array([30, 0, 3.2]) + 0.75 * up, abs=1e-6)


def test_the_path_goes_on_straight_where_the_recording_ends_and_when_it_stands():
    assert path({"along_m": 75, "lateral_m": 2}, body=PERSON)(0.0)[0][:2, 3] == pytest.approx([75, 2], abs=1e-6)
    uphill = path({"along_m": 80}, worlds.hill(slope=0.1))(0.0)[0]  # 20 m beyond the end
    assert uphill[:3, 3] == pytest.approx([80 - 0.0746, 0, 8 + 0.746], abs=1e-3)
    ahead = path({"along_m": 200}, worlds.straight_road(duration_s=6))(0.0)[0]
    assert ahead[:2, 3] == pytest.approx([200, 0], abs=1e-6)
    still = path({"along_m": 20, "lateral_m": 3}, worlds.standing(6.0))(0.0)[0]
    assert still[:2, 3] == pytest.approx([20, 3], abs=0.05)


def test_what_is_refused():
    world = worlds.parked_car_ahead()
    for actor, said in (
        ({"along_m": 47}, "'x' is in the place of actor 'parked' 0.0 s after the start"),
        ({"along_m": 20, "speed_mps": 8}, "'x' is in the place of actor 'parked' 2.6 s after the start"),
        ({"along_m": -10, "speed_mps": 40}, "'x' is in the place of the recorded car before the policy drives 0.3 s"),
        ({"along_m": 20, "ego_at_s": 9}, "ego_at_s is 9, but the recording ends 8.0 s after the start"),
        ({"along_m": 20, "moves": [{"at_s": 1, "over_s": 2, "lateral_m": 3}]}, "it would move sideways at"),
    ):
        with pytest.raises(ScenarioError, match=said):
            added_tracks(scenario(actor), world, {"x": CAR})
    hidden = scenario({"along_m": 47}, actors={"parked": {"hide": True}})
    assert len(added_tracks(hidden, world, {"x": CAR})) == 1
    taken = replace(world, tracks=(replace(world.tracks[0], id="x"),))
    with pytest.raises(ScenarioError, match="adds actor 'x', but scene 'parked-car-ahead' has one"):
        added_tracks(scenario({"along_m": 20}), taken, {"x": CAR})
    rollout = run_rollout(scenario({"along_m": 20}), load_policy("constant_velocity"), world.sense, world)
    assert rollout.status == "failed" and "lacks the added actors ['x']" in rollout.error


def test_keys_of_added_actors_are_checked():
    for actor, said in (
        ({}, "key 'added_actors.x.along_m' is missing"),
        ({"along_m": 1, "speed": 2}, "unknown key 'added_actors.x.speed'; allowed: along_m, asset, colour"),
        ({"along_m": 1, "moves": [{"at": 1}]}, "unknown key 'added_actors.x.moves.0.at'; allowed: at_s, lateral_m"),
        ({"along_m": 1, "speed_mps": 1, "speed_fraction": 1}, "give speed_mps or speed_fraction, not both"),
        ({"along_m": 1, "moves": [{"at_s": 1, "over_s": 1}]}, "a move needs lateral_m, speed_mps or speed_fraction"),
        ({"along_m": 1, "speed_mps": -2, "moves": [{"at_s": 1, "over_s": 1, "speed_mps": 1}]}, "cannot turn round"),
        ({"along_m": 1, "moves": [{"at_s": 1, "over_s": 2, "lateral_m": 1}, {"at_s": 2, "over_s": 1, "lateral_m": 0}]},
         "the move at 2 s changes the place before that at 1 s has ended"),
    ):  # fmt: skip
        with pytest.raises(ScenarioError) as caught:
            scenario(actor)
        assert said in str(caught.value)


@pytest.mark.parametrize("name", ["cut_in", "pedestrian", "slow_lead"])
def test_bundled_scenarios_are_hit_by_the_blind_only(name):
    wanted = load_scenario(name).model_copy(update={"duration_s": 6.0})
    body = PERSON if name == "pedestrian" else CAR
    world = worlds.straight_road()
    (track,) = added_tracks(wanted, world, dict.fromkeys(wanted.added_actors, body))
    world = replace(world, tracks=(track,))
    gaps = {}
    for policy in ("blind_route", "lidar_aeb", "camera_brake"):
        rollout = run_rollout(wanted, load_policy(policy), world.sense, world)
        assert rollout.status == "ok", rollout.error
        here = geometry.inverse(rollout.world_from_rig) @ rollout.actors[track.id]
        across = np.abs(here[:, 1, 3]) < 0.95 + (0.45 if name == "pedestrian" else 0.9)
        half = 0.3 if name == "pedestrian" else 2.25
        gaps[policy] = (here[across, 0, 3] - half - 3.85).min()
    assert gaps["blind_route"] < 0 < min(gaps["lidar_aeb"], gaps["camera_brake"])
