"""A server that answers nonsense: the client says which server, which call and which field, and blames no request."""

from concurrent import futures

import grpc
import numpy as np
import pytest
from google.protobuf import message_factory
from serving_world import camera_request, lidar_request

from nurec_sim.errors import RequestError, ServerError
from nurec_sim.serving import wire
from nurec_sim.serving.client import RemoteSensors
from nurec_sim.serving.scene_client import SceneClient
from nurec_sim.serving.wire import nurec_sim_v1 as v1
from nurec_sim.serving.wire import sensorsim


class Liar(grpc.GenericRpcHandler):
    """Answers every call with the message or the bytes that ``replies`` has for its name."""

    def __init__(self):
        self.replies = {}

    def service(self, details):
        service, name = details.method.strip("/").split("/")
        method = wire.pool.FindServiceByName(service).methods_by_name[name]
        request = message_factory.GetMessageClass(method.input_type)

        def answer(message, context):
            reply = self.replies[name]
            return reply if isinstance(reply, bytes) else reply.SerializeToString()

        return grpc.unary_unary_rpc_method_handler(answer, request.FromString, lambda data: data)


@pytest.fixture(scope="module")
def liar():
    server = grpc.server(futures.ThreadPoolExecutor(2))
    handler = Liar()
    server.add_generic_rpc_handlers([handler])
    handler.address = f"127.0.0.1:{server.add_insecure_port('127.0.0.1:0')}"
    server.start()
    yield handler
    server.stop(0).wait()


def batch(**result):
    reply = sensorsim.BatchRGBRenderReturn()
    item = reply.items.add(camera_name="front", success=True)
    item.result.image_bytes = result.get("image_bytes", b"")
    return reply


def cameras(**fields):
    reply = sensorsim.AvailableCamerasReturn()
    entry = reply.available_cameras.add(logical_id="front")
    entry.rig_to_camera.quat.w = fields.get("w", 1.0)
    return reply


def lidars():
    reply = sensorsim.AvailableLidarsReturn()
    entry = reply.available_lidars.add(logical_id="roof")
    entry.rig_from_lidar.quat.w = 1.0
    entry.lidar_config.lidar_type = 77
    return reply


def trajectories():
    reply = sensorsim.AvailableTrajectoriesReturn()
    reply.available_trajectories.add().trajectory.poses.add().pose.vec.x = float("nan")
    return reply


def tracks():
    reply = sensorsim.DynamicObjectsReturn()
    reply.dynamic_objects.add(id="car")
    return reply


SENSORS = [
    ("batch_render_rgb", batch(image_bytes=b"abc"), lambda c: c.sense([camera_request("front")]),
     "camera 'front': image_bytes must hold 320x180 planar RGB, 172,800 bytes, got 3"),
    ("batch_render_rgb", sensorsim.BatchRGBRenderReturn(), lambda c: c.sense([camera_request("front")]),
     r"items lack camera 'front'; have \[\]"),
    ("render_lidar", sensorsim.LidarRenderReturn(num_points=2, point_xyzs_buffer=b"\0" * 12),
     lambda c: c.sense([lidar_request()]), "lidar 'roof': num_points says 2, but there are 3 point_xyzs, 0 point_int"),
    ("render_lidar", sensorsim.LidarRenderReturn(point_xyzs_buffer=b"\0" * 3), lambda c: c.sense([lidar_request()]),
     "point_xyzs_buffer must hold 4 bytes a value, got 3"),
    ("get_available_cameras", cameras(), lambda c: c.cameras(), "camera 'front': camera_intrinsics must hold"),
    ("get_available_cameras", cameras(w=2.0), lambda c: c.cameras(), "camera 'front': rig_to_camera must have a unit"),
    ("get_available_lidars", lidars(), lambda c: c.lidars(), "LiDAR 'roof': lidar_type must be one of"),
    ("get_available_trajectories", trajectories(), lambda c: c.trajectory(), "available_trajectories.0..0. must be"),
    ("get_dynamic_objects", tracks(), lambda c: c.tracks(), "track 'car': "),
]  # fmt: skip


@pytest.mark.parametrize(("name", "reply", "call", "text"), SENSORS)
def test_a_malformed_reply_is_the_servers_fault(liar, name, reply, call, text):
    liar.replies = {name: reply}
    with RemoteSensors(liar.address, "street", timeout_s=10) as remote, pytest.raises(ServerError, match=text) as error:
        call(remote)
    assert str(error.value).startswith(f"{liar.address}: malformed reply to {name}: ")


def test_a_malformed_reply_of_the_scene_service_too(liar):
    liar.replies = {
        "RenderCamera": v1.RenderCameraReply(rgb=b"abc"),
        "RenderLidar": v1.RenderLidarReply(range_map=v1.RangeMap(rows=2, columns=2)),
    }
    with SceneClient(liar.address, timeout_s=10) as client:
        with pytest.raises(ServerError, match="malformed reply to RenderCamera: camera 'front': rgb must hold 320x180"):
            client.render_camera(camera_request("front"))
        with pytest.raises(ServerError, match="malformed reply to RenderLidar: range_m and intensity must hold 16x180"):
            client.range_map(lidar_request())
        liar.replies["RenderLidar"] = v1.RenderLidarReply(range_map=v1.RangeMap(rows=16, columns=180, range_m=b"abc"))
        with pytest.raises(ServerError, match="RenderLidar: range_m must hold 4 bytes a value, got 3"):
            client.range_map(lidar_request())


def test_bytes_that_are_no_message_are_the_servers_fault(liar):
    liar.replies = {"get_version": b"\xff\xff\xff"}
    with RemoteSensors(liar.address, "street", timeout_s=10) as remote, pytest.raises(ServerError, match=liar.address):
        remote.version()


def test_a_request_that_is_wrong_is_still_the_callers_fault(liar):
    request = camera_request("front")
    request.world_from_sensor[0, 0, 3] = np.nan
    failed = sensorsim.BatchRGBRenderReturn()
    failed.items.add(camera_name="front", success=False, error_code=3, error_message="sensor_pose must be finite")
    liar.replies = {"batch_render_rgb": failed}
    with RemoteSensors(liar.address, "street", timeout_s=10) as remote, pytest.raises(RequestError, match="finite"):
        remote.sense([request])
