"""What a server tells of itself: metrics, log lines, health."""

import io
import json
import logging
import threading
import time
import urllib.error

import grpc
import pytest
from grpc import StatusCode as Code
from grpc_health.v1 import health_pb2, health_pb2_grpc
from serving_calls import Gated, Stub, camera_message, refusal, wait_until
from serving_metrics import metric, scrape
from serving_world import camera_request, scene

from nurec_sim.errors import DeadlinePassedError
from nurec_sim.serving import wire
from nurec_sim.serving.calls import Call, current_call
from nurec_sim.serving.sensor_service import ServiceOptions
from nurec_sim.serving.server import SensorServer, ServerOptions, set_up_logging
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import common, sensorsim

SERVING, NOT_SERVING = health_pb2.HealthCheckResponse.SERVING, health_pb2.HealthCheckResponse.NOT_SERVING
RGB = "SensorsimService/render_rgb"


def health_at(address, service=""):
    with grpc.insecure_channel(address) as channel:
        request = health_pb2.HealthCheckRequest(service=service)
        return health_pb2_grpc.HealthStub(channel).Check(request, timeout=10).status


@pytest.fixture
def gated():
    """A renderer that waits; let through when the test ends."""
    gated = Gated(scene())
    yield gated
    gated.gate.set()


def gated_server(gated, **options):
    store, workers = SceneStore([scene()], make_renderer=lambda _: gated), ServiceOptions(render_workers=2)
    return SensorServer(store, port=0, options=workers, server_options=ServerOptions(metrics_port=0, **options))


# ------------------------------------------------------------------------------------------------------------- metrics


def test_metrics_count_calls_by_method_and_code():
    server = SensorServer(SceneStore([scene()], threads=1), port=0, server_options=ServerOptions(metrics_port=0))
    with server as address, Stub(address) as stub, Stub(address, wire.SERVICE_PATHS[2]) as other_spelling:
        stub.render_rgb(camera_message())
        other_spelling.render_rgb(camera_message())
        assert refusal(stub.render_rgb, camera_message(scene_id="nowhere"))[0] == Code.NOT_FOUND
        assert refusal(stub.channel.unary_unary("/made.up.Service/method"), b"")[0] == Code.UNIMPLEMENTED
        where = server.metrics_address
        wait_until(lambda: metric(where, "requests_total", method=RGB, code="NOT_FOUND") == 1)
        assert metric(where, "requests_total", method=RGB, code="OK") == 2
        assert metric(where, "requests_total", method="unknown", code="UNIMPLEMENTED") == 1
        assert metric(where, "request_seconds_count", method=RGB) == 3
        assert 0 < metric(where, "request_seconds_sum", method=RGB) < 60
        assert (metric(where, "scenes"), metric(where, "scenes_loaded")) == (1, 1)
        assert metric(where, "scene_bytes_loaded") > 10_000
        assert not any("made.up" in str(labels) for _, labels in scrape(where))
    with pytest.raises(urllib.error.URLError):
        scrape(where)


def test_metrics_show_what_waits_and_what_renders(gated):
    server = gated_server(gated)
    with server as address, Stub(address) as stub:
        # The first two render; then the others, of which the last is cancelled, surely wait.
        calls = [stub.render_rgb.future(camera_message(camera_request(t_us=5_100_000 + k))) for k in range(2)]
        wait_until(lambda: metric(server.metrics_address, "renders_in_flight") == 2)
        calls += [stub.render_rgb.future(camera_message(camera_request(t_us=5_100_000 + k))) for k in range(2, 5)]
        wait_until(lambda: metric(server.metrics_address, "renders_waiting") == 3)
        assert metric(server.metrics_address, "requests_in_progress") == 5
        calls[-1].cancel()
        wait_until(lambda: metric(server.metrics_address, "renders_waiting") == 2)
        gated.gate.set()
        assert all(call.result().image_bytes for call in calls[:-1])
        wait_until(lambda: metric(server.metrics_address, "requests_total", method=RGB, code="CANCELLED") == 1)


def test_two_servers_of_a_process_count_apart():
    first, second = (
        SensorServer(SceneStore([scene()]), port=0, server_options=ServerOptions(metrics_port=0)) for _ in range(2)
    )
    with first as address, second, Stub(address) as stub:
        stub.get_version(common.Empty())
        counted = {"method": "SensorsimService/get_version", "code": "OK"}
        wait_until(lambda: metric(first.metrics_address, "requests_total", **counted) == 1)
        assert metric(second.metrics_address, "requests_total", **counted) == 0


def test_a_taken_port_of_metrics_or_health_is_an_error_and_nothing_is_left_open():
    with SensorServer(SceneStore(), port=0, server_options=ServerOptions(metrics_port=0)) as address:
        taken = int(address.rsplit(":", 1)[1])
        for options in (ServerOptions(metrics_port=taken), ServerOptions(health_port=taken)):
            with pytest.raises(OSError, match=f"127.0.0.1:{taken}"):
                SensorServer(SceneStore(), port=0, server_options=options).start()


# ------------------------------------------------------------------------------------------------------------ log lines


@pytest.fixture
def log_lines():
    """Sets up logging into a text that the test reads; the log of the process is as before afterwards."""
    root, package, grpc_log = (
        logging.getLogger(),
        logging.getLogger("nurec_sim"),
        logging.getLogger("grpc._cython.cygrpc"),
    )
    before = root.handlers[:], root.level, package.level, grpc_log.filters[:]
    root.handlers = []
    text = io.StringIO()

    def begin(form, level="info"):
        set_up_logging(form, level, text)
        return lambda: text.getvalue().splitlines()

    yield begin
    root.handlers, root.level, package.level, grpc_log.filters = before


def ask_three_things(address, token):
    metadata = [("authorization", f"Bearer {token}")]
    with Stub(address) as stub:
        stub.render_rgb(camera_message(), metadata=metadata)
        with pytest.raises(grpc.RpcError):
            stub.render_rgb(camera_message(scene_id='odd"\nname'), metadata=metadata)
        batch = sensorsim.BatchRGBRenderRequest()
        batch.items.add(camera_name="front", request=camera_message())
        stub.batch_render_rgb(batch, metadata=metadata)


def test_a_call_is_one_line_of_json_without_secrets(log_lines):
    lines, token = log_lines("json"), "a-long-secret-of-ours"
    with SensorServer(SceneStore([scene()]), port=0, server_options=ServerOptions(token=token)) as address:
        ask_three_things(address, token)
        wait_until(lambda: len(lines()) == 3)
    entries = [json.loads(line) for line in lines()]
    assert [entry["code"] for entry in entries] == ["OK", "NOT_FOUND", "OK"]
    assert [entry["scene"] for entry in entries] == ["street", 'odd"\nname', "street"]
    assert entries[2]["method"] == "SensorsimService/batch_render_rgb" and entries[0]["method"] == RGB
    assert all(entry["level"] == "info" and entry["peer"].startswith("ipv4:127.0.0.1:") for entry in entries)
    assert all(0 < entry["ms"] < 60_000 and entry["time"].endswith("+00:00") for entry in entries)
    assert not any(token in line for line in lines())


def test_a_call_is_one_line_of_text_whatever_its_scene_is_called(log_lines):
    lines = log_lines("text")
    with SensorServer(SceneStore([scene()]), port=0) as address:
        ask_three_things(address, "unused")
        wait_until(lambda: len(lines()) == 3)
    assert "INFO SensorsimService/render_rgb OK " in lines()[0] and "scene='street' peer=ipv4:" in lines()[0]
    assert "NOT_FOUND" in lines()[1] and 'odd"\\nname' in lines()[1]


def test_calls_are_not_logged_above_level_info_and_bugs_are(log_lines):
    class Failing:
        def sense(self, requests, outputs=()):
            raise ZeroDivisionError("oh no")

    lines = log_lines("json", "warning")
    store = SceneStore([scene()], make_renderer=lambda _: Failing())
    with SensorServer(store, port=0) as address, Stub(address) as stub:
        assert refusal(stub.render_rgb, camera_message())[0] == Code.INTERNAL
    (line,) = lines()
    assert json.loads(line)["level"] == "error" and "ZeroDivisionError: oh no" in json.loads(line)["error"]


# --------------------------------------------------------------------------------------------------------------- health


def test_health_says_serving_only_when_the_server_is_warm_and_discovery_answers_before(gated):
    store = SceneStore([scene()], make_renderer=lambda _: gated)
    options = ServerOptions(health_port=0)
    server = SensorServer(store, port=0, options=ServiceOptions(warm_up=True), server_options=options)
    with server as address, Stub(address) as stub:
        wait_until(lambda: gated.begun)
        for name in ("", *wire.SERVICE_PATHS):
            assert health_at(address, name) == health_at(server.health_address, name) == NOT_SERVING
        assert list(stub.get_available_scenes(common.Empty(), timeout=10).scene_ids) == ["clipgt-street"]
        gated.gate.set()
        wait_until(lambda: health_at(address) == SERVING)
        assert health_at(server.health_address, wire.SERVICE) == SERVING
        with Stub(server.health_address) as probe:
            assert refusal(probe.get_version, common.Empty())[0] == Code.UNIMPLEMENTED


def test_health_says_so_first_when_the_server_stops(gated):
    server = gated_server(gated, health_port=0, stop_grace_s=20.0)
    with Stub(server.start()) as stub:
        call = stub.render_rgb.future(camera_message())
        wait_until(lambda: gated.begun)
        assert health_at(server.health_address) == SERVING
        stopping = threading.Thread(target=server.stop)
        stopping.start()
        wait_until(lambda: health_at(server.health_address) == NOT_SERVING)
        assert not call.done()
        gated.gate.set()
        assert call.result(timeout=20).image_bytes
        stopping.join(20)
        assert not stopping.is_alive()


# ---------------------------------------------------------------------------------------------------------------- calls


def test_work_is_refused_once_the_deadline_has_passed():
    Call("a", deadline_s=time.monotonic() + 60).check_deadline()
    Call("a").check_deadline()
    with pytest.raises(DeadlinePassedError, match="the deadline passed .* ms before the work was done"):
        Call("a", deadline_s=time.monotonic() - 1).check_deadline()


def test_there_is_a_call_without_a_client_outside_of_any():
    assert (current_call().method, current_call().peer, current_call().metadata) == ("", "", {})
