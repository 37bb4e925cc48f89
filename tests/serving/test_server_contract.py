"""Rules of the contract beyond the conformance kit's: formats, qualities, masks, times, limits, a guarded stop."""

import dataclasses
import logging

import av
import cv2
import numpy as np
import pytest
from grpc import StatusCode as Code
from serving_calls import (
    Stub,
    camera_message,
    decode,
    pixels,
    place,
    refusal,
    street_renderer,
    street_stub,
    with_change,
)
from serving_world import LAST_US, START_US, camera_request, ego, scene

from nurec_sim.render.images import encode
from nurec_sim.serving.sensor_service import ServiceOptions
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import ImageFormat, common, sensorsim
from nurec_sim.types import Trajectory


@pytest.fixture(scope="module")
def rgb():
    return street_renderer().render_camera(camera_request()).rgb


def image(stub, image_format, quality=0.0):
    message = camera_message(image_format=image_format)
    message.image_quality = quality
    return stub.render_rgb(message).image_bytes


def decode_video(data, decoder):
    context = av.CodecContext.create(decoder, "r")
    (frame,) = (*context.decode(av.Packet(data)), *context.decode(None))
    return frame.to_ndarray(format="rgb24")


def test_video_frames_stand_alone(stub, rgb):
    data = image(stub, ImageFormat.AVC)
    assert data.startswith(b"\0\0\0\1\x67"), "an Annex B access unit that begins with its parameter sets"
    assert np.abs(decode_video(data, "h264").astype(int) - rgb).mean() < 6
    data = image(stub, ImageFormat.AV1)
    assert data.startswith(b"\x12\0\x0a"), "a temporal delimiter and a sequence header"
    assert np.abs(decode_video(data, "libdav1d").astype(int) - rgb).mean() < 6
    assert image(stub, ImageFormat.AV1) == data


@pytest.mark.parametrize("kind", [ImageFormat.JPEG2000, ImageFormat.AVC, ImageFormat.AV1])
def test_quality_counts_in_every_lossy_format(stub, kind):
    assert len(image(stub, kind, 20)) < len(image(stub, kind, 95)) == len(image(stub, kind))


@pytest.mark.parametrize(("kind", "decoder"), [(ImageFormat.AVC, "h264"), (ImageFormat.AV1, "libdav1d")])
@pytest.mark.parametrize(("width", "height"), [(161, 91), (5, 7), (64, 33)])
def test_video_frames_have_the_size_that_is_asked_for(stub, kind, decoder, width, height):
    message = camera_message(image_format=kind)
    message.resolution_w, message.resolution_h = width, height
    assert decode_video(stub.render_rgb(message).image_bytes, decoder).shape == (height, width, 3)


def test_jpeg2000_is_close_to_the_picture(stub, rgb):
    assert np.abs(decode(image(stub, ImageFormat.JPEG2000)).astype(int) - rgb).mean() < 3


@pytest.mark.parametrize("quality", [-7, 0.5, 100.5, float("nan"), float("inf")])
@pytest.mark.parametrize("kind", [ImageFormat.JPEG, ImageFormat.AVC])
def test_a_quality_out_of_range_is_refused(stub, kind, quality):
    message = with_change(lambda m: setattr(m, "image_quality", quality), camera_message(image_format=kind))
    code, text = refusal(stub.render_rgb, message)
    assert code == Code.INVALID_ARGUMENT
    assert f"image_quality of a {kind.name} must lie in 1..100 (0 means 95), got {quality}" in text


def test_quality_is_a_float_and_is_not_looked_at_where_nothing_is_lost(stub, rgb):
    assert image(stub, ImageFormat.JPEG, 94.7) == image(stub, ImageFormat.JPEG, 95)
    assert np.array_equal(decode(image(stub, ImageFormat.PNG, -7)), rgb)
    assert np.array_equal(pixels(stub.render_rgb(with_change(lambda m: setattr(m, "image_quality", -7)))), rgb)


def test_a_format_without_an_encoder_is_refused_with_what_there_is(monkeypatch):
    monkeypatch.setattr(encode.encode_video, "is_available", lambda kind: False)
    encode.available_formats.cache_clear()
    try:
        with street_stub() as stub:
            code, text = refusal(stub.render_rgb, camera_message(image_format=ImageFormat.AV1))
            formats = stub.get_server_config(common.Empty()).config["image_formats"]
    finally:
        encode.available_formats.cache_clear()
    assert code == Code.INVALID_ARGUMENT
    assert text == ("image_format must be one of PNG (1), JPEG (2), JPEG2000 (3), RGB_UINT8_PLANAR (4); got AV1 (6)")
    assert formats == "PNG, JPEG, JPEG2000, RGB_UINT8_PLANAR"


def test_the_camera_and_the_only_rig_of_a_mask_may_be_left_out(tmp_path):
    for rig, value in (("a", 200), ("b", 100)):
        (tmp_path / rig).mkdir()
        cv2.imwrite(str(tmp_path / rig / "front.png"), np.full((9, 16, 3), value, np.uint8))
    cv2.imwrite(str(tmp_path / "a" / "wide.png"), np.full((9, 16, 3), 50, np.uint8))
    with street_stub(ego_mask_dir=tmp_path) as stub:
        message = camera_message(camera_request("wide"))
        message.insert_ego_mask = True
        assert (pixels(stub.render_rgb(message), 160, 100) == 50).all()
        message = camera_message()
        message.insert_ego_mask = True
        code, text = refusal(stub.render_rgb, message)
        assert code == Code.INVALID_ARGUMENT and "have [('a', 'front'), ('a', 'wide'), ('b', 'front')]" in text
        message.ego_mask_id.rig_config_id = "b"
        assert (pixels(stub.render_rgb(message)) == 100).all()


def test_the_path_may_reach_beyond_the_sensors_data():
    world = scene()
    path = Trajectory(np.array([START_US - 200_000, LAST_US + 200_000]), ego().world_from_body[[0, -1]])
    world = dataclasses.replace(world, ego=path)
    with SensorServer(SceneStore([world], threads=2), port=0) as address, Stub(address) as stub:
        for t_us in (START_US - 200_000, LAST_US + 200_000):
            message = camera_message()
            message.frame_start_us, message.frame_end_us = t_us, t_us + 1
            assert pixels(stub.render_rgb(message)).max() > 0
        message.frame_start_us, message.frame_end_us = LAST_US + 200_001, LAST_US + 200_002
        code, text = refusal(stub.render_rgb, message)
    assert code == Code.OUT_OF_RANGE and "covers [4800000, 7200000]" in text


def test_actors_that_nobody_knows_are_counted_in_the_log(stub, caplog):
    with caplog.at_level(logging.INFO, "nurec_sim.serving.sensor_service.rendering"):
        message = camera_message()
        for name in ("x1", "x2", "car-1"):
            place(message, name, np.eye(4))
        stub.render_rgb(message)
    assert "scene street has no 2 of the actors listed, as 'x1'" in caplog.text


def test_endless_polynomials_are_refused_before_they_are_solved(stub):
    message = camera_message(camera_request("wide"))
    message.camera_intrinsics.ftheta_param.pixeldist_to_angle_poly.extend([1e-9] * 5000)
    code, text = refusal(stub.render_rgb, message)
    assert code == Code.INVALID_ARGUMENT and "pixeldist_to_angle_poly has 5000 values, at most 64" in text
    message = camera_message(camera_request("wide"))
    message.camera_intrinsics.bivariate_windshield_model_param.vertical_poly.extend([0.0] * 5050)
    code, text = refusal(stub.render_rgb, message)
    assert code == Code.INVALID_ARGUMENT and "vertical_poly has 5050 values, at most 64" in text


def test_the_configuration_tells_options_and_no_secrets(stub):
    config = stub.get_server_config(common.Empty()).config
    assert config["only_listed_actors"] == "False" and config["allow_remote_scenes"] == "False"
    assert {field.name for field in dataclasses.fields(ServiceOptions)} <= config.keys()


def test_clients_may_stop_a_server_that_allows_it():
    server = SensorServer(SceneStore([scene()], threads=2), port=0, options=ServiceOptions(allow_shut_down=True))
    with server as address, Stub(address) as stub:
        stub.shut_down(common.Empty(), timeout=10)
        server._thread.join(20)
        assert not server._thread.is_alive()


def test_a_message_beyond_the_limit_is_refused():
    with street_stub(max_request_bytes=1 << 20, max_message_bytes=1 << 20) as stub:
        message = camera_message()
        message.camera_intrinsics.temporary_camera_spec = "x" * (2 << 20)
        assert refusal(stub.render_rgb, message)[0] == Code.RESOURCE_EXHAUSTED
        message = camera_message()
        message.resolution_h, message.resolution_w = 1000, 1000
        code, text = refusal(stub.render_rgb, message)
        assert code == Code.RESOURCE_EXHAUSTED and "may take 3,000,000 bytes of 1,048,576" in text
        assert len(stub.get_available_scenes(common.Empty()).scene_ids) == 2


def test_batches_repeat_names_as_they_came(stub):
    batch = sensorsim.BatchRGBRenderRequest()
    for name in ("", "a", "a"):
        batch.items.add(camera_name=name, request=camera_message(image_format=ImageFormat.JPEG))
    items = stub.batch_render_rgb(batch).items
    assert [item.camera_name for item in items] == ["", "a", "a"] and all(item.success for item in items)
    assert len({item.result.image_bytes for item in items}) == 1


def test_a_scene_is_not_held_by_what_was_refused():
    """An aggregate with one bad request ends all of it, and the scene can go."""
    store = SceneStore([scene()], threads=2)
    with SensorServer(store, port=0) as address, Stub(address) as stub:
        aggregate = sensorsim.AggregatedRenderRequest()
        aggregate.rgb_requests.add(scene_id="nowhere")
        aggregate.rgb_requests.add().CopyFrom(camera_message())
        aggregate.lidar_requests.add(scene_id="street")
        assert refusal(stub.render_aggregated, aggregate)[0] == Code.NOT_FOUND
        batch = sensorsim.BatchRGBRenderRequest()
        batch.items.add(camera_name="bad", request=aggregate.rgb_requests[0])
        batch.items.add(camera_name="good", request=camera_message())
        assert [item.success for item in stub.batch_render_rgb(batch).items] == [False, True]
        assert store.stats.in_use == 0 and store.unload("street") > 0
