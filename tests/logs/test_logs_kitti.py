"""KITTI raw and odometry in their published layouts: the demo log written so, and the real drive of a pack."""

import shutil
from pathlib import Path

import numpy as np
import published_logs as published
import pytest
from scipy.spatial.transform import Rotation

from nurec_sim import geometry, logs
from nurec_sim.errors import ClipError
from nurec_sim.logs.checks.calibration import check_calibration
from nurec_sim.logs.checks.sampling import sample_sweeps
from nurec_sim.logs.readers import kitti_raw
from nurec_sim.logs.readers.kitti_odometry import KittiOdometryReader
from nurec_sim.logs.readers.kitti_raw import KittiRawReader
from nurec_sim.serving.store import content_key

FRONT, LIDAR = "camera_front", published.LIDAR


@pytest.fixture(scope="module")
def demo() -> logs.Clip:
    return published.demo()


@pytest.fixture(scope="module")
def root(demo, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("kitti")
    published.kitti_raw(folder, demo)
    published.kitti_odometry(folder / "odometry", demo)
    return folder


@pytest.fixture
def drive(root, tmp_path) -> Path:
    """A copy that may be spoilt."""
    shutil.copytree(root / published.DAY, tmp_path / published.DAY)
    return tmp_path / published.DAY / published.DRIVE


def test_a_drive_keeps_the_contract(root):
    assert logs.check_reader(root / published.DAY / published.DRIVE, KittiRawReader()) == []


def test_a_drive_is_what_was_recorded(root, demo):
    clip = logs.open_clip(root / published.DAY / published.DRIVE)
    assert (clip.id, clip.format) == (published.DRIVE, "kitti-raw")
    camera, given = clip.rig.cameras["image_02"], demo.rig.cameras[FRONT]
    for name in ("fx_px", "fy_px", "cx_px", "cy_px"):
        assert getattr(camera.lens, name) == pytest.approx(getattr(given.lens, name))
    assert (camera.width_px, camera.height_px) == (given.width_px, given.height_px)
    assert np.allclose(camera.rig_from_camera, given.rig_from_camera, atol=1e-9)
    assert np.allclose(clip.rig.lidars["velodyne"].rig_from_lidar, demo.rig.lidars[LIDAR].rig_from_lidar, atol=1e-9)
    # Its images and sweeps have the same times, so that poses at either are the same.
    for number, index in enumerate(published.INDICES):
        step = (
            geometry.inverse(clip.world_from_camera("image_02", 0)[0]) @ clip.world_from_camera("image_02", number)[0]
        )
        wanted = geometry.inverse(demo.world_from_camera(FRONT, published.INDICES[0])[0])
        assert np.allclose(step, wanted @ demo.world_from_camera(FRONT, index)[0], atol=0.02)
    wanted = demo.camera_times_us(FRONT)[list(published.INDICES)] + published.EPOCH_US
    assert clip.camera_times_us("image_02").tolist() == wanted.tolist()
    assert (clip.image("image_02", 3) == demo.image(FRONT, published.INDICES[3])).all()
    swept = [index for number, index in enumerate(published.INDICES) if number != 1]
    assert clip.sweep_times_us("velodyne").tolist() == (demo.sweep_times_us(LIDAR)[swept] + published.EPOCH_US).tolist()
    # Points as measured, moved by the car's motion, are the compensated ones; poses come 1.2 s apart at the end only.
    sweep, same = clip.sweep("velodyne", 1), demo.sweep(LIDAR, swept[1])
    assert np.quantile(np.linalg.norm(sweep.xyz_m - same.xyz_m, axis=1), 0.99) < 0.03
    assert np.allclose(sweep.intensity, same.intensity, atol=1e-6)


def test_poses_are_those_of_the_gps_in_metres_around_the_first(root, demo):
    clip = logs.open_clip(root)
    t_us = np.array([demo.sweep_records(LIDAR)[index].t_us + 7_000 for index in published.INDICES])
    wanted = demo.ego.at(t_us)
    given = clip.ego.at(t_us + published.EPOCH_US)
    assert np.allclose(given[0, :2, 3], [-0.05 * -1, -0.32], atol=1e-3)  # the GPS/IMU unit itself starts at the origin
    assert np.allclose(geometry.inverse(given[0]) @ given, geometry.inverse(wanted[0]) @ wanted, atol=2e-3)


def test_rotations_are_yaw_after_pitch_after_roll():
    roll, pitch, yaw = np.array([0.1, -0.3]), np.array([0.2, 0.05]), np.array([0.7, -2.0])
    wanted = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1)).as_matrix()
    assert np.allclose(kitti_raw._rotations(roll, pitch, yaw), wanted)


def test_tracklets_become_tracks(root, demo):
    tracks = logs.open_clip(root).tracks
    assert [(each.label, each.size_m) for each in tracks] == [(each.label, each.size_m) for each in demo.tracks]
    world = demo.ego.at(demo.sweep_records(LIDAR)[12].t_us)
    clip = logs.open_clip(root)
    here = clip.ego.at(demo.sweep_records(LIDAR)[12].t_us + published.EPOCH_US)
    for track, given in zip(tracks, demo.tracks, strict=True):
        # The second frame, which is the first of the tracklets, has no sweep and so no pose.
        assert track.path.t_us.tolist() == [
            demo.sweep_records(LIDAR)[index].t_us + published.EPOCH_US for index in published.INDICES[2:]
        ]
        relative = geometry.inverse(here) @ track.path.world_from_body[1]
        wanted = geometry.inverse(world) @ given.path.at(demo.sweep_records(LIDAR)[12].t_us)
        assert np.allclose(relative, wanted, atol=1e-6)


def test_inverted_extrinsics_are_found(demo, tmp_path):
    clip = logs.open_clip(published.kitti_raw(tmp_path, demo, invert=True))
    (row,) = check_calibration(clip, sample_sweeps(clip)[1:3])
    assert len(row.faults) == 1 and "camera 'image_02'" in row.faults[0]


def test_a_folder_above_one_drive_is_enough_and_several_are_named(drive):
    day = drive.parent
    assert {logs.open_clip(path).id for path in (day, day.parent)} == {published.DRIVE}
    (day / "2011_09_26_drive_0043_sync").mkdir()
    with pytest.raises(
        ClipError, match=r"holds 2 drives of KITTI raw; give the folder of one: .*0042_sync', .*0043_sync"
    ):
        logs.open_clip(day)


def test_a_cached_scene_depends_on_the_files_beside_a_log(drive, root, tmp_path):
    keys = {content_key(drive, "lift")}
    for name in (kitti_raw.CAM_TO_CAM, kitti_raw.VELO_TO_CAM, kitti_raw.IMU_TO_VELO):
        (drive.parent / name).write_text((drive.parent / name).read_text() + "\n")
        keys.add(content_key(drive, "lift"))
    (drive.parent / "notes.txt").write_text("not of the drive")
    keys.add(content_key(drive, "lift"))
    assert len(keys) == 4
    shutil.copytree(root / "odometry", tmp_path / "odometry")
    sequence = tmp_path / "odometry" / "sequences" / "07"
    before = content_key(sequence, "lift")
    (tmp_path / "odometry" / "poses" / "07.txt").write_text("1 0 0\n")
    assert content_key(sequence, "lift") != before


def test_grey_cameras_stand_in_where_there_is_no_colour(drive):
    shutil.copytree(drive / "image_02", drive / "image_00")
    assert list(logs.open_clip(drive).rig.cameras) == ["image_02"]
    shutil.rmtree(drive / "image_02")
    calibration = drive.parent / "calib_cam_to_cam.txt"
    calibration.write_text(calibration.read_text().replace("_02:", "_00:", 3).replace("R_rect_00", "R_rect_00", 1))
    assert list(logs.open_clip(drive).rig.cameras) == ["image_00"]


@pytest.mark.parametrize(
    "file, change, text",
    [
        ("../calib_cam_to_cam.txt", None, "2011_09_26: file calib_cam_to_cam.txt is missing"),
        ("../calib_cam_to_cam.txt", lambda t: t.replace("P_rect_02", "P_rect_09"), "'P_rect_02' is missing; have "),
        ("../calib_velo_to_cam.txt", lambda t: t.replace("R: ", "R: 2 "), "'R' must have 9 numbers, got 10"),
        ("../calib_velo_to_cam.txt", lambda t: t.replace("e-01", "e-02"), "calib_velo_to_cam.txt: R is not a rotation"),
        ("../calib_imu_to_velo.txt", lambda t: "\xff\n", "calib_imu_to_velo.txt: must be plain text"),
        ("oxts/timestamps.txt", lambda t: t.replace("2011", "yesterday", 1), "timestamps.txt line 1: must be a time"),
        ("oxts/data/0000000002.txt", lambda t: "49 8 nan", "0000000002.txt: must begin with latitude, longitude"),
        ("image_02/timestamps.txt", lambda t: t[:90], "image_02/data/0000000003.png: has no time: .* have 3 lines"),
        ("velodyne_points/timestamps_end.txt", lambda t: t.replace("2011", "2010"), "needs start <= time <= end, got"),
        ("tracklet_labels.xml", lambda t: t[:400], "tracklet_labels.xml: is not a readable XML file"),
        ("tracklet_labels.xml", lambda t: t.replace("<h>", "<h>-", 1), "tracklet 0: h, w, l must be positive"),
        ("tracklet_labels.xml", lambda t: t.replace("<tx>", "<tx>x"), "<tx> must be a finite number, got 'x"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(drive, file, change, text):
    path = drive / file
    if change is None:
        path.unlink()
    else:
        path.write_text(change(path.read_text()), encoding="latin-1")
    with pytest.raises(ClipError, match=text):
        logs.open_clip(drive)


def test_a_sweep_that_is_cut_short_and_one_without_numbers_are_named(drive):
    file = drive / "velodyne_points/data/0000000002.bin"
    file.write_bytes(file.read_bytes()[:-3])
    clip = logs.open_clip(drive)
    with pytest.raises(ClipError, match=r"0000000002.bin must hold 16 bytes for each point, got \d+ bytes"):
        clip.sweep("velodyne", 1)
    file.write_bytes(np.full((4, 4), np.nan, np.float32).tobytes())
    with pytest.raises(ClipError, match="points must be finite"):
        clip.sweep("velodyne", 1)


def test_a_sequence_of_the_odometry_benchmark(root, demo):
    path = root / "odometry" / "sequences" / "07"
    assert logs.check_reader(path, KittiOdometryReader()) == []
    clip = logs.open_clip(root / "odometry")
    assert (clip.id, clip.time_offset_us) == ("kitti_odometry_07", 1_000_000)
    t_us = np.array([demo.sweep_records(LIDAR)[index].t_us for index in published.INDICES])
    assert (clip.ego.t_us - 1_000_000).tolist() == (t_us - t_us[0]).tolist()
    lidar = clip.ego.world_from_body @ clip.rig.lidars["velodyne"].rig_from_lidar
    wanted = demo.ego.at(t_us) @ demo.rig.lidars[LIDAR].rig_from_lidar
    assert np.allclose(geometry.inverse(lidar[0]) @ lidar, geometry.inverse(wanted[0]) @ wanted, atol=1e-6)
    assert np.allclose(clip.sweep("velodyne", 2).xyz_m, demo.sweep(LIDAR, published.INDICES[2]).xyz_m, atol=1e-5)


@pytest.mark.parametrize(
    "file, content, text",
    [
        ("poses/07.txt", None, "poses/07.txt is missing: the benchmark publishes poses for the sequences 00 to 10"),
        ("poses/07.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", "poses/07.txt has 1 poses for 5 times"),
        ("poses/07.txt", "1 0 0\n", "poses/07.txt line 1: must have 12 numbers, got '1 0 0'"),
        ("sequences/07/times.txt", "0\n0\n1\n2\n3\n", "times.txt: time goes back or stands still"),
        ("sequences/07/calib.txt", "P2: 1 2 3\n", "'Tr' is missing; have .'P2'"),
        ("sequences/07/image_2/000009.png", "", "000009.png: has no time: there are 5"),
    ],
)
def test_what_is_wrong_with_a_sequence_is_named(root, tmp_path, file, content, text):
    shutil.copytree(root / "odometry", tmp_path / "odometry")
    path = tmp_path / "odometry" / file
    path.unlink() if content is None else path.write_text(content)
    with pytest.raises(ClipError, match=text):
        logs.open_clip(tmp_path / "odometry")


@pytest.mark.realdata
def test_a_published_drive_is_that_of_the_pack(rawlogs, realdata):
    clip = logs.open_clip(rawlogs / "kitti_raw" / "2011_09_26" / "2011_09_26_drive_0002_sync")
    pack = logs.open_clip(realdata / "kitti_raw_0002")
    shift = clip.rig_from_log @ geometry.inverse(pack.rig_from_log)  # both rigs are given by the GPS/IMU unit
    for name, other in (("image_02", "cam_left"), ("image_03", "cam_right")):
        ours, theirs = clip.rig.cameras[name], pack.rig.cameras[other]
        assert np.allclose(ours.rig_from_camera, shift @ theirs.rig_from_camera, atol=2e-6)
        assert ours.lens == theirs.lens and (ours.width_px, ours.height_px) == (theirs.width_px, theirs.height_px)
        # Offsets between stamps and poses follow from the poses, which differ; the stamps are the same.
        assert np.abs(clip.camera_times_us(name) - pack.camera_times_us(other)).max() <= 10
        difference = clip.image(name, 4).astype(float) - pack.image(other, 4)
        assert 10 * np.log10(255**2 / np.mean(difference**2)) > 37  # the pack has JPEGs of 37.8 dB
    assert np.abs(clip.sweep_times_us("velodyne") - pack.sweep_times_us("lidar")).max() <= 1
    ours, theirs = clip.source.sweep("velodyne", 3), pack.source.sweep("lidar", 3)
    assert np.allclose(ours.xyz_m, theirs.xyz_m, atol=1e-6) and np.allclose(ours.intensity, theirs.intensity, atol=0.01)
    # Images were triggered by the LiDAR: the camera is where it was at the time of the sweep, not at the later stamp.
    record, sweep = clip.image_records("image_02")[3], clip.sweep_records("velodyne")[3]
    assert record.start_us - sweep.t_us == pytest.approx(0, abs=200)
    assert clip.facts["times_of_image_02"].startswith("are those of its poses, 10.5 ms before its stamps")
    lidar_from_camera = geometry.inverse(sweep.world_from_lidar) @ record.world_from_camera[0]
    camera, lidar = clip.rig.cameras["image_02"], clip.rig.lidars["velodyne"]
    assert np.allclose(lidar_from_camera, geometry.inverse(lidar.rig_from_lidar) @ camera.rig_from_camera, atol=1e-9)
    # The pack's poses are LiDAR odometry, ours GPS/IMU at 9 m/s.
    t_us = pack.ego.t_us
    steps = [geometry.inverse(poses[:-1]) @ poses[1:] for poses in (clip.ego.at(t_us) @ shift, pack.ego.at(t_us))]
    assert np.abs(steps[0][:, :3, 3] - steps[1][:, :3, 3]).max() < 0.1
    assert np.abs(steps[0][:, :3, :3] - steps[1][:, :3, :3]).max() < 0.005
