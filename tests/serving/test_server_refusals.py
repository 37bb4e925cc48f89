"""What the server refuses, how it says so, and that it goes on serving."""

import time
from dataclasses import replace

import numpy as np
import pytest
from grpc import StatusCode as Code
from serving_calls import (
    Failing,
    Stub,
    camera_message,
    lidar_message,
    pixels,
    place,
    refusal,
    street_stub,
    with_change,
)
from serving_world import camera_request, lidar_request, rig, scene

from nurec_sim.serving import wire
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import ImageFormat, common, sensorsim


@pytest.fixture(scope="module")
def stub(tmp_path_factory):
    broken = tmp_path_factory.mktemp("archives") / "broken.usdz"
    broken.write_bytes(b"no archive at all, just bytes")
    with street_stub(broken) as stub:
        yield stub


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
        "a frame may have 33,177,600 pixels or beams, got 10000x10000 pixels = 100,000,000",
    ),
    "no intrinsics": (
        lambda m: m.ClearField("camera_intrinsics"),
        Code.INVALID_ARGUMENT,
        "camera_intrinsics must hold ftheta_param, opencv_pinhole_param or opencv_fisheye_param",
    ),
    "no pose": (lambda m: m.ClearField("sensor_pose"), Code.INVALID_ARGUMENT, "sensor_pose is missing"),
    "a tiny JPEG 2000": (
        lambda m: (setattr(m, "image_format", ImageFormat.JPEG2000), setattr(m, "resolution_h", 8)),
        Code.INVALID_ARGUMENT,
        "a JPEG2000 needs sides of at least 32 pixels",
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
        lambda m: (setattr(m, "insert_ego_mask", True), setattr(m.ego_mask_id, "rig_config_id", "van")),
        Code.INVALID_ARGUMENT,
        "there is no ego mask for (rig, camera) ('van', 'front'); have []",
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
    [(400, 100_000, "got 400x100000 beams = 40,000,000"), (800, 5000, "may take 96,000,000 bytes of 67,108,864")],
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


def test_what_is_not_allowed_says_so(stub):
    code, text = refusal(stub.shut_down, common.Empty())
    assert code == Code.PERMISSION_DENIED and "not started with permission" in text


def test_a_bug_becomes_an_internal_error_in_the_log_and_the_server_goes_on(caplog):
    with SensorServer(SceneStore([scene()], make_renderer=Failing), port=0) as address, Stub(address) as stub:
        assert refusal(stub.render_rgb, camera_message()) == (Code.INTERNAL, "internal error: ZeroDivisionError: oh no")
        batch = sensorsim.BatchRGBRenderRequest()
        batch.items.add(camera_name="front", request=camera_message())
        item = stub.batch_render_rgb(batch).items[0]
        assert (item.success, item.error_code) == (False, Code.INTERNAL.value[0])
        assert stub.get_version(common.Empty()).version_id
    assert sum("ZeroDivisionError" in (record.exc_text or "") for record in caplog.records) == 2


def test_what_only_the_renderer_refuses_fails_its_item_alone(stub):
    batch = sensorsim.BatchRGBRenderRequest()
    for name, width in (("good", 320), ("wide", 8200)):
        item = batch.items.add(camera_name=name, request=camera_message())
        item.request.resolution_w, item.request.resolution_h = width, 4
    good, wide = stub.batch_render_rgb(batch, timeout=20).items
    assert good.success and len(good.result.image_bytes) == 3 * 320 * 4
    assert not wide.success and "8200 x 4 pixels are too many; at most 8192 a side" in wide.error_message
    assert wide.error_code == Code.RESOURCE_EXHAUSTED.value[0]
