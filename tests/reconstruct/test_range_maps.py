"""The method `lidar`: windows merged by ownership, movers in their boxes, the contract of methods, its errors."""

import dataclasses

import numpy as np
import pytest
from reconstruct_street import Street

from nurec_sim.errors import ReconstructError, WeightsError
from nurec_sim.evaluate import contenders
from nurec_sim.evaluate.methods import describe, without_weights
from nurec_sim.evaluate.scores.lidar import CloudScore
from nurec_sim.reconstruct import LidarSettings, load_method, reconstruct
from nurec_sim.reconstruct.conformance import check_method
from nurec_sim.reconstruct.free_space import sweep_beams
from nurec_sim.reconstruct.range_maps.ownership import FINEST_M, one_per_voxel, owned, voxel_edge_m
from nurec_sim.reconstruct.range_maps.windows import choose_windows, read_window
from nurec_sim.render import make_renderer
from nurec_sim.types import SensorRequest

UNTRAINED = LidarSettings(random_weights=0)
CAR = {"car": ((4.0, 1.8, 1.5), np.array([[12.0 + 2 * k, 1.0] for k in range(5)]))}


@pytest.fixture(scope="module")
def street():
    return Street(boxes=CAR)


@pytest.fixture(scope="module")
def scene(street):
    return reconstruct(street, "lidar", hold_out_sweeps=[2], settings=UNTRAINED)


def simulated(scene, street, index):
    sweep = street.sweep("top", index)
    poses = np.stack([sweep.world_from_lidar] * 2)
    request = SensorRequest("", street.rig.lidars["top"], sweep.start_us, sweep.end_us, poses)
    frame = make_renderer(scene, "cpu").render_lidar(request)
    return CloudScore.of(
        frame.xyz_m.astype(np.float64) @ poses[1][:3, :3].T + poses[1][:3, 3], sweep.xyz_world_m
    ).figures()


def test_the_method_keeps_the_contract():
    car = {"car": ((4.0, 1.8, 1.5), np.array([12.0, 1.0]))}
    assert check_method(load_method("lidar"), Street(frames=3, cameras=(), boxes=car), UNTRAINED) == []


def test_a_sweep_that_was_held_out_is_simulated(scene, street):
    figures = simulated(scene, street, 2)
    assert figures["precision_m"] < 0.1 and figures["coverage_m"] < 0.1
    assert figures["count_ratio"] == pytest.approx(1, abs=0.05)


def test_actors_are_rigid_parts_of_their_boxes(scene):
    assert len(scene.dynamic) > 50 and scene.dynamic.in_box.all()
    half = np.array([4.0, 1.8, 1.5]) / 2 + 0.2
    assert (np.abs(scene.dynamic.gaussians.mean_m) < half).all()


def test_what_moves_without_a_box_lives_briefly():
    bare = Street(boxes=CAR, labelled=False)
    scene = reconstruct(bare, "lidar", settings=UNTRAINED, actors="recorded")
    life = scene.dynamic.knot_t_us[:, 2] - scene.dynamic.knot_t_us[:, 0]
    assert len(scene.dynamic) and (life <= 400_000).all() and (scene.dynamic.track == -1).all()
    assert "no boxes: what moves lives for the time between two windows" in scene.provenance["unknown"]
    kept = reconstruct(bare, "lidar", settings=dataclasses.replace(UNTRAINED, carve=False), actors="recorded")
    assert len(kept.dynamic) == 0 and len(kept.static) > len(scene.static)


def test_windows_are_sweeps_that_are_not_held_out(street):
    assert choose_windows(street, {1}, 20) == [("top", 0), ("top", 2), ("top", 3), ("top", 4)]
    assert choose_windows(street, set(), 2) == [("top", 0), ("top", 4)]
    window = read_window(street, "top", 0)
    assert window.beams_known and len(window.range_m) == len(window.point_t_us) == len(window.xyz_world_m)
    # The spacing of columns, 1 degree, is a little larger than that of rows, 30 / 31.
    np.testing.assert_allclose(window.spacing_m / window.range_m, np.radians(30 / 31), rtol=1e-3)


def test_a_surface_belongs_to_the_window_that_saw_it_from_nearest(street):
    windows = [read_window(street, "top", index) for index in (0, 4)]
    beams = [sweep_beams(street, "top", street.sweep("top", index)) for index in (0, 4)]
    xyz, reach = windows[0].xyz_world_m, windows[0].range_m
    kept = owned(xyz, reach, [beams[1]], 0.8)
    ratio = np.linalg.norm(xyz - beams[1].world_from_lidar[:3, 3], axis=1) / reach
    # Four metres farther on walls ahead are nearer, but for their tops out of sight; the car is no longer where it was.
    wall = (ratio < 0.79) & (np.abs(xyz[:, 1]) > 7.9)
    car = (np.abs(xyz[:, 1] - 1) < 1) & (xyz[:, 2] > 0.3)
    assert kept[ratio > 0.81].all() and wall.sum() > 20 and kept[wall].mean() < 0.1
    assert (ratio[car] < 0.7).sum() > 20 and kept[car].all()
    assert owned(xyz, reach, [beams[1]], 0.0).all()


def test_voxels_keep_the_nearest():
    xyz = np.array([[0.01, 0.01, 0.01], [0.02, 0.02, 0.02], [0.05, 0.01, 0.01], [0.01, 0.01, 0.01]])
    edge = voxel_edge_m(np.array([0.001, 0.05, FINEST_M, 0.09], np.float32))
    np.testing.assert_allclose(edge, [0.04, 0.04, 0.04, 0.08])
    assert one_per_voxel(xyz, edge, np.array([9.0, 5.0, 7.0, 1.0], np.float32)).tolist() == [False, True, True, True]


def test_errors_say_what_lacks(street):
    with pytest.raises(ReconstructError, match="'lidar' needs LiDAR sweeps.*no usable returns after holding out"):
        reconstruct(street, "lidar", hold_out_sweeps=range(5), settings=UNTRAINED)
    with pytest.raises(WeightsError, match="no weights at 'nowhere'"):
        reconstruct(street, "lidar", settings=LidarSettings(checkpoint="nowhere"))
    with pytest.raises(ReconstructError, match="windows must lie in 1..1000, got 0"):
        LidarSettings(windows=0)


def test_methods_of_table_3_are_compared_by_name(tmp_path):
    both = contenders(("lidar", "lidar-no-floor"))
    assert [each.settings.profile for each in both] == ["lidar", "lidar-no-floor"]
    assert {each.method for each in both} == {"lidar"}
    if without_weights(both[0]) is None:
        assert len(describe(both[0])["settings"]["checkpoint"]) == 64
