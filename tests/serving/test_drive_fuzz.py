"""Whatever a client says, a driver answers or refuses with a status of the map, and goes on driving."""

import asyncio
import collections
import sys
import warnings

import grpc
import numpy as np
import pytest
from driving_calls import (
    NOW_US,
    Looking,
    drive_message,
    ego_message,
    ego_state,
    image_message,
    opening,
    xy_of,
)
from repetition import slow_after

from nurec_sim import geometry
from nurec_sim.errors import NurecSimError
from nurec_sim.serving import wire
from nurec_sim.serving.calls import parse
from nurec_sim.serving.driver import DriverOptions, DriverService
from nurec_sim.serving.wire import driving, driving_paths, egodriver
from nurec_sim.sim.flat_world import demo_rig
from nurec_sim.types import ActorState, LidarFrame, Needs

STRANGE = [0.0, -0.0, 1.0, -1.0, 1e-45, 5e-324, 1e30, 3.4e38, sys.float_info.max, np.nan, np.inf, -np.inf]
WHOLE = [0, 1, 2, 255, 8193, NOW_US, NOW_US + 1, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63, 2**64 - 1]
TEXTS = ["", "s", "front_wide", "top", "\0", "x" * 300, "ä"]
NUMBERS = {1: STRANGE, 2: STRANGE, 4: WHOLE, 6: WHOLE, 8: [False, True], 9: TEXTS, 13: WHOLE, 14: range(-1, 9)}
LIMITS = {13: 2**32 - 1, 2: 3.4e38}


class Everything(Looking):
    """Reads all that can be submitted."""

    name = "everything"
    needs = Needs(cameras=("front",), lidars=("any",), image_width_px=64, privileged=True)


def messages():
    """One of each kind that a session is made of, all well."""
    ego, rig = ego_state(), demo_rig()
    route, recorded = egodriver.RouteRequest(session_uuid="s"), egodriver.GroundTruthRequest(session_uuid="s")
    driving_paths.write_route(ego, np.array([[4.0, 0.1], [8.0, 0.3]]), np.array([5.0, 6.0]), route.route)
    poses = np.array([[0.5, 0.0, 0.0], [1.0, 0.1, 0.1]])
    driving_paths.write_recorded(ego, NOW_US + np.array([100_000, 200_000]), poses, recorded.ground_truth)
    points = np.array([[5.0, 0, 0], [6.0, 1, 0]], np.float32)
    ranges = np.array([5.0, 6.1], np.float32)
    frame = LidarFrame(
        rig.lidars["top"], NOW_US - 100_000, NOW_US, points, ranges, ranges / 10, np.array([3, 4], np.int32)
    )
    sweep, actors = egodriver.RolloutLidarSweep(session_uuid="s"), egodriver.RolloutActors(session_uuid="s")
    driving.write_sweep(frame, sweep)
    actors.timestamp_us = NOW_US
    box = geometry.pose_from_xyyaw(9.0, 1.0, 0.2, 0.8)
    driving.write_actors([ActorState("a", "bus", (9.0, 2.5, 3.0), box, np.array([3.0, 0.0]))], actors)
    return {
        "submit_image_observation": image_message(np.full((48, 80, 3), 90, np.uint8)),
        "submit_egomotion_observation": ego_message(ego_state(NOW_US - 100_000), ego),
        "submit_route": route,
        "submit_recording_ground_truth": recorded,
        "submit_lidar_observation": sweep,
        "submit_actor_observation": actors,
        "drive": drive_message(),
    }


def scalars(message):
    """(holder, field) of all scalar fields in a message."""
    for field in message.DESCRIPTOR.fields:
        if field.type != field.TYPE_MESSAGE:
            yield message, field
        elif field.is_repeated and not field.message_type.GetOptions().map_entry:
            for entry in getattr(message, field.name):
                yield from scalars(entry)
        elif not field.is_repeated and message.HasField(field.name):
            yield from scalars(getattr(message, field.name))


def spoil(message, random):
    """Gives a field of a message a strange value."""
    fields = list(scalars(message))
    holder, field = fields[random.integers(len(fields))]
    if field.type == field.TYPE_BYTES:
        data = bytearray(getattr(holder, field.name))
        for _ in range(random.integers(1, 5)):
            if data:
                data[random.integers(len(data))] = random.integers(256)
        setattr(holder, field.name, bytes(data[: random.integers(len(data) + 1)] if random.random() < 0.3 else data))
        return
    choices = NUMBERS[field.type]
    value = choices[random.integers(len(choices))]
    if field.type in LIMITS and np.isfinite(value):
        value = min(value, LIMITS[field.type])
    if not field.is_repeated:
        setattr(holder, field.name, value)
        return
    values = getattr(holder, field.name)
    if len(values) and random.random() < 0.6:
        values[random.integers(len(values))] = value
    elif len(values) and random.random() < 0.5:
        del values[random.integers(len(values)) :]
    else:
        values.append(value)


def mutated(message, random):
    """The bytes of a message with a few strange fields, or with a few strange bytes."""
    copy = type(message).FromString(message.SerializeToString())
    for _ in range(random.integers(1, 4)):
        spoil(copy, random)
    data = bytearray(copy.SerializeToString())
    if data and random.random() < 0.2:
        for _ in range(random.integers(1, 4)):
            data[random.integers(len(data))] = random.integers(256)
        data = data[: random.integers(len(data) + 1)] if random.random() < 0.3 else data
    return bytes(data)


async def say(service, name, data):
    """The status of a call, as the server would answer it."""
    try:
        await getattr(service, name)(parse(driving.DRIVER_METHODS[name].request, data))
    except NurecSimError as error:
        assert str(error)
        return wire.code_of(error)
    return grpc.StatusCode.OK


async def fuzz(random, count):
    service = DriverService(Everything, DriverOptions(max_sessions=4))
    good, statuses = messages(), collections.Counter()
    names = [*good, "start_session", "close_session"]
    templates = {
        **good,
        "start_session": opening(),
        "close_session": egodriver.DriveSessionCloseRequest(session_uuid="s"),
    }
    for i in range(count):
        if i % 8 == 0:  # a session that everything but the spoilt messages fits
            service.close()
            await service.start_session(opening())
            for name in names[:6]:
                await getattr(service, name)(good[name])
        name = names[random.integers(len(names))]
        statuses[name, await say(service, name, mutated(templates[name], random))] += 1
        if i % 8 == 7:
            statuses["drive", await say(service, "drive", good["drive"].SerializeToString())] += 1
    service.close()
    await service.start_session(opening())
    for name in names[:6]:
        await getattr(service, name)(good[name])
    assert np.allclose(xy_of(await service.drive(good["drive"]))[-1], [25.0, 1.0])
    service.close()
    return statuses


@pytest.mark.parametrize("count", slow_after(1, [1500, 4000]))
def test_mutated_requests_get_a_status_of_the_map(count):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        statuses = asyncio.run(fuzz(np.random.default_rng(11), count))
    codes = collections.Counter()
    for (_, code), count in statuses.items():
        codes[code.name] += count
    assert set(codes) <= {
        "OK", "INVALID_ARGUMENT", "NOT_FOUND", "ALREADY_EXISTS", "FAILED_PRECONDITION", "RESOURCE_EXHAUSTED"
    }  # fmt: skip
    assert sum(codes.values()) >= count and codes["INVALID_ARGUMENT"] > count / 8 and codes["OK"] > count / 8
    assert statuses["drive", grpc.StatusCode.OK] > count / 80


@pytest.mark.parametrize("name", driving.DRIVER_METHODS)
def test_empty_messages_are_answered_or_refused(name):
    async def once():
        service = DriverService(Everything)
        return await say(service, name, b"")

    code = asyncio.run(once())
    unsure = {"get_version", "get_policy"}
    assert (code is grpc.StatusCode.OK) == (name in unsure)
