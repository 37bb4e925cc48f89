"""``serve-grpc`` with the command lines that AlpaSim and users of NVIDIA's renderer have in their scripts."""

import contextlib
import json
import re
import signal
from pathlib import Path

import pytest
from grpc import StatusCode as Code
from serving_calls import Stub, camera_message, place, red_count, refusal
from serving_metrics import metric
from serving_process import ended, serving
from serving_world import scene

from nurec_sim import cli, geometry
from nurec_sim.cli.nre_flags import IGNORED_SWITCHES, IGNORED_VALUES, sort_flags
from nurec_sim.cli.serving import _glob_folder, sort_serve_grpc
from nurec_sim.errors import NurecSimError
from nurec_sim.scene import write_scene
from nurec_sim.serving.wire import ImageFormat, common


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A folder as AlpaSim has them: archives at several depths, and a hood picture."""
    import cv2
    import numpy as np

    folder = tmp_path_factory.mktemp("alpasim")
    (folder / "scenes" / "deep").mkdir(parents=True)
    write_scene(scene(), folder / "scenes" / "deep" / "street.usdz")
    write_scene(scene("other", seed=1), folder / "scenes" / "other.usdz")
    (folder / "hoods" / "hyperion_8_1").mkdir(parents=True)
    cv2.imwrite(str(folder / "hoods" / "hyperion_8_1" / "front.png"), np.full((180, 320, 4), 255, np.uint8))
    return folder


def fails(capsys, *words):
    """The one line that a command line ends with."""
    with pytest.raises(SystemExit) as stop:
        cli.main(["serve-grpc", *map(str, words)])
    assert stop.value.code == 1
    return capsys.readouterr().err


# ------------------------------------------------------------------------------------------------------ a real process


def test_the_launch_line_of_alpasim_serves_and_ends_cleanly(scenes, tmp_path):
    words = (
        "serve-grpc", "--port", "0", "--host=0.0.0.0", f"--artifact-glob={scenes}/scenes/**/*.usdz",
        f"--egocar-hood-dir={scenes}/hoods", "--no-enable-nrend", "--download-cache-dir", str(tmp_path / "downloads"),
        "--cache-size=3", "--max-workers=2", "--enable-editing-actors",
    )  # fmt: skip
    with serving(*words) as (process, address):
        assert address.startswith("0.0.0.0:")
        with Stub(address.replace("0.0.0.0", "127.0.0.1")) as stub:
            assert set(stub.get_available_scenes(common.Empty(), timeout=60).scene_ids) == {
                "clipgt-street",
                "clipgt-other",
            }
            masks = stub.get_available_ego_masks(common.Empty(), timeout=60).ego_mask_metadata
            assert [m.ego_mask_id.rig_config_id for m in masks] == ["hyperion_8_1"]
            config = dict(stub.get_server_config(common.Empty(), timeout=60).config)
            assert (config["render_workers"], config["scene_capacity"]) == ("2", "3")
            assert (config["only_listed_actors"], config["warm_up"]) == ("True", "True")
            assert stub.render_rgb(camera_message(image_format=ImageFormat.JPEG), timeout=60).image_bytes.startswith(
                b"\xff\xd8"
            )
        process.send_signal(signal.SIGTERM)
        code, out, complaints = ended(process)
    assert (code, out) == (0, "")
    warnings = complaints.splitlines()
    assert len(warnings) == 2, complaints
    assert warnings[0] == "warning: these flags have no effect on this renderer: --no-enable-nrend"
    assert re.fullmatch(r"warning: any client that can reach 0.0.0.0:0 may call; .*", warnings[1])


@pytest.mark.slow
def test_a_protected_server_with_all_its_ports(scenes, tmp_path):
    from grpc_health.v1 import health_pb2, health_pb2_grpc

    (tmp_path / "token").write_text("a-long-secret-of-ours\n")
    words = (
        "serve-grpc", f"--artifact_glob={scenes}/scenes/other.usdz", "--port=0",
        "--token-file", str(tmp_path / "token"),
        "--health-port=0", "--metrics-port=0", "--log-format=json", "--log-level=info", "--max-pixels=100000",
    )  # fmt: skip
    with serving(*words) as (process, address):
        lines = [process.stderr.readline() for _ in range(3)]
        assert "the token travels in plain text" in lines[0]
        health, metrics = (re.search(r"127\.0\.0\.1:\d+|localhost:\d+", line)[0] for line in lines[1:])
        assert all(json.loads(line)["level"] == "info" for line in lines[1:])
        token = [("authorization", "Bearer a-long-secret-of-ours")]
        with Stub(address) as stub, Stub(health) as probe:
            assert refusal(stub.get_version, common.Empty())[0] == Code.UNAUTHENTICATED
            assert stub.get_version(common.Empty(), metadata=token, timeout=60).version_id
            big = camera_message(scene_id="other")
            big.resolution_w, big.resolution_h = 400, 300
            with pytest.raises(Exception, match="a frame may have 100,000 pixels"):
                stub.render_rgb(big, metadata=token, timeout=60)
            assert health_pb2_grpc.HealthStub(probe.channel).Check(health_pb2.HealthCheckRequest(), timeout=10).status
        assert metric(metrics, "requests_total", method="SensorsimService/render_rgb", code="RESOURCE_EXHAUSTED") == 1
        process.send_signal(signal.SIGINT)
        assert ended(process)[0] == 0


# --------------------------------------------------------------------------------------------------------------- flags


def test_both_spellings_of_a_value_mean_the_same():
    for words in (["--cache-size", "4"], ["--cache-size=4"], ["--cache_size=4"], ["--cache_size", "4"]):
        assert sort_serve_grpc(words) == ["--cache-size", "4"]


@pytest.mark.parametrize(
    ("word", "kept"),
    [
        ("--enable-editing-actors", "--enable-editing-actors"),
        ("--enable_editing_actors=true", "--enable-editing-actors"),
        ("--enable-editing-actors=False", "--no-enable-editing-actors"),
        ("--no-enable-editing-actors", "--no-enable-editing-actors"),
        ("--no-test-scenes-are-valid=false", "--test-scenes-are-valid"),
    ],
)
def test_switches_may_be_spelt_out(word, kept):
    assert sort_serve_grpc([word]) == [kept]


def test_all_that_does_not_apply_is_named_in_one_warning(capsys):
    words = [
        "--renderer", "gsplat", "--port", "7", "--no-enable-nrend", "--use-gsplat", "--ray-chunk-size=4096",
        "--enable-timing", "--metrics-output-dir", "out", "--multiproc-workers", "2", "--enable-difix",
        "--difix-model", "some/model", "--enable-harmonizer=true", "--harmonizer-steps=3", "--harmonizer-compile",
        "--enable-harmonizer-temporal", "--use-gsplat",
    ]  # fmt: skip
    assert sort_serve_grpc(words) == ["--port", "7"]
    warning = capsys.readouterr().err
    assert warning.count("\n") == 1
    for name in ("renderer", "no-enable-nrend", "use-gsplat", "ray-chunk-size", "enable-timing", "metrics-output-dir",
                 "multiproc-workers", "enable-difix", "difix-model", "enable-harmonizer", "harmonizer-steps",
                 "harmonizer-compile", "enable-harmonizer-temporal"):  # fmt: skip
        assert warning.count(f"--{name}") >= 1, name
    assert warning.count("--use-gsplat") == 1


def test_nothing_is_said_if_everything_applies(capsys):
    assert sort_serve_grpc(["--port=1", "--artifact-glob=a.usdz"]) == ["--port", "1", "--artifact-glob", "a.usdz"]
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("word", "nearest"),
    [
        ("--artefact-glob=x.usdz", "artifact-glob"),
        ("--prot=1", "port"),
        ("--enable-editing-actor", "enable-editing-actors"),
        ("--use-gspalt", "use-gsplat"),
        ("--no-enable-nerd", "enable-nrend"),
    ],
)
def test_an_unknown_flag_is_an_error_that_names_the_nearest(capsys, word, nearest):
    said = fails(capsys, word)
    assert f"unknown flag {word.partition('=')[0]}; the nearest known one is --{nearest} " in said


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["scene.usdz"], "unexpected 'scene.usdz': serve-grpc takes flags only"),
        (["--port"], "--port needs a value"),
        (["--enable-editing-actors=perhaps"], "--enable-editing-actors is a switch: true or false, got 'perhaps'"),
        (["--artifact-glob=/data/scenes"], "must end in .usdz, got '/data/scenes'; try /data/scenes/**/*.usdz"),
        (["--artifact-glob=/no/such/*.usdz"], "--artifact-glob '/no/such/*.usdz' matches no file"),
        (["--cache-size=0"], "capacity 0"),
        (["--max-workers=0"], "render_workers must be at least 1, got 0"),
        (["--download-cache-size=0"], "download_cache_size must be at least 1, got 0"),
        (["--rate=-1"], "rate_per_s must be above 0, got -1"),
        (["--tls-cert=a.pem"], "TLS needs both --tls-cert and --tls-key"),
        (["--token-file=/no/such/token"], "the token cannot be read from /no/such/token"),
    ],
)
def test_a_mistake_is_one_clear_line(capsys, words, text):
    said = fails(capsys, *words)
    assert text in said and "Traceback" not in said


def test_help_teaches(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["serve-grpc", "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for flag in ("artifact-glob", "health-port", "enable-editing-actors", "egocar-hood-dir", "test-scenes-are-valid",
                 "download-cache-size", "tls-client-ca", "token-file", "metrics-port", "log-format"):  # fmt: skip
        assert f"--{flag}" in text


def test_no_flag_both_applies_and_is_passed_over():
    sorted_ = sort_flags(["--port=1"], [], ["port"])
    assert sorted_.arguments == ["--port", "1"] and not sorted_.ignored
    for name in (*IGNORED_SWITCHES, *IGNORED_VALUES):
        assert sort_serve_grpc([f"--{name}"]) == []


# ------------------------------------------------------------------------------------------------------- without a port


@pytest.fixture
def not_served(monkeypatch):
    """Takes what would be served instead of serving it."""
    import nurec_sim.serving.server

    taken = []

    def server(store, host, port, **choices):
        return store, {"host": host, "port": port, **choices}

    monkeypatch.setattr(nurec_sim.serving.server, "SensorServer", server)
    monkeypatch.setattr(nurec_sim.serving.server, "run_until_signal", taken.append)
    monkeypatch.setattr(nurec_sim.serving.server, "set_up_logging", lambda *_: None)
    return taken


def test_health_tells_scripts_whether_a_server_serves(capsys):
    from nurec_sim.serving.server import SensorServer
    from nurec_sim.serving.store import SceneStore

    with SensorServer(SceneStore([scene()]), port=0) as address:
        cli.main(["health", address])
        assert capsys.readouterr().out == f"{address}: SERVING\n"
    with pytest.raises(SystemExit) as stop:
        cli.main(["health", address, "--timeout", "0.5"])
    assert stop.value.code == 1 and re.search("UNAVAILABLE|DEADLINE_EXCEEDED", capsys.readouterr().err)


def test_a_gpu_that_is_not_there_is_said_before_anything_is_served(capsys):
    import torch

    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    assert "Traceback" not in (said := fails(capsys, "--device=cuda")) and "nurec-sim: " in said


def test_an_empty_server_is_fine_without_a_glob(not_served):
    cli.main(["serve-grpc"])
    ((store, choices),) = not_served
    assert store.ids == () and (choices["host"], choices["port"]) == ("localhost", 8080)


def test_files_of_clients_lie_in_the_folders_that_were_given(not_served, scenes, tmp_path, capsys, monkeypatch):
    (tmp_path / "more").mkdir()
    own = scenes / "scenes"
    cli.main(["serve-grpc", f"--artifact-glob={scenes}/**/*.usdz", "--scene-dirs", str(tmp_path / "more")])
    cli.main(["serve-grpc", "--allow-any-file"])
    cli.main(["serve", str(own)])
    monkeypatch.chdir(own)
    cli.main(["serve", "other.usdz"])
    globbed, anything, folder, file = (choices["options"] for _, choices in not_served)
    assert {tmp_path / "more", scenes, own} <= set(globbed.scene_dirs) and not globbed.allow_any_file
    assert anything.allow_any_file and anything.scene_dirs == ()
    assert folder.scene_dirs == (own,) and own in file.scene_dirs
    assert "--scene-dirs '/no/where' is no folder" in fails(capsys, "--scene-dirs", "/no/where")
    assert _glob_folder("/a/*/b/*.usdz") == [Path("/a")] and _glob_folder("x.usdz") == [Path()]


def test_flags_with_several_values_take_all_that_follow(not_served, tmp_path):
    folders = [tmp_path / name for name in "abc"]
    for folder in folders:
        folder.mkdir()
    cli.main(
        [
            "serve-grpc",
            "--scene-dirs",
            *map(str, folders[:2]),
            "--port",
            "1",
            f"--clip-dirs={folders[2]}",
            str(tmp_path),
        ]
    )
    ((_, choices),) = not_served
    assert choices["options"].scene_dirs == tuple(folders[:2]) and choices["port"] == 1
    assert choices["scene_options"].clip_dirs == (folders[2], tmp_path)


def test_scenes_are_tested_before_they_are_served(not_served, scenes, tmp_path, capsys):
    glob = f"--artifact-glob={scenes}/**/*.usdz"
    cli.main(["serve-grpc", glob, "--test-scenes-are-valid"])
    assert len(not_served) == 1
    data = (scenes / "scenes" / "other.usdz").read_bytes()
    (tmp_path / "cut.usdz").write_bytes(data[: len(data) // 2])
    (tmp_path / "good.usdz").write_bytes(data)
    said = fails(capsys, f"--artifact-glob={tmp_path}/*.usdz", "--test-scenes-are-valid")
    assert "1 of 2 scenes are invalid:\n  cut: " in said and len(not_served) == 1
    cli.main(["serve-grpc", f"--artifact-glob={tmp_path}/*.usdz"])  # without the flag the good one is served
    assert not_served[1][0].ids == ("clipgt-other",)


@pytest.mark.parametrize(
    ("words", "refused"),
    [
        (["--host", "0.0.0.0"], True),
        (["--host", "0.0.0.0", "--insecure"], False),
        (["--host", "0.0.0.0", "--token-file", "TOKEN"], False),
        ([], False),
    ],
)
def test_serve_opens_itself_to_others_only_on_purpose(not_served, scenes, tmp_path, words, refused):
    (tmp_path / "token").write_text("a-long-secret-of-ours")
    words = [str(tmp_path / "token") if word == "TOKEN" else word for word in words]
    outcome = pytest.raises(SystemExit) if refused else contextlib.nullcontext()
    with outcome:
        cli.main(["serve", str(scenes / "scenes"), *words])
    assert len(not_served) == (0 if refused else 1)


def test_a_frame_needs_a_thread(scenes, capsys):
    with pytest.raises(SystemExit):
        cli.main(["serve", str(scenes / "scenes"), "--threads", "0"])
    assert "--threads must be at least 1, got 0" in capsys.readouterr().err


def test_a_refusal_to_open_itself_says_what_to_do():
    from nurec_sim.serving.server import check_exposure

    with pytest.raises(NurecSimError, match="refused to listen at '0.0.0.0', which other machines can reach"):
        check_exposure("0.0.0.0", protected=False, insecure=False)


def test_only_listed_actors_are_drawn_if_editing_is_enabled(scenes):
    """The rule of --enable-editing-actors, seen in pixels; static actors stay."""
    from nurec_sim.serving.sensor_service import ServiceOptions
    from nurec_sim.serving.server import SensorServer
    from nurec_sim.serving.store import SceneStore

    def reds(only_listed):
        options = ServiceOptions(only_listed_actors=only_listed)
        with SensorServer(SceneStore([scene()], threads=1), port=0, options=options) as address, Stub(address) as stub:
            message = camera_message()
            place(message, "an-id-that-no-scene-has", geometry.pose_from_xyyaw(50.0, 0.0, 0.0))
            import numpy as np

            reply = np.frombuffer(stub.render_rgb(message, timeout=60).image_bytes, np.uint8).reshape(3, 180, 320)
            return red_count(np.moveaxis(reply, 0, 2))

    assert reds(only_listed=False) > reds(only_listed=True)
