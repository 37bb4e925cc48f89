"""ROS 2 bags written by ``mcap-ros2-support``: layouts, times of points, transforms, settings and damage."""

import dataclasses
import shutil
import sys

import numpy as np
import pytest
import tiny_clip
from ros_files import MOVING, bag_messages, camera_info, header, odometry, points, write_bag, write_mcap

from nurec_sim import logs
from nurec_sim.errors import ClipError
from nurec_sim.logs.readers import _ros_messages, _ros_sensors
from nurec_sim.logs.readers.ros_bag import RosBagReader
from nurec_sim.serving.store import content_key
from nurec_sim.types import Pinhole, Rig


@pytest.fixture(scope="module")
def ros():
    pytest.importorskip("mcap_ros2")


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """The tiny clip without its F-theta camera, which a CameraInfo cannot describe; exposures are instants."""
    whole = logs.open_clip(tiny_clip.write(tmp_path_factory.mktemp("tiny") / "tiny"))
    cameras = {name: camera for name, camera in whole.rig.cameras.items() if name != "wide"}
    images = {
        name: [dataclasses.replace(row, end_us=row.start_us) for row in whole.image_records(name)] for name in cameras
    }
    sweeps = {"top": whole.sweep_records("top")}
    return logs.Clip("tiny", Rig(cameras, whole.rig.lidars), whole.ego, images, sweeps, whole.source)


@pytest.fixture(scope="module")
def bag(ros, clip, tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("ros") / "tiny.mcap", clip)


def same(opened, clip, name="top_points", images=True):
    assert np.allclose(opened.ego.at(clip.ego.t_us), clip.ego.world_from_body, atol=1e-9)
    for camera in clip.rig.cameras:
        found, given = opened.rig.cameras[camera], clip.rig.cameras[camera]
        assert np.allclose(found.rig_from_camera, given.rig_from_camera, atol=1e-9)
        assert np.allclose(found.lens.radial, given.lens.radial) and np.isclose(found.lens.cx_px, given.lens.cx_px)
        assert np.array_equal(opened.camera_times_us(camera), clip.camera_times_us(camera))
        for index in range(clip.frame_count(camera)):
            assert np.array_equal(opened.image(camera, index), clip.image(camera, index))
    for index in range(clip.sweep_count("top")):
        sweep, given = opened.sweep(name, index), clip.sweep("top", index)
        # float32 points of 14 m err by a micrometre, interpolated poses by less than half a millimetre.
        assert np.abs(sweep.xyz_world_m - given.xyz_world_m).max() < 1e-3
        assert np.allclose(sweep.intensity, given.intensity, atol=1e-6)
        yield sweep, given


def test_an_mcap_file_gives_what_was_written(clip, bag):
    opened = logs.open_clip(bag)
    assert (opened.id, opened.format) == ("tiny", "ros2-bag")
    assert opened.facts["poses"] == "of 'base_link' in 'map'"
    assert opened.rig.cameras["front"].lens.thin_prism == (0.001, 0, 0, 0)
    for sweep, given in same(opened, clip):
        assert (sweep.start_us, sweep.end_us) == (given.start_us, given.end_us)
        assert np.array_equal(sweep.point_t_us, given.point_t_us)


@pytest.mark.parametrize("times", ["time", "timestamp", "offset_time"])
def test_times_of_points_in_other_conventions(ros, clip, tmp_path, times):
    for sweep, given in same(logs.open_clip(write_bag(tmp_path / "a.mcap", clip, times)), clip):
        assert np.abs(sweep.point_t_us - given.point_t_us).max() <= 1


def test_points_without_times_belong_to_the_message(ros, clip, tmp_path):
    for sweep, given in same(logs.open_clip(write_bag(tmp_path / "a.mcap", clip, "")), clip):
        assert sweep.start_us == sweep.end_us == given.end_us


@pytest.mark.parametrize("name, raw", [("folder", True), ("old.db3", False)])
def test_folders_and_databases_give_the_same(ros, clip, tmp_path, name, raw):
    path = write_bag(tmp_path / name, clip, raw=raw)
    assert len(list(same(logs.open_clip(path), clip))) == 3


def test_the_reader_keeps_the_contract(bag):
    assert logs.check_reader(bag, RosBagReader()) == []


def settings_of(bag, tmp_path, text):
    file = tmp_path / "drive.yaml"
    file.write_text(f"bag: {bag}\n{text}")
    return file


def test_settings_name_topics_frames_and_calibration(clip, bag, tmp_path):
    text = """
world: odom
ground_z_m: -0.3
cameras:
  nose:
    topic: /front/image_raw/compressed
    lens: {model: fisheye, fx_px: 30, fy_px: 30, cx_px: 32, cy_px: 24}
    width: 64
    height: 48
    T_base_sensor: [[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.4], [0, 0, 0, 1]]
    shutter: top_to_bottom
    readout_us: 20000
lidars:
  roof: {topic: /top/points, beams: VLP-16, time: {field: t, unit: ns}, intensity_scale: 510}
"""
    opened = logs.open_clip(settings_of(bag, tmp_path, text))
    nose, roof = opened.rig.cameras["nose"], opened.rig.lidars["roof"]
    assert (
        list(opened.rig.cameras) == ["nose"] and nose.lens.kind == "fisheye" and nose.shutter.value == "top_to_bottom"
    )
    # The rig frame lies 0.3 m below the base frame.
    assert np.allclose(nose.rig_from_camera[:3, 3], [1.5, 0, 1.7])
    assert len(roof.elevation_rad) == 16 and np.isclose(roof.rig_from_lidar[2, 3], 1.8 + 0.3)
    assert np.isclose(opened.ego.world_from_body[0, 2, 3], 0.01 - 0.5 - 0.3)
    assert (np.diff(opened.camera_times_us("nose"), axis=1) == 20_000).all()
    assert np.isclose(opened.sweep("roof", 0).intensity.max(), 0.5)


def test_a_cached_scene_depends_on_the_bag_and_on_its_settings(bag, tmp_path):
    copy = tmp_path / f"own{bag.suffix}"
    shutil.copy(bag, copy)
    beside, file = content_key(copy, "lift"), settings_of(copy, tmp_path, "")
    named = content_key(file, "lift")
    copy.with_suffix(".yaml").write_text("world: odom\n")
    assert content_key(copy, "lift") != beside
    with copy.open("ab") as end:
        end.write(b"more")
    assert content_key(file, "lift") != named


@pytest.mark.parametrize(
    "text, error",
    [
        ("wrold: map", "drive.yaml: unknown key 'wrold'; known are .*'world'"),
        ("cameras: {a: {topic: /top/points}}", r"topic '/top/points' of 'a' holds sensor_msgs/msg/PointCloud2"),
        ("cameras: {a: {topic: /x}}", r"topic '/x' of 'a' is not in the bag.*/front/image_raw/compressed"),
        ("lidars: {a: {topic: /top/points, beams: HDL}}", "beams 'HDL' is unknown; known are .*HDL-64"),
        ("lidars: {a: {topic: /top/points, time: {field: q}}}", "no field 'q'; have .*intensity"),
        ("lidars: {a: {topic: /top/points, time: {unit: s}}}", "no times of a sweep in s; name its field and unit"),
        ("lidars: {a: {topic: /top/points, frame: roof}}", "no transforms lead from frame 'roof'.*T_base_sensor"),
        ("base: car", "there is no frame 'car', have .*'base_link'.*names the frame of the car under 'base'"),
        ("world: front_frame", "frame 'base_link' does not move in 'front_frame'; name the topic of its poses"),
        ("poses: /tf", "topic '/tf' holds no poses; topics with poses are"),
    ],
)
def test_wrong_settings_are_named(bag, tmp_path, text, error):
    with pytest.raises(ClipError, match=error):
        logs.open_clip(settings_of(bag, tmp_path, text))


def test_lenses_of_cameras_that_show_a_part_at_half_the_resolution(clip):
    info = camera_info(clip.rig.cameras["front"], header(1, "a"))
    info.binning_x = info.binning_y = 2
    info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height = 4, 2, 48, 40
    lens, width, height = _ros_sensors.lens_of("/info", info, rectified=False)
    assert (width, height, lens.fx_px, lens.cx_px, lens.cy_px) == (24, 20, 30.0, 14.25, 11.25)
    assert _ros_sensors.lens_of("/info", info, rectified=True)[0].radial == Pinhole(1, 1, 0, 0).radial
    with pytest.raises(ClipError, match="focal lengths of 0.0 and 61.0, it is not calibrated; give a lens"):
        info.k[0] = 0.0
        _ros_sensors.lens_of("/info", info, rectified=False)
    info.k[0], info.distortion_model = 60.0, "thin"
    with pytest.raises(ClipError, match="/info: distortion model 'thin' is unknown; known are plumb_bob"):
        _ros_sensors.lens_of("/info", info, rectified=False)


@pytest.mark.parametrize(
    "encoding, data, rgb",
    [
        ("rgb8", [1, 2, 3], [1, 2, 3]),
        ("bgra8", [3, 2, 1, 9], [1, 2, 3]),
        ("mono8", [7], [7, 7, 7]),
    ],
)
def test_encodings_of_raw_images(encoding, data, rgb):
    message = type("Image", (), {})()
    message.encoding, message.height, message.width, message.step = encoding, 2, 2, 2 * len(data)
    message.data = bytes(data * 4)
    assert _ros_sensors.picture(message).tolist() == [[rgb] * 2] * 2
    message.step = 1
    with pytest.raises(ClipError, match="does not fit its"):
        _ros_sensors.picture(message)


def test_clouds_that_do_not_fit_are_refused(clip):
    _, message = points(clip, "top", 0, "t")
    message.data = message.data[:-4]
    with pytest.raises(ClipError, match="do not fit"):
        _ros_sensors.cloud(message)
    message.fields = message.fields[1:]
    with pytest.raises(ClipError, match="needs the fields x, y and z once, got"):
        _ros_sensors.cloud(message)


def test_damaged_bags_say_what_to_do(bag, tmp_path):
    (tmp_path / "cut.mcap").write_bytes(bag.read_bytes()[:-500])
    with pytest.raises(ClipError, match="cut.mcap.*'mcap recover'"):
        logs.open_clip(tmp_path / "cut.mcap")
    (tmp_path / "no.db3").write_bytes(b"no database" * 100)
    with pytest.raises(ClipError, match="no.db3 is damaged: DatabaseError"):
        logs.open_clip(tmp_path / "no.db3")


def test_without_the_package_the_extra_is_named(tmp_path, monkeypatch):
    (tmp_path / "a.mcap").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "mcap.reader", None)
    with pytest.raises(ClipError, match=r"a ROS 2 bag needs the extra 'ros': pip install 'nurec-sim\[ros\]'"):
        logs.open_clip(tmp_path / "a.mcap")


def test_odometry_gives_poses_where_there_are_no_transforms(ros, clip, tmp_path):
    rows = [row for row in bag_messages(clip, "t", False, np.asarray) if row[0] != MOVING]
    path = tmp_path / "a.mcap"
    write_mcap(path, [*rows, *odometry(clip)])
    opened = logs.open_clip(path)
    assert opened.facts["poses"] == "of 'base_link' in 'odom'"
    assert len(list(same(opened, clip))) == 3


def test_clouds_in_the_frame_of_the_map_are_no_lidars(ros, clip, tmp_path):
    rows = list(bag_messages(clip, "t", False, np.asarray))
    t_us, cloud = points(clip, "top", 0, "")
    cloud.header.frame_id = "map"
    path = tmp_path / "a.mcap"
    write_mcap(path, [*rows, ("/obstacles", _ros_messages.POINTS, cloud, t_us * 1000)])
    assert list(logs.open_clip(path).rig.lidars) == ["top_points"]


def test_headers_are_read_from_the_first_bytes():
    data = bytes([0, 1, 0, 0]) + np.array([5, 7, 2], "<u4").tobytes() + b"a\0"
    assert _ros_messages.header(data) == (5_000_000_007, "a")
    assert _ros_messages.header(bytes([0, 0, 0, 0]) + np.array([5, 7, 2], ">u4").tobytes() + b"a") == (
        5_000_000_007,
        "a",
    )
    for wrong, text in ((data[:-2], "its frame id is cut off"), (data[:4] + bytes(8) + data[12:], "its time is 0")):
        with pytest.raises(ClipError, match=text):
            _ros_messages.header(wrong)
