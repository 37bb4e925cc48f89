"""Clips that become scenes on the server: progress, names, folders that are allowed, clients that leave."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import tiny_clip
from serving_calls import wait_until
from serving_world import camera_request, scene

import nurec_sim.reconstruct
from nurec_sim.errors import ArchiveError, ClipError, ReconstructError, RequestError, WeightsError
from nurec_sim.reconstruct import LiftSettings, ViewSettings
from nurec_sim.render import CpuRenderer
from nurec_sim.scene import write_scene
from nurec_sim.serving.scene_client import SceneClient
from nurec_sim.serving.scene_service import SceneOptions
from nurec_sim.serving.server import SensorServer, ServerOptions
from nurec_sim.serving.store import SceneStore

SMALL = LiftSettings(sky_px=16, views=ViewSettings(levels=8))


@pytest.fixture
def clip(tmp_path):
    (tmp_path / "clips").mkdir()
    return tiny_clip.write(tmp_path / "clips" / "drive.zip")


@pytest.fixture
def store(tmp_path):
    stored = write_scene(scene("stored"), tmp_path / "stored.usdz")
    return SceneStore([scene(), stored], cache_dir=tmp_path / "cache", settings=SMALL, threads=1)


@pytest.fixture
def address(store, clip):
    with SensorServer(store, port=0, scene_options=SceneOptions(clip_dirs=(clip.parent,))) as address:
        yield address


@pytest.fixture
def client(address):
    with SceneClient(address, timeout_s=30) as client:
        yield client


class Method:
    """Stands for all reconstruction methods; waits to be let through, step by step, and counts."""

    def __init__(self, monkeypatch):
        self.begun, self.ended, self.gate = [], [], threading.Event()
        monkeypatch.setattr(nurec_sim.reconstruct, "reconstruct", self)

    def __call__(self, clip, method, *, progress, settings=None, cameras=None):
        self.begun.append((clip.id, method, settings, cameras))
        try:
            step = 0
            while not self.gate.wait(0.02):
                step += 1
                progress("thinking", step / 10_000)
            progress("thinking", 0.9)
            return scene(clip.id)
        finally:
            self.ended.append(clip.id)


@pytest.fixture
def method(monkeypatch):
    return Method(monkeypatch)


def test_a_clip_is_lifted_and_served_with_its_progress_told(client, clip):
    said = []
    assert client.reconstruct(path=str(clip), progress=lambda *step: said.append(step)) == "clipgt-tiny"
    stages = [stage for stage, _ in said]
    assert stages[0] == "waiting for its turn" and {"sweeps", "depth", "lifting", "solving colours"} <= set(stages)
    assert all(0 <= fraction <= 1 for _, fraction in said)
    assert [entry.scene_id for entry in client.scenes().scenes][2:] == ["clipgt-tiny"]
    assert client.scenes().scenes[2].loaded
    before = client.stats()["loads"]
    assert client.reconstruct(scene_id="tiny") == "clipgt-tiny" and client.stats()["loads"] == before


def test_a_clip_becomes_several_scenes_by_several_methods(client, clip, method, store):
    method.gate.set()
    assert client.reconstruct(path=str(clip)) == "clipgt-tiny"
    ours = client.reconstruct(scene_id="tiny", name="net", method="dense", profile="tiny", cameras=["front"])
    assert ours == "clipgt-net" and store.ids[2:] == ("clipgt-tiny", "clipgt-net")
    (_, first, settings, _), (_, second, chosen, cameras) = method.begun
    assert (first, settings) == ("lift", SMALL)
    assert second == "dense" and chosen.profile == "tiny" and cameras == ("front",)
    assert client.render_camera(camera_request(scene_id="net"), ()).rgb.any()
    assert client.reconstruct(scene_id="net") == "clipgt-net" and len(method.begun) == 2
    with pytest.raises(ArchiveError, match="a scene of id 'clipgt-tiny' is already served"):
        client.reconstruct(scene_id="tiny", method="selective")


def test_a_clip_that_is_on_offer_already_is_known_again_by_its_path(client, clip, method, store, monkeypatch):
    monkeypatch.chdir(clip.parent)
    store.add("drive.zip")
    method.gate.set()
    assert client.reconstruct(path=str(clip)) == client.reconstruct(scene_id="drive") == "clipgt-tiny"
    assert len(method.begun) == 1 and len(store.ids) == 3


def test_two_clients_that_want_the_same_at_once_get_the_same(client, address, clip, method, store, monkeypatch):
    offer = store.offer

    def slowly(*arguments):
        time.sleep(0.2)
        return offer(*arguments)

    monkeypatch.setattr(store, "offer", slowly)
    method.gate.set()
    with SceneClient(address) as other, ThreadPoolExecutor(2) as pool:
        ids = list(pool.map(lambda each: each.reconstruct(path=str(clip)), (client, other)))
    assert ids == ["clipgt-tiny"] * 2 and len(method.begun) == 1


def test_only_allowed_folders_are_looked_at(client, clip, tmp_path):
    outside = tmp_path / "secret.zip"
    outside.write_bytes(clip.read_bytes())
    (clip.parent / "link.zip").symlink_to(outside)
    for path in (outside, clip.parent / ".." / "secret.zip", clip.parent / "link.zip", tmp_path / "nothing"):
        with pytest.raises(RequestError, match="does not lie in a folder that this server allows"):
            client.reconstruct(path=str(path))
    for path in ("clips/drive.zip", "a\0b"):
        with pytest.raises(RequestError, match="path must be an absolute path on the server"):
            client.reconstruct(path=path)


def test_bad_requests_are_explained_and_leave_no_scene(client, clip, store, tmp_path):
    broken = clip.parent / "broken.zip"
    broken.write_bytes(b"no zip")
    for kind, text, asked in [
        (RequestError, "scene '' is not served", {}),
        (RequestError, "scene 'clipgt-street' comes from no clip", {"scene_id": "street"}),
        (RequestError, "scene 'clipgt-stored' comes from no clip", {"scene_id": "stored"}),
        (RequestError, "names a scene, not a clip", {"path": str(clip.parent / "scene.usdz")}),
        (RequestError, "name must have up to 150 letters", {"path": str(clip), "name": "a b"}),
        (RequestError, "profile and cameras need a method", {"path": str(clip), "profile": "tiny-dense"}),
        (RequestError, "method 'lift' uses no network", {"path": str(clip), "method": "lift", "profile": "x"}),
        (ArchiveError, "no reconstruction method 'magic'", {"path": str(clip), "method": "magic"}),
        (ArchiveError, "no network profile 'huge'", {"path": str(clip), "method": "dense", "profile": "huge"}),
        (ArchiveError, "has no camera", {"path": str(clip), "method": "lift", "cameras": ["none"]}),
        (ArchiveError, "broken.zip: no log reader knows this format", {"path": str(broken)}),
        (ArchiveError, "no clip at|does not exist", {"path": str(clip.parent / "gone.zip")}),
    ]:
        with pytest.raises((kind, ClipError, ReconstructError, WeightsError), match=text):
            client.reconstruct(**asked)
    wait_until(lambda: store.ids == ("clipgt-street", "clipgt-stored"))


def test_when_the_client_leaves_the_work_ends(client, clip, method, store):
    class EnoughError(Exception):
        pass

    def leave(stage, fraction):
        if stage == "thinking":
            raise EnoughError

    with pytest.raises(EnoughError):
        client.reconstruct(path=str(clip), progress=leave)
    wait_until(lambda: method.ended)
    wait_until(lambda: store.ids == ("clipgt-street", "clipgt-stored"))
    method.gate.set()
    assert client.reconstruct(path=str(clip)) == "clipgt-tiny" and len(method.begun) == 2


def test_when_its_deadline_passes_the_work_ends(client, clip, method, store):
    while not method.begun:  # a busy machine may not begin it in time
        with pytest.raises(Exception, match="DEADLINE_EXCEEDED"):
            client.reconstruct(path=str(clip), timeout_s=0.5)
    wait_until(lambda: method.ended)
    wait_until(lambda: store.ids == ("clipgt-street", "clipgt-stored"))


def asks_until(left, address, clip):
    """A client that asks for the scene and leaves once ``left`` is set."""

    def progress(stage, fraction):
        if left.is_set():
            raise InterruptedError

    with SceneClient(address) as other, pytest.raises(InterruptedError):
        other.reconstruct(path=str(clip), progress=progress)


def test_who_waits_for_the_scene_gets_it_though_the_other_leaves(client, address, clip, method, store):
    frames, begun = [], threading.Event()

    def waiter():
        with store.lease("tiny") as loaded:
            frames.append(CpuRenderer(loaded.scene, threads=1).render_camera(camera_request()))

    threads = [threading.Thread(target=asks_until, args=(begun, address, clip))]
    threads[0].start()
    wait_until(lambda: method.begun)
    threads.append(threading.Thread(target=waiter))
    threads[1].start()
    wait_until(lambda: store.entries[2].users == 2)
    begun.set()
    wait_until(lambda: len(method.begun) == 2)  # begun anew for who waits
    method.gate.set()
    for thread in threads:
        thread.join(20)
    assert frames and store.ids[2] == "clipgt-tiny"


def test_of_two_clients_the_second_gets_the_scene_though_the_first_leaves(client, address, clip, method, store):
    leave = threading.Event()

    with ThreadPoolExecutor(2) as pool:
        leaving = pool.submit(asks_until, leave, address, clip)
        wait_until(lambda: method.begun)
        heard = []
        staying = pool.submit(client.reconstruct, path=str(clip), progress=lambda *step: heard.append(step))
        wait_until(lambda: heard)
        leave.set()
        leaving.result(20)
        wait_until(lambda: len(method.begun) == 2)
        method.gate.set()
        assert staying.result(20) == "clipgt-tiny" == store.ids[2]


def test_a_server_that_stops_ends_the_work(store, clip, method):
    options = {
        "scene_options": SceneOptions(clip_dirs=(clip.parent,)),
        "server_options": ServerOptions(stop_grace_s=0.3),
    }
    server = SensorServer(store, port=0, **options)
    failed = []

    def ask(address):
        with SceneClient(address) as client:
            try:
                client.reconstruct(path=str(clip), timeout_s=20)
            except Exception as error:
                failed.append(error)

    thread = threading.Thread(target=ask, args=(server.start(),))
    thread.start()
    wait_until(lambda: method.begun)
    stopping = threading.Thread(target=server.stop)
    stopping.start()
    stopping.join(20)
    assert not stopping.is_alive() and method.ended
    thread.join(20)
    assert failed
