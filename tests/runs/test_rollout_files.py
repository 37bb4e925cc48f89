"""Rollouts and records of scenes come back from their files as they went in; damaged files are refused."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from metrics_worlds import failed_rollout, flat_street, full_rollout, rollout, straight_poses

from nurec_sim.errors import RunError
from nurec_sim.metrics import OffroadGrid
from nurec_sim.runs.rollout_file import load_rollout, save_rollout
from nurec_sim.runs.scene_file import load_scene_record, record_scene, save_scene_record
from nurec_sim.scene import codec


def assert_same(a, b):
    assert codec.dump({"rig": a.rig, "events": len(a.events)}, "a") == codec.dump(
        {"rig": b.rig, "events": len(b.events)}, "b"
    )
    for name in ("scenario", "scene_id", "reconstruction", "policy", "seed", "status", "error", "first_closed_loop_us"):
        assert getattr(a, name) == getattr(b, name), name
    assert a.events == b.events and list(a.actors) == list(b.actors)
    assert a.actor_sizes_m == b.actor_sizes_m and a.actor_labels == b.actor_labels
    for actor in a.actors:
        assert np.array_equal(a.actors[actor], b.actors[actor], equal_nan=True)
    assert np.array_equal(a.world_from_rig, b.world_from_rig)
    assert [dataclasses.replace(s, world_from_rig=None) for s in a.states] == [
        dataclasses.replace(s, world_from_rig=None) for s in b.states
    ]
    assert np.array_equal(a.recorded.world_from_body, b.recorded.world_from_body)
    assert len(a.plans) == len(b.plans)
    for (made_a, plan_a), (made_b, plan_b) in zip(a.plans, b.plans, strict=True):
        assert made_a == made_b and plan_a.stop_session == plan_b.stop_session
        assert np.array_equal(plan_a.t_us, plan_b.t_us) and np.array_equal(plan_a.pose, plan_b.pose)


@pytest.mark.parametrize(
    "run", [full_rollout(), failed_rollout(), rollout(straight_poses(1))], ids=["full", "failed", "short"]
)
def test_a_rollout_comes_back_bit_for_bit(tmp_path, run):
    path = save_rollout(run, tmp_path / "rollout.npz")
    assert_same(load_rollout(path), run)
    assert path.read_bytes() == save_rollout(load_rollout(path), tmp_path / "again.npz").read_bytes()


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(-1e9, 1e9), min_size=1, max_size=4), st.text(max_size=8))
def test_any_numbers_and_texts_survive(tmp_path_factory, numbers, text):
    run = rollout(straight_poses(len(numbers)), policy=text, error=text)
    states = tuple(dataclasses.replace(s, speed_mps=v) for s, v in zip(run.states, numbers, strict=True))
    run = dataclasses.replace(run, states=states)
    assert_same(load_rollout(save_rollout(run, tmp_path_factory.mktemp("r") / "r.npz")), run)


def test_broken_rollout_files_are_refused_with_a_reason(tmp_path):
    good = save_rollout(full_rollout(), tmp_path / "good.npz")
    with pytest.raises(RunError, match="absent.npz does not exist"):
        load_rollout(tmp_path / "absent.npz")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(RunError, match="not a readable rollout file"):
        load_rollout(tmp_path / "text.npz")
    (tmp_path / "cut.npz").write_bytes(good.read_bytes()[:400])
    with pytest.raises(RunError, match="not a readable rollout file"):
        load_rollout(tmp_path / "cut.npz")
    with np.load(good) as file:
        arrays = dict(file)
    np.savez(tmp_path / "few.npz", **{k: v for k, v in arrays.items() if k != "plan_stops"})
    with pytest.raises(RunError, match=r"missing \['plan_stops'\]"):
        load_rollout(tmp_path / "few.npz")
    np.savez(tmp_path / "odd.npz", **{**arrays, "state_t_us": arrays["state_t_us"].astype(float)})
    with pytest.raises(RunError, match=r"state_t_us must be int64 \[-1\], got float64 \[20\]"):
        load_rollout(tmp_path / "odd.npz")
    np.savez(tmp_path / "short.npz", **{**arrays, "state_t_us": arrays["state_t_us"][:-1]})
    with pytest.raises(RunError, match="state_numbers has 20 entries; 19 are needed"):
        load_rollout(tmp_path / "short.npz")
    np.savez(tmp_path / "pickle.npz", **{**arrays, "plan_stops": np.array([{}], object)})
    with pytest.raises(RunError, match="not a readable rollout file"):
        load_rollout(tmp_path / "pickle.npz")


def test_a_scene_record_comes_back_with_its_grid(tmp_path):
    scene, _ = flat_street()
    record = record_scene(scene)
    assert record.actors_known and record.counts["tracks"] == 1 and record.counts["static road"] > 0
    assert record.unknown == ("no road map in the log",)
    save_scene_record(record, tmp_path)
    again = load_scene_record(tmp_path)
    assert again == record and isinstance(again.grid, OffroadGrid)
    assert np.array_equal(again.grid.state, record.grid.state)
    assert np.array_equal(again.grid.beyond_known_m, record.grid.beyond_known_m)
    (tmp_path / "scene.json").write_text("{}")
    with pytest.raises(RunError, match="scene.json is not a readable scene record"):
        load_scene_record(tmp_path)


def test_a_scene_without_road_or_boxes_says_so():
    scene, _ = flat_street()
    bare = dataclasses.replace(scene, tracks=(), provenance={"method": "lift"}, static=scene.static[:0])
    record = record_scene(bare)
    assert record.grid is None and not record.actors_known
    assert any("no actor boxes" in text for text in record.unknown)
    assert any("labelled road" in text for text in record.unknown) and any("no road map" in t for t in record.unknown)
    assert record_scene(dataclasses.replace(bare, provenance={"unknown": ["no boxes"]})).actors_known is False
    assert record_scene(dataclasses.replace(bare, provenance={"unknown": []})).actors_known is True
