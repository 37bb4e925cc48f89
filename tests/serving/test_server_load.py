"""Batches, many clients at once, clients that leave, and a server that stops in between."""

import itertools
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from grpc import StatusCode as Code
from grpc_health.v1 import health_pb2, health_pb2_grpc
from serving_calls import (
    Gated,
    Stub,
    camera_message,
    lidar_message,
    pixels,
    refusal,
    street_server,
    street_stub,
    wait_until,
    with_change,
)
from serving_metrics import metric
from serving_world import LAST_US, START_US, camera_request, lidar_request, scene

from nurec_sim.render import CpuRenderer
from nurec_sim.serving.sensor_service import ServiceOptions
from nurec_sim.serving.server import SensorServer, ServerOptions
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import common, sensorsim


def test_a_batch_answers_every_item_and_says_what_is_wrong_with_one(stub, renderer):
    batch = sensorsim.BatchRGBRenderRequest()
    batch.items.add(camera_name="front", request=camera_message())
    batch.items.add(camera_name="bad", request=with_change(lambda m: m.sensor_pose.start_pose.quat.Clear()))
    batch.items.add(camera_name="fish", request=camera_message(camera_request("fish")))
    front, bad, fish = stub.batch_render_rgb(batch).items
    assert (front.camera_name, bad.camera_name, fish.camera_name) == ("front", "bad", "fish")
    assert front.success and np.array_equal(pixels(front.result), renderer.render_camera(camera_request()).rgb)
    assert fish.success and len(fish.result.image_bytes) == 120 * 90 * 3
    assert not bad.success and "must have a unit quaternion" in bad.error_message
    assert bad.error_code == Code.INVALID_ARGUMENT.value[0] and not bad.result.image_bytes


def test_a_batch_has_a_limit(stub):
    batch = sensorsim.BatchRGBRenderRequest()
    for i in range(65):
        batch.items.add(camera_name=str(i))
    assert refusal(stub.batch_render_rgb, batch) == (Code.RESOURCE_EXHAUSTED, "a batch may have 64 items, got 65")


def test_an_aggregate_holds_images_and_sweeps(stub):
    request = sensorsim.AggregatedRenderRequest(
        rgb_requests=[camera_message(), camera_message(camera_request("fish"))], lidar_requests=[lidar_message()]
    )
    reply = stub.render_aggregated(request)
    assert [len(r.image_bytes) for r in reply.rgb_returns] == [320 * 180 * 3, 120 * 90 * 3]
    assert [r.num_points for r in reply.lidar_returns] == [stub.render_lidar(lidar_message()).num_points]
    request.lidar_requests[0].scene_id = "nowhere"
    assert refusal(stub.render_aggregated, request)[0] == Code.NOT_FOUND


@pytest.mark.parametrize("workers", [1, 2])
def test_eight_clients_at_once_get_what_one_gets(workers):
    requests = [camera_request(c, t) for c in ("front", "fish") for t in range(START_US, LAST_US, 500_000)]
    messages = [camera_message(r) for r in requests]
    with street_stub(render_workers=workers) as stub:
        alone = [stub.render_rgb(m).image_bytes for m in messages]
        with ThreadPoolExecutor(8) as pool:
            jobs = [pool.submit(stub.render_rgb, m) for m in messages * 4]
            slowest = slowest_health_check(stub.channel, until=jobs)
            together = [job.result().image_bytes for job in jobs]
    assert together == alone * 4
    assert slowest < 1.0


@pytest.mark.slow
def test_sixteen_clients_of_cameras_and_lidars_get_what_one_gets():
    """Each client has a channel of its own, asks in its own order, and for two scenes."""
    asked = []
    for scene_id, t_us in itertools.product(("street", "other"), (5_100_000, 6_300_000)):
        for camera in ("front", "wide", "fish"):
            asked.append(("render_rgb", camera_message(camera_request(camera, t_us), scene_id=scene_id)))
        asked.append(("render_lidar", lidar_message(lidar_request(t_us), scene_id=scene_id)))
    begin = threading.Barrier(16)

    def ask(address, seed):
        order = np.random.default_rng(seed).permutation(len(asked))
        with Stub(address) as stub:
            begin.wait(30)
            replies = {k: getattr(stub, asked[k][0])(asked[k][1], timeout=60) for k in order}
        return [replies[k].SerializeToString(deterministic=True) for k in range(len(asked))]

    with street_server(render_workers=2) as address, ThreadPoolExecutor(16) as pool:
        with Stub(address) as stub:
            alone = [getattr(stub, name)(message).SerializeToString(deterministic=True) for name, message in asked]
        together = list(pool.map(ask, [address] * 16, range(16)))
    assert len(set(alone)) > len(asked) // 2  # some see nothing in which the two scenes differ
    assert all(replies == alone for replies in together)


def start_soak(*options):
    program = Path(__file__).parents[2] / "benchmarks" / "soak.py"
    # Where pytest itself runs in the background, its children ignore Ctrl-C.
    listening = "import os, runpy, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    listening += "sys.argv = sys.argv[1:]; sys.path.insert(0, os.path.dirname(sys.argv[0])); "
    listening += "runpy.run_path(sys.argv[0], run_name='__main__')"
    command = [sys.executable, "-c", listening, str(program), "--width", "64", "--height", "36", *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the memory of a process is read from /proc")
def test_memory_does_not_grow_with_frames():
    """A short form of ``benchmarks/soak.py``."""
    with start_soak("--frames", "300") as soak:
        text = soak.communicate(timeout=120)[0]
    assert soak.returncode == 0 and "300 frames" in text and "memory grew by" in text, text


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the memory of a process is read from /proc")
def test_an_interrupted_soak_says_what_it_has_seen():
    with start_soak("--frames", "1000000", "--direct") as soak:
        lines = []
        for line in soak.stdout:
            lines.append(line)
            if "to warm up" in line:
                soak.send_signal(signal.SIGINT)
    assert lines[-2] == "interrupted\n" and "memory grew by" in lines[-1], lines


def slowest_health_check(channel, until):
    health, slowest = health_pb2_grpc.HealthStub(channel), 0.0
    while not all(job.done() for job in until):
        begin = time.perf_counter()
        health.Check(health_pb2.HealthCheckRequest(), timeout=10)
        slowest = max(slowest, time.perf_counter() - begin)
        time.sleep(0.01)
    return slowest


def test_what_a_client_gave_up_is_not_rendered():
    gated = Gated(scene())
    store, one = SceneStore([scene()], make_renderer=lambda _: gated), ServiceOptions(render_workers=1)
    server = SensorServer(store, port=0, options=one, server_options=ServerOptions(metrics_port=0))
    with server as address, Stub(address) as stub:
        first = stub.render_rgb.future(camera_message(camera_request(t_us=5_100_000)))
        wait_until(lambda: gated.begun)
        cancelled = stub.render_rgb.future(camera_message(camera_request(t_us=5_200_000)))
        too_late = stub.render_rgb.future(camera_message(camera_request(t_us=5_300_000)), timeout=0.3)
        assert health_pb2_grpc.HealthStub(stub.channel).Check(health_pb2.HealthCheckRequest(), timeout=20).status == 1
        assert too_late.exception().code() == Code.DEADLINE_EXCEEDED
        cancelled.cancel()
        wait_until(lambda: metric(server.metrics_address, "requests_in_progress") == 1)
        gated.gate.set()
        assert first.result().image_bytes
        assert stub.render_rgb(camera_message(camera_request(t_us=5_400_000))).image_bytes
    assert gated.begun == [5_100_000, 5_400_000]


def test_a_scene_that_loads_does_not_hold_up_the_others():
    gate, begun = threading.Event(), []

    def make_renderer(loading):
        begun.append(loading.id)
        assert loading.id == "street" or gate.wait(30)
        return CpuRenderer(loading, threads=2)

    store = SceneStore([scene(), scene("slow")], make_renderer=make_renderer)
    with SensorServer(store, port=0) as address, Stub(address) as stub:
        waiting = [stub.render_rgb.future(camera_message(scene_id="slow")) for _ in range(8)]
        waiting[0].cancel()
        assert stub.render_rgb(camera_message(), timeout=20).image_bytes
        assert stub.get_loaded_scenes(common.Empty(), timeout=20).scenes[0].scene_id == "clipgt-street"
        gate.set()
        assert all(call.result().image_bytes for call in waiting[1:])
    assert sorted(begun) == ["slow", "street"]


def test_a_frame_in_progress_is_finished_before_the_server_stops():
    gated = Gated(scene())
    server = SensorServer(SceneStore([scene()], make_renderer=lambda _: gated), port=0)
    with Stub(server.start()) as stub:
        call = stub.render_rgb.future(camera_message())
        wait_until(lambda: gated.begun)
        stopping = threading.Thread(target=server.stop)
        stopping.start()
        time.sleep(0.2)
        gated.gate.set()
        assert call.result(timeout=20).image_bytes
        stopping.join(20)
        assert not stopping.is_alive()
