"""Whatever a message holds, reading it gives a sound request or a ``RequestError``, never another exception."""

import contextlib
import sys

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from serving_world import camera_request, lidar_request, rig

from nurec_sim.errors import RequestError
from nurec_sim.sensors import check_camera, check_lidar
from nurec_sim.serving import wire
from nurec_sim.serving.calls import parse
from nurec_sim.serving.wire import sensorsim
from nurec_sim.types import CameraModel

FLOAT32_MAX = float(np.finfo(np.float32).max)
STRANGE = [0.0, -0.0, 1.0, -1.0, 1e-30, 1e30, float("nan"), float("inf"), -float("inf"), FLOAT32_MAX]
UINT32 = st.sampled_from([0, 1, 2, 8193, 2**31, 2**32 - 1]) | st.integers(0, 4000)
VALUE_OF_KIND = {
    "bool": st.booleans(),
    "enum": st.integers(-1, 9),
    "string": st.text(max_size=4) | st.sampled_from(["front", "street"]),
    "uint32": UINT32,
    "fixed64": st.sampled_from([0, 1, 5_500_000, 5_600_000, 2**62, 2**63, 2**64 - 1]),
    "float": st.sampled_from(STRANGE) | st.floats(-3, 3, width=32),
    "double": st.sampled_from([*STRANGE, sys.float_info.max, 5e-324]) | st.floats(-400, 400),
}
KINDS = {1: "double", 2: "float", 6: "fixed64", 8: "bool", 9: "string", 13: "uint32", 14: "enum"}


def fields_of(message, path=()):
    """Paths of all scalar fields of a message and of the messages in it."""
    for field in message.DESCRIPTOR.fields:
        if field.type != field.TYPE_MESSAGE:
            yield (*path, field.name), field
        elif not field.is_repeated:
            yield from fields_of(getattr(message, field.name), (*path, field.name))
        else:
            for i, entry in enumerate(getattr(message, field.name)):
                yield from fields_of(entry, (*path, field.name, i))


def mutate(data, message, count):
    """Gives some fields of a message strange values."""
    fields = list(fields_of(message))
    for _ in range(count):
        path, field = data.draw(st.sampled_from(fields))
        holder = message
        for step in path[:-1]:
            if isinstance(step, str):
                holder = getattr(holder, step)
            elif step < len(holder):
                holder = holder[step]
            else:
                return
        value = VALUE_OF_KIND[KINDS[field.type]]
        if not field.is_repeated:
            setattr(holder, field.name, data.draw(value))
            continue
        values = getattr(holder, field.name)
        if len(values) and data.draw(st.booleans()):
            values[data.draw(st.integers(0, min(len(values) - 1, 7)))] = data.draw(value)
        else:
            del values[:]
            values.extend(data.draw(st.lists(value, max_size=16)))


def template(camera_id):
    message = sensorsim.RGBRenderRequest()
    actors = {"car-1": camera_request().world_from_sensor}
    wire.write_camera_request(camera_request(camera_id, actors=actors), message, scene_id="street")
    return message.SerializeToString()


CAMERAS = [template(camera_id) for camera_id in rig().cameras]
FUZZ = settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))


def is_sound(request):
    assert 0 <= request.start_us < request.end_us <= 2**62
    for pair in (request.world_from_sensor, *request.actors.values()):
        assert pair.shape == (2, 4, 4) and np.isfinite(pair).all()
        np.testing.assert_allclose(pair[:, :3, :3] @ pair[:, :3, :3].swapaxes(1, 2), np.tile(np.eye(3), (2, 1, 1)),
                                   atol=1e-2)  # fmt: skip
    (check_camera if isinstance(request.sensor, CameraModel) else check_lidar)(request.sensor)


@FUZZ
@given(st.data(), st.sampled_from(CAMERAS), st.integers(1, 3))
def test_strange_camera_requests(data, start, count):
    message = sensorsim.RGBRenderRequest.FromString(start)
    mutate(data, message, count)
    with contextlib.suppress(RequestError):
        request, options = wire.read_camera_request(message, rig().cameras)
        is_sound(request)
        assert 1 <= options.quality <= 100


@FUZZ
@given(st.data(), st.integers(1, 3))
def test_strange_lidar_requests(data, count):
    message = sensorsim.LidarRenderRequest()
    wire.write_lidar_request(lidar_request(), message, scene_id="street")
    mutate(data, message, count)
    with contextlib.suppress(RequestError):
        request, filter = wire.read_lidar_request(message)
        is_sound(request)
        assert 0 <= filter.opacity_threshold <= 1 and 0 <= filter.raydrop_threshold <= 1
        assert filter.distance_threshold_m is None or 0 <= filter.distance_threshold_m < np.inf


@FUZZ
@given(st.binary(max_size=64), st.sampled_from(list(wire.METHODS.values())))
def test_strange_bytes(noise, method):
    with contextlib.suppress(RequestError):
        assert isinstance(parse(method.request, noise), method.request)
