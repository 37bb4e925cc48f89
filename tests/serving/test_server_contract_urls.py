"""Scenes that clients bring along: ``x-nre-scene-url`` and ``x-nre-scene-id`` beside any request."""

import contextlib
import http.server
import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import grpc
import numpy as np
import pytest
from grpc import StatusCode as Code
from serving_calls import Stub, camera_message, pixels
from serving_world import camera_request, scene

from nurec_sim.errors import RequestError
from nurec_sim.render import CpuRenderer
from nurec_sim.scene import read_scene, write_scene
from nurec_sim.serving.sensor_service import ServiceOptions
from nurec_sim.serving.sensor_service.downloads import DownloadCache
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import common


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    path = tmp_path_factory.mktemp("archives") / "brought along.usdz"
    write_scene(scene("brought", seed=3), path)
    return path


class Web(http.server.BaseHTTPRequestHandler):
    """Serves what the test put into ``server.pages``: path -> (status, headers, body)."""

    def do_GET(self):
        self.server.asked.append(self.path)
        status, headers, body = self.server.pages.get(self.path, (404, {}, b""))
        self.send_response(status)
        chunks = [body] if isinstance(body, bytes) else body
        length = {"Content-Length": str(len(body))} if isinstance(body, bytes) else {}
        for name, value in (length | headers).items():
            self.send_header(name, value)
        self.end_headers()
        with contextlib.suppress(OSError):  # who asked has left
            for chunk in chunks:
                self.wfile.write(chunk)

    def log_message(self, *_):
        pass


@pytest.fixture
def web(monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Web) as server:
        server.pages, server.asked = {}, []
        server.url = f"http://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def serving(tmp_path, *folders, **options):
    folders = {"scene_dirs": (tmp_path, *folders)} if folders else {}
    options = ServiceOptions(download_cache_dir=tmp_path / "downloads", **folders, **options)
    return SensorServer(SceneStore([scene()], threads=2, cache_dir=tmp_path), port=0, options=options)


def scenes(stub, url=None, name=None):
    pairs = [("x-nre-scene-url", url), ("x-nre-scene-id", name)]
    reply = stub.get_available_scenes(common.Empty(), metadata=[p for p in pairs if p[1] is not None], timeout=30)
    return list(reply.scene_ids)


def refusal(stub, url, name=None):
    with pytest.raises(grpc.RpcError) as caught:
        scenes(stub, url, name)
    return caught.value.code(), caught.value.details()


def test_a_file_is_served_under_the_name_that_is_asked_for(archive, tmp_path):
    with serving(tmp_path, archive.parent) as address, Stub(address) as stub:
        assert scenes(stub) == ["clipgt-street"]
        url = archive.as_uri()
        assert "%20" in url
        metadata = [("x-nre-scene-url", url), ("x-nre-scene-id", "mine_1-a")]
        image = pixels(stub.render_rgb(camera_message(scene_id="mine_1-a"), metadata=metadata, timeout=30))
        assert scenes(stub) == ["clipgt-street", "clipgt-mine_1-a"]
        assert scenes(stub, url, "mine_1-a") == scenes(stub), "the second time nothing happens"
        assert scenes(stub, url) == ["clipgt-street", "clipgt-mine_1-a", "clipgt-brought"], "or under its own name"
        again = pixels(stub.render_rgb(camera_message(scene_id="brought")))
    expected = CpuRenderer(read_scene(archive), threads=2).render_camera(camera_request()).rgb
    assert np.array_equal(image, expected) and np.array_equal(again, expected)


def test_a_file_that_is_served_already_is_found_again_however_its_path_is_spelt(archive, tmp_path, monkeypatch):
    monkeypatch.chdir(archive.parent)
    options = ServiceOptions(download_cache_dir=tmp_path / "downloads")
    store = SceneStore([archive.name], threads=2, cache_dir=tmp_path)
    with SensorServer(store, port=0, options=options) as address, Stub(address) as stub:
        for name in (None, "brought"):
            assert scenes(stub, archive.as_uri(), name) == ["clipgt-brought"]


WRONG = {
    "no archive": ("file:///tmp/x.txt", "a", Code.INVALID_ARGUMENT, "must be a file:// or http(s):// address"),
    "another scheme": ("ftp://h/x.usdz", "a", Code.INVALID_ARGUMENT, "must be a file:// or http(s):// address"),
    "no such file": (
        "file:///no/where.usdz",
        "a",
        Code.INVALID_ARGUMENT,
        "is no file in the scene folders",
    ),
    "a NUL": ("file:///tmp/a%00.usdz", "a", Code.INVALID_ARGUMENT, "is no file in the scene folders"),
    "a folder": ("file:///tmp/../.usdz", "a", Code.INVALID_ARGUMENT, "is no file in the scene folders"),
    "another host": ("file://host/x.usdz", "a", Code.INVALID_ARGUMENT, "without a host"),
    "a name with dots": ("file:///x.usdz", "../a", Code.INVALID_ARGUMENT, "x-nre-scene-id must be 1 to 200"),
    "the web": ("http://127.0.0.1/x.usdz", "a", Code.PERMISSION_DENIED, "fetches no scenes from the web"),
    "no host": ("http:///x.usdz", "a", Code.INVALID_ARGUMENT, "must be a file:// or http(s):// address"),
    "a broken host": ("http://[/x.usdz", "a", Code.INVALID_ARGUMENT, "is no address"),
    "a long one": ("file:///" + "a" * 3000 + ".usdz", "a", Code.INVALID_ARGUMENT, "of up to 2048 letters"),
}


def test_wrong_addresses_are_explained_and_change_nothing(archive, tmp_path):
    with serving(tmp_path, archive.parent) as address, Stub(address) as stub:
        for case, (url, name, code, text) in WRONG.items():
            got, details = refusal(stub, url, name)
            assert got == code and text in details, case
        code, text = refusal(stub, archive.as_uri(), "street")
        assert code == Code.FAILED_PRECONDITION and "'clipgt-street' is already served" in text
        (tmp_path / "junk.usdz").write_bytes(b"junk")
        assert refusal(stub, (tmp_path / "junk.usdz").as_uri(), "junk")[0] == Code.FAILED_PRECONDITION
        assert scenes(stub) == ["clipgt-street"]


def test_files_outside_the_scene_folders_are_as_if_they_were_not_there(archive, tmp_path):
    """By their path, by ``..``, by a link, in a folder whose name begins alike; and the text tells nothing apart."""
    inside, beside, secret = tmp_path / "scenes", tmp_path / "scenes-private", tmp_path / "secret"
    for folder in (inside, beside, secret):
        folder.mkdir()
        (folder / "there.usdz").write_bytes(archive.read_bytes())
    (inside / "link.usdz").symlink_to(secret / "there.usdz")
    (inside / "out").symlink_to(secret)
    (inside / "loop.usdz").symlink_to(inside / "loop.usdz")
    (secret / "back.usdz").symlink_to(inside / "there.usdz")
    refused = [
        secret / "there.usdz",
        secret / "absent.usdz",
        beside / "there.usdz",
        f"{inside}/../secret/there.usdz",
        f"{inside}/%2e%2e/secret/there.usdz",
        f"{inside}/../secret/absent.usdz",
        inside / "link.usdz",
        inside / "out" / "there.usdz",
        inside / "out" / "absent.usdz",
        inside / "loop.usdz",
        inside / "absent.usdz",
        inside,
    ]
    options = ServiceOptions(scene_dirs=(inside,))
    with (
        SensorServer(SceneStore([scene()], cache_dir=tmp_path), port=0, options=options) as address,
        Stub(address) as stub,
    ):
        said = set()
        for path in refused:
            url = f"file://{path}" + ("/.usdz" if path == inside else "")
            code, text = refusal(stub, url, "mine")
            said.add((code, text.replace(url, "URL")))
        ((code, text),) = said
        assert code == Code.INVALID_ARGUMENT and text.startswith(
            "x-nre-scene-url: 'URL' is no file in the scene folders"
        )
        assert scenes(stub, (inside / "there.usdz").as_uri(), "mine") == ["clipgt-street", "clipgt-mine"]
        assert "clipgt-back" in scenes(stub, (secret / "back.usdz").as_uri(), "back"), "what counts is where it leads"


def test_by_default_files_lie_where_the_first_scenes_do(archive, tmp_path):
    """In the folder of each, and where a link to one leads; everywhere with ``allow_any_file``."""
    first, blobs = tmp_path / "first", tmp_path / "blobs"
    first.mkdir()
    blobs.mkdir()
    for name in ("blob", "other.usdz"):
        (blobs / name).write_bytes(archive.read_bytes())
    (first / "a.usdz").symlink_to(blobs / "blob")
    (first / "b.usdz").write_bytes(archive.read_bytes())
    for options, allowed in ((ServiceOptions(), False), (ServiceOptions(allow_any_file=True), True)):
        store = SceneStore([first / "a.usdz"], cache_dir=tmp_path)
        with SensorServer(store, port=0, options=options) as address, Stub(address) as stub:
            assert scenes(stub, (first / "a.usdz").as_uri()) == ["clipgt-brought"]
            assert scenes(stub, (first / "b.usdz").as_uri(), "b") == ["clipgt-brought", "clipgt-b"]
            if allowed:
                assert "clipgt-c" in scenes(stub, (blobs / "other.usdz").as_uri(), "c")
            else:
                assert refusal(stub, (blobs / "other.usdz").as_uri(), "c")[0] == Code.INVALID_ARGUMENT


def test_a_scene_of_the_web_is_fetched_once_and_kept_for_the_next_server(archive, tmp_path, web):
    web.pages = {
        "/a.usdz": (302, {"Location": "/real.usdz"}, b""),
        "/real.usdz": (200, {}, archive.read_bytes()),
    }
    for _ in range(2):
        with serving(tmp_path, allow_remote_scenes=True) as address, Stub(address) as stub:
            with ThreadPoolExecutor(4) as pool:
                lists = list(pool.map(lambda _: scenes(stub, f"{web.url}/a.usdz", "w"), range(4)))
            assert lists == [["clipgt-street", "clipgt-w"]] * 4
            assert len(stub.render_rgb(camera_message(scene_id="w")).image_bytes) == 320 * 180 * 3
    assert web.asked == ["/a.usdz", "/real.usdz"]
    assert [p.suffix for p in (tmp_path / "downloads").iterdir()] == [".usdz"]


def test_faults_of_the_web_are_explained_and_leave_nothing_behind(archive, tmp_path, web):
    body = archive.read_bytes()
    web.pages = {
        "/html.usdz": (200, {}, b"<html>sign in</html>"),
        "/empty.usdz": (200, {}, b""),
        "/cut.usdz": (200, {"Content-Length": str(len(body) + 10)}, body),
        "/large.usdz": (200, {"Content-Length": str(10**12)}, body),
        "/file.usdz": (302, {"Location": archive.as_uri()}, b""),
        "/loop.usdz": (302, {"Location": "/loop.usdz"}, b""),
    }
    texts = {
        "/html.usdz": "is no .usdz archive: it begins with b'<html>si'",
        "/empty.usdz": "broke off after 0 of 0 bytes",
        "/cut.usdz": "broke off after",
        "/file.usdz": "cannot be fetched",
        "/loop.usdz": "cannot be fetched",
        "/absent.usdz": "HTTP Error 404",
    }
    with serving(tmp_path, allow_remote_scenes=True) as address, Stub(address) as stub:
        for path, text in texts.items():
            code, details = refusal(stub, web.url + path, "w")
            assert code == Code.INVALID_ARGUMENT and text in details, details
        code, details = refusal(stub, web.url + "/large.usdz", "w")
        assert code == Code.RESOURCE_EXHAUSTED and "a scene may have 4,294,967,296 bytes" in details
        assert refusal(stub, "http://127.0.0.1:1/x.usdz", "w")[0] == Code.INVALID_ARGUMENT
        assert list((tmp_path / "downloads").iterdir()) == [] and scenes(stub) == ["clipgt-street"]


def test_a_body_longer_than_allowed_is_cut_off_whatever_its_header_says(tmp_path, web):
    web.pages = {"/a.usdz": (200, {"Content-Length": ""}, b"PK\x03\x04" + bytes(3 << 20))}
    cache = DownloadCache(tmp_path, 2, 1 << 20, 10.0)
    with pytest.raises(Exception, match="a scene may have 1,048,576 bytes"):
        cache.fetch(f"{web.url}/a.usdz")


def test_a_web_that_sends_a_byte_now_and_then_is_given_up_in_time(tmp_path, web):
    def trickle():
        for byte in b"PK\x03\x04" + bytes(400):
            yield bytes([byte])
            time.sleep(0.05)

    web.pages = {"/a.usdz": (200, {"Content-Length": "1000000"}, trickle())}
    begin = time.monotonic()
    with pytest.raises(RequestError, match=r"did not arrive within 0\.5 s"):
        DownloadCache(tmp_path, 2, 1 << 20, 0.5).fetch(f"{web.url}/a.usdz")
    assert time.monotonic() - begin < 10 and list(tmp_path.iterdir()) == []


def test_files_that_were_not_downloaded_never_make_room(tmp_path):
    own = tmp_path / "my town.usdz"
    cache = DownloadCache(tmp_path, 1, 1 << 20, 10.0)
    files = [own, *(cache.path_of(f"http://h/{k}.usdz") for k in range(3))]
    for age, file in enumerate(files):
        file.write_bytes(b"PK")
        os.utime(file, (age, age))
    assert sorted(cache.make_room()) == sorted(files[1:3])
    assert sorted(tmp_path.iterdir()) == sorted([own, files[3]])


def test_the_least_recently_used_download_makes_room_and_is_fetched_again(archive, tmp_path, web):
    web.pages = {f"/{name}.usdz": (200, {}, archive.read_bytes()) for name in "abc"}
    with serving(tmp_path, allow_remote_scenes=True, download_cache_size=2) as address, Stub(address) as stub:
        for name in "abc":
            scenes(stub, f"{web.url}/{name}.usdz", name)
            time.sleep(0.02)
        assert scenes(stub) == ["clipgt-street", "clipgt-b", "clipgt-c"]
        assert len(list((tmp_path / "downloads").iterdir())) == 2
        assert scenes(stub, f"{web.url}/a.usdz", "a") == ["clipgt-street", "clipgt-c", "clipgt-a"]
    assert web.asked == ["/a.usdz", "/b.usdz", "/c.usdz", "/a.usdz"]


def test_what_an_earlier_process_left_half_written_is_removed_in_time(tmp_path, web, archive):
    web.pages = {"/a.usdz": (200, {}, archive.read_bytes())}
    old, young = tmp_path / ".old.part", tmp_path / ".young.part"
    for part in (old, young):
        part.write_bytes(b"PK")
    os.utime(old, (0, 0))
    DownloadCache(tmp_path, 2, 1 << 30, 10.0).fetch(f"{web.url}/a.usdz")
    assert not old.exists() and young.exists()
