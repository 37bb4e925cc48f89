"""A server to call, raw calls, and renderers that misbehave, for the tests of the server."""

import contextlib
import threading
import time

import cv2
import grpc
import numpy as np
import pytest
from raw_calls import RawCalls
from serving_world import camera_request, lidar_request, scene

from nurec_sim.compute.turns import rest
from nurec_sim.render import CpuRenderer
from nurec_sim.serving import wire
from nurec_sim.serving.sensor_service import ServiceOptions
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import ImageFormat, sensorsim
from nurec_sim.serving.wire.requests import write_poses


class Stub(RawCalls):
    """Raw procedures of a server, under any spelling of the service."""

    def __init__(self, address: str, path: str = wire.SERVICE) -> None:
        options = [("grpc.max_receive_message_length", 64 << 20)]
        super().__init__(grpc.insecure_channel(address, options=options), path, wire.METHODS)


@contextlib.contextmanager
def street_server(*more, **options):
    """Serves the street, another scene and ``more`` sources; gives the address."""
    store = SceneStore([scene(), scene("other", seed=1), *more], threads=2)
    with SensorServer(store, port=0, options=ServiceOptions(**options)) as address:
        yield address


@contextlib.contextmanager
def street_stub(*more, **options):
    """Raw procedures of such a server."""
    with street_server(*more, **options) as address, Stub(address) as stub:
        yield stub


def street_renderer():
    return CpuRenderer(scene(), threads=2)


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


def decode(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]


def with_change(change, message=None):
    message = message or camera_message()
    change(message)
    return message


def red_count(image):
    return int(((image[..., 0] > 120) & (image[..., 1] < 80)).sum())


def blue_count(image):
    return int(((image[..., 2] > 120) & (image[..., 0] < 80)).sum())


def place(message, track_id, pose):
    pair = message.dynamic_objects.add(track_id=track_id).pose_pair
    write_poses(np.stack([pose, pose]), [pair.start_pose, pair.end_pose])


class Failing:
    """A renderer with a bug."""

    def __init__(self, scene):
        self.scene = scene

    def sense(self, requests, outputs=()):
        raise ZeroDivisionError("oh no")


class Gated:
    """A renderer that waits to be let through, and counts."""

    def __init__(self, scene):
        self.inner, self.gate, self.begun = CpuRenderer(scene, threads=2), threading.Event(), []

    def sense(self, requests, outputs=()):
        frames = []
        for request in requests:
            rest()
            self.begun.append(request.start_us)
            assert self.gate.wait(30)
            frames += self.inner.sense([request], outputs)
        return frames


def wait_until(condition, seconds=20):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)
