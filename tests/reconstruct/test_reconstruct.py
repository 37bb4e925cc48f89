import dataclasses

import numpy as np
import pytest
from reconstruct_street import KERB_M, Street, camera

from nurec_sim import geometry
from nurec_sim.compute import cores
from nurec_sim.errors import ReconstructError
from nurec_sim.evaluate.scores.images import psnr
from nurec_sim.reconstruct import LiftSettings, ViewSettings, reconstruct
from nurec_sim.scene import scene_hash
from nurec_sim.types import Label, SensorRequest

SMALL = LiftSettings(sky_px=32, views=ViewSettings(levels=32))
PARKED = {"parked": ((4.0, 1.8, 1.5), np.array([14.0, -2.5]))}
CROSSING = {"moving": ((4.0, 1.8, 1.5), np.column_stack([np.linspace(12, 16, 5), np.full(5, 2.2)]))}


@pytest.fixture(scope="module")
def street():
    return Street(boxes=PARKED | CROSSING)


@pytest.fixture(scope="module")
def scene(street):
    return reconstruct(street, settings=SMALL)


def image_of(scene, clip, name, index):
    from nurec_sim.render import CpuRenderer

    t_us = int(clip.t_us[index])
    request = SensorRequest("street", clip.rig.cameras[name], t_us, t_us + 1, clip.world_from_camera(name, index))
    return CpuRenderer(scene, threads=1).render_camera(request)


def test_scene_looks_like_the_log(street, scene):
    for index in (1, 3):
        assert psnr(image_of(scene, street, "front", index).rgb, street.image("front", index)) > 20


def test_scene_looks_right_from_beside_the_driven_path(street, scene):
    beside = dataclasses.replace(street, cameras=(camera("beside", left_m=1.0),))
    assert psnr(image_of(scene, beside, "beside", 2).rgb, beside.image("beside", 2)) > 17.5


def test_depth_is_the_true_depth(street, scene):
    from nurec_sim import sensors

    frame = image_of(scene, street, "front", 2)
    rays, _ = sensors.pixel_rays(street.rig.cameras["front"])
    pose = street.world_from_camera("front", 2)[0]
    distance, what = street.cast(pose[:3, 3], rays.reshape(-1, 3) @ pose[:3, :3].T, 2)
    true = (distance * rays.reshape(-1, 3)[:, 2]).reshape(frame.depth_m.shape)
    near = (true < 20) & (frame.depth_m > 0)
    assert near.mean() > 0.4
    assert np.median(np.abs(frame.depth_m - true)[near] / true[near]) < 0.02


def test_points_in_boxes_are_dynamic(street, scene):
    for number, track in enumerate(street.tracks):
        mine = scene.dynamic.track == number
        assert mine.sum() > 50
        assert (scene.dynamic.gaussians.label[mine] == Label.MOVABLE).all()
        for pose in track.path.world_from_body:
            box = geometry.transform_points(geometry.inverse(pose), scene.static.mean_m)
            inside = geometry.points_in_box(box, track.size_m, -0.15)
            assert inside.sum() <= 3
    assert scene.dynamic.in_box.all()
    for number, track in enumerate(street.tracks):
        local = scene.dynamic.gaussians.mean_m[scene.dynamic.track == number]
        assert geometry.points_in_box(local, track.size_m, 0.3).mean() > 0.98


def test_road_ends_at_the_kerb(scene):
    flat = np.abs(scene.static.mean_m[:, 2]) < 0.3
    side, x = np.abs(scene.static.mean_m[:, 1]), scene.static.mean_m[:, 0]
    near = flat & (x > 2) & (x < 12)
    road = scene.static.label == Label.ROAD
    assert not (road & (side > KERB_M + 0.25)).any()
    assert road[near & (side < KERB_M - 0.3)].mean() > 0.97


def test_road_has_no_holes_where_a_car_drives(scene):
    road = scene.static.mean_m[scene.static.label == Label.ROAD]
    x, y = np.meshgrid(np.arange(0.0, 15, 0.3), np.arange(-1.5, 1.51, 0.3))
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(road[:, :2]).query(np.column_stack([x.ravel(), y.ravel()]))
    assert distance.max() < 0.2


def test_sky_is_where_nothing_stands(scene):
    up = scene.sky[2].mean(axis=(0, 1))
    assert up == pytest.approx([0.7, 0.8, 1.0], abs=0.08)


def test_intensities_are_kept(scene):
    known = np.isfinite(scene.static.intensity)
    assert known.mean() > 0.5
    assert scene.static.intensity[known].min() > 0.15 and scene.static.intensity[known].max() < 0.75


def test_provenance_is_plain_json(scene):
    import json

    facts = json.loads(json.dumps(scene.provenance))
    assert facts["method"] == "lift" and facts["settings"]["sky_px"] == 32
    assert facts["counts"]["static"] == len(scene.static)
    assert any(text.startswith("no map") for text in facts["unknown"])


@pytest.mark.slow
def test_same_clip_same_scene_by_any_number_of_threads(street, scene, monkeypatch):
    monkeypatch.setattr(cores, "usable_cores", lambda: 3)
    again = reconstruct(street, settings=SMALL)
    assert scene_hash(again) == scene_hash(scene)


def test_works_without_boxes_and_intensity():
    clip = Street(frames=3, boxes=PARKED, labelled=False, with_intensity=False)
    scene = reconstruct(clip, settings=SMALL)
    assert len(scene.dynamic) == 0 and np.isnan(scene.static.intensity).all()
    assert any(text.startswith("no boxes") for text in scene.provenance["unknown"])
    assert any(text.startswith("no LiDAR intensity") for text in scene.provenance["unknown"])
    box = scene.static.mean_m - np.array([14.0, -2.5, 0.77])
    assert geometry.points_in_box(box, (4, 1.8, 1.5), 0.2).sum() > 50


@pytest.mark.slow
def test_works_with_one_frame_and_standing():
    one = reconstruct(Street(frames=1, boxes=PARKED), settings=SMALL)
    assert len(one.static) > 1000 and len(one.dynamic) > 20
    standing = reconstruct(Street(frames=3, speed_mps=0.0, boxes=PARKED), settings=SMALL)
    assert (standing.static.label == Label.ROAD).sum() > 1000


def test_works_without_cameras(street):
    scene = reconstruct(street, cameras=[], settings=SMALL)
    assert len(scene.static) > 1000
    assert any(text.startswith("no cameras") for text in scene.provenance["unknown"])


@pytest.mark.slow
def test_camera_gain_becomes_its_isp():
    pair = (camera("left", 0.3), camera("right", -0.3))
    clip = Street(frames=3, cameras=pair, gains={"right": 0.8})
    scene = reconstruct(clip, settings=SMALL)
    assert np.allclose(scene.isp["left"], np.eye(3, 4))
    shown = scene.isp["right"] @ np.array([0.4, 0.4, 0.4, 1])
    assert shown == pytest.approx([0.32] * 3, abs=0.02)


def test_held_out_sweeps_are_not_read(street):
    class Guard(Street):
        def sweep(self, lidar_id, index):
            assert index != 2
            return super().sweep(lidar_id, index)

    scene = reconstruct(Guard(boxes=PARKED), hold_out_sweeps=[2], cameras=[], settings=SMALL)
    assert scene.provenance["held_out_sweeps"] == [2] and scene.provenance["counts"]["sweeps"] == 4


def test_errors_say_what_there_is(street):
    with pytest.raises(
        ReconstructError,
        match=r"unknown reconstruction method 'magic'; have \['dense', 'lidar', 'lift', 'optimized', 'selective'\]",
    ):
        reconstruct(street, "magic")
    with pytest.raises(ReconstructError, match=r"has no camera \['back'\]; have \['front'\]"):
        reconstruct(street, cameras=["back"])
    with pytest.raises(ReconstructError, match=r"no sweeps \[7\] to hold out; have 0..4"):
        reconstruct(street, hold_out_sweeps=[7])
    with pytest.raises(ReconstructError, match="'lift' needs LiDAR sweeps.*'dense' needs images only"):
        reconstruct(street, hold_out_sweeps=range(5))


def test_progress_names_stages_in_order(street):
    seen = []
    reconstruct(Street(frames=1), settings=SMALL, progress=lambda stage, fraction: seen.append((stage, fraction)))
    stages = list(dict.fromkeys(stage for stage, _ in seen))
    assert stages == [
        "sweeps", "ground and surfaces", "images", "depth", "colours", "lifting", "solving colours",
        "ray drop",
    ]  # fmt: skip
    told = [fraction for _, fraction in seen]
    assert told == sorted(told) and (told[0], told[-1]) == (0.0, 1.0)


@pytest.mark.slow
def test_the_provenance_says_by_how_much_times_were_moved():
    moved = reconstruct(Street(frames=1, time_offset_us=1_000_000), settings=SMALL)
    assert moved.provenance["time_offset_us"] == 1_000_000
    assert "time_offset_us" not in reconstruct(Street(frames=1), settings=SMALL).provenance
