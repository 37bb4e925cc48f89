"""Sensors and poses <-> messages: exact there and back, and clear about what is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from serving_world import camera_request, lidar_request, rig, scene

from nurec_sim import geometry
from nurec_sim.errors import RequestError
from nurec_sim.sensors import lidar_model
from nurec_sim.serving import wire
from nurec_sim.serving.wire import common, sensorsim
from nurec_sim.serving.wire.requests import read_poses, write_poses
from nurec_sim.types import (
    CameraModel,
    Fisheye,
    FTheta,
    FThetaReference,
    LidarFilter,
    Pinhole,
    Shutter,
    Trajectory,
    Windshield,
    WindshieldReference,
)  # fmt: skip

POSE = geometry.pose(geometry.matrix_from_quat(np.array([0.5, 0.1, -0.7, 0.2])), np.array([1234.567891, -0.1, 3e-7]))


def small(low: float, high: float):
    return st.floats(low, high, allow_nan=False)


def numbers(count: int, size: float = 0.01):
    return st.tuples(*[small(-size, size)] * count)


poses = st.builds(
    lambda quat, xyz: geometry.pose(geometry.matrix_from_quat(np.array(quat)), np.array(xyz)),
    st.tuples(*[small(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    st.tuples(*[small(-1e6, 1e6)] * 3),
)


def there_and_back(pose, *, keep_exact: bool):
    message = common.Pose()
    write_poses(pose[None], [message])
    if not keep_exact:
        message.ClearField("exact")
    received = common.Pose.FromString(message.SerializeToString())
    return read_poses([received], ["p"])[0]


@given(poses)
def test_our_poses_travel_bit_for_bit(pose):
    assert np.array_equal(there_and_back(pose, keep_exact=True), pose)


@given(poses)
def test_other_clients_poses_travel_as_float32(pose):
    back = there_and_back(pose, keep_exact=False)
    np.testing.assert_allclose(back[:3, :3], pose[:3, :3], atol=1e-6)
    np.testing.assert_allclose(back[:3, 3], pose[:3, 3], rtol=1e-7, atol=1e-30)
    assert geometry.is_rotation(back[:3, :3], 1e-12)


def test_the_quaternion_is_wxyz_of_the_pose_of_b_in_a():
    message = common.Pose()
    write_poses(geometry.pose_from_xyyaw(1, 2, np.pi / 2, 3)[None], [message])
    assert (message.vec.x, message.vec.y, message.vec.z) == (1, 2, 3)
    assert message.quat.w == pytest.approx(np.sqrt(0.5)) and message.quat.z == pytest.approx(np.sqrt(0.5))
    assert message.quat.x == message.quat.y == 0


def test_a_stale_exact_rotation_is_ignored_however_far_away():
    message = common.Pose()
    write_poses(geometry.pose_from_xyyaw(1e6, 0, 0.2)[None], [message])
    message.quat.w, message.quat.z = np.cos(0.15), np.sin(0.15)
    assert geometry.yaw_of(read_poses([message], ["p"])[0]) == pytest.approx(0.3)


def test_a_stale_exact_pose_is_ignored():
    message = common.Pose()
    write_poses(POSE[None], [message])
    message.vec.x += 0.5
    assert read_poses([message], ["p"])[0, 0, 3] == pytest.approx(1235.067891, abs=1e-3)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda m: setattr(m.vec, "y", float("nan")), r"sensor_pose.start_pose must be finite, got vec \(x, y, z\) ="),
        (lambda m: setattr(m.vec, "y", float("inf")), "must be finite"),
        (lambda m: setattr(m.quat, "w", 1.2), "must have a unit quaternion .* got squared norm 2"),
        (lambda m: m.ClearField("quat"), "got squared norm 0"),
        (lambda m: m.exact.pop(), "exact must have 16 values .* got 15"),
        (lambda m: m.exact.__setitem__(0, 7.0), "exact must be a rigid transform"),
        (lambda m: m.exact.__setitem__(12, 1.0), "with last row 0 0 0 1"),
        (lambda m: m.exact.__setitem__(3, float("nan")), "exact must be a rigid transform"),
    ],
)
def test_a_bad_pose_is_named(change, text):
    message = common.Pose()
    write_poses(POSE[None], [message])
    change(message)
    with pytest.raises(RequestError, match=text):
        read_poses([message], ["sensor_pose.start_pose"])


# ------------------------------------------------------------------------------------------------------------- cameras

lenses = st.one_of(
    st.builds(
        Pinhole, small(200, 400), small(200, 400), small(150, 170), small(80, 100), numbers(6), numbers(2), numbers(4)
    ),
    st.builds(
        Fisheye, small(90, 120), small(90, 120), small(150, 170), small(80, 100), numbers(4), small(0.5, 1.4)
    ),
    st.builds(
        lambda cx, cy, k, cde, angle: FTheta(
            cx, cy, FThetaReference.ANGLE_TO_PIXELDIST, (), (0.0, 110.0, *k), angle, (1 + cde[0], *cde[1:])
        ),
        small(150, 170), small(80, 100), numbers(3), numbers(3), small(0.5, 1.4),
    ),
)  # fmt: skip
windshields = st.one_of(
    st.none(),
    st.builds(
        lambda k: Windshield(
            WindshieldReference.FORWARD, (k, 1.0, 0.0, 0.0, 0.0, 0.0), (k, 0.0, 0.0, 1.0, 0.0, 0.0),
            (-k, 1.0, 0.0, 0.0, 0.0, 0.0), (-k, 0.0, 0.0, 1.0, 0.0, 0.0),
        ),
        small(-0.01, 0.01),
    ),
)  # fmt: skip


@settings(deadline=None)
@given(lenses, st.sampled_from(Shutter), windshields)
def test_cameras_travel_bit_for_bit(lens, shutter, windshield):
    camera = CameraModel("cam", 320, 180, lens, np.eye(4), shutter, windshield)
    message = sensorsim.CameraSpec()
    wire.write_camera(camera, message)
    back = wire.read_camera(sensorsim.CameraSpec.FromString(message.SerializeToString()), 320, 180, {})
    assert replace(back, rig_from_camera=None).__dict__ == replace(camera, rig_from_camera=None).__dict__


def test_only_ftheta_principal_points_count_pixel_centres_as_whole_numbers():
    for camera_id, shift in (("front", 0.0), ("fish", 0.0), ("wide", 0.5)):
        camera, message = rig().cameras[camera_id], sensorsim.CameraSpec()
        wire.write_camera(camera, message)
        param = getattr(message, message.WhichOneof("camera_param"))
        assert param.principal_point_x == camera.lens.cx_px - shift
        assert param.principal_point_y == camera.lens.cy_px - shift


def spec(camera_id: str = "front"):
    message = sensorsim.CameraSpec()
    wire.write_camera(rig().cameras[camera_id], message)
    return message


@pytest.mark.parametrize(
    ("asked", "got"),
    [((320, 180), (320, 180)), ((0, 0), (320, 180)), ((1, 90), (160, 90)), ((0, 101), (179, 101)), ((64, 0), (64, 36)),
     ((200, 180), (200, 180))],
)  # fmt: skip
def test_a_size_that_is_left_open_follows_from_the_aspect(asked, got):
    camera = wire.read_camera(spec(), *asked, {})
    assert (camera.width_px, camera.height_px) == got


def test_another_size_keeps_the_field_of_view():
    camera = wire.read_camera(spec(), 160, 45, {})
    native = rig().cameras["front"].lens
    assert camera.lens.fx_px == pytest.approx(native.fx_px / 2) and camera.lens.cx_px == pytest.approx(native.cx_px / 2)
    assert camera.lens.fy_px == pytest.approx(native.fy_px / 4) and camera.lens.cy_px == pytest.approx(native.cy_px / 4)


def test_a_bare_logical_id_names_a_camera_of_the_scene():
    known = rig().cameras
    assert wire.read_camera(sensorsim.CameraSpec(logical_id="fish"), 0, 0, known) is known["fish"]
    with pytest.raises(RequestError, match=r"got no parameters and logical_id 'no', the scene has \['fish', 'front'"):
        wire.read_camera(sensorsim.CameraSpec(logical_id="no"), 0, 0, known)


def test_short_coefficient_lists_are_filled_with_zeros():
    message = spec()
    del message.opencv_pinhole_param.radial_coeffs[2:], message.opencv_pinhole_param.thin_prism_coeffs[:]
    assert wire.read_camera(message, 0, 0, {}).lens == rig().cameras["front"].lens


def test_an_ftheta_camera_with_one_polynomial_and_no_reference_is_read():
    message = spec("wide")
    message.ftheta_param.reference_poly = 0
    message.ftheta_param.ClearField("linear_cde")
    assert wire.read_camera(message, 0, 0, {}).lens == rig().cameras["wide"].lens


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda m: m.opencv_pinhole_param.radial_coeffs.extend([0.0]), "radial_coeffs has 7 values, at most 6"),
        (lambda m: setattr(m, "shutter_type", 9), r"shutter_type must be one of \['UNKNOWN', 'ROLLING.* got 9"),
        (lambda m: setattr(m.opencv_pinhole_param, "focal_length_x", float("nan")), "camera_intrinsics: "),
        (lambda m: setattr(m.opencv_pinhole_param, "focal_length_x", 0.0), "camera_intrinsics: "),
        (lambda m: m.ftheta_param.SetInParent(), "camera_intrinsics: "),
        (lambda m: setattr(m.ftheta_param, "reference_poly", 5), "reference_poly must be one of .* got 5"),
        (lambda m: m.bivariate_windshield_model_param.horizontal_poly.extend([1.0, 2.0]), "camera_intrinsics: "),
    ],
)
def test_a_bad_camera_is_explained(change, text):
    message = spec()
    change(message)
    with pytest.raises(RequestError, match=text):
        wire.read_camera(message, 0, 0, {})


def test_a_camera_without_any_size_is_refused():
    message = spec()
    message.resolution_w = message.resolution_h = 0
    with pytest.raises(RequestError, match="the image size is missing: camera_intrinsics has resolution 0x0"):
        wire.read_camera(message, 0, 0, {})
    assert wire.read_camera(message, 320, 180, {}).width_px == 320


# -------------------------------------------------------------------------------------------------------------- LiDARs


def test_lidars_travel_bit_for_bit():
    lidar, message = rig().lidars["roof"], sensorsim.LidarSpec()
    wire.write_lidar(lidar, message)
    back = wire.read_lidar(sensorsim.LidarSpec.FromString(message.SerializeToString()))
    for name in ("id", "spin", "frequency_hz", "range_m"):
        assert getattr(back, name) == getattr(lidar, name)
    for name in ("elevation_rad", "azimuth_rad", "row_azimuth_offset_rad"):
        assert np.array_equal(getattr(back, name), getattr(lidar, name))


@pytest.mark.parametrize(("number", "name"), [(0, "PANDAR128"), (1, "AT128")])
def test_device_types_are_our_tables(number, name):
    lidar, table = wire.read_lidar(sensorsim.LidarSpec(lidar_type=number)), lidar_model(name, np.eye(4))
    assert np.array_equal(lidar.elevation_rad, table.elevation_rad) and lidar.spin == table.spin
    assert np.array_equal(lidar.azimuth_rad, table.azimuth_rad)


def test_a_custom_lidar_may_leave_out_what_is_usual():
    message = sensorsim.LidarSpec()
    wire.write_lidar(rig().lidars["roof"], message)
    for name in ("row_azimuth_offset_rad", "frequency_hz", "max_range_m"):
        message.custom_model.ClearField(name)
    lidar = wire.read_lidar(message)
    assert not lidar.row_azimuth_offset_rad.any() and len(lidar.row_azimuth_offset_rad) == 16
    assert (lidar.frequency_hz, lidar.range_m) == (10.0, (0.5, 200.0))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda m: m.custom_model.ClearField("elevation_rad"), "custom_model: .* elevation_rad must be a list of at"),
        (lambda m: m.custom_model.row_azimuth_offset_rad.pop(), "16 rows but 15 row_azimuth_offset_rad"),
        (lambda m: m.custom_model.azimuth_rad.__setitem__(3, float("nan")), "azimuth_rad must be .* finite"),
        (lambda m: m.custom_model.elevation_rad.__setitem__(3, -20.0), "stay within .-pi/2, pi/2"),
        (lambda m: setattr(m.custom_model, "min_range_m", 300.0), "0 <= near < far"),
        (lambda m: setattr(m.custom_model, "frequency_hz", -1.0), "frequency_hz must be positive, got -1"),
        (lambda m: setattr(m.custom_model, "spin", 4), "spin must be one of"),
        (lambda m: (m.ClearField("custom_model"), setattr(m, "lidar_type", 8)), "lidar_type must be one of .* got 8"),
    ],
)
def test_a_bad_lidar_is_explained(change, text):
    message = sensorsim.LidarSpec()
    wire.write_lidar(rig().lidars["roof"], message)
    change(message)
    with pytest.raises(RequestError, match=text):
        wire.read_lidar(message)


# ------------------------------------------------------------------------------------------------ requests, tracks, ..


def test_camera_requests_travel_bit_for_bit():
    actors = {"car-1": np.stack([POSE, geometry.pose_from_xyyaw(1, 2, 3)])}
    request, message = camera_request("wide", actors=actors), sensorsim.RGBRenderRequest()
    wire.write_camera_request(replace(request, apply_isp=False), message, scene_id="s")
    received = sensorsim.RGBRenderRequest.FromString(message.SerializeToString())
    back, options = wire.read_camera_request(received, {})
    assert (back.scene_id, back.start_us, back.end_us) == ("s", request.start_us, request.end_us)
    assert np.array_equal(back.world_from_sensor, request.world_from_sensor)
    assert list(back.actors) == ["car-1"] and np.array_equal(back.actors["car-1"], actors["car-1"])
    assert back.sensor.lens == request.sensor.lens and back.sensor.id == "wide"
    assert not back.apply_isp and options == wire.ImageOptions(wire.ImageFormat.RGB_UINT8_PLANAR)


def test_lidar_requests_travel_bit_for_bit():
    request, message = lidar_request(), sensorsim.LidarRenderRequest()
    wire.write_lidar_request(request, message, scene_id="s")
    back, filter = wire.read_lidar_request(message)
    assert np.array_equal(back.world_from_sensor, request.world_from_sensor) and filter == LidarFilter()


@pytest.mark.parametrize(
    "fields, wanted",
    [
        ({"opacity_threshold": 0.25}, LidarFilter(opacity_threshold=0.25)),
        ({"opacity_threshold": 0.0, "raydrop_threshold": 1.0}, LidarFilter(raydrop_threshold=1, opacity_threshold=0)),
        ({"enable_distance_filter": True}, LidarFilter(distance_threshold_m=1.0)),
        ({"enable_distance_filter": True, "distance_filter_threshold": 0.5}, LidarFilter(distance_threshold_m=0.5)),
        ({"distance_filter_threshold": 0.5}, LidarFilter()),
        ({"enable_distance_filter": False, "distance_filter_threshold": 0.5}, LidarFilter()),
    ],
)
def test_lidar_filters(fields, wanted):
    message = sensorsim.LidarRenderRequest(render_filter=fields)
    wire.write_lidar_request(lidar_request(), message, scene_id="s")
    assert wire.read_lidar_request(message)[1] == wanted


@pytest.mark.parametrize(
    "fields, text",
    [
        ({"opacity_threshold": 1.5}, r"render_filter: opacity_threshold must lie in 0\.\.1, got 1\.5"),
        ({"raydrop_threshold": float("nan")}, r"render_filter: raydrop_threshold must lie in 0\.\.1, got nan"),
        ({"distance_filter_threshold": -1.0}, r"distance_filter_threshold must be finite and not negative, .*got -1"),
        ({"distance_filter_threshold": float("inf")}, "distance_filter_threshold must be finite and not negative"),
    ],
)
def test_lidar_filters_out_of_range(fields, text):
    message = sensorsim.LidarRenderRequest(render_filter=fields)
    wire.write_lidar_request(lidar_request(), message, scene_id="s")
    with pytest.raises(RequestError, match=text):
        wire.read_lidar_request(message)


def test_an_actor_listed_twice_is_drawn_at_its_last_pose():
    message = sensorsim.RGBRenderRequest()
    wire.write_camera_request(camera_request(), message, scene_id="s")
    for x in (1.0, 2.0):
        pair = message.dynamic_objects.add(track_id="car-1").pose_pair
        write_poses(np.tile(geometry.pose_from_xyyaw(x, 0, 0), (2, 1, 1)), [pair.start_pose, pair.end_pose])
    actors = wire.read_camera_request(message, {})[0].actors
    assert list(actors) == ["car-1"] and actors["car-1"][0, 0, 3] == 2.0


def test_trajectories_and_tracks_travel():
    world = scene()
    message = common.Trajectory()
    wire.write_trajectory(world.ego, message)
    back = wire.read_trajectory(message, "ego")
    assert np.array_equal(back.t_us, world.ego.t_us)
    assert np.array_equal(back.world_from_body, world.ego.world_from_body)
    for track in world.tracks:
        message = sensorsim.DynamicObjectTrack()
        wire.write_track(track, message)
        back = wire.read_track(message)
        assert (back.id, back.label) == (track.id, track.label)
        assert back.size_m == pytest.approx(track.size_m)
        assert np.array_equal(back.path.world_from_body, track.path.world_from_body)


def test_a_trajectory_that_goes_back_in_time_is_refused():
    message = common.Trajectory()
    wire.write_trajectory(Trajectory(np.array([1, 2]), np.tile(np.eye(4), (2, 1, 1))), message)
    message.poses[1].timestamp_us = 1
    with pytest.raises(RequestError, match="ego: trajectory times must increase strictly"):
        wire.read_trajectory(message, "ego")
    with pytest.raises(RequestError, match="t >= 1"):
        wire.read_trajectory(common.Trajectory(), "ego")
