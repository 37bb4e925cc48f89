"""Malformed requests are refused with a text that says why."""

import dataclasses

import numpy as np
import pytest
from render_scenes import START_US, camera, cloud, request, scene

from nurec_sim import sensors
from nurec_sim.errors import OutOfRangeError, RequestError, TooLargeError
from nurec_sim.render import CpuRenderer, encode_image

RENDERER = CpuRenderer(scene(cloud(5)), threads=1)
GOOD = request(camera())


def refused(error, text, **changes):
    with pytest.raises(error, match=text):
        RENDERER.sense([dataclasses.replace(GOOD, **changes)])


def test_poses():
    pair = GOOD.world_from_sensor.copy()
    refused(
        RequestError, r"world_from_sensor must be two 4 x 4 poses .* got float64 \[4, 4\]", world_from_sensor=pair[0]
    )
    pair[1, 0, 3] = np.nan
    refused(RequestError, "sensor 'front': world_from_sensor must be finite", world_from_sensor=pair)
    pair = GOOD.world_from_sensor.copy()
    pair[0, :3, :3] *= 2
    refused(RequestError, "not a rotation .determinant 8.0", world_from_sensor=pair)
    pair = GOOD.world_from_sensor.copy()
    pair[0, 3] = (0, 0, 1, 1)
    refused(RequestError, "must end in the row 0 0 0 1", world_from_sensor=pair)
    refused(RequestError, "actor 'car': world_from_box must be finite", actors={"car": np.full((2, 4, 4), np.inf)})


def test_times():
    refused(RequestError, "must end after it starts", end_us=START_US)
    refused(OutOfRangeError, r"covers \[1000000, 2000000\] us, the request asks for \[999999", start_us=START_US - 1)
    refused(OutOfRangeError, "covers", start_us=2_000_000, end_us=2_000_002)
    last = dataclasses.replace(GOOD, start_us=2_000_000, end_us=2_000_001)
    assert RENDERER.render_camera(last).rgb.shape == (48, 72, 3)


def test_sensors():
    refused(
        RequestError,
        "focal lengths must be positive",
        sensor=camera(lens=dataclasses.replace(GOOD.sensor.lens, fx_px=0)),
    )
    refused(TooLargeError, "9000 x 10 pixels are too many; at most 8192 a side", sensor=camera(9000, 10))
    refused(TooLargeError, "33177600 in all", sensor=camera(8000, 8000))
    lidar = sensors.lidar_model("VLP-16", np.eye(4), columns=8)
    refused(RequestError, "range_m", sensor=dataclasses.replace(lidar, range_m=(3.0, 1.0)))
    refused(RequestError, "must be a CameraModel or a LidarModel, got str", sensor="front")
    with pytest.raises(RequestError, match="is a camera"):
        RENDERER.render_lidar(GOOD)
    with pytest.raises(RequestError, match="is a LiDAR"):
        RENDERER.render_camera(dataclasses.replace(GOOD, sensor=lidar))
    with pytest.raises(RequestError, match=r"unknown outputs \['flow'\]"):
        RENDERER.render_camera(GOOD, outputs=("rgb", "flow"))


def test_threads_and_encoding():
    with pytest.raises(ValueError, match="at least 1 thread"):
        CpuRenderer(scene(), threads=0)
    image = np.zeros((4, 4, 3), np.uint8)
    with pytest.raises(RequestError, match="unknown image format 'gif'"):
        encode_image(image, "gif")
    with pytest.raises(RequestError, match="quality must lie in 1..100, got 0"):
        encode_image(image, "jpeg", 0)
    with pytest.raises(RequestError, match="8-bit RGB"):
        encode_image(image.astype(float))
