"""The wire contract: numbers of the public interface, compiled descriptors, and life beside other generated code."""

import re
import shutil

import pytest
from generated_code import PROTOS, generate_like_alpasim, protoc

from nurec_sim.serving import wire
from nurec_sim.serving.wire import messages

# Facts of the public NuRec and AlpaSim interfaces; nested names with dots.
NUMBERS = {
    "common.Quat": "w1 x2 y3 z4",
    "common.Pose": "vec1 quat2",
    "common.PoseAtTime": "pose1 timestamp_us2",
    "common.Trajectory": "poses1",
    "common.AABB": "size_x1 size_y2 size_z3",
    "common.DynamicState": "angular_velocity1 linear_velocity2 linear_acceleration3 angular_acceleration4",
    "common.VersionId": "version_id1 git_hash2 grpc_api_version3",
    "common.AvailableScenesReturn": "scene_ids1",
    "nre.grpc.protos.sensorsim.RGBRenderRequest": "scene_id1 resolution_h2 resolution_w3 camera_intrinsics4 "
    "frame_start_us5 frame_end_us6 sensor_pose7 dynamic_objects8 image_format9 image_quality10 insert_ego_mask11 "
    "ego_mask_id12",
    "nre.grpc.protos.sensorsim.CameraSpec": "temporary_camera_spec1 ftheta_param2 opencv_pinhole_param3 "
    "opencv_fisheye_param4 logical_id5 resolution_h7 resolution_w8 shutter_type9 bivariate_windshield_model_param10",
    "nre.grpc.protos.sensorsim.FthetaCameraParam": "principal_point_x1 principal_point_y2 reference_poly3 "
    "pixeldist_to_angle_poly4 angle_to_pixeldist_poly5 max_angle6 linear_cde7",
    "nre.grpc.protos.sensorsim.OpenCVPinholeCameraParam": "principal_point_x1 principal_point_y2 focal_length_x3 "
    "focal_length_y4 radial_coeffs5 tangential_coeffs6 thin_prism_coeffs7",
    "nre.grpc.protos.sensorsim.OpenCVFisheyeCameraParam": "principal_point_x1 principal_point_y2 focal_length_x3 "
    "focal_length_y4 radial_coeffs5 max_angle6",
    "nre.grpc.protos.sensorsim.BivariateWindshieldModelParameters": "reference_poly1 horizontal_poly2 "
    "vertical_poly3 horizontal_poly_inverse4 vertical_poly_inverse5",
    "nre.grpc.protos.sensorsim.AvailableCamerasReturn.AvailableCamera": "intrinsics1 rig_to_camera2 logical_id3",
    "nre.grpc.protos.sensorsim.AvailableTrajectoriesReturn.AvailableTrajectory": "trajectory2",
    "nre.grpc.protos.sensorsim.LidarSpec": "lidar_type2",
    "nre.grpc.protos.sensorsim.LidarRenderRequest": "scene_id1 lidar_config2 frame_start_us3 frame_end_us4 "
    "sensor_pose5 dynamic_objects6 render_filter7",
    "nre.grpc.protos.sensorsim.LidarRenderReturn": "point_xyzs1 point_intensities2 num_points3 point_xyzs_buffer4 "
    "point_intensities_buffer5",
    "nre.grpc.protos.sensorsim.BatchRGBRenderRequestItem": "camera_name1 request2",
    "nre.grpc.protos.sensorsim.BatchRGBRenderReturnItem": "camera_name1 result2 success3 error_message4",
    "nre.grpc.protos.sensorsim.AggregatedRenderReturn": "rgb_returns1 lidar_returns2 driver_data3",
    "nre.grpc.protos.sensorsim.LoadedScenesReturn": "scenes1 loaded_instance_capacity2",
    "nre.grpc.protos.sensorsim.DynamicObjectTrack": "id1 semantic_class2 trajectory3 object_size4 asset_id5",
    "egodriver.DriveSessionRequest": "session_uuid1 random_seed2 debug_info4 rollout_spec5",
    "egodriver.RolloutCameraImage.CameraImage": "frame_start_us2 frame_end_us3 image_bytes4 logical_id5",
    "egodriver.RolloutEgoTrajectory": "session_uuid1 trajectory3 dynamic_states5",
    "egodriver.DriveRequest": "session_uuid1 time_now_us3 time_query_us4 renderer_data5",
    "egodriver.DriveResponse": "trajectory2 debug_info3 terminate_session4",
}


@pytest.mark.parametrize("name", NUMBERS)
def test_fields_have_the_public_numbers(name):
    fields = wire.pool.FindMessageTypeByName(name).fields
    found = {field.name: field.number for field in fields if field.number < 2001}
    assert found == {m[1]: int(m[2]) for m in re.finditer(r"([a-z_]+)(\d+)", NUMBERS[name])}


def test_enums_have_the_public_numbers():
    assert {f.name: f.value for f in wire.ImageFormat} == {
        "UNDEFINED": 0, "PNG": 1, "JPEG": 2, "JPEG2000": 3, "RGB_UINT8_PLANAR": 4, "AVC": 5, "AV1": 6
    }  # fmt: skip
    assert [s.name.removeprefix("ROLLING_") for s in messages.ShutterType] == [
        "UNKNOWN", "TOP_TO_BOTTOM", "LEFT_TO_RIGHT", "BOTTOM_TO_TOP", "RIGHT_TO_LEFT", "GLOBAL"
    ]  # fmt: skip
    assert [d.name for d in messages.LidarDeviceType] == ["PANDAR128", "AT128"]


def test_times_are_fixed64():
    for name in ("RGBRenderRequest", "LidarRenderRequest"):
        fields = getattr(wire.sensorsim, name).DESCRIPTOR.fields_by_name
        assert fields["frame_start_us"].type == fields["frame_end_us"].type == 6  # TYPE_FIXED64


def test_the_committed_descriptors_match_the_protos(tmp_path):
    built = tmp_path / "descriptors.binpb"
    names = ["common.proto", "sensorsim.proto", "egodriver.proto", "nurec_sim_v1.proto"]
    protoc(f"-I{PROTOS}", f"--descriptor_set_out={built}", *names)
    assert built.read_bytes() == messages.descriptor_bytes(), "run `python protos/build.py` and commit the result"


def test_generated_code_of_the_same_packages_lives_beside_ours(tmp_path):
    common, sensorsim = generate_like_alpasim(tmp_path)
    assert sensorsim.RGBRenderRequest.DESCRIPTOR.full_name == wire.sensorsim.RGBRenderRequest.DESCRIPTOR.full_name
    assert sensorsim.RGBRenderRequest is not wire.sensorsim.RGBRenderRequest
    theirs = sensorsim.RGBRenderRequest(scene_id="a", frame_start_us=2**40, image_format=sensorsim.JPEG)
    theirs.sensor_pose.start_pose.CopyFrom(common.Pose(vec=common.Vec3(x=1.5), quat=common.Quat(w=1)))
    theirs.camera_intrinsics.opencv_pinhole_param.radial_coeffs.extend([0.1, 0.2])
    ours = wire.sensorsim.RGBRenderRequest.FromString(theirs.SerializeToString())
    assert (ours.scene_id, ours.frame_start_us, ours.image_format) == ("a", 2**40, wire.ImageFormat.JPEG)
    assert ours.sensor_pose.start_pose.vec.x == 1.5 and len(ours.sensor_pose.start_pose.exact) == 0
    assert list(ours.camera_intrinsics.opencv_pinhole_param.radial_coeffs) == [0.1, 0.2]
    ours.apply_isp = False
    assert sensorsim.RGBRenderRequest.FromString(ours.SerializeToString()).scene_id == "a"


def test_the_descriptors_load_from_a_bare_checkout(tmp_path, monkeypatch):
    checkout = tmp_path / "nurec_sim" / "serving" / "wire"
    checkout.mkdir(parents=True)
    shutil.copytree(PROTOS, tmp_path / "protos")
    monkeypatch.setattr(messages, "__file__", str(checkout / "messages.py"))
    monkeypatch.setattr(messages.resources, "files", missing_package)
    assert messages.descriptor_bytes() == (PROTOS / "descriptors.binpb").read_bytes()


def missing_package(name):
    raise ModuleNotFoundError(name)
