"""Edited actors: braking by hand, who is the lead, and random differences that belong to scene, actor and seed."""

from dataclasses import replace

import numpy as np
import pytest
import worlds

from nurec_sim.errors import ScenarioError
from nurec_sim.plugins import load_policy
from nurec_sim.sim import make_scenario, run_rollout
from nurec_sim.sim.actors import braked, edited_actors, lead_actor
from nurec_sim.sim.flat_world import START_US
from nurec_sim.sim.scenario import Brake

SECONDS = np.array([0.0, 0.5, 1.0, 2.0, 3.0, 5.0])


def steady(speed_mps=10.0, gap_m=25.0, y_m=0.0, track_id="ahead"):
    return worlds.car(track_id, worlds.straight_line(y_m=y_m), gap_m + speed_mps * np.arange(81) / 10)


def actors(scenario, tracks, seed=0, scene_id="street"):
    ego = worlds.straight_road().ego
    return edited_actors(make_scenario({"name": "a", **scenario}), scene_id, ego, tracks, START_US, seed)


def test_braking_by_hand():
    """10 m/s, from 1 s on 5 m/s2: 10 m, then 10 t - 2.5 t2, so 17.5 m after 2 s and 20 m from 3 s on."""
    path = steady(gap_m=0.0).path
    times = START_US + (1e6 * SECONDS).astype(np.int64)
    asked = braked(path, Brake(at_s=1.0, decel_mps2=5.0), times, START_US)
    assert path.at(asked)[:, 0, 3] == pytest.approx([0.0, 5.0, 10.0, 17.5, 20.0, 20.0], abs=0.01)


def test_an_actor_is_never_ahead_of_its_recording():
    """Recorded: 5 m/s2 from 1.5 s on. Braking by 0.5 m/s2 from 1 s on would be slower in stopping."""
    (track,) = worlds.braking_lead().tracks
    times = START_US + (1e6 * SECONDS).astype(np.int64)
    asked = braked(track.path, Brake(at_s=1.0, decel_mps2=0.5), times, START_US)
    assert (asked <= times).all() and (np.diff(track.path.at(asked)[:, 0, 3]) >= -1e-9).all()
    assert asked[-1] > START_US + 3_000_000


def test_the_lead_is_the_nearest_actor_ahead_on_the_recorded_path():
    ego = worlds.straight_road().ego
    cars = [
        steady(gap_m=40.0, track_id="second"), steady(gap_m=25.0, track_id="first"),
        steady(gap_m=10.0, y_m=3.5, track_id="beside"), steady(gap_m=-12.0, track_id="behind"),
        replace(steady(gap_m=8.0, track_id="parked"), controllable=False),
        worlds.car("oncoming", worlds.straight_line()[::-1], 285.0 - np.arange(81)),
    ]  # fmt: skip
    assert lead_actor(ego, cars, START_US) == "first"
    with pytest.raises(ScenarioError, match="there is no lead actor: at 1000000 us nothing drives within 60 m"):
        lead_actor(ego, cars[2:], START_US)


def test_a_lead_that_brakes_stops_who_looks_and_is_hit_by_who_does_not():
    world = replace(worlds.straight_road(), tracks=(steady(),))
    scenario = make_scenario(
        {"name": "a", "duration_s": 7.0, "actors": {"lead": {"brake": {"at_s": 1, "decel_mps2": 6}}}}
    )
    gaps = {}
    for name in ("route_follower", "blind_route"):
        rollout = run_rollout(scenario, load_policy(name), world.sense, world)
        front = rollout.world_from_rig[:, 0, 3] + 3.85
        gaps[name] = (rollout.actors["ahead"][:, 0, 3] - 2.25 - front).min()
    assert gaps["blind_route"] < 0 < gaps["route_follower"]
    rollout = run_rollout(scenario, load_policy("blind_route"), world.sense, worlds.straight_road())
    assert rollout.status == "failed" and "there is no lead actor" in rollout.error


def test_actors_differ_by_scene_actor_and_seed_only():
    tracks = [steady(track_id="a"), steady(track_id="b", gap_m=50.0), replace(steady(track_id="c"), controllable=False)]
    random = {"perturbation": {"actor_delay_s": 0.3, "actor_along_m": 1.0}}
    edits = actors(random, tracks, seed=5).edits
    assert set(edits) == {"a", "b"} and edits["a"] != edits["b"]
    assert actors(random, tracks[::-1], seed=5).edits == edits
    assert actors(random, tracks, seed=6).edits["a"] != edits["a"]
    assert actors(random, tracks, seed=5, scene_id="other").edits["a"] != edits["a"]
    drawn = [actors(random, tracks[:1], seed=seed).edits["a"] for seed in range(400)]
    assert np.std([each.delay_s for each in drawn]) == pytest.approx(0.3, abs=0.03)
    assert np.std([each.shift_m[0] for each in drawn]) == pytest.approx(1.0, abs=0.1)
    assert {each.shift_m[1] for each in drawn} == {0.0}
    added = actors({**random, "actors": {"a": {"delay_s": 2.0, "hide": True}}}, tracks, seed=5).edits["a"]
    assert added.hide and added.delay_s == pytest.approx(2.0 + edits["a"].delay_s)
    assert actors({}, tracks).edits == {}
