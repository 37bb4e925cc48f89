"""Policies driven in the truth, and beside it in a reconstruction of the log of the same town."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from nurec_sim import logs, runs
from nurec_sim.errors import RunError
from nurec_sim.plugins import load_policy
from nurec_sim.reconstruct import reconstruct
from nurec_sim.render import CpuRenderer
from nurec_sim.sim import Scenario, run_rollout
from nurec_sim.types import Trajectory
from nurec_sim.world import TrueWorld, street_rig, town_plan, write_town_clip

pytestmark = pytest.mark.slow

RIG = street_rig(84, 48, lidar_rows=16, lidar_columns=120)
SCENARIO = Scenario(name="truth", duration_s=3.0, policies=("lidar_aeb", "camera_road_follower"),
                    sensors={"image_width_px": 84})  # fmt: skip


@pytest.fixture(scope="module")
def plan():
    return dataclasses.replace(town_plan(12, "train", "straight", seconds=4.0), buildings=(), props=())


@pytest.fixture(scope="module")
def log(plan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("truth")
    path = write_town_clip(plan, folder / "clip", rig=RIG, period_us=500_000, backend="rays", truth=folder / "truth")
    return logs.open_clip(path), folder / "truth" / "plan.json"


def test_policies_drive_in_the_true_world(plan):
    facts = SimpleNamespace(id="town", rig=RIG, ego=plan.ego_trajectory(), tracks=plan.tracks(), span_us=plan.span_us)
    with TrueWorld(plan, "rays") as world:
        seen = []
        rollouts = [
            run_rollout(
                SCENARIO, load_policy(name), world.sense, facts, on_frames=lambda t, frames: seen.append(frames)
            )
            for name in SCENARIO.policies
        ]
    assert [rollout.status for rollout in rollouts] == ["ok", "ok"], [rollout.error for rollout in rollouts]
    assert {type(frame).__name__ for frames in seen for frame in frames.values()} == {"CameraFrame", "LidarFrame"}
    for rollout in rollouts:
        assert len(rollout.states) == 31 and len(rollout.plans) == 5
        start, end = (rollout.states[i].world_from_rig[:3, 3] for i in (0, -1))
        assert 1.0 < np.linalg.norm(end - start) < 60.0


@pytest.mark.slow
def test_truth_and_reconstruction_stand_side_by_side_in_one_run(log, tmp_path):
    clip, plan_file = log
    scene = reconstruct(clip, "lift")
    renderer = CpuRenderer(scene)
    folder = runs.execute([scene], SCENARIO, SCENARIO.policies, lambda _: renderer.sense, tmp_path, video=False)
    with runs.true_world(plan_file, scene, "rays") as (truth, sense):
        again = runs.execute(
            [truth], SCENARIO, SCENARIO.policies, lambda _: sense, tmp_path, resume=folder, video=False
        )
    assert again == folder
    heading, *rows = runs.headline(folder)
    assert sorted((row[0], row[1], row[3]) for row in rows) == [
        (policy, made, "0") for policy in sorted(SCENARIO.policies) for made in ("lift", "truth")
    ]
    assert "truth" in (folder / "report.html").read_text()


def test_a_plan_of_another_town_is_refused(plan, log, tmp_path):
    clip, plan_file = log
    scene = SimpleNamespace(id="clip", tracks=plan.tracks(), ego=plan.ego_trajectory(), provenance={})

    def refused(text, file=plan_file, **changes):
        with pytest.raises(RunError, match=text), runs.true_world(file, SimpleNamespace(**{**vars(scene), **changes})):
            pass

    broken = tmp_path / "plan.json"
    broken.write_text("{}")
    refused("plan.json: not a town plan: seed: Field required", broken)
    refused("nowhere.json: the town plan cannot be read: .*No such file", tmp_path / "nowhere.json")
    refused("the plan has no actor 'ghost'", tracks=(dataclasses.replace(plan.tracks()[0], id="ghost"),))
    beside = scene.ego.world_from_body + np.pad([[0.0, 0.0, 0.0, 0.3]], ((1, 2), (0, 0)))
    refused(r"its ego is up to 0.30 m beside the plan's", ego=Trajectory(scene.ego.t_us, beside))
    refused("it lasts from .* the plan from 1000000", ego=Trajectory(scene.ego.t_us + 10**7, scene.ego.world_from_body))
