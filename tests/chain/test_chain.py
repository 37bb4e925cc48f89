"""The whole chain on the log that ships with the package: log, scene, archive, server, loop, metrics, report."""

from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from nurec_sim import metrics, plugins, runs, sim
from nurec_sim.metrics.offroad import offroad_agreement
from nurec_sim.metrics.offroad_grid import scene_offroad_grid
from nurec_sim.serving.client import RemoteSensors
from nurec_sim.serving.driver import DriverServer, RemotePolicy
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import LoadedScene, SceneStore
from nurec_sim.sim import Scenario
from nurec_sim.types import CameraFrame, GaussianScene, LidarFrame, Rollout, SensorFrame

pytestmark = pytest.mark.slow
SCENARIOS = Path(str(resources.files("nurec_sim.scenarios")))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SceneStore:
    return SceneStore([SCENARIOS / "demo_clip.zip"], cache_dir=tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def loaded(store: SceneStore) -> LoadedScene:
    return store.get(store.ids[0])


@pytest.fixture(scope="module")
def remote(store: SceneStore, loaded: LoadedScene) -> Iterator[RemoteSensors]:
    with SensorServer(store, port=0) as address, RemoteSensors(address, loaded.scene.id) as sensors:
        yield sensors


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return sim.load_scenario(SCENARIOS / "demo.yaml")


def value(rollout: Rollout, scene: GaussianScene, name: str) -> float:
    series = metrics.score_rollout(rollout, scene_offroad_grid(scene), scene.road_map)
    return next(one for one in series if one.name == name).value()


def test_offroad_from_gaussians_agrees_with_the_true_polygon(loaded: LoadedScene) -> None:
    scene = loaded.scene
    assert scene.road_map is not None
    grid = scene_offroad_grid(scene)
    found = offroad_agreement(grid, scene.road_map, scene.ego, scene.rig.body)
    assert found.known >= 500
    assert found.agreement >= 0.95
    assert found.unknown_frac <= 0.05
    assert grid.overruled_frac < 0.05


def test_log_replay_has_no_event_and_constant_velocity_has_one(
    loaded: LoadedScene, remote: RemoteSensors, scenario: Scenario
) -> None:
    events = {}
    for name in ("log_replay", "constant_velocity"):
        rollout = sim.run_rollout(scenario, plugins.load_policy(name), remote.sense, loaded.scene)
        assert rollout.status == "ok", rollout.error
        events[name] = [value(rollout, loaded.scene, metric) for metric in ("collision_any", "offroad", "offroad_true")]
    assert events["log_replay"] == [0.0, 0.0, 0.0]
    assert max(events["constant_velocity"]) == 1.0


def assert_same_frame(a: SensorFrame, b: SensorFrame) -> None:
    names = ("rgb",) if isinstance(a, CameraFrame) else ("xyz_m", "intensity", "range_m", "beam")
    assert isinstance(b, CameraFrame if isinstance(a, CameraFrame) else LidarFrame)
    for name in names:
        assert np.array_equal(getattr(a, name), getattr(b, name)), name


@pytest.mark.parametrize("name", ["camera_road_follower", "lidar_aeb"])
def test_a_rollout_through_the_server_equals_the_local_one_bit_for_bit(
    name: str, loaded: LoadedScene, remote: RemoteSensors, scenario: Scenario
) -> None:
    short = scenario.model_copy(update={"duration_s": 2.0})
    frames: dict[str, list[SensorFrame]] = {"local": [], "remote": []}
    rollouts = {}
    for place, sense in (("local", loaded.renderer.sense), ("remote", remote.sense)):

        def kept(requests, sense=sense, place=place):
            answer = list(sense(requests))
            frames[place] += answer
            return answer

        rollouts[place] = sim.run_rollout(short, plugins.load_policy(name), kept, loaded.scene)
    assert rollouts["local"].status == rollouts["remote"].status == "ok"
    assert len(frames["local"]) == len(frames["remote"]) > 0
    for a, b in zip(frames["local"], frames["remote"], strict=True):
        assert_same_frame(a, b)
    assert np.array_equal(rollouts["local"].world_from_rig, rollouts["remote"].world_from_rig)
    for (_, mine), (_, theirs) in zip(rollouts["local"].plans, rollouts["remote"].plans, strict=True):
        assert np.array_equal(mine.pose, theirs.pose)


@pytest.mark.parametrize("name", ["camera_road_follower", "lidar_aeb"])
def test_a_driver_on_the_far_side_of_a_wire_drives_the_same_bit_for_bit(
    name: str, loaded: LoadedScene, remote: RemoteSensors, scenario: Scenario
) -> None:
    local = sim.run_rollout(scenario, plugins.load_policy(name), remote.sense, loaded.scene)
    with DriverServer(lambda: plugins.load_policy(name), port=0) as address, RemotePolicy(address) as policy:
        far = sim.run_rollout(scenario, policy, remote.sense, loaded.scene)
    assert local.status == far.status == "ok", far.error
    assert len(local.plans) == len(far.plans) == 19
    for (_, mine), (_, theirs) in zip(local.plans, far.plans, strict=True):
        assert np.array_equal(mine.t_us, theirs.t_us) and np.array_equal(mine.pose, theirs.pose)
    assert np.array_equal(local.world_from_rig, far.world_from_rig)


def test_a_run_folder_with_report(
    loaded: LoadedScene, remote: RemoteSensors, scenario: Scenario, tmp_path: Path
) -> None:
    short = scenario.model_copy(update={"duration_s": 1.5})
    scene = loaded.scene
    folder = runs.execute([scene], short, ["log_replay"], lambda _: remote.sense, tmp_path, stamp="one")
    assert (tmp_path / "latest").resolve() == folder.resolve()
    assert "log_replay" in (folder / "report.html").read_text(encoding="utf-8")
    assert next(folder.rglob("front.mp4")).stat().st_size > 1000
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("rollout.npz")}
    runs.execute([scene], short, ["log_replay"], lambda _: remote.sense, tmp_path, resume=folder)
    assert before == {path: path.stat().st_mtime_ns for path in folder.rglob("rollout.npz")}
