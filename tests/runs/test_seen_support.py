"""Support of what a policy saw: per plan, in its own file, as a metric and in the tables of a run."""

import json

import numpy as np
import pytest
from metrics_worlds import flat_street
from striped_images import striped

from nurec_sim import runs, sim
from nurec_sim.errors import RunError
from nurec_sim.metrics import read_table, rollout_values
from nurec_sim.runs import folder as layout
from nurec_sim.runs.seen_support import load_support, save_support
from nurec_sim.types import Needs, Plan

SCENARIO = sim.make_scenario({"name": "short", "duration_s": 2.0, "warm_up_s": 0.3, "seeds": [0], "replan_s": 0.5})


class Looks:
    """Drives straight on at 8 m/s and sees the front camera."""

    name, needs = "looks", Needs(cameras=("front",), image_width_px=32)

    def reset(self, rig, seed):
        pass

    def plan(self, observation):
        t = np.arange(1, 51) * 100_000
        return Plan(observation.t_us + t, np.column_stack([t * 8e-6, 0 * t, 0 * t]))


class FallsWithTime:
    """Support 0.9 at the start of the scene, 0.1 less every half second; half of each image has 0.1 more."""

    def __init__(self, scene):
        self.start_us, self.asked = scene.ego.start_us, []

    def map(self, request):
        self.asked.append(request)
        value = 0.85 - 0.2e-6 * (request.start_us - self.start_us)
        return np.array([[value, value + 0.1]], np.float32)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    scene, _ = flat_street()
    made = []

    def support_for(scene):
        made.append(FallsWithTime(scene))
        return made[-1]

    run = runs.execute(
        [scene], SCENARIO, ["log_replay", Looks()], lambda scene: striped, tmp_path_factory.mktemp("runs"),
        video=False, support_for=support_for,
    )  # fmt: skip
    return scene, run, made


def test_every_plan_of_a_policy_with_cameras_has_its_support(finished):
    scene, run, made = finished
    assert len(made) == 1, "once per scene"
    found = load_support(run / "street" / "lift" / "looks" / "0" / layout.SUPPORT)
    seconds = [(t_us - scene.ego.start_us) / 1e6 for t_us in found]
    assert len(found) >= 3 and list(found.values()) == pytest.approx([0.9 - 0.2 * s for s in seconds], abs=1e-4)
    assert not (run / "street" / "lift" / "log_replay" / "0" / layout.SUPPORT).exists()


def test_maps_are_asked_for_where_the_car_was(finished):
    scene, run, (support,) = finished
    rollout = runs.load_rollout(run / "street" / "lift" / "looks" / "0" / "rollout.npz")
    poses = dict(zip(rollout.t_us.tolist(), rollout.world_from_rig, strict=True))
    for request in support.asked:
        assert request.sensor.width_px == 32 and request.end_us == request.start_us + 1
        wanted = poses[request.start_us] @ next(iter(scene.rig.cameras.values())).rig_from_camera
        assert np.allclose(request.world_from_sensor, wanted)


def test_the_metric_is_the_mean_while_the_policy_drives_and_the_least(finished):
    scene, run, _ = finished
    values = rollout_values(read_table(run / "metrics.parquet"))
    found = load_support(run / "street" / "lift" / "looks" / "0" / layout.SUPPORT)
    driven = [value for t_us, value in found.items() if t_us >= scene.ego.start_us + 300_000]
    by_name = {
        (row["policy"], row["name"]): row["value"]
        for row in values.iter_rows(named=True)
        if row["name"].startswith("support")
    }
    assert by_name["looks", "support"] == pytest.approx(np.mean(driven))
    assert by_name["looks", "support_least"] == pytest.approx(min(driven))
    assert by_name["log_replay", "support"] is None


def test_a_file_of_support_is_read_back(tmp_path):
    path = tmp_path / layout.SUPPORT
    save_support({1_000_000: 0.5, 1_500_000: 0.25}, path)
    assert load_support(path) == {1_000_000: 0.5, 1_500_000: 0.25}
    assert load_support(tmp_path / "none.json") == {}


@pytest.mark.parametrize(
    "facts",
    [
        {"t_us": [1, 2], "support": [0.5]},
        {"t_us": [1], "support": [1.5]},
        {"t_us": [2, 1], "support": [0.5, 0.5]},
        {"t_us": [1.5], "support": [0.5]},
        {"t_us": [1]},
        [],
    ],
)
def test_a_damaged_file_of_support_is_refused(tmp_path, facts):
    path = tmp_path / layout.SUPPORT
    path.write_text(json.dumps(facts))
    with pytest.raises(RunError, match="support.json"):
        load_support(path)
