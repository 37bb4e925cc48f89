"""Remote sensors: the same frames and the same errors as a renderer in this process."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from serving_world import LAST_US, camera_request, lidar_request, rig, scene

from nurec_sim import geometry
from nurec_sim.errors import (
    OutOfRangeError,
    RequestError,
    ServerError,
    TooLargeError,
    UnknownSceneError,
)
from nurec_sim.render import CpuRenderer
from nurec_sim.serving import client
from nurec_sim.serving.client import RemoteSensors
from nurec_sim.serving.sensor_service import ServiceOptions
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.types import LidarModel, Pinhole


@pytest.fixture(scope="module")
def world():
    return scene()


@pytest.fixture(scope="module")
def renderer(world):
    return CpuRenderer(world, threads=2)


@pytest.fixture(scope="module")
def address(world):
    with SensorServer(SceneStore([world], threads=2), port=0) as address:
        yield address


@pytest.fixture(scope="module")
def remote(address):
    with RemoteSensors(address, "street", timeout_s=30) as remote:
        yield remote


def mixed_requests():
    odd = geometry.pose(geometry.matrix_from_quat(np.array([0.9, 0.01, -0.02, 0.3])), np.array([1 / 3, 2 / 7, 0.81]))
    actors = {"car-1": np.stack([odd @ geometry.pose_from_xyyaw(9, -1, 0), odd @ geometry.pose_from_xyyaw(9.3, -1, 0)])}
    return [
        camera_request("front", actors=actors),
        lidar_request(),
        camera_request("wide", 5_900_001),
        camera_request("front", 6_000_003),
        camera_request("fish"),
        lidar_request(6_100_000),
    ]


def assert_same(ours, theirs):
    assert (ours.start_us, ours.end_us) == (theirs.start_us, theirs.end_us)
    names = ("xyz_m", "range_m", "intensity", "beam") if hasattr(ours, "beam") else ("rgb",)
    for name in names:
        a, b = getattr(ours, name), getattr(theirs, name)
        assert a.dtype == b.dtype and a.flags.writeable and np.array_equal(a, b), name


def test_remote_frames_are_the_local_ones_bit_for_bit(remote, renderer):
    requests = mixed_requests()
    frames = remote.sense(requests)
    assert len(frames) == len(requests)
    for request, far, near in zip(requests, frames, renderer.sense(requests), strict=True):
        assert_same(far, near)
        assert (far.lidar if isinstance(request.sensor, LidarModel) else far.camera) is request.sensor
    assert remote.sense([]) == []


def test_the_colour_correction_follows_the_client(address, world):
    with RemoteSensors(address, "street", timeout_s=30, apply_isp=False) as remote:
        (far,) = remote.sense([camera_request()])
    (near,) = CpuRenderer(world, threads=2, apply_isp=False).sense([camera_request()])
    assert np.array_equal(far.rgb, near.rgb)


def test_batches_are_split_by_size_and_by_name(monkeypatch, remote, renderer):
    requests = [camera_request(c, t) for t in (5_200_000, 5_300_000) for c in ("front", "fish", "wide")]
    assert list(client._batches(requests)) == [[0, 1, 2], [3, 4, 5]]
    monkeypatch.setattr(client, "_BATCH_REPLY_BYTES", 3 * 320 * 180)
    assert list(client._batches(requests)) == [[0], [1, 2], [3], [4, 5]]
    for far, near in zip(remote.sense(requests), renderer.sense(requests), strict=True):
        assert_same(far, near)
    monkeypatch.setattr(client, "MAX_BATCH_ITEMS", 1)
    assert list(client._batches(requests)) == [[i] for i in range(6)]


def test_what_the_server_tells_of_a_scene_is_what_it_has(remote, world):
    assert remote.scenes() == ["clipgt-street"]
    assert list(remote.cameras()) == list(world.rig.cameras) and list(remote.lidars()) == ["roof"]
    for camera_id, camera in remote.cameras().items():
        own = world.rig.cameras[camera_id]
        assert (camera.id, camera.width_px, camera.height_px, camera.shutter) == (
            own.id, own.width_px, own.height_px, own.shutter
        )  # fmt: skip
        assert np.array_equal(camera.rig_from_camera, own.rig_from_camera)
    assert np.array_equal(remote.lidars()["roof"].rig_from_lidar, world.rig.lidars["roof"].rig_from_lidar)
    assert np.array_equal(remote.trajectory().world_from_body, world.ego.world_from_body)
    assert [t.id for t in remote.tracks()] == ["car-1", "parked-1"]
    assert remote.server_config()["render_workers"] == str(ServiceOptions().render_workers) and remote.version()


def far_away():
    return replace(camera_request(), start_us=LAST_US + 10, end_us=LAST_US + 20)


def nan_pose():
    return replace(camera_request(), world_from_sensor=np.full((2, 4, 4), np.nan))


def too_large():
    return replace(camera_request(), sensor=replace(rig().cameras["front"], width_px=10_000, height_px=10_000))


def bad_lens():
    return replace(camera_request(), sensor=replace(rig().cameras["front"], lens=Pinhole(-1.0, 255.0, 161.3, 88.7)))


@pytest.mark.parametrize(
    ("request_", "error", "text"),
    [
        (far_away(), OutOfRangeError, "camera 'front': the frame .* lies outside of scene 'street'"),
        (too_large(), TooLargeError, "10000x10000 pixels"),
        (bad_lens(), RequestError, "camera_intrinsics: "),
        (replace(lidar_request(), start_us=1, end_us=2), OutOfRangeError, "lies outside of scene 'street'"),
        (replace(camera_request(), end_us=0), RequestError, "needs start < end"),
        (nan_pose(), RequestError, "finite"),
    ],
)
def test_errors_come_back_as_ours(remote, request_, error, text):
    with pytest.raises(error, match=text) as caught:
        remote.sense([camera_request("fish"), request_])
    assert type(caught.value) is error
    assert remote.sense([camera_request("fish")])[0].rgb.shape == (90, 120, 3)


def test_an_unknown_scene_is_said_on_every_call(address):
    with RemoteSensors(address, "nowhere", timeout_s=30) as remote:
        for call in (remote.cameras, remote.trajectory, remote.tracks, lambda: remote.sense([camera_request()])):
            with pytest.raises(UnknownSceneError, match=r"scene 'nowhere' is not served; have \['clipgt-street'\]"):
                call()


def test_a_server_that_is_not_there_is_an_error_in_time():
    begin = time.monotonic()
    with (
        RemoteSensors("127.0.0.1:9", "street", timeout_s=0.5) as remote,
        pytest.raises(ServerError, match="127.0.0.1:9: the server cannot be reached within 0.5 s"),
    ):
        remote.scenes()
    assert time.monotonic() - begin < 5


def test_a_client_waits_for_a_server_and_survives_its_restart(world, renderer):
    first = SensorServer(SceneStore([world], threads=2), port=0)
    address = first.start()
    port = int(address.rsplit(":", 1)[1])
    with RemoteSensors(address, "street", timeout_s=30) as remote:
        assert remote.scenes()
        first.stop()
        second = SensorServer(SceneStore([world], threads=2), port=port)
        starting = threading.Timer(0.5, second.start)
        starting.start()
        try:
            (far,) = remote.sense([camera_request()])
            assert_same(far, renderer.render_camera(camera_request()))
        finally:
            starting.join()
            second.stop()
