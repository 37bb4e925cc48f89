"""How a server starts and stops, and how its store loads, keeps and refuses scenes."""

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import grpc
import numpy as np
import pytest
from serving_world import camera_request, scene

from nurec_sim.errors import ArchiveError, ClipError, UnknownSceneError
from nurec_sim.render import CpuRenderer
from nurec_sim.scene import write_scene
from nurec_sim.scene.precision import archived
from nurec_sim.serving import store as scene_store
from nurec_sim.serving.client import RemoteSensors
from nurec_sim.serving.sensor_service import ServiceOptions
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore, content_key
from nurec_sim.serving.wire import SERVICE, common

HERE = Path(__file__).parents[1] / "helpers"


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    return write_scene(scene(), tmp_path_factory.mktemp("archive") / "file-name.usdz")


def one_thread(world):
    return CpuRenderer(world, threads=1)


# -------------------------------------------------------------------------------------------------------------- server


def serve_in_a_process(archive: Path) -> subprocess.Popen:
    program = (
        "import sys; from nurec_sim.serving.store import SceneStore; "
        "from nurec_sim.serving.server import SensorServer, run_until_signal; "
        "run_until_signal(SensorServer(SceneStore([sys.argv[1]], threads=1), port=0))"
    )
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-c", program, str(archive)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=HERE.parents[1],
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_serve_says_where_and_stops_cleanly_on_a_signal(archive, number):
    process = serve_in_a_process(archive)
    try:
        line = process.stdout.readline()
        address = re.fullmatch(r"Serving on (127\.0\.0\.1:\d+)\n", line)[1]
        with RemoteSensors(address, "street", timeout_s=30) as remote:
            assert remote.scenes() == ["clipgt-street"]
        process.send_signal(number)
        _, complaints = process.communicate(timeout=20)
        assert (process.returncode, complaints) == (0, "")
    finally:
        process.kill()
        process.wait()


def test_a_taken_port_is_an_error_that_names_it():
    with SensorServer(SceneStore([scene()]), port=0) as address:
        port = int(address.rsplit(":", 1)[1])
        with pytest.raises(OSError, match=f"cannot listen at 127.0.0.1:{port}"):
            SensorServer(SceneStore(), port=port).start()
        with RemoteSensors(address, timeout_s=10) as remote:
            assert remote.scenes() == ["clipgt-street"]


def test_a_port_that_no_machine_has_is_an_error():
    with pytest.raises(OSError, match="ports are 0 .any free one. to 65535"):
        SensorServer(SceneStore([scene()], make_renderer=one_thread), port=99999).start()


def test_stopping_twice_is_harmless_and_a_server_can_start_again():
    server = SensorServer(SceneStore([scene()]), port=0)
    first = server.start()
    with pytest.raises(RuntimeError, match="runs already"):
        server.start()
    server.stop()
    server.stop()
    with pytest.raises(grpc.RpcError), grpc.insecure_channel(first) as channel:
        channel.unary_unary(f"/{SERVICE}/get_version")(b"", timeout=1)
    with server as address, RemoteSensors(address, timeout_s=10) as remote:
        assert remote.version()


def test_a_client_may_shut_the_server_down_if_allowed():
    server = SensorServer(SceneStore(), port=0, options=ServiceOptions(allow_shut_down=True))
    address = server.start()
    with grpc.insecure_channel(address) as channel:
        channel.unary_unary(f"/{SERVICE}/shut_down")(common.Empty().SerializeToString(), timeout=10)
    server._thread.join(10)
    assert not server._thread.is_alive()
    server.stop()


class Counting:
    """A renderer that notes what it is asked for."""

    def __init__(self, world):
        self.inner, self.drawn = one_thread(world), []

    def sense(self, requests, outputs=()):
        self.drawn += [request.sensor.id for request in requests]
        return self.inner.sense(requests, outputs)


def test_a_server_can_warm_up_before_somebody_asks(caplog):
    made = []
    store = SceneStore([scene()], make_renderer=lambda s: made.append(Counting(s)) or made[0])
    with SensorServer(store, port=0, options=ServiceOptions(warm_up=True)):
        end = time.monotonic() + 20
        while not (made and made[0].drawn == ["front", "roof"]):
            assert time.monotonic() < end
            time.sleep(0.01)
    assert not caplog.records


def test_a_warm_up_that_fails_is_a_line_in_the_log(caplog):
    def refuse(world):
        raise ArchiveError("no such luck")

    store = SceneStore([scene()], make_renderer=refuse)
    with SensorServer(store, port=0, options=ServiceOptions(warm_up=True)) as address:
        with (
            RemoteSensors(address, "street", timeout_s=10) as remote,
            pytest.raises(ArchiveError, match="no such luck"),
        ):
            remote.cameras()
    assert "could not warm up: no such luck" in caplog.text


# --------------------------------------------------------------------------------------------------------------- store


def test_an_archive_answers_to_its_id_and_its_file_name(archive):
    store = SceneStore([archive], make_renderer=one_thread)
    assert store.ids == ("clipgt-street",)
    loaded = store.get("street")
    for name in ("clipgt-street", "file-name", "clipgt-file-name"):
        assert store.get(name) is loaded
    frame = loaded.renderer.render_camera(camera_request())
    assert np.array_equal(frame.rgb, one_thread(archived(scene())).render_camera(camera_request()).rgb)


def test_unknown_scenes_are_listed_with_a_limit():
    store = SceneStore([scene(f"s{i:02}") for i in range(25)])
    with pytest.raises(UnknownSceneError, match=r"scene 'x' is not served; have \['clipgt-s00', .*-s19'\] and 5 more$"):
        store.get("x")
    with pytest.raises(UnknownSceneError, match=r"have \[\]"):
        SceneStore().get("x")


def damaged(archive: Path, folder: Path) -> dict[str, Path]:
    """Archives broken in several ways."""
    data = archive.read_bytes()
    with zipfile.ZipFile(archive) as members:
        largest = max((m for m in members.infolist() if m.filename.endswith(".usdc")), key=lambda m: m.file_size)
    middle = largest.header_offset + 256 + largest.file_size // 2
    contents = {
        "empty": b"",
        "text": b"no archive at all, just text",
        "half": data[: len(data) // 2],
        "flipped": data[:middle] + bytes(255 - b for b in data[middle : middle + 64]) + data[middle + 64 :],
    }
    paths = {name: folder / f"{name}.usdz" for name in contents} | {"missing": folder / "missing.usdz"}
    for name, content in contents.items():
        paths[name].write_bytes(content)
    return paths


@pytest.mark.parametrize("kind", ["empty", "text", "half", "missing"])
def test_a_damaged_archive_is_a_fault_beside_good_ones(archive, tmp_path, kind):
    path = damaged(archive, tmp_path)[kind]
    store = SceneStore([path, archive], make_renderer=one_thread)
    assert store.ids == ("clipgt-street",) and list(store.faults) == [kind]
    for name in (kind, f"clipgt-{kind}"):
        with pytest.raises(ArchiveError, match=f"scene '{name}' cannot be served: .*{kind}.usdz"):
            store.get(name)
    assert store.get("street").scene.id == "street"


def test_an_archive_changed_inside_fails_when_loaded_and_only_then(archive, tmp_path):
    path = damaged(archive, tmp_path)["flipped"]
    store = SceneStore([path, scene("good")], make_renderer=one_thread)
    assert store.ids == ("clipgt-street", "clipgt-good")
    for _ in range(2):
        with pytest.raises(ArchiveError, match="flipped.usdz"):
            store.get("street")
    assert store.loaded_ids == () and store.get("good").scene.id == "good"


def test_a_folder_offers_all_that_lies_in_it(archive, tmp_path):
    (tmp_path / "deep" / "er").mkdir(parents=True)
    write_scene(scene("a"), tmp_path / "deep" / "er" / "a.usdz")
    shutil.copy(archive, tmp_path / "b.usdz")
    damaged(archive, tmp_path / "deep")
    store = SceneStore([tmp_path])
    assert store.ids == ("clipgt-street", "clipgt-a")
    assert sorted(store.faults) == ["empty", "flipped", "half", "text"]
    assert "clipgt-street' is already served" in store.faults["flipped"]


def test_two_sources_of_one_id_are_the_first(archive):
    store = SceneStore([scene(), archive])
    assert store.ids == ("clipgt-street",)
    assert "a scene of id 'clipgt-street' is already served" in store.faults["file-name"]


def test_a_folder_that_is_no_clip_is_a_fault(tmp_path):
    store = SceneStore([tmp_path])
    assert store.ids == () and tmp_path.name in store.faults
    with pytest.raises(ArchiveError, match="cannot be served"):
        store.get(tmp_path.name)


def test_the_least_recently_used_scene_goes_first():
    made = []
    store = SceneStore([scene(n) for n in "abc"], capacity=2, make_renderer=lambda s: made.append(s.id))
    for name in "abacab":
        store.get(name)
    assert made == ["a", "b", "c", "b"]  # c drove b out, and b then c
    assert store.loaded_ids == ("clipgt-a", "clipgt-b")
    with pytest.raises(ValueError, match="capacity 0"):
        SceneStore(capacity=0)


def test_callers_at_the_same_time_share_one_load():
    begun, gate = [], threading.Event()

    def slow(world):
        begun.append(world.id)
        assert gate.wait(10)
        return one_thread(world)

    store = SceneStore([scene("a")], make_renderer=slow)
    with ThreadPoolExecutor(8) as pool:
        jobs = [pool.submit(store.get, "a") for _ in range(8)]
        time.sleep(0.1)
        gate.set()
        assert len({id(job.result()) for job in jobs}) == 1
    assert begun == ["a"]


def test_a_load_that_failed_is_tried_again():
    attempts = []

    def flaky(world):
        attempts.append(world.id)
        if len(attempts) == 1:
            raise ClipError("not yet")
        return one_thread(world)

    store = SceneStore([scene("a")], make_renderer=flaky)
    with pytest.raises(ClipError, match="not yet"):
        store.get("a")
    assert store.get("a").scene.id == "a"


class FakeClip:
    id = "drive"


@pytest.fixture
def clip(tmp_path, monkeypatch):
    """A folder that opens as a clip and whose reconstruction is counted."""
    import nurec_sim.logs
    import nurec_sim.reconstruct

    folder = tmp_path / "drive-folder"
    folder.mkdir()
    (folder / "data.bin").write_bytes(b"one")
    calls = []

    def reconstruct(opened, method, progress=None):
        if progress:
            progress("lifting", 0.5)
        calls.append((opened.id, method))
        return scene("drive")

    monkeypatch.setattr(nurec_sim.logs, "open_clip", lambda path: FakeClip(), raising=False)
    monkeypatch.setattr(nurec_sim.reconstruct, "reconstruct", reconstruct, raising=False)
    return folder, calls


def test_a_clip_is_reconstructed_once_and_kept_by_content(clip, tmp_path):
    folder, calls = clip
    cache, said = tmp_path / "cache", []
    options = {"cache_dir": cache, "make_renderer": one_thread}
    store = SceneStore([folder], on_progress=said.append, **options)
    assert store.ids == ("clipgt-drive",) and calls == []
    stages = []
    first = store.get("drive-folder", progress=lambda *stage: stages.append(stage)).scene
    assert calls == [("drive", "lift")] and "reconstructing" in said[0] and stages == [("lifting", 0.5)]
    (kept,) = cache.iterdir()
    second = SceneStore([folder], **options).get("drive").scene
    assert calls == [("drive", "lift")]
    assert np.array_equal(first.static.mean_m, second.static.mean_m)

    kept.write_bytes(kept.read_bytes()[:1000])
    assert SceneStore([folder], **options).get("drive").scene.id == "drive"
    assert len(calls) == 2 and len(list(cache.iterdir())) == 1

    (folder / "data.bin").write_bytes(b"two")
    SceneStore([folder], **options).get("drive")
    assert len(calls) == 3 and len(list(cache.iterdir())) == 2


def test_a_cache_that_cannot_be_written_does_not_stop_serving(clip, tmp_path, caplog):
    folder, _ = clip
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where the folder should be")
    store = SceneStore([folder], cache_dir=blocked / "cache", make_renderer=one_thread)
    assert store.get("drive").scene.id == "drive"
    assert "could not be kept" in caplog.text


def test_the_content_key_depends_on_names_content_and_method(tmp_path):
    folder = tmp_path / "clip"
    (folder / "sub").mkdir(parents=True)
    (folder / "sub" / "a").write_bytes(b"1")
    key = content_key(folder, "lift")
    moved = tmp_path / "elsewhere" / "clip"
    shutil.copytree(folder, moved)
    assert content_key(moved, "lift") == key != content_key(folder, "dense")
    (moved / "sub" / "a").rename(moved / "sub" / "b")
    assert content_key(moved, "lift") != key
    assert content_key(folder / "sub" / "a", "lift") != key


def test_the_cache_folder_can_be_chosen(monkeypatch):
    monkeypatch.setenv("NUREC_SIM_CACHE", os.path.join("some", "where"))
    assert scene_store.default_cache_dir() == Path("some/where")
    monkeypatch.delenv("NUREC_SIM_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "xdg")
    assert scene_store.default_cache_dir() == Path("xdg/nurec_sim")
