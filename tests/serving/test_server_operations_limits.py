"""Clients that ask too often, read too slowly, come in crowds, leave, or wait too short a time."""

import contextlib
import resource
import time
from concurrent.futures import ThreadPoolExecutor

import grpc
import pytest
from grpc import StatusCode as Code
from grpc_health.v1 import health_pb2, health_pb2_grpc
from serving_calls import Gated, Stub, camera_message, wait_until
from serving_metrics import metric
from serving_world import camera_request, scene
from slow_reader import SlowReader

from nurec_sim.serving import wire
from nurec_sim.serving.calls import address_of
from nurec_sim.serving.sensor_service import ServiceOptions
from nurec_sim.serving.server import SensorServer, ServerOptions
from nurec_sim.serving.server.gate import RateLimit, UnreadReplies
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import common, sensorsim

RENDER = f"/{wire.SERVICE}/render_rgb"
FRAME_BYTES = 320 * 180 * 3


@contextlib.contextmanager
def gated_server():
    """A server whose renderer waits to be let through, raw calls to it, the renderer, and where its metrics are."""
    gated, options = Gated(scene()), ServiceOptions(render_workers=2)
    store = SceneStore([scene()], make_renderer=lambda _: gated)
    server = SensorServer(store, port=0, options=options, server_options=ServerOptions(metrics_port=0))
    with server as address, Stub(address) as stub:
        try:
            yield stub, gated, server.metrics_address
        finally:
            gated.gate.set()


@contextlib.contextmanager
def street(**options):
    """A server of the street: its address, raw calls to it, and where its metrics are."""
    options = ServerOptions(metrics_port=0, **options)
    server = SensorServer(SceneStore([scene()], threads=1), port=0, server_options=options)
    with server as address, Stub(address) as stub:
        yield address, stub, server.metrics_address


# ---------------------------------------------------------------------------------------------------------------- rate


def test_a_bucket_fills_at_its_rate_and_no_further():
    now = 0.0
    limit = RateLimit(per_s=2.0, burst=3, clock=lambda: now)
    assert [limit.allows("a") for _ in range(4)] == [True, True, True, False]
    assert limit.allows("b")  # another address has a bucket of its own
    now = 0.6
    assert [limit.allows("a") for _ in range(2)] == [True, False]
    now = 1000.0
    assert [limit.allows("a") for _ in range(4)] == [True, True, True, False]


def test_buckets_of_many_addresses_take_bounded_room():
    limit = RateLimit(per_s=1.0, burst=1, clock=lambda: 0.0)
    for i in range(20_000):
        assert limit.allows(str(i))
    assert len(limit._buckets) == 10_000


@pytest.mark.parametrize(
    ("peer", "address"),
    [("ipv4:10.0.0.1:5000", "ipv4:10.0.0.1"), ("ipv6:%5B::1%5D:80", "ipv6:%5B::1%5D"), ("unix:", "unix:")],
)
def test_all_connections_of_an_address_share_its_bucket(peer, address):
    assert address_of(peer) == address


def test_who_calls_too_often_is_told_and_health_is_not_counted():
    with street(rate_per_s=0.001, rate_burst=5) as (address, stub, _), Stub(address) as second:
        codes = []
        for k in range(8):
            try:
                (stub if k % 2 else second).get_version(common.Empty(), timeout=10)
                codes.append(Code.OK)
            except Exception as error:
                codes.append(error.code())
                assert "more than 0.001 calls a second from this address" in error.details()
        assert codes == [Code.OK] * 5 + [Code.RESOURCE_EXHAUSTED] * 3
        health = health_pb2_grpc.HealthStub(stub.channel)
        assert {health.Check(health_pb2.HealthCheckRequest(), timeout=10).status for _ in range(20)} == {1}


@pytest.mark.parametrize(
    "name", ["rate_per_s", "rate_burst", "max_calls", "max_request_bytes", "max_message_bytes", "max_unread_bytes"]
)
def test_limits_must_let_something_through(name):
    with pytest.raises(ValueError, match=f"{name} must be above 0, got 0"):
        ServerOptions(**{name: 0})


# -------------------------------------------------------------------------------------------------------- slow readers


def test_unread_replies_are_bounded_for_one_connection_and_for_all():
    unread = UnreadReplies(1000)
    assert unread.refusal("a", 5000) is None  # a single reply may have any size
    unread.add("a", 200)
    assert unread.refusal("a", 50) is None
    assert "200 bytes of replies wait to be read by this connection" in unread.refusal("a", 51)
    for peer in "bcd":
        assert unread.refusal(peer, 250) is None
        unread.add(peer, 250)
    assert "950 bytes of replies wait to be read by clients" in unread.refusal("e", 51)
    unread.remove("b", 250)
    assert unread.refusal("e", 51) is None and unread.total == 700


def test_a_client_that_does_not_read_is_bounded_and_the_others_are_served():
    with street(max_unread_bytes=8 * FRAME_BYTES) as (address, stub, metrics):
        stub.render_rgb(camera_message())
        with SlowReader(address) as slow:
            for _ in range(50):
                slow.ask(RENDER, camera_message().SerializeToString())
            wait_until(lambda: metric(metrics, "requests_in_progress") == 0)
            assert FRAME_BYTES <= metric(metrics, "unread_reply_bytes") <= 2.1 * FRAME_BYTES
            refused = {"method": "SensorsimService/render_rgb", "code": "RESOURCE_EXHAUSTED"}
            assert metric(metrics, "requests_total", **refused) >= 48
            assert len(stub.render_rgb(camera_message(), timeout=30).image_bytes) == FRAME_BYTES
        wait_until(lambda: metric(metrics, "unread_reply_bytes") == 0)


# --------------------------------------------------------------------------------------------------- crowds of clients


def test_a_thousand_connections_are_answered_and_one_more_is_served():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= hard < 2500:
        pytest.skip(f"this process may have {hard} files open; a thousand connections take 2000")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2500), hard))
    try:
        with street() as (address, stub, _), contextlib.ExitStack() as crowd:
            many = [crowd.enter_context(SlowReader(address, window=1 << 16)) for _ in range(1000)]
            for one in many:
                one.ask(f"/{wire.SERVICE}/get_version", b"")
            assert all(one.answered() for one in many)
            begin = time.perf_counter()
            assert stub.render_rgb(camera_message(), timeout=30).image_bytes
            for one in many[::100]:
                one.ask(f"/{wire.SERVICE}/get_available_scenes", b"")
                assert one.answered()
            assert time.perf_counter() - begin < 20
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def outcome(procedure, message):
    """The code of a call, and what it says if it is refused."""
    try:
        procedure(message, timeout=30)
    except grpc.RpcError as error:
        return error.code(), error.details()
    return Code.OK, ""


def test_calls_in_progress_have_a_limit():
    gated = Gated(scene())
    store = SceneStore([scene()], make_renderer=lambda _: gated)
    server = SensorServer(store, port=0, server_options=ServerOptions(max_calls=3))
    with server as address, Stub(address) as stub:
        held = [stub.render_rgb.future(camera_message(), timeout=60) for _ in range(3)]
        full = (Code.RESOURCE_EXHAUSTED, "3 calls are in progress; try again later")
        wait_until(lambda: outcome(stub.get_version, common.Empty()) == full)  # all three are inside
        gated.gate.set()
        assert all(call.result().image_bytes for call in held)
        assert stub.get_version(common.Empty(), timeout=10).version_id


# ------------------------------------------------------------------------------------- clients that leave or wait less


def test_the_rest_of_a_batch_is_not_rendered_for_a_client_that_left():
    with gated_server() as (stub, gated, metrics):
        batch = sensorsim.BatchRGBRenderRequest()
        for k in range(8):
            batch.items.add(camera_name=str(k), request=camera_message(camera_request(t_us=5_100_000 + k)))
        call = stub.batch_render_rgb.future(batch)
        wait_until(lambda: gated.begun)
        call.cancel()
        wait_until(lambda: metric(metrics, "requests_in_progress") == 0)
        before = len(gated.begun)
        gated.gate.set()
        assert stub.render_rgb(camera_message(camera_request(t_us=6_000_000)), timeout=30).image_bytes
        assert len(gated.begun) == before + 1 and gated.begun[-1] == 6_000_000 and before < 8


def test_a_deadline_shorter_than_the_render_ends_the_call_and_nothing_more_is_begun_for_it():
    with gated_server() as (stub, gated, metrics):
        begin = time.monotonic()
        calls = [stub.render_rgb.future(camera_message(), timeout=0.3) for _ in range(6)]
        assert {call.exception().code() for call in calls} == {Code.DEADLINE_EXCEEDED}
        assert time.monotonic() - begin < 10
        wait_until(lambda: metric(metrics, "requests_in_progress") == 0)
        begun = len(gated.begun)
        gated.gate.set()
        assert stub.render_rgb(camera_message(), timeout=30).image_bytes
        assert len(gated.begun) == begun + 1 and begun < 6


def test_many_clients_that_come_and_go_leave_nothing_behind():
    with street() as (address, stub, metrics):
        stub.render_rgb(camera_message())

        def come_and_go(k):
            with Stub(address) as one:
                call = one.render_rgb.future(camera_message())
                time.sleep(0.002 * (k % 5))
                call.cancel()

        with ThreadPoolExecutor(8) as pool:
            list(pool.map(come_and_go, range(40)))
        assert stub.render_rgb(camera_message(), timeout=30).image_bytes
        for name in ("requests_in_progress", "renders_waiting", "renders_in_flight", "unread_reply_bytes"):
            wait_until(lambda name=name: metric(metrics, name) == 0)
