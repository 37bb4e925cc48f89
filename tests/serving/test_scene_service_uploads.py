"""Uploads: whole and checked or not there at all, whoever leaves, dies or lies."""

import errno
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
import tiny_clip
from serving_calls import wait_until
from serving_world import camera_request, scene

from nurec_sim.errors import ArchiveError, NurecSimError, RequestError, ServerError, TooLargeError, UnknownSceneError
from nurec_sim.render import CpuRenderer
from nurec_sim.scene import read_scene, write_scene
from nurec_sim.serving import wire
from nurec_sim.serving.client import RemoteSensors
from nurec_sim.serving.connection import open_channel, our_errors
from nurec_sim.serving.scene_client import SceneClient
from nurec_sim.serving.scene_service import SceneOptions
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore, UploadFolder
from nurec_sim.serving.wire import nurec_sim_v1 as v1

HERE = Path(__file__).parents[1] / "helpers"


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    return write_scene(scene("sent", seed=4), tmp_path_factory.mktemp("client") / "sent.usdz")


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "uploads"


def server_of(folder, *sources, **options):
    return SensorServer(
        SceneStore(sources, threads=1), port=0, scene_options=SceneOptions(upload_dir=folder, **options)
    )


@pytest.fixture
def address(folder):
    with server_of(folder, scene(), max_upload_bytes=20 << 20) as address:
        yield address


@pytest.fixture
def client(address):
    with SceneClient(address, timeout_s=30) as client:
        yield client


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


def test_an_uploaded_scene_is_rendered_bit_for_bit_and_outlives_the_server(archive, folder):
    said, request = [], camera_request(scene_id="sent")
    expected = CpuRenderer(read_scene(archive), threads=1).render_camera(request).rgb
    with server_of(folder, scene()) as address, SceneClient(address, timeout_s=30) as client:
        assert client.upload(archive, lambda *step: said.append(step)) == "clipgt-sent"
        assert said[0] == ("hashing", 0.0) and said[-1] == ("sending", 1.0)
        assert np.array_equal(client.render_camera(request, ()).rgb, expected)
        street, sent = client.scenes().scenes
        assert sent.uploaded and not street.uploaded and sent.file_bytes == archive.stat().st_size
        assert client.stats()["uploaded_bytes"] == archive.stat().st_size
    assert names_in(folder) == ["sent.usdz"] and (folder / "sent.usdz").read_bytes() == archive.read_bytes()
    with server_of(folder) as address, RemoteSensors(address, "sent", timeout_s=30) as remote:
        assert remote.scenes() == ["clipgt-sent"]
        assert np.array_equal(remote.sense([request])[0].rgb, expected)


def test_a_clip_is_uploaded_as_a_zip_and_offered(client, folder, tmp_path):
    clip = tiny_clip.write(tmp_path / "tiny.zip")
    assert client.upload(clip) == "clipgt-tiny"
    assert client.scenes().scenes[1].kind == "clip" and names_in(folder) == ["tiny.zip"]
    with pytest.raises(RequestError, match=r"drive.tar: a scene archive ends in .usdz, a clip to upload in .zip"):
        client.upload(tmp_path / "drive.tar")


def test_an_uploaded_scene_can_be_deleted_and_others_cannot(client, archive, folder):
    client.upload(archive)
    for name in ("street", "sent"):
        client.render_camera(camera_request(scene_id=name), ())
    with pytest.raises(RequestError, match="scene 'clipgt-street' was not uploaded"):
        client.unload("street", delete_file=True)
    assert client.stats()["loaded"] == 2, "what was refused changed nothing"
    assert client.unload("sent", delete_file=True) > 50_000
    assert names_in(folder) == [] and [entry.scene_id for entry in client.scenes().scenes] == ["clipgt-street"]
    with pytest.raises(UnknownSceneError):
        client.unload("sent")
    assert client.upload(archive) == "clipgt-sent"


def send(address, parts, procedure="UploadScene"):
    """A raw upload."""
    with open_channel(address) as channel, our_errors(address):
        path = f"/{wire.SCENE_SERVICE}/{procedure}"
        call = channel.stream_unary(path, v1.UploadPart.SerializeToString, v1.UploadReply.FromString)
        return call(iter(parts), timeout=30)


def header(data, **changes):
    fields = {"name": "new.usdz", "size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    return v1.UploadPart(header=v1.UploadHeader(**fields | changes))


def body(data):
    return v1.UploadPart(data=data)


DATA = b"no archive at all " * 10
SHA = "0" * 64


@pytest.mark.parametrize(
    ("parts", "kind", "text"),
    [
        ([], RequestError, "an upload begins with its header"),
        ([body(DATA)], RequestError, "an upload begins with its header"),
        ([header(DATA), header(DATA)], RequestError, "after the header an upload has data only"),
        ([header(DATA), v1.UploadPart()], RequestError, "after the header an upload has data only"),
        ([header(DATA, name="../up.usdz")], RequestError, r"name must have up to 150 letters.*got '../up.usdz'"),
        ([header(DATA, name=".hidden.usdz")], RequestError, "name must have"),
        ([header(DATA, name="a/b.usdz")], RequestError, "name must have"),
        ([header(DATA, name="x" * 10_000 + ".usdz")], RequestError, "name must have"),
        ([header(DATA, name="clip.zip")], RequestError, r"end in .usdz, got 'clip.zip'"),
        ([header(DATA, sha256="abc")], RequestError, "sha256 must have 64 hexadecimal digits"),
        ([header(DATA, size=0)], RequestError, "size is missing"),
        ([header(DATA, size=1 << 60)], TooLargeError, "an upload may have 20,971,520 bytes"),
        ([header(DATA), body(DATA[:-1])], RequestError, "the header announced 180 bytes, 179 came"),
        ([header(DATA), body(DATA), body(b"x")], RequestError, "more bytes than the 180"),
        ([header(DATA, sha256=SHA), body(DATA)], RequestError, "the bytes have sha256 .*the header announced 0000"),
        ([header(DATA), body(DATA)], ArchiveError, "new.usdz: not a readable ZIP archive"),
    ],
)
def test_a_bad_upload_is_explained_and_nothing_stays(address, folder, parts, kind, text):
    with pytest.raises(kind, match=text) as caught:
        send(address, parts)
    assert ".incoming" not in str(caught.value) and names_in(folder) == []


def test_an_archive_with_a_damaged_member_never_appears(address, archive, folder):
    data = bytearray(archive.read_bytes())
    place = bytes(data).index(b"PXR-USDC") + 400
    data[place : place + 64] = bytes(64)
    with pytest.raises(ArchiveError, match="new.usdz: .* was changed or damaged"):
        send(address, [header(bytes(data)), body(bytes(data))])
    assert names_in(folder) == []


def test_a_taken_id_or_name_is_refused(address, client, archive, folder, tmp_path):
    street = write_scene(scene(), tmp_path / "other-name.usdz")
    with pytest.raises(ArchiveError, match="other-name.usdz: a scene of id 'clipgt-street' is already served"):
        client.upload(street)
    client.upload(archive)
    with pytest.raises(RequestError, match="a file 'sent.usdz' was uploaded before"):
        client.upload(archive)
    assert names_in(folder) == ["sent.usdz"]


def test_uploads_have_limits(archive, folder):
    size = archive.stat().st_size
    with server_of(folder, max_uploads=1, max_uploaded_bytes=size + 100, upload_idle_s=1.0) as address:
        with SceneClient(address, timeout_s=30) as client:
            held = threading.Event()

            def slow():
                yield header(DATA)
                held.wait(20)

            silent = []
            thread = threading.Thread(target=lambda: silent.append(outcome(address, slow())))
            thread.start()
            wait_until(lambda: client.stats()["uploads_in_progress"] == 1)
            with pytest.raises(TooLargeError, match="1 uploads are in progress, no more are allowed"):
                client.upload(archive)
            wait_until(lambda: client.stats()["uploads_in_progress"] == 0)
            held.set()
            thread.join(20)
            assert "nothing came for 1 s; the upload is dropped" in str(silent[0])
            client.upload(archive)
            with pytest.raises(TooLargeError, match="uploads may take .* bytes in all"):
                send(address, [header(DATA)])
    assert names_in(folder) == ["sent.usdz"]


def outcome(address, parts):
    try:
        return send(address, parts)
    except NurecSimError as error:
        return error


def test_a_server_without_a_folder_takes_none(archive):
    with SensorServer(SceneStore(), port=0) as address, SceneClient(address, timeout_s=30) as client:
        with pytest.raises(ServerError, match="UNIMPLEMENTED: this server has no folder for uploads"):
            client.upload(archive)


def test_a_client_that_leaves_leaves_nothing(address, client, folder):
    with open_channel(address) as channel:
        path = f"/{wire.SCENE_SERVICE}/UploadScene"
        begun, left = threading.Event(), threading.Event()

        def parts():
            yield header(DATA)
            yield body(DATA[:50])
            begun.set()
            left.wait(20)

        call = channel.stream_unary(path, v1.UploadPart.SerializeToString).future(parts())
        assert begun.wait(20)
        wait_until(lambda: names_in(folder) and names_in(folder)[0].startswith(".incoming-"))
        call.cancel()
        left.set()
    wait_until(lambda: names_in(folder) == [])
    wait_until(lambda: client.stats()["uploads_in_progress"] == 0)


def test_a_full_disk_refuses_and_the_server_lives_on(address, client, archive, folder, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(100, 95, 5))
    with pytest.raises(TooLargeError, match="the server's disk has 5 bytes left"):
        client.upload(archive)
    monkeypatch.undo()

    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(TooLargeError, match="the server cannot keep the upload: No space left on device"):
        client.upload(archive)
    monkeypatch.undo()
    assert names_in(folder) == [] and client.upload(archive) == "clipgt-sent"


SERVER = """
import sys
from pathlib import Path
from nurec_sim.serving.store import SceneStore, UploadFolder
from nurec_sim.serving.server import SensorServer, run_until_signal
from nurec_sim.serving.scene_service import SceneOptions
options = SceneOptions(upload_dir=Path(sys.argv[2]))
run_until_signal(SensorServer(SceneStore([sys.argv[1]], threads=1), port=0, scene_options=options))
"""


@pytest.mark.slow
def test_a_server_killed_during_an_upload_starts_again_without_a_half_file(archive, folder, tmp_path):
    street = write_scene(scene(), tmp_path / "street.usdz")
    command = [sys.executable, "-c", SERVER, str(street), str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=HERE.parents[1]) as process:
        address = process.stdout.readline().removeprefix("Serving on ").strip()
        held = threading.Event()

        def parts():
            data = archive.read_bytes()
            yield header(data)
            yield body(data[: len(data) // 2])
            held.wait(20)

        sending = threading.Thread(target=outcome, args=(address, parts()))
        sending.start()
        wait_until(lambda: folder.is_dir() and [p for p in folder.iterdir() if p.stat().st_size > 10_000])
        process.send_signal(signal.SIGKILL)
        process.wait(10)
        held.set()
        sending.join(20)
    (half,) = names_in(folder)
    assert half.startswith(".incoming-")
    with server_of(folder, street) as address, SceneClient(address, timeout_s=30) as client:
        assert names_in(folder) == [] and len(client.scenes().scenes) == 1 and not client.scenes().faults
        assert client.upload(archive) == "clipgt-sent" and names_in(folder) == ["sent.usdz"]


def test_the_command_line_uploads(address, archive, folder, tmp_path, capsys):
    from nurec_sim.cli import main

    main(["upload", str(archive), "--server", address])
    assert "uploaded as clipgt-sent" in capsys.readouterr().out and names_in(folder) == ["sent.usdz"]
    for arguments, text in [
        ([str(archive)], "a file 'sent.usdz' was uploaded before"),
        ([str(archive), "--reconstruct"], "--reconstruct is for clips, sent.usdz is not one"),
        ([str(tmp_path / "gone.usdz")], "gone.usdz: No such file or directory"),
        ([str(archive), "--token-file", str(tmp_path / "no.txt")], "the token cannot be read from "),
    ]:
        with pytest.raises(SystemExit):
            main(["upload", *arguments, "--server", address])
        assert text in " ".join(capsys.readouterr().err.split())


def test_uploads_at_the_same_time_share_the_room_that_they_were_promised(folder):
    uploads = UploadFolder(folder, SceneStore(), max_bytes=100, max_total_bytes=150)
    with uploads.receive("a.usdz", 100, "0" * 64, ".usdz") as upload:
        upload.write(b"PK")
        assert uploads.total_bytes == 100
        with pytest.raises(TooLargeError, match="uploads may take 150 bytes in all, with this one 160"):
            uploads.receive("b.usdz", 60, "0" * 64, ".usdz").__enter__()
    assert uploads.total_bytes == 0 and list(folder.iterdir()) == []
