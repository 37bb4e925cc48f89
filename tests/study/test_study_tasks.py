"""Tasks of a study in a street without a town: worlds that cannot be made, controls, resuming."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
import study_workers
from metrics_worlds import flat_street, rig, s_curve_gaussians, s_curve_map, s_curve_path, scene

from nurec_sim.errors import RunError
from nurec_sim.metrics import road_agreement, scene_offroad_grid
from nurec_sim.runs.scene_file import record_scene, save_scene_record
from nurec_sim.scene import write_scene
from nurec_sim.study import CONTROLS, LocalProcesses, make_study, road, tasks
from nurec_sim.study.road import measure_roads
from nurec_sim.study.run import STUDY, report_again, run_study
from nurec_sim.study.tasks import Task, drive
from nurec_sim.types import DynamicGaussians, Gaussians

POLICIES = ["constant_velocity", "blind_route_noisy", "camera_brake"]
CONFIG = make_study(
    {"name": "street", "families": [{"name": "street", "seeds": [0]}], "policies": POLICIES,
     "worlds": ["truth", "lift"], "controls": {"of": "lift", "how": ["empty_road"]}}
)  # fmt: skip


@pytest.fixture
def street(tmp_path, monkeypatch):
    """A task whose log is the street of the metrics' tests; its scene."""
    scene, _ = flat_street()
    facts = dataclasses.replace(scene, static=Gaussians.empty(), dynamic=DynamicGaussians.empty(), id="street-0")
    monkeypatch.setattr(tasks, "facts_of", lambda task: facts)
    task = Task(tmp_path, CONFIG, *CONFIG.scenes[0], world="lift")
    task.scene_folder.mkdir(parents=True)
    return task, scene


def values_of(task):
    return pl.read_parquet(task.world_folder / "values.parquet")


def test_a_world_that_could_not_be_made_fails_only_those_that_look(street):
    task, _ = street
    task.error_file.write_text("no LiDAR sweep\n")
    messages = drive(task)
    by_policy = dict(values_of(task).select("policy", "status").unique().iter_rows())
    assert by_policy == {"constant_velocity": "ok", "blind_route_noisy": "ok", "camera_brake": "failed"}
    assert len(messages) == 1 and "this world could not be reconstructed: no LiDAR sweep" in messages[0]


def test_finished_rollouts_are_not_driven_again(street, monkeypatch):
    task, scene = street
    write_scene(scene, task.archive)
    drive(task)
    before = (task.world_folder / "values.parquet").read_bytes()
    driven = []
    real = tasks.drive_job
    monkeypatch.setattr(tasks, "drive_job", lambda job, *rest: driven.append(job.policy.name) or real(job, *rest))
    (task.world_folder / "constant_velocity" / "0" / "rollout.npz").unlink()
    drive(task)
    assert driven == ["constant_velocity"] and (values_of(task)["status"] == "ok").all()
    assert (task.world_folder / "values.parquet").read_bytes() == before


def test_worlds_get_the_actors_that_a_scenario_adds(street, tmp_path):
    """A standing van is hit by who does not look; where there is no room for it, rollouts fail and say so."""
    task, scene = street
    write_scene(scene, task.archive)
    for along_m, said in ((14.0, []), (4.0, ["'van' is in the place of the recorded car"])):
        file = tmp_path / f"van{along_m:g}.yaml"
        file.write_text(f"name: van\nduration_s: 3\nadded_actors: {{van: {{asset: van, along_m: {along_m}}}}}\n")
        family = task.family.model_copy(update={"scenario": str(file)})
        messages = drive(dataclasses.replace(task, family=family))
        values = values_of(task).filter(pl.col("policy") == "constant_velocity")
        if said:
            assert said[0] in messages[0] and set(values["status"]) == {"failed"}
        else:
            hit = values.filter(pl.col("name") == "collision_any")
            assert not messages and set(values["status"]) == {"ok"} and hit["value"].to_list() == [1.0]


def test_controls_only_spoil_what_is_rendered():
    scene, _ = flat_street()
    for name, control in CONTROLS.items():
        spoilt = control(scene)
        for fact in ("id", "rig", "ego", "tracks", "road_map", "span_us"):
            assert getattr(spoilt, fact) is getattr(scene, fact), (name, fact)
    assert len(CONTROLS["sparse"](scene).static) == -(-len(scene.static) // 4)
    assert CONTROLS["faint"](scene).static.opacity == pytest.approx(scene.static.opacity / 2)
    assert len(CONTROLS["empty_road"](scene).dynamic) == 0 and CONTROLS["no_sky"](scene).sky.max() == 0
    grown = CONTROLS["stretched"](scene).static.mean_m
    driven = scene.ego.position_m
    away, now = (
        np.linalg.norm(points[:200, None] - driven[None], axis=2).min(axis=1) for points in (scene.static.mean_m, grown)
    )
    assert (now <= 1.0501 * away + 1e-5).all() and now.mean() > 1.02 * away.mean()


def test_a_folder_keeps_to_one_study(tmp_path):
    class Nothing:
        def run(self, work, tasks, tick):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(CONFIG, tmp_path / "a", Nothing())
    assert "street" in (tmp_path / "a" / STUDY).read_text()
    other = CONFIG.model_copy(update={"trials": 2})
    with pytest.raises(RunError, match="holds another study than 'street' as it is now"):
        run_study(other, tmp_path / "a", Nothing())
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "holiday.jpg").write_bytes(b"")
    with pytest.raises(RunError, match="is not empty and holds no study"):
        run_study(CONFIG, tmp_path / "b", Nothing())
    with pytest.raises(RunError, match="holds no study; run it first"):
        report_again(CONFIG, tmp_path / "c")
    with pytest.raises(RunError, match="the study is incomplete; run it again"):
        report_again(CONFIG, tmp_path / "a")


def test_roads_are_compared_with_the_map_of_each_log(tmp_path, monkeypatch):
    """The S-curve's road is 7.4 m wide; in the other two towns of lift, and in all of dense, nothing is road."""
    ego, wide = s_curve_path(), s_curve_map()
    clip = SimpleNamespace(ego=ego, road_map=wide, rig=rig())
    monkeypatch.setattr(road.logs, "open_clip", lambda path: clip)
    config = make_study({"name": "roads", "families": [{"name": "bend", "seeds": [1, 2, 3]}], "policies": POLICIES,
                         "worlds": ["truth", "lift", "dense"]})  # fmt: skip
    seen = scene(s_curve_gaussians(), ego, wide)
    for world in ("lift", "dense"):
        for each in config.scenes:
            shown = seen if (world, each[2]) == ("lift", 1) else dataclasses.replace(seen, static=Gaussians.empty())
            save_scene_record(record_scene(shown), Task(tmp_path, config, *each, world=world).world_folder)
    (found,) = measure_roads(tmp_path, config).values()
    expected = road_agreement(scene_offroad_grid(seen), wide, ego, rig().body)
    assert (found.scenes, found.without_road) == (3, 2)
    assert found.agreement == found.least == expected.agreement > 0.98
    assert found.boundary_bias_m == found.worst_bias_m == expected.boundary_bias_m
    assert abs(found.boundary_bias_m) < 0.15 and found.unknown_frac < 0.02


def test_workers_have_one_thread_and_a_dead_one_is_an_error():
    assert [result for _, result in LocalProcesses(1).run(study_workers.threads, [0], lambda: None)] == ["1"]
    with pytest.raises(RunError, match="a worker process was killed"):
        list(LocalProcesses(1).run(study_workers.die, [0], lambda: None))
    with pytest.raises(RunError, match="1 or more, got 0"):
        LocalProcesses(0)
