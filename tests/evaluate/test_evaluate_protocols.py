import dataclasses

import numpy as np
import pytest
from evaluation_worlds import BOX, street
from feedforward_clip import clip_of, frame_times, pinhole

from nurec_sim import sensors, world
from nurec_sim.errors import ReconstructError
from nurec_sim.evaluate import Protocol, procedural
from nurec_sim.evaluate.recorded import clip_window, recorded_window, storm_windows
from nurec_sim.logs import open_clip

SMALL = {"size_px": (48, 32), "backend": "rays"}


@pytest.fixture(scope="module", autouse=True)
def _bare_towns():
    """Towns without scenery are built in half the time."""
    whole = procedural.town_plan

    def bare(*given, **more):
        return dataclasses.replace(whole(*given, **more), buildings=(), props=())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(procedural, "town_plan", bare)
        yield


@pytest.fixture(scope="module")
def storm():
    with Protocol("storm", (5,), **SMALL).window(0) as window:
        window.clip.sweep("lidar_top", 19)
        yield window


def test_storm_shows_four_frames_and_asks_for_the_others(storm):
    seen = storm.clip.camera_times_us("camera_front")[:, 0]
    asked = np.array([target.request.start_us for target in storm.targets])
    assert np.diff(seen).tolist() == [500_000] * 3
    assert len(asked) == 16 and not set(asked) & set(seen)
    assert np.array_equal(np.sort(np.concatenate([seen, asked])), seen[0] + 100_000 * np.arange(20))
    assert [target.beyond for target in storm.targets] == [False] * 12 + [True] * 4
    start, end = storm.clip.span_us
    assert start == seen[0] and end == start + 2_000_000
    assert storm.clip.tracks == () and storm.cameras == ("camera_front",)
    assert len(storm.clip.sweep_times_us("lidar_top")) == 20


def test_the_truth_of_a_target_is_what_the_world_shows_from_there(storm):
    target = storm.targets[7]
    assert target.true.rgb.shape == (32, 48, 3) and target.movable.shape == (32, 48)
    assert 0.2 < (target.true.depth_m > 0).mean() <= 1
    points = storm.clip.sweep("lidar_top", 8).xyz_world_m
    camera = target.request.sensor
    uv, valid, _ = sensors.project_rolling(camera, target.request.world_from_sensor, points)
    valid &= sensors.in_image(camera, uv)
    pose = np.linalg.inv(target.request.world_from_sensor[0])
    z = points[valid] @ pose[2, :3] + pose[2, 3]
    shown = target.true.depth_m[uv[valid, 1].astype(int), uv[valid, 0].astype(int)]
    assert valid.sum() > 100
    assert np.median(np.abs(shown - z)[shown > 0] / z[shown > 0]) < 0.03


@pytest.mark.slow
def test_shift_moves_the_car_to_its_left_and_skips_what_is_inside_of_things():
    with Protocol("shift", (5,), **SMALL).window(0) as window:
        offsets = {target.left_m for target in window.targets}
        ego = window.clip.ego
        for target in window.targets:
            pose = target.request.world_from_sensor[0]
            mount = window.clip.rig.cameras["camera_front"].rig_from_camera
            rig = np.linalg.inv(ego.at(target.request.start_us)) @ pose @ np.linalg.inv(mount)
            assert np.allclose(rig[:3, 3], (0, target.left_m, 0), atol=1e-6)
            depth = target.true.depth_m
            assert ((depth > 0) & (depth < 1)).mean() <= 0.2
        on_path, beside = (
            [target.shown.mean() for target in window.targets if abs(target.left_m) == at] for at in (0.0, 2.0)
        )
        assert 0.9 < np.mean(on_path) and 0.3 < np.mean(beside) < np.mean(on_path) - 0.05, "what input images show"
    assert 0.0 in offsets and {1.0, -1.0} & offsets and max(offsets) <= 3.5


@pytest.fixture(scope="module")
def lidar():
    small = world.street_rig(lidar_rows=6, lidar_columns=40).lidars["lidar_top"]
    with pytest.MonkeyPatch.context() as patch:
        asked = []
        patch.setattr(procedural, "lidar_model", lambda name, mount, id: asked.append(name) or small)
        with Protocol("lidar", (5,), **SMALL).window(0) as window:
            yield window, asked


def test_lidar_holds_out_sweeps_and_measures_them_beside_the_path_too(lidar):
    window, asked = lidar
    assert asked == ["PANDAR128"] and window.targets == ()
    start_us = window.clip.span_us[0]
    given = (window.clip.sweep_times_us("lidar_top")[:, 0] - start_us) // 100_000
    assert given.tolist() == [k for k in range(20) if k not in (3, 8, 13)]
    assert sorted(window.beside) == [-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0]
    targets = (window.beside[0.0].sweep_times_us("lidar_top")[:, 0] - start_us) // 100_000
    assert targets.tolist() == [3, 8, 13]
    for left_m, clip in window.beside.items():
        moved = np.linalg.inv(window.clip.ego.at(start_us)) @ clip.ego.at(start_us)
        assert np.allclose(moved[:3, 3], (0, left_m, 0), atol=1e-6)
        for index in range(len(clip.sweep_times_us("lidar_top"))):
            assert np.mean(np.linalg.norm(clip.sweep("lidar_top", index).xyz_m, axis=1) < 1) <= 0.2


@pytest.mark.slow
def test_clip_holds_out_every_kth_frame_of_all_cameras():
    protocol = Protocol("clip", (5,), seconds=2.0, rate_hz=3.0, hold_out_every=3, boxes=True, **SMALL)
    with protocol.window(0) as window:
        seen = window.clip.camera_times_us("camera_front_left")[:, 0]
        asked = sorted({target.request.start_us for target in window.targets})
        assert len(window.cameras) == 3 and len(seen) == 4 and len(asked) == 2
        assert len(window.targets) == 6 and window.clip.tracks
        assert asked[0] - seen[0] == 666_667


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"name": "drive", "seeds": (1,)}, "no protocol 'drive'; have"),
        ({"name": "storm"}, "give seeds or clips"),
        ({"name": "storm", "seeds": (1, 1)}, "each may be given once"),
        ({"name": "shift", "clips": ("log",)}, "logs have no sensors at lateral offsets"),
        ({"name": "clip", "seeds": (1,), "hold_out_every": 1}, "holds out every second frame or fewer"),
        ({"name": "clip", "seeds": (1,), "cameras": 2}, "1 or 3 cameras, got 2"),
    ],
)
def test_settings_out_of_range_are_errors(arguments, text):
    with pytest.raises(ReconstructError, match=text):
        Protocol(**arguments)


def test_recorded_logs_are_cut_into_windows():
    log = clip_of(pinhole("front"), times=frame_times(47, 100_000))
    windows = storm_windows(log, 20, (0, 5, 10, 15), 100_000, False)
    assert list(windows) == ["made-0000", "made-0020"]  # the tail that does not fit is left out
    second = windows["made-0020"]()
    first_us = log.times["front"][20, 0]
    assert np.array_equal(second.clip.camera_times_us("front")[:, 0], first_us + 500_000 * np.arange(4))
    assert len(second.targets) == 16 and second.targets[0].movable is None
    assert not second.targets[0].true.depth_m.any()  # without a LiDAR no depth is known
    (whole,) = clip_window(log, 1, 4, False).values()
    assert len(whole().targets) == 11
    slow = clip_of(pinhole("front"), times=frame_times(47, 500_000))
    with pytest.raises(ReconstructError, match="needs 20 frames 0.1 s apart, camera 'front' has 47 0.5 s apart"):
        storm_windows(slow, 20, (0,), 100_000, False)
    with pytest.raises(ReconstructError, match="none to hold out"):
        clip_window(clip_of(pinhole("front"), times=frame_times(2, 100_000)), 1, 4, False)


def test_held_out_sweeps_are_the_truth_of_recorded_depth():
    log = street()
    window = recorded_window(log, "street", ("front",), (0, 3, 6), (1, 2, 4), False)
    assert window.clip.sweep_times_us("top")[:, 0].tolist() == log.t_us[[0, 3, 5, 6]].tolist()
    target = window.targets[1]
    camera = log.rig.cameras["front"]
    rays, _ = sensors.pixel_rays(camera)
    pose = log.world_from_camera("front", 2)[0]
    distance, _ = log.cast(pose[:3, 3], rays.reshape(-1, 3) @ pose[:3, :3].T, 2)
    expected = (distance.reshape(64, 96) * rays[..., 2])[target.true.depth_m > 0]
    found = target.true.depth_m[target.true.depth_m > 0]
    assert len(found) > 300
    assert np.median(np.abs(found - expected) / expected) < 0.03


def test_boxes_of_a_log_say_what_can_move():
    log = street()
    target = recorded_window(log, "street", ("front",), (0,), (2,), False).targets[0]
    pose = log.world_from_camera("front", 2)[0]
    rays, _ = sensors.pixel_rays(log.rig.cameras["front"])
    _, what = log.cast(pose[:3, 3], rays.reshape(-1, 3) @ pose[:3, :3].T, 2)
    box = (what >= 5).reshape(64, 96)
    assert box.any() and target.movable[box].mean() > 0.98
    assert target.movable.sum() < 1.4 * box.sum()
    tree = dataclasses.replace(log.tracks[0], label="barrier")
    log.tracks = [tree]
    assert not recorded_window(log, "street", ("front",), (0,), (2,), False).targets[0].movable.any()
    assert list(BOX) == ["car"]


@pytest.mark.realdata
def test_a_real_drive_is_cut_into_windows_with_depth_and_boxes(realdata):
    log = open_clip(realdata / "kitti_raw_0009")
    windows = storm_windows(log, 20, (0, 5, 10, 15), 100_000, False)
    assert list(windows) == ["kitti_raw_0009-0000", "kitti_raw_0009-0020"]
    window = windows["kitti_raw_0009-0020"]()
    assert window.cameras == ("cam_left",) and len(window.clip.sweep_times_us("lidar")) <= 6
    depth_m = window.targets[5].true.depth_m
    assert depth_m.shape == (108, 357) and (depth_m > 0).mean() > 0.2
    assert 3 < np.median(depth_m[depth_m > 0]) < 30
    assert 0.01 < window.targets[5].movable.mean() < 0.5
    with pytest.raises(ReconstructError, match="give each once"):
        Protocol("storm", clips=(realdata / "kitti_raw_0009",) * 2).ids  # noqa: B018
    with pytest.raises(ReconstructError, match="needs 20 frames 0.1 s apart"):
        Protocol("storm", clips=(realdata / "ddad_6cam",)).ids  # noqa: B018
