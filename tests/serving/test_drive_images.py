"""Encoded images of clients: refused when they are damaged or huge, seen as ideal pinholes otherwise."""

import struct
import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest
import worlds

from nurec_sim.errors import NurecSimError, RequestError, TooLargeError
from nurec_sim.render.images.encode import encode_image
from nurec_sim.sensors import scaled_camera
from nurec_sim.serving.driver.images import MAX_IMAGE_PIXELS, decode_image, image_size, see_image
from nurec_sim.serving.wire.driving import EncodedImage
from nurec_sim.sim.flat_world import START_US, demo_rig
from nurec_sim.sim.policy_sensors import policy_camera
from nurec_sim.types import Fisheye, FTheta, FThetaReference, Pinhole, SensorRequest

CAMERA = demo_rig().cameras["front_wide"]
RGB = np.random.default_rng(5).integers(0, 255, (48, 80, 3), np.uint8)
PNG, JPEG = encode_image(RGB, "png"), encode_image(RGB, "jpeg", 95)


def encoded(rgb, as_is=False, image_format="png"):
    return EncodedImage(CAMERA.id, START_US, START_US, encode_image(rgb, image_format), as_is)


def png_of_size(width, height):
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + header
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk)) + b"IEND"


def test_sizes_are_read_from_headers_alone():
    assert image_size(PNG, "it") == image_size(JPEG, "it") == (80, 48)
    progressive = cv2.imencode(".jpg", RGB, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    assert image_size(progressive, "it") == (80, 48)
    np.testing.assert_array_equal(decode_image(PNG, "it"), RGB)
    assert decode_image(JPEG, "it").shape == RGB.shape


@pytest.mark.parametrize(
    ("data", "error", "text"),
    [
        (b"", RequestError, "must be a PNG or a JPEG file, got 0 bytes"),
        (b"GIF89a and so on", RequestError, "must be a PNG or a JPEG file, got 16 bytes that begin with b'GIF89a a'"),
        (PNG[:-20], RequestError, "is truncated"),
        (JPEG[:-20], RequestError, "is truncated"),
        (PNG[:12], RequestError, "is truncated"),
        (b"\xff\xd8\xff\xd9", RequestError, "is truncated"),
        (b"\xff\xd8" + b"\xff" * 400 + b"\xff\xd9", RequestError, "is truncated"),
        (png_of_size(2**31 - 1, 2**31 - 1), TooLargeError, f"may have {MAX_IMAGE_PIXELS} pixels"),
        (png_of_size(0, 5), RequestError, "has no pixels"),
    ],
)
def test_what_is_no_image_is_refused_before_it_is_decoded(data, error, text):
    with pytest.raises(error, match="it " + text):
        image_size(data, "it")


def test_damage_inside_is_refused_or_gives_an_image_of_the_right_size():
    random = np.random.default_rng(0)
    for data in (PNG, JPEG):
        for _ in range(150):
            spoilt = bytearray(data)
            for at in random.integers(2, len(data) - 2, 4):
                spoilt[at] = random.integers(256)
            try:
                width, height = image_size(bytes(spoilt), "it")
                if width * height < 1e6:
                    assert decode_image(bytes(spoilt), "it").shape == (height, width, 3)
            except NurecSimError:
                continue


def test_an_orientation_tag_does_not_turn_the_image():
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    turned = JPEG[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + JPEG[2:]
    assert decode_image(turned, "it").shape == (48, 80, 3)


def test_an_image_as_is_stays_as_it_is():
    camera = policy_camera(CAMERA, 160)
    rgb = np.random.default_rng(1).integers(0, 255, (camera.height_px, camera.width_px, 3), np.uint8)
    frame = see_image(encoded(rgb, as_is=True), camera, 320)
    np.testing.assert_array_equal(frame.rgb, rgb)
    assert frame.camera == camera
    fisheye = replace(CAMERA, lens=Fisheye(300.0, 300.0, 320.0, 192.0))
    with pytest.raises(RequestError, match="an image as_is must be an ideal pinhole's; camera 'front_wide'"):
        see_image(encoded(rgb, as_is=True), fisheye, 320)


def seen_by(camera):
    """A flat world with a car, as a camera sees it; 2 x 2 rays a pixel, as a sensor gathers light."""
    world = worlds.parked_car_ahead(12.0)
    pose = world.ego.world_from_body[0] @ camera.rig_from_camera
    fine = scaled_camera(camera, 2 * camera.width_px, 2 * camera.height_px)
    rgb = world.sense([SensorRequest("w", fine, START_US, START_US + 1, np.stack([pose, pose]))])[0].rgb
    return cv2.resize(rgb, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA)


FTHETA = FTheta(159.75, 96.25, FThetaReference.ANGLE_TO_PIXELDIST, (), (0.0, 165.0, 0.0, -6.0), 1.4)
FISHEYE = Fisheye(155.0, 156.0, 161.0, 95.0, (0.02, -0.01, 0.0, 0.0), 1.3)
DISTORTED = Pinhole(160.0, 161.0, 159.0, 96.5, (-0.05, 0.01, 0.0, 0.0, 0.0, 0.0), (0.001, -0.001))
IDEAL = Pinhole(160.0, 160.0, 160.0, 96.0)


@pytest.mark.parametrize(
    ("lens", "sent_width_px"),
    [(FTHETA, 320), (FTHETA, 200), (FTHETA, 480), (FISHEYE, 320), (DISTORTED, 200), (IDEAL, 320), (IDEAL, 200)],
)
def test_rectified_images_show_what_the_policys_pinhole_would_have_seen(lens, sent_width_px):
    camera = replace(CAMERA, width_px=320, height_px=192, lens=lens)
    sent = scaled_camera(camera, sent_width_px, sent_width_px * 192 // 320)
    frame = see_image(encoded(seen_by(sent)), camera, 80)
    assert frame.camera.ideal_pinhole is not None
    assert (frame.camera.width_px, frame.camera.height_px) == (80, 48) == frame.rgb.shape[1::-1]
    wanted = seen_by(frame.camera)
    visible = frame.rgb.max(axis=2) > 0  # a lens may see less than the wanted pinhole does
    assert visible.mean() > 0.9
    error = np.abs(frame.rgb.astype(float) - wanted)[visible]
    assert error.mean() < 4.0 and np.quantile(error, 0.9) < 12.0


def test_jpegs_and_scaled_up_images_are_fine():
    small = scaled_camera(CAMERA, 80, 48)
    frame = see_image(encoded(seen_by(small), image_format="jpeg"), CAMERA, 160)
    assert frame.rgb.shape == (96, 160, 3)
    assert np.abs(frame.rgb.astype(float) - seen_by(frame.camera)).mean() < 12.0


@pytest.mark.parametrize(
    "lens", [Pinhole(1e300, 1e300, 1.0, 1.0), Fisheye(1e-300, 1e-300, 1.0, 1.0), Pinhole(1e-9, 1e9, 0.0, 0.0)]
)
def test_cameras_that_show_nothing_are_refused_or_black(lens):
    try:
        frame = see_image(encoded(RGB), replace(CAMERA, lens=lens), 160)
    except RequestError:
        return
    assert frame.rgb.shape[1] == 160


def test_a_very_tall_image_is_not_blown_up():
    tall = np.zeros((60_000, 2, 3), np.uint8)
    with pytest.raises(TooLargeError, match="a policy may see 4194304 pixels, not 320 x"):
        see_image(encoded(tall), CAMERA, 320)
