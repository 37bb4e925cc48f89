"""The whole chain on the log that ships with the package: log, scene, archive, server, loop, metrics, report."""

from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import shapely

from nurec_sim import metrics, plugins, runs, sim
from nurec_sim.metrics.offroad_agreement import road_agreement
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
    found = road_agreement(grid, scene.road_map, scene.ego, scene.rig.body)
    assert found.known >= 500
    assert found.agreement >= 0.95
    assert found.unknown_frac <= 0.05
    assert grid.overruled_frac < 0.05


def test_who_drives_without_an_event_who_collides_and_who_leaves_the_road(
    loaded: LoadedScene, remote: RemoteSensors, scenario: Scenario
) -> None:
    """The log has no event. Driving straight on misses the turn, on a road without anybody.

    Who brakes for the pedestrian by the crossing stops in her way, and she does not react. The network with one image
    cuts the corner.
    """
    names = ("collision_any", "offroad", "offroad_true")
    events, rollouts = {}, {}
    for policy in ("log_replay", "constant_velocity", "route_follower", "e2e_1cam"):
        rollout = sim.run_rollout(scenario, plugins.load_policy(policy), remote.sense, loaded.scene)
        assert rollout.status == "ok", rollout.error
        events[policy] = [value(rollout, loaded.scene, metric) for metric in names]
        rollouts[policy] = rollout
    assert events == {
        "log_replay": [0.0, 0.0, 0.0],
        "constant_velocity": [0.0, 0.0, 0.0],
        "route_follower": [1.0, 0.0, 0.0],
        "e2e_1cam": [0.0, 1.0, 1.0],
    }
    ends = {policy: rollout.world_from_rig[-1, :2, 3] for policy, rollout in rollouts.items()}
    recorded = loaded.scene.ego.world_from_body[-1, :2, 3]
    assert np.linalg.norm(ends["log_replay"] - recorded) < 0.5
    assert np.linalg.norm(ends["constant_velocity"] - recorded) > 15  # on, where the log turned
    found = {policy: contact_with(rollout, "pedestrian_0") for policy, rollout in rollouts.items()}
    assert found == {policy: policy == "route_follower" for policy in rollouts}


def contact_with(rollout: Rollout, actor: str) -> bool:
    """Whether the outlines of the car and of an actor ever overlap, by shapely."""
    length, width, _ = rollout.actor_sizes_m[actor]
    body = rollout.rig.body
    return any(
        outline(ego, body.center_m[0], body.size_m[0], body.size_m[1]).intersects(outline(box, 0.0, length, width))
        for ego, box in zip(rollout.world_from_rig, rollout.actors[actor], strict=True)
        if np.isfinite(box).all()
    )


def outline(pose: np.ndarray, ahead_m: float, length_m: float, width_m: float) -> shapely.Polygon:
    """A box from above, its centre ahead of the origin of its pose."""
    x = ahead_m + length_m / 2 * np.array([1, 1, -1, -1])
    y = width_m / 2 * np.array([1, -1, -1, 1])
    return shapely.Polygon((pose[:2, :2] @ [x, y]).T + pose[:2, 3])


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
