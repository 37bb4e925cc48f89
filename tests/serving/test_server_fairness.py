"""What one client may ask for, and what another gets meanwhile."""

import threading
import time

import grpc
import numpy as np
import pytest
from grpc import StatusCode as Code
from serving_calls import (
    Gated,
    Stub,
    camera_message,
    lidar_message,
    pixels,
    place,
    refusal,
    street_renderer,
    street_server,
    street_stub,
    wait_until,
    with_change,
)
from serving_world import camera_request, scene

from nurec_sim import geometry
from nurec_sim.compute.turns import rest
from nurec_sim.serving.sensor_service import ServiceOptions
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import ImageFormat, sensorsim

FRONT, ROOF = 320 * 180, 16 * 180


def sized(width, height, image_format=ImageFormat.JPEG):
    def change(message):
        message.resolution_w, message.resolution_h, message.image_format = width, height, image_format

    return with_change(change)


def test_a_call_may_ask_for_so_many_rays_in_all():
    request = sensorsim.AggregatedRenderRequest(rgb_requests=[camera_message()] * 2, lidar_requests=[lidar_message()])
    with street_stub(max_call_rays=2 * FRONT + ROOF) as stub:
        assert len(stub.render_aggregated(request).rgb_returns) == 2
        request.lidar_requests.append(lidar_message())
        code, text = refusal(stub.render_aggregated, request)
        assert code == Code.RESOURCE_EXHAUSTED
        assert text == (
            "a call may ask for 118,080 pixels and beams in all (max_call_rays), got 120,960; "
            "ask for fewer or smaller frames"
        )
        batch = sensorsim.BatchRGBRenderRequest()
        for _ in range(3):
            batch.items.add(request=camera_message())
        assert "got 172,800" in refusal(stub.batch_render_rgb, batch)[1]
        assert "got 480,000" in refusal(stub.render_rgb, sized(800, 600))[1]


def test_sixty_four_of_the_largest_images_are_refused_before_anything_is_drawn():
    request = sensorsim.AggregatedRenderRequest(rgb_requests=[sized(7680, 4320)] * 64)
    with street_stub() as stub:
        begin = time.monotonic()
        code, text = refusal(stub.render_aggregated, request)
        assert code == Code.RESOURCE_EXHAUSTED and "got 2,123,366,400" in text
        assert time.monotonic() - begin < 5


def test_a_connection_may_ask_for_so_many_rays_at_a_time_and_others_still_may():
    gated = Gated(scene())
    store = SceneStore([scene()], make_renderer=lambda _: gated)
    options = ServiceOptions(max_client_rays=2 * FRONT)
    server = SensorServer(store, port=0, options=options)
    with server as address, Stub(address) as stub:
        first = [stub.render_rgb.future(camera_message()) for _ in range(2)]
        wait_until(lambda: gated.begun)

        def both_held():
            if first[1].done():  # refused: a third image was read before it
                first[1] = stub.render_rgb.future(camera_message())
            time.sleep(0.1)
            return refused_for_now(stub) and not first[1].done()

        wait_until(both_held)
        with Stub(address) as other:  # gRPC would let both share a connection: another kind of channel has its own
            other.channel.close()
            other.channel = grpc.insecure_channel(address, [("grpc.use_local_subchannel_pool", 1)])
            call = other.channel.unary_unary("/sensorsim.SensorsimService/render_rgb").future(
                camera_message().SerializeToString()
            )
            gated.gate.set()
            assert call.result(timeout=20)
        assert all(call.result(timeout=20).image_bytes for call in first)
        assert stub.render_rgb(camera_message()).image_bytes  # what has ended does not count


def refused_for_now(stub):
    """Whether a third image is too much; the first two may not have been read yet."""
    try:
        stub.render_rgb(camera_message(), timeout=0.5)
    except grpc.RpcError as error:
        text = "the calls of a connection may ask for 115,200 pixels and beams at a time (max_client_rays); 115,200 are"
        return error.code() == Code.RESOURCE_EXHAUSTED and text in error.details()
    return False


@pytest.mark.parametrize("make", [camera_message, lidar_message])
def test_a_frame_may_place_so_many_actors(make):
    message = make()
    for k in range(6):
        place(message, f"actor-{k}", geometry.pose_from_xyyaw(k, 0.0, 0.0))
    with street_stub(max_actors=5) as stub:
        procedure = stub.render_rgb if make is camera_message else stub.render_lidar
        code, text = refusal(procedure, message)
        assert code == Code.RESOURCE_EXHAUSTED
        assert text == "a frame may place 5 actors (max_actors), got 6 dynamic_objects"
        del message.dynamic_objects[5]
        assert procedure(message).ByteSize() > 100


def test_many_actors_are_read_alike_and_an_error_names_the_one():
    pose = geometry.pose_from_xyyaw(9.0, 1.0, 0.3)
    message = camera_message()
    for k in range(500):
        place(message, f"actor-{k}", pose)
    place(message, "car-1", pose)
    expected = street_renderer().render_camera(camera_request(actors={"car-1": np.stack([pose, pose])})).rgb
    with street_stub() as stub:
        assert np.array_equal(pixels(stub.render_rgb(message)), expected)
        message.dynamic_objects[321].pose_pair.end_pose.exact[0] = 7.0
        code, text = refusal(stub.render_rgb, message)
        assert code == Code.INVALID_ARGUMENT
        assert text.startswith("dynamic_objects['actor-321'].pose_pair.end_pose.exact must be a rigid transform")


def test_a_request_that_is_too_large_is_not_received():
    with street_server(max_request_bytes=1000) as address, Stub(address) as stub:
        send = stub.channel.unary_unary("/sensorsim.SensorsimService/render_rgb")
        code, text = refusal(send, b"\xff" * 1001)
        assert code == Code.RESOURCE_EXHAUSTED and "1001 vs. 1000" in text
        assert refusal(send, b"\xff" * 1000)[0] == Code.INVALID_ARGUMENT


class Resting:
    """A renderer whose large images take until they are let go, or cancelled, and rest meanwhile."""

    def __init__(self, world):
        self.inner, self.go, self.begun, self.ended = street_renderer(), threading.Event(), threading.Event(), 0

    def sense(self, requests, outputs=()):
        if requests[0].sensor.width_px > 320:
            self.begun.set()
            try:
                while not self.go.is_set():
                    time.sleep(0.001)
                    rest()
            finally:
                self.ended += 1
        return self.inner.sense(requests, outputs)


def test_a_small_image_is_done_while_a_large_one_is_under_way_which_ends_with_its_client():
    renderer = Resting(scene())
    store = SceneStore([scene()], make_renderer=lambda _: renderer)
    with SensorServer(store, port=0, options=ServiceOptions(render_workers=1)) as address, Stub(address) as stub:
        large = stub.render_rgb.future(sized(640, 360))
        assert renderer.begun.wait(20)
        assert stub.render_rgb(camera_message(), timeout=20).image_bytes
        assert not large.done()
        large.cancel()
        wait_until(lambda: renderer.ended)
        renderer.begun.clear()
        while not renderer.begun.is_set():  # a busy machine may not begin it in time
            late = stub.render_rgb.future(sized(640, 360), timeout=0.3)
            assert late.exception().code() == Code.DEADLINE_EXCEEDED
        wait_until(lambda: renderer.ended == 2)
        assert stub.render_rgb(camera_message(), timeout=20).image_bytes


def test_images_of_a_batch_that_are_of_one_scene_are_rendered_together():
    seen = []

    class Counting:
        def __init__(self, world):
            self.inner, self.name = street_renderer(), world.id

        def sense(self, requests, outputs=()):
            seen.append((self.name, len(requests), outputs))
            return self.inner.sense(requests, outputs)

    store = SceneStore([scene(), scene("other", seed=1)], make_renderer=Counting)
    batch = sensorsim.BatchRGBRenderRequest()
    for k, name in enumerate(["street", "other", "street", "nowhere", "street"]):
        batch.items.add(camera_name=str(k), request=camera_message(scene_id=name))
    batch.items[2].request.image_format = ImageFormat.JPEG2000
    batch.items[2].request.resolution_w, batch.items[2].request.resolution_h = 16, 9  # too small for this format
    with SensorServer(store, port=0) as address, Stub(address) as stub:
        items = stub.batch_render_rgb(batch).items
    assert sorted(seen) == [("other", 1, ("rgb",)), ("street", 3, ("rgb",))]
    assert [item.success for item in items] == [True, True, False, False, True]
    assert "a JPEG2000 needs sides of at least 32 pixels" in items[2].error_message
    assert items[3].error_code == Code.NOT_FOUND.value[0]
