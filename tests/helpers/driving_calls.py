"""Policies that behave and misbehave, raw calls of a driver, and what AlpaSim's runtime would say to it."""

import asyncio
import contextlib
import time

import grpc
import numpy as np
from raw_calls import RawCalls

from nurec_sim import geometry
from nurec_sim.render.images.encode import encode_image
from nurec_sim.serving.driver import DriverOptions, DriverServer
from nurec_sim.serving.wire import driving, driving_states, egodriver
from nurec_sim.sim.flat_world import demo_rig
from nurec_sim.types import EgoState, Needs, Plan

START_US = 5_000_000
NOW_US = START_US + 500_000
TIMES = 100_000 * np.arange(1, 51)


class Steady:
    """Straight on at 5 m/s, veering by its seed; remembers what it saw."""

    name = "steady"
    needs = Needs()

    def __init__(self):
        self.seen = []

    def reset(self, rig, seed):
        self.rig, self.seed, self.seen = rig, seed, []

    def plan(self, observation):
        self.seen.append(observation)
        pose = np.zeros((50, 3))
        pose[:, 0] = 0.5 * np.arange(1, 51)
        pose[:, 1] = self.seed % 7
        return Plan(observation.t_us + TIMES, pose)


class Looking(Steady):
    name = "looking"
    needs = Needs(cameras=("front",), image_width_px=160)


def answering(plan_of, needs=None):
    """A policy class that answers ``plan_of(observation)`` to the first question and drives steadily afterwards."""

    class Odd(Steady):
        name = "odd"

        def plan(self, observation):
            steady = super().plan(observation)
            return plan_of(observation) if len(self.seen) == 1 else steady

    Odd.needs = needs or Needs()
    return Odd


class Stub(RawCalls):
    """Raw procedures of a driver."""

    def __init__(self, address):
        super().__init__(grpc.insecure_channel(address), driving.DRIVER_SERVICE, driving.DRIVER_METHODS)


@contextlib.contextmanager
def driver(policy=Steady, **options):
    """Raw procedures of a driver of ``policy``, and the instances that it has made."""
    made = []

    def make():
        made.append(policy())
        return made[-1]

    with DriverServer(make, port=0, options=DriverOptions(**options)) as address, Stub(address) as stub:
        stub.address, stub.made = address, made
        yield stub


def status(procedure, message, timeout=20):
    """(code, text) of a call that must be refused."""
    try:
        procedure(message, timeout=timeout)
    except grpc.RpcError as error:
        return error.code(), error.details()
    raise AssertionError("the call was answered")


def opening(session="s", seed=1, rig=None, names=None):
    message = egodriver.DriveSessionRequest()
    driving.write_session_start(driving.SessionStart(session, seed, rig or demo_rig(), names or {}), message)
    return message


def ego_state(t_us=NOW_US, x=0.0, y=0.0, yaw=0.0, speed=5.0):
    return EgoState(t_us, geometry.pose_from_xyyaw(x, y, yaw), speed, 0.3, 0.1, 0.05)


def ego_message(*states, session="s"):
    message = egodriver.RolloutEgoTrajectory(session_uuid=session)
    driving_states.write_states(states or (ego_state(),), message)
    return message


def image_message(rgb=None, end_us=NOW_US, camera="front_wide", session="s", data=None, as_is=False):
    rgb = np.full((96, 160, 3), 90, np.uint8) if rgb is None else rgb
    data = encode_image(rgb, "png") if data is None else data
    message = egodriver.RolloutCameraImage(session_uuid=session)
    driving.write_encoded_image(driving.EncodedImage(camera, end_us - 30_000, end_us, data, as_is), message)
    return message


def drive_message(now_us=NOW_US, session="s"):
    return egodriver.DriveRequest(session_uuid=session, time_now_us=now_us, time_query_us=now_us)


def like_alpasim(message):
    """The message without our additions, as AlpaSim's runtime would send it."""
    for field, value in list(message.ListFields()):
        if field.number >= 2001:
            message.ClearField(field.name)
        elif field.type == field.TYPE_MESSAGE:
            for entry in value if field.is_repeated else [value]:
                like_alpasim(entry)
    return message


def xy_of(response):
    return np.array([(p.pose.vec.x, p.pose.vec.y) for p in response.trajectory.poses])


def times_of(response):
    return np.array([p.timestamp_us for p in response.trajectory.poses])


def wait_until(condition, seconds=10):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


def run(coroutine):
    return asyncio.run(coroutine)
