"""Added actors in what is rendered: Gaussians of their meshes, the same tracks in reconstructions and in the town."""

import dataclasses

import numpy as np
import pytest
from metrics_worlds import flat_street
from sensor_worlds import request_at, small_plan, true_world

from nurec_sim import geometry
from nurec_sim.errors import ScenarioError
from nurec_sim.plugins import load_policy
from nurec_sim.render import make_renderer
from nurec_sim.runs.added_actors import added_actors, with_added_actors
from nurec_sim.scene import write_scene
from nurec_sim.sim import make_scenario, run_rollout
from nurec_sim.types import DynamicGaussians, Gaussians, GaussianScene, Label, SensorRequest
from nurec_sim.world import ACTOR_SIZES_M, actor_gaussians

AHEAD = {"asset": "sedan", "along_m": 20.0, "colour": [0.9, 0.1, 0.1]}


def scenario(**added):
    return make_scenario({"name": "a", "duration_s": 2.5, "added_actors": added})


@pytest.mark.parametrize("kind", ["hatch", "pedestrian"])
def test_gaussians_fill_the_box_of_the_actor(kind):
    size = np.array(ACTOR_SIZES_M[kind])
    look = actor_gaussians(kind, tuple(size), (0.1, 0.2, 0.9))
    body = look[look.label == Label.MOVABLE]
    low, high = body.mean_m.min(axis=0), body.mean_m.max(axis=0)
    if kind == "hatch":
        assert low == pytest.approx(-size / 2, abs=0.03) and high == pytest.approx(size / 2, abs=0.03)
    else:
        assert (low >= -size / 2 - 0.03).all() and low[2] == pytest.approx(-size[2] / 2, abs=0.03)
        assert high[2] > size[2] / 2 - 0.05
    # The third axis is the surface's normal, and most of the colour is the one that was asked for.
    axis = geometry.matrix_from_quat(body.quat_wxyz.astype(np.float64))[:, :, 2]
    assert (axis * body.normal).sum(axis=1) == pytest.approx(1.0, abs=1e-3)
    blue = (body.rgb[:, 2] > 1.5 * body.rgb[:, 0]).mean()
    assert blue > 0.25 and np.isfinite(body.intensity).all()
    again = actor_gaussians(kind, tuple(size), (0.1, 0.2, 0.9))
    assert again.mean_m.tobytes() == look.mean_m.tobytes() and again.rgb.tobytes() == look.rgb.tobytes()


def test_cameras_and_lidars_see_it_on_the_road():
    """A road 0.1 m above the plane of the recorded drive: the car stands on it. Its tail is 17.65 m ahead."""
    scene, _ = flat_street()
    static = dataclasses.replace(scene.static, mean_m=scene.static.mean_m + np.float32([0, 0, 0.1]))
    scene = with_added_actors(dataclasses.replace(scene, static=static), scenario(x=AHEAD))
    track = scene.tracks[-1]
    start = scene.span_us[0]
    pose = track.path.at(start)
    # The first start of the recorded drive is the origin of the street; heights are the median of noise of 2 cm.
    assert pose[:3, 3] - scene.ego.at(start)[:3, 3] == pytest.approx([20, 0, 0.1 + 1.44 / 2], abs=0.02)
    renderer = make_renderer(scene, "cpu", threads=1)
    (camera,), (lidar,) = scene.rig.cameras.values(), scene.rig.lidars.values()
    requests = [
        SensorRequest(scene.id, sensor, start, start + 1, np.repeat((scene.ego.at(start) @ mount)[None], 2, axis=0))
        for sensor, mount in ((camera, camera.rig_from_camera), (lidar, lidar.rig_from_lidar))
    ]
    image, sweep = renderer.sense(requests)
    middle = image.rgb[camera.height_px // 2 + 5 : camera.height_px // 2 + 20, camera.width_px // 2 - 8 :][:, :16]
    red = middle.reshape(-1, 3).mean(axis=0)
    assert red[0] > 1.5 * red[1]
    points = geometry.transform_points(scene.ego.at(start) @ lidar.rig_from_lidar, sweep.xyz_m.astype(np.float64))
    on_it = geometry.points_in_box(geometry.transform_points(geometry.inverse(pose), points), track.size_m, 0.05)
    near = points[on_it & (points[:, 2] > 0.4)]
    assert len(near) > 20 and near[:, 0].min() - scene.ego.at(start)[0, 3] == pytest.approx(17.65, abs=0.3)


def test_one_set_of_tracks_serves_all_worlds_of_a_log():
    scene, world = flat_street()
    facts = dataclasses.replace(scene, static=Gaussians.empty(), dynamic=DynamicGaussians.empty())
    wanted = scenario(x={**AHEAD, "speed_fraction": 0.5})
    added = added_actors(wanted, facts)
    runs = [
        run_rollout(wanted, load_policy("blind_route_noisy"), None, one, seed=3)
        for one in (added.in_facts(facts), added.in_scene(scene))
    ]
    assert runs[0].status == "ok", runs[0].error
    assert runs[0].world_from_rig.tobytes() == runs[1].world_from_rig.tobytes()
    assert runs[0].actors["x"].tobytes() == runs[1].actors["x"].tobytes()
    assert len(added.in_facts(facts).dynamic) == 0 < len(added.in_scene(scene).dynamic)


@pytest.mark.slow
def test_the_town_shows_the_same_actor():
    plan = small_plan()
    scene = GaussianScene(
        "town", Gaussians.empty(), DynamicGaussians.empty(), np.zeros((6, 1, 1, 3), np.float32), {},
        flat_street()[0].rig, plan.ego_trajectory(), plan.tracks(), None, plan.span_us,
    )  # fmt: skip
    added = added_actors(scenario(x={**AHEAD, "along_m": 9.0, "lateral_m": 0.5, "speed_fraction": 1.0}), scene)
    (track,) = added.tracks
    town = added.in_town(plan)
    times = plan.span_us[0] + np.array([0, 1_000_000, 2_400_000])
    shown, wanted = town.tracks()[-1].path.at(times), track.path.at(times)
    assert town.tracks()[-1].label == "automobile" and shown[:, :3, 3] == pytest.approx(wanted[:, :3, 3], abs=0.03)
    assert shown[:, :3, :3] == pytest.approx(wanted[:, :3, :3], abs=0.02)
    with true_world(town, "rays") as world:
        (lidar,) = scene.rig.lidars.values()
        seen = world.scan(request_at(plan, lidar, 1.0))
    assert (seen.instance == len(town.actors)).sum() > 20


def test_an_archive_is_an_asset_for_reconstructions_only(tmp_path):
    scene, _ = flat_street()
    write_scene(with_added_actors(scene, scenario(x=AHEAD)), tmp_path / "car.usdz")
    for asset in ("car.usdz", "car.usdz#x"):
        added = added_actors(scenario(y={"asset": asset, "along_m": 20.0}), scene, tmp_path)
        assert added.assets["y"].size_m == pytest.approx(ACTOR_SIZES_M["sedan"])
        assert len(added.in_scene(scene).dynamic) == len(added.assets["y"].gaussians) > 1000
    with pytest.raises(ScenarioError, match="the true world needs one of .'bus', 'cyclist'"):
        added.in_town(small_plan())
    for asset, said in (
        ("car.usdz#z", "has no track 'z'"),
        ("tank", "no asset 'tank'; have .'bus', 'cyclist', .*or give an archive"),
    ):
        with pytest.raises(ScenarioError, match=said):
            added_actors(scenario(y={"asset": asset, "along_m": 20.0}), scene, tmp_path)
