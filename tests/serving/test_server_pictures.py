"""What the server draws: images, sweeps, actors and times, the same as the renderer's own."""

import numpy as np
import pytest
from grpc import StatusCode as Code
from serving_calls import (
    blue_count,
    camera_message,
    decode,
    lidar_message,
    pixels,
    place,
    red_count,
    refusal,
    street_stub,
)
from serving_world import LAST_US, START_US, camera_request, lidar_request, scene

from nurec_sim import geometry
from nurec_sim.render import CpuRenderer
from nurec_sim.serving.wire import ImageFormat
from nurec_sim.serving.wire.requests import write_poses


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


def test_a_sweep_is_the_renderers_own(stub, renderer):
    reply, frame = stub.render_lidar(lidar_message()), renderer.render_lidar(lidar_request())
    assert reply.num_points == len(frame.xyz_m) > 100
    assert np.array_equal(np.frombuffer(reply.point_xyzs_buffer, "<f4").reshape(-1, 3), frame.xyz_m)
    assert np.array_equal(np.frombuffer(reply.point_intensities_buffer, "<f4"), frame.intensity)
    assert np.array_equal(np.frombuffer(reply.point_ranges_buffer, "<f4"), frame.range_m)
    assert np.array_equal(np.frombuffer(reply.point_beams_buffer, "<i4"), frame.beam)


def test_a_named_lidar_and_its_filters(stub):
    message = lidar_message()
    message.lidar_config.Clear()
    message.lidar_config.lidar_type = 1
    some = stub.render_lidar(message).num_points
    message.render_filter.opacity_threshold = 0.01
    message.render_filter.raydrop_threshold = 0.5
    all_beams = stub.render_lidar(message).num_points
    assert 100 < some < all_beams
    message.render_filter.distance_filter_threshold = 0.001
    assert stub.render_lidar(message).num_points == all_beams
    message.render_filter.enable_distance_filter = True
    assert stub.render_lidar(message).num_points < all_beams


def test_a_requested_size_scales_the_intrinsics(stub, renderer):
    message = camera_message()
    message.resolution_h, message.resolution_w = 90, 1
    small = pixels(stub.render_rgb(message), 160, 90).astype(float)
    full = renderer.render_camera(camera_request()).rgb.astype(float)
    halved = full.reshape(90, 2, 160, 2, 3).mean((1, 3))
    assert np.abs(small - halved).mean() < 4


def test_the_colour_correction_can_be_left_out(stub):
    message = camera_message()
    message.apply_isp = False
    plain = CpuRenderer(scene(), threads=2, apply_isp=False).render_camera(camera_request()).rgb
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


def test_unlisted_actors_can_be_hidden_by_option():
    with street_stub(only_listed_actors=True) as stub:
        plain = pixels(stub.render_rgb(camera_message()))
        message = camera_message()
        place(message, "nobody", np.eye(4))
        hidden = pixels(stub.render_rgb(message))
    assert red_count(plain) > 200 and red_count(hidden) == 0
    assert blue_count(hidden) == blue_count(plain)


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
