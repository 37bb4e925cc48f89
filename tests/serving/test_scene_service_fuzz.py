"""Damaged messages to every procedure of the scene service: an answer or a known status, and the server lives on."""

import hashlib

import grpc
import numpy as np
import pytest
from grpc import StatusCode as Code
from serving_world import camera_request, lidar_request, scene

from nurec_sim.serving import wire
from nurec_sim.serving.connection import open_channel
from nurec_sim.serving.scene_client import SceneClient
from nurec_sim.serving.scene_service import SceneOptions
from nurec_sim.serving.sensor_service import ServiceOptions
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import nurec_sim_v1 as v1

ALLOWED = {Code.OK, Code.INVALID_ARGUMENT, Code.NOT_FOUND, Code.OUT_OF_RANGE, Code.RESOURCE_EXHAUSTED,
           Code.FAILED_PRECONDITION}  # fmt: skip
ROUNDS = 120


def requests():
    camera = v1.RenderCameraRequest(outputs=list(wire.CameraOutput))
    pair = {"car-1": camera_request().world_from_sensor}
    wire.write_camera_request(camera_request("fish", actors=pair), camera.request, scene_id="street")
    lidar = v1.RenderLidarRequest(form=wire.SweepForm.RANGE_MAP)
    wire.write_lidar_request(lidar_request(), lidar.request, scene_id="street")
    clip = v1.ReconstructClipRequest(path="/nowhere/drive.zip", method="dense", profile="tiny", cameras=["front"])
    data = b"not an archive"
    header = v1.UploadHeader(name="a.usdz", size=len(data), sha256=hashlib.sha256(data).hexdigest())
    return {
        "ListScenes": [v1.ListScenesRequest()],
        "Stats": [v1.StatsRequest()],
        "UnloadScene": [v1.UnloadSceneRequest(scene_id="other", delete_file=True)],
        "RenderCamera": [camera],
        "RenderLidar": [lidar],
        "ReconstructClip": [clip],
        "UploadScene": [v1.UploadPart(header=header), v1.UploadPart(data=data)],
        "UploadClip": [v1.UploadPart(header=header), v1.UploadPart(data=data)],
    }


def damaged(data, random):
    """Bytes changed, put in, taken out or cut off."""
    data = bytearray(data)
    for _ in range(random.integers(1, 4)):
        place = int(random.integers(0, len(data) + 1))
        kind = random.integers(0, 4)
        if kind == 0 and place < len(data):
            data[place] ^= 1 << random.integers(0, 8)
        elif kind == 1:
            data[place:place] = random.bytes(int(random.integers(1, 9)))
        elif kind == 2:
            del data[place : place + int(random.integers(1, 9))]
        else:
            data[place : place + 8] = np.float64(random.choice([np.nan, np.inf, -1e308, 5e-324])).tobytes()
    return bytes(data)


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    store = SceneStore([scene(), scene("other", seed=1)], threads=1)
    scenes = SceneOptions(upload_dir=tmp_path_factory.mktemp("uploads"))
    options = ServiceOptions(max_pixels=100_000)
    with SensorServer(store, port=0, options=options, scene_options=scenes) as address:
        yield address


@pytest.mark.parametrize("name", list(requests()))
def test_damaged_messages_get_an_answer_or_a_known_status(address, name):
    method = wire.pool.FindServiceByName(wire.SCENE_SERVICE).methods_by_name[name]
    parts = [message.SerializeToString() for message in requests()[name]]
    random, seen = np.random.default_rng(len(name)), set()
    with open_channel(address) as channel:
        path = f"/{wire.SCENE_SERVICE}/{name}"
        kinds = {(False, False): channel.unary_unary, (False, True): channel.unary_stream,
                 (True, False): channel.stream_unary}  # fmt: skip
        call = kinds[method.client_streaming, method.server_streaming](path)
        for _ in range(ROUNDS):
            sent = [damaged(part, random) for part in parts]
            try:
                if method.client_streaming:
                    call(iter(sent), timeout=30)
                elif method.server_streaming:
                    list(call(sent[0], timeout=30))
                else:
                    call(sent[0], timeout=30)
                seen.add(Code.OK)
            except grpc.RpcError as error:
                seen.add(error.code())
    assert seen <= ALLOWED and Code.INVALID_ARGUMENT in seen
    with SceneClient(address, timeout_s=30) as client:
        assert client.stats()["uploads_in_progress"] == 0
        assert client.render_camera(camera_request("fish"), ("label",)).label.any()
