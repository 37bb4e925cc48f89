"""What the server tells of its scenes and itself, and how other clients find it."""

import dataclasses

import cv2
import grpc
import numpy as np
import pytest
from generated_code import generate_like_alpasim
from grpc import StatusCode as Code
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from serving_calls import Stub, camera_message, decode, pixels, refusal, street_server, street_stub
from serving_world import camera_request, rig, scene

from nurec_sim.serving import wire
from nurec_sim.serving.wire import ImageFormat, common, sensorsim


@pytest.fixture(scope="module")
def address():
    with street_server() as address:
        yield address


@pytest.fixture(scope="module")
def stub(address):
    with Stub(address) as stub:
        yield stub


def test_scenes_are_listed_and_answer_to_their_aliases(stub):
    assert list(stub.get_available_scenes(common.Empty()).scene_ids) == ["clipgt-street", "clipgt-other"]
    frames = {stub.render_rgb(camera_message(scene_id=name)).image_bytes for name in ("street", "clipgt-street")}
    assert len(frames) == 1 and frames != {stub.render_rgb(camera_message(scene_id="other")).image_bytes}
    loaded = stub.get_loaded_scenes(common.Empty())
    assert {s.scene_id for s in loaded.scenes} == {"clipgt-street", "clipgt-other"}
    assert loaded.loaded_instance_capacity == 10 and loaded.scenes[0].loaded_instance_count == 1


def test_cameras_are_told_at_native_size_with_their_pose_in_the_rig(stub):
    reply = stub.get_available_cameras(sensorsim.AvailableCamerasRequest(scene_id="street"))
    assert [c.logical_id for c in reply.available_cameras] == ["front", "wide", "fish"]
    for entry in reply.available_cameras:
        assert entry.intrinsics.logical_id == entry.logical_id
        camera = rig().cameras[entry.logical_id]
        assert (entry.intrinsics.resolution_w, entry.intrinsics.resolution_h) == (camera.width_px, camera.height_px)
        # The field is called rig_to_camera and holds the pose of the camera in the rig.
        assert entry.rig_to_camera.vec.x == pytest.approx(camera.rig_from_camera[0, 3])
    wide = reply.available_cameras[1].intrinsics.ftheta_param
    assert len(wide.pixeldist_to_angle_poly) > 1 and list(wide.angle_to_pixeldist_poly) == [0.0, 90.0, 0.0, -3.0]
    assert (wide.linear_cde.linear_c, wide.linear_cde.linear_d, wide.linear_cde.linear_e) == (1, 0, 0)


def test_the_intrinsics_can_be_sent_back_as_they_came(stub, renderer):
    reply = stub.get_available_cameras(sensorsim.AvailableCamerasRequest(scene_id="street"))
    for entry in reply.available_cameras:
        request = camera_request(entry.logical_id)
        message = camera_message(request)
        message.camera_intrinsics.CopyFrom(entry.intrinsics)
        camera = request.sensor
        image = pixels(stub.render_rgb(message), camera.width_px, camera.height_px)
        assert np.array_equal(image, renderer.render_camera(request).rgb)


def test_trajectory_and_tracks_are_told(stub):
    request = sensorsim.AvailableTrajectoriesRequest(scene_id="street")
    (entry,) = stub.get_available_trajectories(request).available_trajectories
    assert [p.timestamp_us for p in entry.trajectory.poses] == scene().ego.t_us.tolist()
    assert entry.trajectory.poses[-1].pose.vec.x == pytest.approx(16.0)
    tracks = stub.get_dynamic_objects(sensorsim.DynamicObjectsRequest(scene_id="street")).dynamic_objects
    assert [(t.id, t.semantic_class) for t in tracks] == [("car-1", "automobile"), ("parked-1", "automobile")]
    request = sensorsim.ExternalAssetObjectsRequest(scene_id="street")
    assert not stub.get_external_asset_objects(request).track_ids
    assert refusal(stub.get_dynamic_objects, sensorsim.DynamicObjectsRequest(scene_id="x"))[0] == Code.NOT_FOUND


def test_the_server_describes_itself(stub):
    version = stub.get_version(common.Empty())
    assert version.version_id and version.grpc_api_version.minor == 54
    config = stub.get_server_config(common.Empty()).config
    assert config["scenes"] == "2" and config["max_batch_items"] == "64"


@pytest.mark.parametrize("path", wire.SERVICE_PATHS)
def test_the_service_answers_under_every_spelling(address, path):
    with Stub(address, path) as stub:
        assert stub.get_version(common.Empty()).version_id


def test_health_and_reflection_answer(stub):
    health = health_pb2_grpc.HealthStub(stub.channel)
    for name in ("", *wire.SERVICE_PATHS):
        reply = health.Check(health_pb2.HealthCheckRequest(service=name))
        assert reply.status == health_pb2.HealthCheckResponse.SERVING
    ask = reflection_pb2.ServerReflectionRequest
    answers = reflection_pb2_grpc.ServerReflectionStub(stub.channel).ServerReflectionInfo(
        iter([ask(list_services=""), ask(file_containing_symbol=wire.SERVICE)])
    )
    services, file = answers
    assert wire.SERVICE in [s.name for s in services.list_services_response.service]
    assert b"batch_render_rgb" in file.file_descriptor_response.file_descriptor_proto[0]


def test_code_generated_without_our_additions_is_served(address, tmp_path):
    """A client of the public interface: float32 poses, PNG, AlpaSim's own message classes."""
    _, theirs = generate_like_alpasim(tmp_path)
    with grpc.insecure_channel(address) as channel:
        call = channel.unary_unary(
            f"/{wire.SERVICE}/batch_render_rgb",
            theirs.BatchRGBRenderRequest.SerializeToString,
            theirs.BatchRGBRenderReturn.FromString,
        )
        message = theirs.RGBRenderRequest.FromString(camera_message(image_format=ImageFormat.PNG).SerializeToString())
        message.DiscardUnknownFields()
        assert b"\x8a\x7d" not in message.SerializeToString()  # field 2001 left out
        batch = theirs.BatchRGBRenderRequest()
        batch.items.add(camera_name="front", request=message)
        (item,) = call(batch).items
    assert item.success and decode(item.result.image_bytes).shape == (180, 320, 3)


def test_ego_masks_are_listed_and_laid_over(tmp_path):
    mask = np.zeros((90, 160, 4), np.uint8)
    mask[60:] = (20, 10, 5, 255)  # the lower third, in BGRA
    (tmp_path / "hyperion_8_1").mkdir()
    cv2.imwrite(str(tmp_path / "hyperion_8_1" / "front.png"), mask)
    with street_stub(ego_mask_dir=tmp_path) as stub:
        (entry,) = stub.get_available_ego_masks(common.Empty()).ego_mask_metadata
        assert (entry.ego_mask_id.rig_config_id, entry.ego_mask_id.camera_logical_id) == ("hyperion_8_1", "front")
        plain = pixels(stub.render_rgb(camera_message()))
        message = camera_message()
        message.insert_ego_mask = True
        message.ego_mask_id.CopyFrom(entry.ego_mask_id)
        covered = pixels(stub.render_rgb(message))
    assert (covered[120:] == (5, 10, 20)).all() and np.array_equal(covered[:118], plain[:118])


def test_without_a_named_mask_the_scene_shows_what_it_knows_of_the_ego_vehicle():
    """The bonnet that the scene keeps is laid over if asked for; scenes that know none are shown as they are."""
    image = np.zeros((180, 320, 4), np.uint8)
    image[120:] = (5, 10, 20, 255)
    driven = dataclasses.replace(scene("driven"), ego_images={"front": image})
    message = camera_message(scene_id="driven")
    message.insert_ego_mask = True
    with street_stub(driven) as stub:
        covered, plain = pixels(stub.render_rgb(message)), pixels(stub.render_rgb(camera_message(scene_id="driven")))
        message.scene_id = "street"
        unknown, street = pixels(stub.render_rgb(message)), pixels(stub.render_rgb(camera_message()))
    assert (covered[120:] == (5, 10, 20)).all() and np.array_equal(covered[:120], plain[:120])
    assert not (plain[120:] == (5, 10, 20)).all()
    np.testing.assert_array_equal(unknown, street)
