"""What AlpaSim's runtime sent in four rollouts, sent once more to our driver and to our sensor server over sockets."""

import grpc
import numpy as np
import pytest
from alpasim_replay import OURS, RENDERED, STREET_LOG, SUBMITTED, decoded, read_messages, scene_of
from driving_calls import Stub as DriverStub
from driving_calls import image_message, times_of, xy_of
from serving_calls import Stub as SensorStub

from nurec_sim.logs import open_clip
from nurec_sim.plugins import load_policy
from nurec_sim.serving.driver import DriverServer
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import egodriver

FILES = ("map_route", "recorded_route", "short_log_recorded_route", "short_log_no_route")
"""The first two are of a generated street and part of the repository, the others of KITTI raw 0002."""


@pytest.fixture(params=FILES)
def recording(request):
    """Name and messages of one rollout."""
    if not request.param.startswith("short_log"):
        return request.param, list(read_messages(OURS / f"{request.param}.jsonl.gz"))
    folder = request.getfixturevalue("alpasim_messages")
    return request.param, list(read_messages(folder / f"{request.param}.jsonl"))


@pytest.fixture
def clip(recording, request):
    """The log that the rollout was driven in."""
    name = recording[0]
    log = request.getfixturevalue("realdata") / "kitti_raw_0002" if name.startswith("short_log") else STREET_LOG
    return open_clip(log)


class Watching:
    """A policy that remembers what it saw."""

    def __init__(self, policy):
        self.policy, self.name, self.needs, self.seen = policy, policy.name, policy.needs, []

    def reset(self, rig, seed):
        self.policy.reset(rig, seed)

    def plan(self, observation):
        self.seen.append(observation)
        return self.policy.plan(observation)


def replayed(messages, policy):
    """Plans and observations of a policy; a recording that ends before its first question is asked one.

    Images are left out of the recordings: a grey one comes with every question.
    """
    made, answers = [], []

    def make():
        made.append(Watching(load_policy(policy)))
        return made[-1]

    if not any(kind == "driver_request" for kind, _ in messages):
        last = next(m for kind, m in messages if kind == "driver_ego_trajectory")
        now_us = last.trajectory.poses[-1].timestamp_us
        asked = egodriver.DriveRequest(session_uuid=last.session_uuid, time_now_us=now_us, time_query_us=now_us)
        messages = [*messages, ("driver_request", asked)]
    camera = next(m for kind, m in messages if kind == "driver_camera_image").camera_image.logical_id
    with DriverServer(make, port=0) as address, DriverStub(address) as stub:
        for kind, message in messages:
            if kind == "driver_request":
                image = image_message(end_us=message.time_now_us, camera=camera, session=message.session_uuid)
                stub.submit_image_observation(image, timeout=20)
            if kind in SUBMITTED:
                reply = getattr(stub, SUBMITTED[kind])(message, timeout=20)
            if kind == "driver_request":
                answers.append(reply)
        close = egodriver.DriveSessionCloseRequest(session_uuid=messages[-1][1].session_uuid)
        stub.close_session(close, timeout=20)
    return answers, made[-1].seen


def true_speeds(messages, clip, times_us):
    """Speed at each time, by what the car did before and after it: the log while it follows that, then its own poses.

    A driver knows nothing of what comes after, and nothing of the log.
    """
    sent = [p for kind, m in messages if kind == "driver_ego_trajectory" for p in m.trajectory.poses]
    t_us, at = np.array([p.timestamp_us for p in sent]), np.array([(p.pose.vec.x, p.pose.vec.y) for p in sent])
    log_us, log_at = clip.ego.t_us, clip.ego.world_from_body[:, :2, 3]
    off = np.linalg.norm(at - clip.ego.at(np.clip(t_us, log_us[0], log_us[-1]))[:, :2, 3], axis=1)
    free_us = t_us[off > 0.01].min(initial=log_us[-1])
    keep = t_us >= free_us
    all_us = np.concatenate([log_us[log_us < free_us], t_us[keep]])
    path = np.concatenate([log_at[log_us < free_us], at[keep]])
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    around = np.clip(times_us[:, None] + np.array([-50_000, 50_000]), all_us[0], all_us[-1])
    where = np.interp(around, all_us, arc)
    return (where[:, 1] - where[:, 0]) * 1e6 / (around[:, 1] - around[:, 0])


def test_plans_go_at_the_true_speed_from_the_first_call_on(recording, clip):
    messages = recording[1]
    answers, seen = replayed(messages, "constant_velocity")
    now_us = np.array([observation.t_us for observation in seen])
    assert len(answers) == max(1, sum(kind == "driver_request" for kind, _ in messages))
    planned = np.array([
        np.linalg.norm(np.diff(xy_of(answer), axis=0), axis=1).sum() * 1e6 / np.ptp(times_of(answer))
        for answer in answers
    ])  # fmt: skip
    true = true_speeds(messages, clip, now_us)
    print(np.column_stack([planned, true, planned / true - 1]).round(3))
    np.testing.assert_allclose(planned, true, rtol=0.05)
    np.testing.assert_allclose([o.ego.speed_mps for o in seen], planned, rtol=1e-4)


def test_routes_are_those_of_the_log_without_their_padding(recording):
    name, messages = recording
    routes = [m.route for kind, m in messages if kind == "route_request"]
    _, seen = replayed(messages, "constant_velocity")
    lengths = [len(observation.route_m) for observation in seen]
    expected = {"map_route": [20] * 25, "recorded_route": [20] * 13, "short_log_recorded_route": [3]}
    assert lengths == expected.get(name, [0] * 6)
    for observation, route in zip(seen, routes, strict=False):
        told = np.array([(p.x, p.y) for p in route.waypoints])[: len(observation.route_m)]
        np.testing.assert_allclose(observation.route_m, told, atol=2e-2)  # KITTI's car pitches
        assert np.isfinite(observation.route_m).all()


@pytest.mark.parametrize("policy", ["camera_road_follower", "log_replay"])
def test_every_policy_for_alpasim_answers_all_that_was_asked(recording, policy):
    answers, seen = replayed(recording[1], policy)
    assert len(answers) == len(seen) and all(len(a.trajectory.poses) == 51 for a in answers)
    assert all(times_of(answer)[0] == observation.t_us for answer, observation in zip(answers, seen, strict=True))


def test_the_sensor_server_renders_all_that_was_asked(recording, clip):
    """Of a scene with the log's id, cameras, path and tracks; what it shows is a plain."""
    frames = 0
    with SensorServer(SceneStore([scene_of(clip)], threads=1), port=0) as address, SensorStub(address) as stub:
        for kind, message in recording[1]:
            if kind not in RENDERED:
                continue
            try:
                reply = getattr(stub, RENDERED[kind])(message, timeout=60)
            except grpc.RpcError as error:
                pytest.fail(f"{kind} is refused: {error.details()}")
            if kind == "available_cameras_request":
                ids = {camera.logical_id for camera in reply.available_cameras}
            elif kind == "render_request":
                check(message, reply)
                frames += 1
            elif kind == "batch_render_request":
                assert sorted(item.camera_name for item in reply.items) == sorted(i.camera_name for i in message.items)
                for item, asked in zip(reply.items, message.items, strict=True):
                    assert item.success and asked.camera_name in ids
                    check(asked.request, item.result)
                    frames += 1
    assert frames >= 2


def check(request, reply):
    rgb = decoded(reply.image_bytes)
    assert rgb.shape[:2] == (request.resolution_h, request.resolution_w)
    assert rgb.std() > 10  # AlpaSim drops rollouts with black images; this one shows ground and sky
