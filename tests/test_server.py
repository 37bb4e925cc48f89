"""The sensor server over a real connection: what it draws, what it refuses, and that it goes on serving."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import grpc
import numpy as np
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from serving_world import LAST_US, START_US, camera_request, lidar_request, rig, scene
from test_wire_messages import alpasim_like  # noqa: F401  (a fixture)

from nurec_sim import geometry, wire
from nurec_sim.render import Renderer
from nurec_sim.scene_store import SceneStore
from nurec_sim.server import SensorServer
from nurec_sim.service import ServiceOptions
from nurec_sim.wire import ImageFormat, common, sensorsim
from nurec_sim.wire.poses import write_poses

Code = grpc.StatusCode


class Stub:
    """Raw procedures of a server, under any spelling of the service."""

    def __init__(self, address: str, path: str = wire.SERVICE) -> None:
        options = [("grpc.max_receive_message_length", 64 << 20)]
        self.channel = grpc.insecure_channel(address, options=options)
        for name, method in wire.METHODS.items():
            procedure = self.channel.unary_unary(
                f"/{path}/{name}", method.request.SerializeToString, method.reply.FromString
            )
            setattr(self, name, procedure)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.channel.close()


@pytest.fixture(scope="module")
def world():
    return scene()


@pytest.fixture(scope="module")
def renderer(world):
    return Renderer(world, threads=2)


@pytest.fixture(scope="module")
def broken_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("archives") / "broken.usdz"
    path.write_bytes(b"PK\x03\x04 this is no archive")
    return path


@pytest.fixture(scope="module")
def address(world, broken_path):
    store = SceneStore([world, scene("other", seed=1), broken_path], threads=2)
    with SensorServer(store, port=0) as address:
        yield address


@pytest.fixture(scope="module")
def stub(address):
    with Stub(address) as stub:
        yield stub


def camera_message(request=None, image_format=ImageFormat.RGB_UINT8_PLANAR, scene_id="street"):
    message = sensorsim.RGBRenderRequest()
    wire.write_camera_request(request or camera_request(), message, scene_id=scene_id)
    message.image_format = image_format
    return message


def lidar_message(request=None, scene_id="street"):
    message = sensorsim.LidarRenderRequest()
    wire.write_lidar_request(request or lidar_request(), message, scene_id=scene_id)
    return message


def pixels(reply, width=320, height=180):
    return np.moveaxis(np.frombuffer(reply.image_bytes, np.uint8).reshape(3, height, width), 0, 2)


def refusal(procedure, message):
    with pytest.raises(grpc.RpcError) as caught:
        procedure(message, timeout=20)
    return caught.value.code(), caught.value.details()


# ------------------------------------------------------------------------------------------------------------ pictures


def test_the_scene_is_worth_looking_at(renderer):
    rgb = renderer.render_camera(camera_request()).rgb
    red = (rgb[..., 0] > 120) & (rgb[..., 1] < 80)
    assert red.sum() > 200 and len(np.unique(rgb.reshape(-1, 3), axis=0)) > 500


@pytest.mark.parametrize("camera_id", ["front", "wide", "fish"])
def test_a_planar_image_is_the_renderers_own(stub, renderer, camera_id):
    request = camera_request(camera_id)
    reply = stub.render_rgb(camera_message(request))
    camera = request.sensor
    assert np.array_equal(pixels(reply, camera.width_px, camera.height_px), renderer.render_camera(request).rgb)


def test_png_is_lossless_and_jpeg_close(stub, renderer):
    rgb = renderer.render_camera(camera_request()).rgb
    png = stub.render_rgb(camera_message(image_format=ImageFormat.PNG)).image_bytes
    assert png.startswith(b"\x89PNG") and np.array_equal(decode(png), rgb)
    message = camera_message(image_format=ImageFormat.JPEG)
    best = stub.render_rgb(message).image_bytes
    assert np.abs(decode(best).astype(int) - rgb).mean() < 3
    message.image_quality = 95
    assert stub.render_rgb(message).image_bytes == best
    message.image_quality = 20
    assert len(stub.render_rgb(message).image_bytes) < len(best) / 2


def decode(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]


def test_a_sweep_is_the_renderers_own(stub, renderer):
    reply, frame = stub.render_lidar(lidar_message()), renderer.render_lidar(lidar_request())
    assert reply.num_points == len(frame.xyz_m) > 100
    assert np.array_equal(np.frombuffer(reply.point_xyzs_buffer, "<f4").reshape(-1, 3), frame.xyz_m)
    assert np.array_equal(np.frombuffer(reply.point_intensities_buffer, "<f4"), frame.intensity)
    assert np.array_equal(np.frombuffer(reply.point_ranges_buffer, "<f4"), frame.range_m)
    assert np.array_equal(np.frombuffer(reply.point_beams_buffer, "<i4"), frame.beam)


def test_a_named_lidar_and_its_opacity_threshold(stub):
    message = lidar_message()
    message.lidar_config.Clear()
    message.lidar_config.lidar_type = 1
    some = stub.render_lidar(message).num_points
    message.render_filter.opacity_threshold = 0.01
    message.render_filter.raydrop_threshold = 0.5
    assert 100 < some < stub.render_lidar(message).num_points


def test_a_requested_size_scales_the_intrinsics(stub, renderer):
    message = camera_message()
    message.resolution_h, message.resolution_w = 90, 1
    small = pixels(stub.render_rgb(message), 160, 90).astype(float)
    full = renderer.render_camera(camera_request()).rgb.astype(float)
    halved = full.reshape(90, 2, 160, 2, 3).mean((1, 3))
    assert np.abs(small - halved).mean() < 4


def test_the_colour_correction_can_be_left_out(stub, world):
    message = camera_message()
    message.apply_isp = False
    plain = Renderer(world, threads=2, apply_isp=False).render_camera(camera_request()).rgb
    assert np.array_equal(pixels(stub.render_rgb(message)), plain)
    message.apply_isp = True
    assert not np.array_equal(pixels(stub.render_rgb(message)), plain)


def test_a_rolling_shutter_differs_from_a_global_one(stub):
    message = camera_message()
    turned = geometry.pose(geometry.rotation_from_yaw(0.05), np.zeros(3)) @ camera_request().world_from_sensor[0]
    message.sensor_pose.end_pose.Clear()
    write_poses(turned[None], [message.sensor_pose.end_pose])
    rolling = pixels(stub.render_rgb(message))
    message.camera_intrinsics.shutter_type = 5
    still = pixels(stub.render_rgb(message))
    assert (
        np.abs(rolling[-20:].astype(int) - still[-20:]).mean()
        > 2 * np.abs(rolling[:20].astype(int) - still[:20]).mean()
    )


# -------------------------------------------------------------------------------------------------------------- actors


def red_count(image):
    return int(((image[..., 0] > 120) & (image[..., 1] < 80)).sum())


def blue_count(image):
    return int(((image[..., 2] > 120) & (image[..., 0] < 80)).sum())


def place(message, track_id, pose):
    pair = message.dynamic_objects.add(track_id=track_id).pose_pair
    write_poses(np.stack([pose, pose]), [pair.start_pose, pair.end_pose])


def test_listed_actors_are_moved_and_all_others_stay(stub):
    plain = pixels(stub.render_rgb(camera_message()))
    message = camera_message()
    place(message, "car-1", geometry.pose_from_xyyaw(12, -2, 0, -100))
    buried = pixels(stub.render_rgb(message))
    assert red_count(plain) > 200 and red_count(buried) == 0
    assert blue_count(buried) == blue_count(plain) > 200
    message = camera_message()
    place(message, "nobody", geometry.pose_from_xyyaw(9, 0, 0))
    place(message, "parked-1", geometry.pose_from_xyyaw(0, 0, 0, -100))
    assert np.array_equal(pixels(stub.render_rgb(message)), plain)


def test_unlisted_actors_can_be_hidden_by_option(world):
    options = ServiceOptions(only_listed_actors=True)
    with SensorServer(SceneStore([world], threads=2), port=0, options=options) as address, Stub(address) as stub:
        plain = pixels(stub.render_rgb(camera_message()))
        message = camera_message()
        place(message, "nobody", np.eye(4))
        hidden = pixels(stub.render_rgb(message))
    assert red_count(plain) > 200 and red_count(hidden) == 0
    assert blue_count(hidden) == blue_count(plain)


# --------------------------------------------------------------------------------------------------------------- times


@pytest.mark.parametrize(
    ("start_us", "end_us", "allowed"),
    [
        (START_US, START_US + 1, True),
        (LAST_US, LAST_US + 1, True),
        (LAST_US, LAST_US + 30_000, True),
        (START_US - 30_000, START_US + 1, True),
        (START_US - 30_000, START_US, False),
        (LAST_US + 2, LAST_US + 3, False),
    ],
)
def test_a_frame_renders_if_it_overlaps_the_scenes_time(stub, start_us, end_us, allowed):
    message = camera_message()
    message.frame_start_us, message.frame_end_us = start_us, end_us
    if allowed:
        assert len(stub.render_rgb(message).image_bytes) == 320 * 180 * 3
    else:
        code, text = refusal(stub.render_rgb, message)
        assert code == Code.OUT_OF_RANGE
        assert f"[{start_us}, {end_us}) us lies outside of scene 'street', which covers [5000000, 7000001]" in text


# ----------------------------------------------------------------------------------------------------------- bad input


def with_change(change, message=None):
    message = message or camera_message()
    change(message)
    return message


def hundred_megapixels(message):
    message.resolution_w = message.resolution_h = 10_000


BAD_CAMERA_REQUESTS = {
    "a NaN pose": (
        lambda m: setattr(m.sensor_pose.start_pose.vec, "x", float("nan")),
        Code.INVALID_ARGUMENT,
        "sensor_pose.start_pose must be finite, got vec (x, y, z) = (nan",
    ),
    "an unknown scene": (
        lambda m: setattr(m, "scene_id", "nowhere"),
        Code.NOT_FOUND,
        "scene 'nowhere' is not served; have ['clipgt-street', 'clipgt-other']",
    ),
    "a zero-length frame": (
        lambda m: setattr(m, "frame_end_us", m.frame_start_us),
        Code.INVALID_ARGUMENT,
        "needs start < end, got [5500000, 5500000)",
    ),
    "a time beyond any clock": (
        lambda m: setattr(m, "frame_end_us", 2**64 - 1),
        Code.INVALID_ARGUMENT,
        "must be microseconds below 2**62",
    ),
    "100 megapixels": (
        hundred_megapixels,
        Code.RESOURCE_EXHAUSTED,
        "a frame may have 16,777,216 pixels or beams, got 10000x10000 pixels = 100,000,000",
    ),
    "no intrinsics": (
        lambda m: m.ClearField("camera_intrinsics"),
        Code.INVALID_ARGUMENT,
        "camera_intrinsics must hold ftheta_param, opencv_pinhole_param or opencv_fisheye_param",
    ),
    "no pose": (lambda m: m.ClearField("sensor_pose"), Code.INVALID_ARGUMENT, "sensor_pose is missing"),
    "a video format": (
        lambda m: setattr(m, "image_format", ImageFormat.AV1),
        Code.INVALID_ARGUMENT,
        "image_format must be one of PNG (1), JPEG (2), RGB_UINT8_PLANAR (4); got AV1 (6)",
    ),
    "no format": (lambda m: setattr(m, "image_format", 0), Code.INVALID_ARGUMENT, "got UNDEFINED (0)"),
    "a format from the future": (lambda m: setattr(m, "image_format", 77), Code.INVALID_ARGUMENT, "got unknown (77)"),
    "a JPEG of quality -7": (
        lambda m: (setattr(m, "image_format", ImageFormat.JPEG), setattr(m, "image_quality", -7)),
        Code.INVALID_ARGUMENT,
        "image_quality of a JPEG must lie in 1..100",
    ),
    "a quaternion of length 2": (
        lambda m: setattr(m.sensor_pose.end_pose.quat, "w", 2.0),
        Code.INVALID_ARGUMENT,
        "sensor_pose.end_pose must have a unit quaternion",
    ),
    "an actor at NaN": (
        lambda m: (place(m, "car-1", np.eye(4)), setattr(m.dynamic_objects[0].pose_pair.end_pose.vec, "z", np.nan)),
        Code.INVALID_ARGUMENT,
        "dynamic_objects['car-1'].pose_pair.end_pose must be finite",
    ),
    "an ego mask that is not there": (
        lambda m: setattr(m, "insert_ego_mask", True),
        Code.INVALID_ARGUMENT,
        "there is no ego mask for (rig, camera) ('', ''); have []",
    ),
    "an archive that is not one": (
        lambda m: setattr(m, "scene_id", "clipgt-broken"),
        Code.FAILED_PRECONDITION,
        "broken.usdz",
    ),
}


@pytest.mark.parametrize("case", BAD_CAMERA_REQUESTS)
def test_a_bad_request_is_explained_and_the_server_goes_on(stub, renderer, case):
    change, code, text = BAD_CAMERA_REQUESTS[case]
    got_code, got_text = refusal(stub.render_rgb, with_change(change))
    assert got_code == code and text in got_text
    assert np.array_equal(pixels(stub.render_rgb(camera_message())), renderer.render_camera(camera_request()).rgb)


@pytest.mark.parametrize("case", ["a NaN pose", "an unknown scene", "a zero-length frame", "no pose"])
def test_a_bad_lidar_request_is_explained_and_the_server_goes_on(stub, case):
    change, code, text = BAD_CAMERA_REQUESTS[case]
    got_code, got_text = refusal(stub.render_lidar, with_change(change, lidar_message()))
    assert got_code == code and text.split("; have")[0] in got_text
    assert stub.render_lidar(lidar_message()).num_points > 100


@pytest.mark.parametrize(
    ("rows", "columns", "text"),
    [(300, 100_000, "got 300x100000 beams = 30,000,000"), (40, 100_000, "may take 96,000,000 bytes of 67,108,864")],
)
def test_too_many_beams_are_refused(stub, rows, columns, text):
    lidar = replace(
        rig().lidars["roof"],
        elevation_rad=np.linspace(0.1, -0.3, rows),
        azimuth_rad=np.linspace(3, -3, columns),
        row_azimuth_offset_rad=np.zeros(rows),
    )
    code, details = refusal(stub.render_lidar, lidar_message(replace(lidar_request(), sensor=lidar)))
    assert code == Code.RESOURCE_EXHAUSTED and text in details


def test_raw_pixels_beyond_a_message_are_refused_before_they_are_drawn(stub):
    def ask(m):
        m.resolution_w, m.resolution_h = 4000, 4000

    batch = sensorsim.BatchRGBRenderRequest()
    for name in "ab":
        batch.items.add(camera_name=name, request=with_change(ask))
    begin = time.perf_counter()
    code, text = refusal(stub.batch_render_rgb, batch)
    assert code == Code.RESOURCE_EXHAUSTED and "may take 96,000,000 bytes of 67,108,864" in text
    assert time.perf_counter() - begin < 2


def test_bytes_that_are_no_message_are_refused(stub):
    raw = stub.channel.unary_unary(f"/{wire.SERVICE}/render_rgb")
    text = "the 3 bytes received are no RGBRenderRequest message"
    assert refusal(raw, b"\xff\xff\xff") == (Code.INVALID_ARGUMENT, text)
    assert stub.get_version(common.Empty()).version_id


def test_what_is_not_offered_says_so(stub):
    for name, text in (
        ("edit_assets", "cannot be replaced or inserted"),
        ("restore_model_parameters", "nothing to restore"),
        ("shut_down", "not started with permission"),
    ):
        code, details = refusal(getattr(stub, name), wire.METHODS[name].request())
        assert code == Code.UNIMPLEMENTED and text in details


class Failing:
    """A renderer with a bug."""

    def __init__(self, scene):
        self.scene = scene

    def render_camera(self, request, outputs=()):
        raise ZeroDivisionError("oh no")


def test_a_bug_becomes_an_internal_error_in_the_log_and_the_server_goes_on(world, caplog):
    with SensorServer(SceneStore([world], make_renderer=Failing), port=0) as address, Stub(address) as stub:
        assert refusal(stub.render_rgb, camera_message()) == (Code.INTERNAL, "internal error: ZeroDivisionError: oh no")
        batch = sensorsim.BatchRGBRenderRequest()
        batch.items.add(camera_name="front", request=camera_message())
        item = stub.batch_render_rgb(batch).items[0]
        assert (item.success, item.error_code) == (False, Code.INTERNAL.value[0])
        assert stub.get_version(common.Empty()).version_id
    assert sum("ZeroDivisionError" in (record.exc_text or "") for record in caplog.records) == 2


# ------------------------------------------------------------------------------------------------ batches and bundles


def test_a_batch_answers_every_item_and_says_what_is_wrong_with_one(stub, renderer):
    batch = sensorsim.BatchRGBRenderRequest()
    batch.items.add(camera_name="front", request=camera_message())
    batch.items.add(camera_name="bad", request=with_change(BAD_CAMERA_REQUESTS["a NaN pose"][0]))
    batch.items.add(camera_name="fish", request=camera_message(camera_request("fish")))
    front, bad, fish = stub.batch_render_rgb(batch).items
    assert (front.camera_name, bad.camera_name, fish.camera_name) == ("front", "bad", "fish")
    assert front.success and np.array_equal(pixels(front.result), renderer.render_camera(camera_request()).rgb)
    assert fish.success and len(fish.result.image_bytes) == 120 * 90 * 3
    assert not bad.success and "must be finite" in bad.error_message
    assert bad.error_code == Code.INVALID_ARGUMENT.value[0] and not bad.result.image_bytes


def test_a_batch_has_a_limit(stub):
    batch = sensorsim.BatchRGBRenderRequest()
    for i in range(65):
        batch.items.add(camera_name=str(i))
    assert refusal(stub.batch_render_rgb, batch) == (Code.RESOURCE_EXHAUSTED, "a batch may have 64 items, got 65")


def test_an_aggregate_holds_images_and_sweeps(stub):
    request = sensorsim.AggregatedRenderRequest(
        rgb_requests=[camera_message(), camera_message(camera_request("fish"))], lidar_requests=[lidar_message()]
    )
    reply = stub.render_aggregated(request)
    assert [len(r.image_bytes) for r in reply.rgb_returns] == [320 * 180 * 3, 120 * 90 * 3]
    assert [r.num_points for r in reply.lidar_returns] == [stub.render_lidar(lidar_message()).num_points]
    request.lidar_requests[0].scene_id = "nowhere"
    assert refusal(stub.render_aggregated, request)[0] == Code.NOT_FOUND


# ----------------------------------------------------------------------------------------------------------- discovery


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


def test_trajectory_and_tracks_are_told(stub, world):
    request = sensorsim.AvailableTrajectoriesRequest(scene_id="street")
    (entry,) = stub.get_available_trajectories(request).available_trajectories
    assert [p.timestamp_us for p in entry.trajectory.poses] == world.ego.t_us.tolist()
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


def test_code_generated_without_our_additions_is_served(address, alpasim_like):  # noqa: F811
    """A client of the public interface: float32 poses, PNG, AlpaSim's own message classes."""
    _, theirs = alpasim_like
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


def test_ego_masks_are_listed_and_laid_over(world, tmp_path):
    mask = np.zeros((90, 160, 4), np.uint8)
    mask[60:] = (20, 10, 5, 255)  # the lower third, in BGRA
    (tmp_path / "hyperion_8_1").mkdir()
    cv2.imwrite(str(tmp_path / "hyperion_8_1" / "front.png"), mask)
    options = ServiceOptions(ego_mask_dir=tmp_path)
    with SensorServer(SceneStore([world], threads=2), port=0, options=options) as address, Stub(address) as stub:
        (entry,) = stub.get_available_ego_masks(common.Empty()).ego_mask_metadata
        assert (entry.ego_mask_id.rig_config_id, entry.ego_mask_id.camera_logical_id) == ("hyperion_8_1", "front")
        plain = pixels(stub.render_rgb(camera_message()))
        message = camera_message()
        message.insert_ego_mask = True
        message.ego_mask_id.CopyFrom(entry.ego_mask_id)
        covered = pixels(stub.render_rgb(message))
    assert (covered[120:] == (5, 10, 20)).all() and np.array_equal(covered[:118], plain[:118])


# --------------------------------------------------------------------------------------------------------- concurrency


@pytest.mark.parametrize("workers", [1, 2])
def test_eight_clients_at_once_get_what_one_gets(world, workers):
    requests = [camera_request(c, t) for c in ("front", "fish") for t in range(START_US, LAST_US, 500_000)]
    messages = [camera_message(r) for r in requests]
    options = ServiceOptions(render_workers=workers)
    with SensorServer(SceneStore([world], threads=2), port=0, options=options) as address, Stub(address) as stub:
        alone = [stub.render_rgb(m).image_bytes for m in messages]
        with ThreadPoolExecutor(8) as pool:
            jobs = [pool.submit(stub.render_rgb, m) for m in messages * 4]
            slowest = slowest_health_check(stub.channel, until=jobs)
            together = [job.result().image_bytes for job in jobs]
    assert together == alone * 4
    assert slowest < 1.0


def slowest_health_check(channel, until):
    health, slowest = health_pb2_grpc.HealthStub(channel), 0.0
    while not all(job.done() for job in until):
        begin = time.perf_counter()
        health.Check(health_pb2.HealthCheckRequest(), timeout=10)
        slowest = max(slowest, time.perf_counter() - begin)
        time.sleep(0.01)
    return slowest


class Gated:
    """A renderer that waits to be let through, and counts."""

    def __init__(self, scene):
        self.inner, self.gate, self.begun = Renderer(scene, threads=2), threading.Event(), []

    def render_camera(self, request, outputs=()):
        self.begun.append(request.start_us)
        assert self.gate.wait(30)
        return self.inner.render_camera(request, outputs)


def test_what_a_client_gave_up_is_not_rendered(world):
    gated = Gated(world)
    store = SceneStore([world], make_renderer=lambda scene: gated)
    with SensorServer(store, port=0) as address, Stub(address) as stub:
        first = stub.render_rgb.future(camera_message(camera_request(t_us=5_100_000)))
        wait_until(lambda: gated.begun)
        given_up = stub.render_rgb.future(camera_message(camera_request(t_us=5_200_000)))
        too_late = stub.render_rgb.future(camera_message(camera_request(t_us=5_300_000)), timeout=0.3)
        assert health_pb2_grpc.HealthStub(stub.channel).Check(health_pb2.HealthCheckRequest(), timeout=1).status == 1
        assert too_late.exception().code() == Code.DEADLINE_EXCEEDED
        given_up.cancel()
        time.sleep(0.2)
        gated.gate.set()
        assert first.result().image_bytes
        assert stub.render_rgb(camera_message(camera_request(t_us=5_400_000))).image_bytes
    assert gated.begun == [5_100_000, 5_400_000]


def test_a_scene_that_loads_does_not_hold_up_the_others(world):
    gate, begun = threading.Event(), []

    def make_renderer(loading):
        begun.append(loading.id)
        assert loading.id == "street" or gate.wait(30)
        return Renderer(loading, threads=2)

    store = SceneStore([world, scene("slow")], make_renderer=make_renderer)
    with SensorServer(store, port=0) as address, Stub(address) as stub:
        waiting = [stub.render_rgb.future(camera_message(scene_id="slow")) for _ in range(8)]
        waiting[0].cancel()
        assert stub.render_rgb(camera_message(), timeout=20).image_bytes
        assert stub.get_loaded_scenes(common.Empty(), timeout=2).scenes[0].scene_id == "clipgt-street"
        gate.set()
        assert all(call.result().image_bytes for call in waiting[1:])
    assert sorted(begun) == ["slow", "street"]


def test_a_frame_in_progress_is_finished_before_the_server_stops(world):
    gated = Gated(world)
    server = SensorServer(SceneStore([world], make_renderer=lambda scene: gated), port=0)
    with Stub(server.start()) as stub:
        call = stub.render_rgb.future(camera_message())
        wait_until(lambda: gated.begun)
        stopping = threading.Thread(target=server.stop)
        stopping.start()
        time.sleep(0.2)
        gated.gate.set()
        assert call.result(timeout=20).image_bytes
        stopping.join(20)
        assert not stopping.is_alive()


def wait_until(condition, seconds=20):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)
