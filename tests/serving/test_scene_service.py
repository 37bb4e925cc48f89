"""The scene service: lists, statistics, geometry of cameras, range maps, unloading."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from serving_calls import Gated, wait_until
from serving_world import camera_request, lidar_request, scene

from nurec_sim.errors import (
    ArchiveError,
    OutOfRangeError,
    RequestError,
    ServerError,
    TooLargeError,
    UnknownSceneError,
)
from nurec_sim.render import CpuRenderer
from nurec_sim.scene import write_scene
from nurec_sim.serving import wire
from nurec_sim.serving.connection import open_channel
from nurec_sim.serving.scene_client import SceneClient
from nurec_sim.serving.sensor_service import ServiceOptions
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import nurec_sim_v1 as v1

OUTPUTS = ("depth", "alpha", "label", "normal")


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    return write_scene(scene("stored"), tmp_path_factory.mktemp("scenes") / "stored.usdz")


@pytest.fixture(scope="module")
def address(archive, tmp_path_factory):
    broken = tmp_path_factory.mktemp("broken") / "broken.usdz"
    broken.write_bytes(b"no archive")
    store = SceneStore([scene(), archive, broken], threads=2)
    with SensorServer(store, port=0) as address:
        yield address


@pytest.fixture
def client(address):
    with SceneClient(address, timeout_s=60) as client:
        yield client


@pytest.fixture(scope="module")
def renderer():
    return CpuRenderer(scene(), threads=2)


def test_scenes_are_listed_with_their_state_and_faults(client, archive):
    client.render_camera(camera_request(), ())
    reply = client.scenes()
    street, stored = reply.scenes
    assert (street.scene_id, stored.scene_id) == ("clipgt-street", "clipgt-stored")
    assert (street.kind, stored.kind) == ("memory", "archive")
    assert street.loaded and street.loaded_bytes > 50_000 and not street.users and not street.uploaded
    assert stored.file_bytes == archive.stat().st_size
    assert list(reply.faults) == ["broken"] and "broken.usdz" in reply.faults["broken"]


@pytest.mark.parametrize("camera", ["front", "wide", "fish"])
def test_cameras_give_geometry_and_labels_bit_for_bit(client, renderer, camera):
    request = camera_request(camera)
    ours, theirs = renderer.render_camera(request, ("rgb", *OUTPUTS)), client.render_camera(request)
    for name in ("rgb", "depth_m", "alpha", "label", "normal"):
        here, there = getattr(ours, name), getattr(theirs, name)
        assert here.dtype == there.dtype and np.array_equal(here, there), name
    assert (ours.depth_m > 1).any() and len(np.unique(ours.label)) > 1


def test_a_camera_gives_only_what_is_asked_for(client, address):
    frame = client.render_camera(camera_request(), ("label",))
    assert frame.label is not None and frame.depth_m is None and frame.normal is None and frame.alpha is None
    message = v1.RenderCameraRequest(outputs=[wire.CameraOutput.DEPTH])
    wire.write_camera_request(camera_request(), message.request, scene_id="street")
    message.request.image_format = 0  # nobody wants colours
    reply = call(address, "RenderCamera", message)
    assert (reply.width, reply.height, len(reply.depth_m), reply.rgb) == (320, 180, 4 * 320 * 180, b"")
    del message.outputs[:]
    message.request.image_format = wire.ImageFormat.PNG
    reply = call(address, "RenderCamera", message)
    assert reply.rgb.startswith(b"\x89PNG") and not reply.depth_m


def test_points_of_any_lidar_are_those_of_the_renderer(client, renderer):
    ours, theirs = renderer.render_lidar(lidar_request()), client.render_lidar(lidar_request())
    for name in ("xyz_m", "range_m", "intensity", "beam"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name)), name


def test_a_range_map_has_a_value_for_every_beam(client, renderer):
    sweep = renderer.render_lidar(lidar_request())
    range_m, intensity = client.range_map(lidar_request())
    assert range_m.shape == intensity.shape == (16, 180) and range_m.dtype == np.float32
    assert np.array_equal(range_m.ravel()[sweep.beam], sweep.range_m)
    assert np.array_equal(intensity.ravel()[sweep.beam], sweep.intensity)
    assert 0 < np.count_nonzero(range_m) == len(sweep.beam) < range_m.size


def call(address, name, message):
    """A raw call."""
    method = wire.pool.FindServiceByName(wire.SCENE_SERVICE).methods_by_name[name]
    reply = getattr(v1, method.output_type.name)
    with open_channel(address) as channel:
        return channel.unary_unary(f"/{wire.SCENE_SERVICE}/{name}", type(message).SerializeToString, reply.FromString)(
            message, timeout=60
        )


def test_bad_requests_are_explained(client, address):
    with pytest.raises(UnknownSceneError, match="scene 'nowhere' is not served"):
        client.render_camera(camera_request(scene_id="nowhere"))
    with pytest.raises(OutOfRangeError, match="lies outside of scene 'street'"):
        client.range_map(lidar_request(9_000_000))
    with pytest.raises(ArchiveError, match="scene 'broken' cannot be served"):
        client.render_camera(camera_request(scene_id="broken"))
    for name, message, text in [
        ("RenderCamera", v1.RenderCameraRequest(), "request is missing"),
        ("RenderLidar", v1.RenderLidarRequest(), "request is missing"),
        ("RenderCamera", v1.RenderCameraRequest(outputs=[9]), r"outputs must be among RGB \(0\).*; got \[9\]"),
        ("RenderLidar", v1.RenderLidarRequest(form=7, request={}), r"form must be one of POINTS \(0\).*; got 7"),
        ("RenderLidar", v1.RenderLidarRequest(request={"scene_id": "street"}), "needs start < end"),
    ]:
        with pytest.raises(Exception, match=text):
            call(address, name, message)


def test_raw_outputs_have_the_limit_of_a_message():
    options = ServiceOptions(max_message_bytes=1 << 20)
    with SensorServer(SceneStore([scene()], threads=1), port=0, options=options) as address:
        with SceneClient(address, timeout_s=60) as client:
            with pytest.raises(TooLargeError, match="the raw pixels of this reply may take 1,382,400 bytes"):
                client.render_camera(camera_request())
            assert client.render_camera(camera_request(), ("depth",)).depth_m is not None
            request = lidar_request()
            assert len(client.range_map(request)[0]) == 16


def test_statistics_count_loads_hits_and_evictions():
    store = SceneStore([scene("a"), scene("b")], capacity=1, threads=1)
    with SensorServer(store, port=0) as address, SceneClient(address, timeout_s=60) as client:
        for name in ("a", "a", "b"):
            client.render_lidar(lidar_request(scene_id=name))
        stats = client.stats()
    assert (stats["loads"], stats["evictions"], stats["loaded"], stats["capacity"]) == (2, 1, 1, 1)
    assert stats["hits"] >= 1 and stats["in_use"] == 0 and stats["load_seconds"] > 0 and stats["scenes"] == 2
    assert 0 < stats["loaded_bytes"] < stats["max_loaded_bytes"]


def test_a_scene_in_use_cannot_be_unloaded():
    gated = Gated(scene())
    store = SceneStore([scene()], make_renderer=lambda _: gated)
    with SensorServer(store, port=0) as address, SceneClient(address, timeout_s=60) as client:
        assert client.unload("street") == 0
        with open_channel(address) as channel:
            message = wire.sensorsim.RGBRenderRequest()
            wire.write_camera_request(camera_request(), message, scene_id="street")
            render = channel.unary_unary(f"/{wire.SERVICE}/render_rgb", message.__class__.SerializeToString)
            waiting = render.future(message)
            wait_until(lambda: gated.begun)
            (entry,) = client.scenes().scenes
            assert entry.users == 1 and client.stats()["frames_rendering"] == 1
            with pytest.raises(ArchiveError, match=r"scene 'clipgt-street' is in use \(1 calls\)"):
                client.unload("street")
            gated.gate.set()
            waiting.result(30)
        wait_until(lambda: not client.scenes().scenes[0].users)
        freed = client.unload("street")
        assert freed > 50_000 and client.stats()["loaded"] == 0
        with pytest.raises(UnknownSceneError):
            client.unload("nowhere")
        with pytest.raises(ServerError, match="UNIMPLEMENTED: this server has no folder for uploads"):
            client.unload("street", delete_file=True)


def test_clients_check_what_they_send_and_get(client):
    with pytest.raises(RequestError, match="must be a LidarModel, got CameraModel"):
        client.range_map(camera_request())
    reply = v1.RenderCameraReply(width=4, height=3, depth_m=b"\0" * 8)
    with pytest.raises(RequestError, match="depth_m has 2 values, which do not make 4x3"):
        wire.read_outputs(reply)
    with pytest.raises(RequestError, match=r"range_m and intensity must hold 16x180 values, got \[4, 0\] .* \(2, 2\)"):
        wire.read_range_map(v1.RangeMap(rows=2, columns=2, range_m=b"\0" * 16, intensity=b""), lidar_request())


@pytest.mark.slow
def test_clients_of_more_scenes_than_fit_get_the_right_frames():
    names = ("a", "b", "c")
    store = SceneStore([scene(name, seed=i) for i, name in enumerate(names)], capacity=1, threads=1)
    with SensorServer(store, port=0, options=ServiceOptions(render_workers=2)) as address:
        with SceneClient(address, timeout_s=60) as client:

            def ask(name):
                return client.render_camera(camera_request("front", scene_id=name), ("depth",)).rgb.tobytes()

            alone = {name: ask(name) for name in names}
            order = np.random.default_rng(3).choice(names, 60)
            with ThreadPoolExecutor(8) as pool:
                together = list(pool.map(ask, order))
            stats = client.stats()
    assert len(set(alone.values())) == 3 and together == [alone[name] for name in order]
    assert stats["in_use"] == 0 and stats["loaded"] == 1 and stats["evictions"] == stats["loads"] - 1 > 3
