"""SIGTERM under load: what is in progress is finished, nothing new is taken, a second signal ends at once."""

import signal
import subprocess
import sys
import threading
import time
import urllib.request
from types import SimpleNamespace

import grpc
import pytest
from grpc import StatusCode as Code
from grpc_health.v1 import health_pb2, health_pb2_grpc
from serving_calls import Stub, camera_message, wait_until
from serving_process import ended, serving
from serving_world import camera_request, scene

from nurec_sim.scene import write_scene
from nurec_sim.serving.server import SensorServer, ServerOptions
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import ImageFormat, sensorsim


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    return str(write_scene(scene(), tmp_path_factory.mktemp("archive") / "street.usdz"))


BATCH = 12
"""Images of a call of a second."""
FLAGS = ("--port", "0", "--grace", "60", "--health-port", "0", "--metrics-port", "0", "--log-level", "info")


def long_batch(images):
    """One call for so many images."""
    batch = sensorsim.BatchRGBRenderRequest()
    for k in range(images):
        message = camera_message(camera_request(t_us=5_100_000 + k), ImageFormat.PNG)
        message.resolution_w, message.resolution_h = 1280, 720
        batch.items.add(camera_name=str(k), request=message)
    return batch


def said_address(process):
    """The address at the end of the server's next log line."""
    return process.stderr.readline().rsplit(" ", 1)[1].strip()


def begun_batch(stub, metrics, images=BATCH):
    """A batch that an idle server has begun: a call that it has only received may be refused after the signal."""
    batch = stub.batch_render_rgb.future(long_batch(images), timeout=300)
    wait_until(lambda: b"requests_in_progress 1.0\n" in urllib.request.urlopen(metrics).read(), 60)
    return batch


@pytest.mark.slow
def test_a_signal_under_load_lets_calls_finish_and_takes_no_new_ones(archive):
    outcomes, begun = [], threading.Event()

    def keep_asking(address):
        with Stub(address) as stub:
            for k in range(10_000):
                try:
                    reply = stub.render_rgb(camera_message(camera_request(t_us=5_100_000 + k % 50)), timeout=300)
                    outcomes.append(len(reply.image_bytes))
                except grpc.RpcError as error:
                    outcomes.append(error.code())
                    return
                begun.set()

    with serving("serve", archive, *FLAGS) as (process, address), Stub(address) as stub:
        _, metrics = said_address(process), said_address(process)
        batch = begun_batch(stub, metrics)
        clients = [threading.Thread(target=keep_asking, args=(address,)) for _ in range(8)]
        for client in clients:
            client.start()
        assert begun.wait(300)  # the first frame of all may have to wait for kernels to be compiled
        process.send_signal(signal.SIGTERM)
        reply = batch.result(timeout=300)
        assert len(reply.items) == BATCH and all(item.success for item in reply.items)
        for client in clients:
            client.join(60)
        assert ended(process)[:2] == (0, "")
    frames = [outcome for outcome in outcomes if isinstance(outcome, int)]
    refusals = [outcome for outcome in outcomes if not isinstance(outcome, int)]
    assert len(frames) >= 8 and set(frames) == {320 * 180 * 3}
    assert refusals == [Code.UNAVAILABLE] * 8  # each client's first call after the signal


def test_a_second_signal_ends_the_process_at_once(archive):
    with serving("serve", archive, *FLAGS) as (process, address), Stub(address) as stub:
        health, metrics = said_address(process), said_address(process)
        batch = begun_batch(stub, metrics, images=5 * BATCH)
        process.send_signal(signal.SIGTERM)
        with grpc.insecure_channel(health) as channel:
            check = health_pb2_grpc.HealthStub(channel).Check
            wait_until(lambda: check(health_pb2.HealthCheckRequest(), timeout=5).status == 2)  # NOT_SERVING
        assert process.poll() is None and not batch.done()
        process.send_signal(signal.SIGINT)
        begin = time.monotonic()
        assert ended(process)[0] == -signal.SIGINT
        assert time.monotonic() - begin < 10  # of the 60 s of grace
        assert batch.exception(timeout=10).code() == Code.UNAVAILABLE


def test_shared_libraries_are_loaded_before_there_are_threads_that_could_load_them():
    """OpenUSD and another library that are loaded at the same time by two threads wait for each other for ever."""
    program = (
        "import sys\nfrom nurec_sim.serving.store import SceneStore\n"
        "from nurec_sim.serving.server import SensorServer\n"
        "assert not {'cv2', 'pxr'} & set(sys.modules)\n"
        "with SensorServer(SceneStore(), port=0): assert {'cv2', 'pxr.Usd', 'pxr.Tf'} <= set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def drawing(stub):
    return stub.render_rgb.future(camera_message(scene_id="drive"), timeout=60)


def editing(stub):
    request = sensorsim.EditAssetsRequest(scene_id="street")
    request.replace.add(original_id="car-1", replacement_id="drive/car-1")
    return stub.edit_assets.future(request, timeout=60)


@pytest.mark.parametrize("ask", [drawing, editing])
def test_a_reconstruction_does_not_hold_up_the_end(ask, tmp_path, monkeypatch):
    import nurec_sim.logs
    import nurec_sim.reconstruct

    begun = threading.Event()

    def reconstruct(opened, method, progress=None, **_):
        for _ in range(6000):  # a minute
            begun.set()
            progress("lifting", 0.5)
            time.sleep(0.01)
        return scene("drive")

    (tmp_path / "drive").mkdir()
    monkeypatch.setattr(nurec_sim.logs, "open_clip", lambda path: SimpleNamespace(id="drive"))
    monkeypatch.setattr(nurec_sim.reconstruct, "reconstruct", reconstruct)
    store = SceneStore([tmp_path / "drive", scene()], cache_dir=tmp_path / "cache")
    server = SensorServer(store, port=0, server_options=ServerOptions(stop_grace_s=0.1))
    with Stub(server.start()) as stub:
        call = ask(stub)
        assert begun.wait(30)
        begin = time.monotonic()
        server.stop()
        assert time.monotonic() - begin < 10
        assert call.exception(timeout=10) is not None
    assert not list(tmp_path.glob("cache/*.usdz"))
