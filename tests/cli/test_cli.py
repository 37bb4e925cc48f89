"""The command line as a stranger meets it: help, mistakes, exit codes."""

import os
import re
import rlcompleter
import subprocess
import sys
from pathlib import Path

import pytest

import nurec_sim
import nurec_sim.evaluate
import nurec_sim.render
from nurec_sim import cli
from nurec_sim.cli import driving
from nurec_sim.errors import NurecSimError
from nurec_sim.serving.driver import RemotePolicy

REPO = Path(__file__).parents[2]
VERBS = [
    "compare",
    "conformance",
    "demo",
    "drive-grpc",
    "evaluate",
    "export",
    "health",
    "import",
    "import-log",
    "inspect",
    "lidar",
    "policies",
    "reconstruct",
    "render",
    "report",
    "run",
    "serve",
    "serve-grpc",
    "study",
    "train",
    "trim",
    "upload",
    "validate",
    "view",
    "weights",
    "world",
]


def run_cli(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "nurec_sim.cli", *arguments], capture_output=True, text=True, timeout=120
    )


def test_help_names_every_verb_and_loads_nothing_heavy() -> None:
    text = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "nurec_sim.cli", "--help"], capture_output=True, text=True
    )
    assert text.returncode == 0
    for verb in VERBS:
        assert re.search(rf"\b{verb}\b", text.stdout), verb
    loaded = {line.split("|")[-1].strip() for line in text.stderr.splitlines()}
    assert not loaded & {"torch", "numba", "mujoco", "pxr", "plotly", "cv2", "polars", "grpc", "scipy"}


def test_health_starts_with_next_to_nothing(tmp_path: Path) -> None:
    """It is asked every few seconds: 0.15 s of CPU time, half of which is gRPC's own."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "nurec_sim.cli", "health", "127.0.0.1:1", "--timeout", "0.2"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1 and "nurec-sim: 127.0.0.1:1: UNAVAILABLE" in done.stderr
    loaded = {line.split("|")[-1].strip() for line in done.stderr.splitlines()}
    assert "grpc" in loaded
    heavy = {"torch", "numba", "mujoco", "pxr", "cv2", "scipy", "numpy", "polars", "tyro", "rich", "yaml", "pydantic"}
    assert not loaded & heavy
    ours = {name for name in loaded if name.startswith("nurec_sim")}
    expected = {"nurec_sim", "nurec_sim.cli", "nurec_sim.cli.health", "nurec_sim.errors", "nurec_sim.serving"}
    assert ours == expected | {"nurec_sim.serving.channels", "nurec_sim.serving.health"}


def test_health_takes_no_other_words(capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in (
        ([], "HOST:PORT"),
        (["127.0.0.1:1", "--time", "1"], "unrecognized arguments: --time 1"),
        (["127.0.0.1:1", "--timeout", "nan"], "must be more than 0"),
        (["127.0.0.1:1", "--timeout", "-1"], "must be more than 0"),
    ):
        with pytest.raises(SystemExit) as stop:
            cli.main(["health", *words])
        assert stop.value.code == 2 and said in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        cli.main(["health", "127.0.0.1:1", "--root-ca", "/nowhere.pem"])
    assert stop.value.code == 1 and "TLS cannot be set up" in capsys.readouterr().err


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_every_option(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main([verb, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert "usage: nurec-sim" in text


def test_an_unknown_option_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["serve", "scene.usdz", "--prot", "1"])
    assert stop.value.code == 2
    assert "--prot" in capsys.readouterr().err


def test_a_missing_clip_is_one_clear_line(tmp_path: Path) -> None:
    missing = tmp_path / "nowhere"
    result = run_cli("inspect", str(missing))
    assert result.returncode == 1
    assert "nowhere" in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize("page", ["README.md", "docs/commands.md", "docs/tutorial.md"])
def test_pages_use_only_verbs_that_exist(page: str) -> None:
    used = set(re.findall(r"^nurec-sim ([\w-]+)", (REPO / page).read_text(), flags=re.MULTILINE))
    assert used
    assert used <= set(VERBS)


def test_the_demo_log_can_be_had_as_a_file(tmp_path: Path) -> None:
    result = run_cli("demo", "--save-log", str(tmp_path / "log.zip"))
    assert result.returncode == 0 and "wrote" in result.stdout
    assert (tmp_path / "log.zip").read_bytes() == (REPO / "scenarios" / "demo_clip.zip").read_bytes()


@pytest.mark.parametrize(
    ("name", "text"), [("log.tar", "--save-log writes a .zip file, got"), ("there.zip", "there.zip exists; give")]
)
def test_a_demo_log_is_not_written_elsewhere(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / "there.zip").write_text("mine")
    with pytest.raises(NurecSimError, match=text):
        driving.demo(save_log=tmp_path / name)
    assert (tmp_path / "there.zip").read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["serve", "nowhere.usdz"], "nothing to serve: nowhere.usdz does not exist"),
        (["run", "--scenario", "nope"], "no scenario named 'nope'; have ['cut_in', 'demo', 'hard_brake', 'pedestrian'"),
        (["run", "--scenario", "short"], "has no clip"),
        (["demo", "--refine", "0"], "--refine: seconds must be positive and finite, got 0.0"),
        (["run", "--scenario", "demo", "--refine", "5", "--address", "127.0.0.1:9"], "--refine cannot be used with"),
        (["demo", "--budget", "9"], "--budget bounds the Gaussians of an optimisation: give it with --refine"),
        (["demo", "--refine", "5", "--budget", "0"], "--budget: max_gaussians must be positive and finite, got 0"),
        (["render", "nowhere.usdz"], "nowhere.usdz does not exist"),
        (["lidar", "nowhere.usdz"], "nowhere.usdz does not exist"),
        (["lidar", "nowhere.usdz", "--out", "a.txt"], "--out must end in .npz, .ply, .png, got 'a.txt'"),
        (["lidar", "nowhere.usdz", "--noise", "-1"], "--noise is a standard deviation in metres, at least 0; got -1"),
        (["lidar", "nowhere.usdz", "--left-m", "inf"], "--left-m, --ahead-m and --yaw-deg must be finite"),
        (["evaluate", "nowhere"], "no clip at 'nowhere'"),
        (["policies", "nobody"], "unknown policy 'nobody'; have ['blind_route'"),
        (["world", "--out", "a.zip", "--seconds", "100"], "1..30 seconds"),
    ],
)
def test_mistakes_are_one_clear_line(
    arguments: list[str], text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == 1
    assert text in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def spoilt_clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clip whose second image ends in the middle."""
    import tiny_clip

    folder = tiny_clip.write(tmp_path_factory.mktemp("clips") / "spoilt", jpeg_quality=90)
    image = sorted(folder.rglob("*.jpg"))[1]
    image.write_bytes(image.read_bytes()[:200])
    return folder


def test_a_corrupt_image_is_found_and_nothing_is_half_written(
    spoilt_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        cli.main(["inspect", str(spoilt_clip)])
    assert stop.value.code == 1
    assert "fault:" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stop:
        cli.main(["reconstruct", str(spoilt_clip), "--out", "scene.usdz"])
    assert stop.value.code == 1
    assert ".jpg" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_server_lives_on_beside_a_corrupt_clip(spoilt_clip: Path, tmp_path: Path) -> None:
    from serving_world import camera_request, scene

    from nurec_sim.errors import NurecSimError
    from nurec_sim.serving.client import RemoteSensors
    from nurec_sim.serving.server import SensorServer
    from nurec_sim.serving.store import SceneStore

    good = scene()
    store = SceneStore([good, spoilt_clip], cache_dir=tmp_path)
    assert len(store.ids) == 2
    with SensorServer(store, port=0) as address:
        with RemoteSensors(address, store.ids[1]) as bad, pytest.raises(NurecSimError, match=r"\.jpg"):
            bad.sense([camera_request(scene_id="tiny")])
        with RemoteSensors(address, good.id) as remote:
            assert remote.sense([camera_request()])[0].rgb.any()
    assert not list(tmp_path.iterdir())


# --------------------------------------------------------------------------------------------------------- first steps


@pytest.mark.parametrize(("given", "used"), [(None, "1"), ("3", "3")])
def test_matrices_are_multiplied_by_one_thread_unless_the_user_says_otherwise(monkeypatch, given, used) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    if given:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", given)
    cli.main(["--version"])
    assert os.environ["OPENBLAS_NUM_THREADS"] == used


def test_version_and_first_steps_need_nothing_heavy(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["--version"])
    assert capsys.readouterr().out == f"nurec-sim {nurec_sim.__version__}\n"
    cli.main([])
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    steps = re.findall(r"^  nurec-sim ([\w-]+)", text, flags=re.MULTILINE)
    assert steps == ["demo", "inspect", "run"] and set(steps) <= set(VERBS)


@pytest.mark.parametrize(
    ("word", "hint"),
    [
        ("rnder", "did you mean 'render'?"),
        ("inspct", "did you mean 'inspect'?"),
        ("lift", "it is a method: nurec-sim reconstruct LOG --method lift."),
        ("zzz", "have compare, conformance, "),
    ],
)
def test_a_wrong_verb_is_one_line_that_names_the_nearest(word: str, hint: str, capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main([word, "scene.usdz"])
    assert stop.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and f"unknown command '{word}'; {hint}" in lines[0]


@pytest.mark.parametrize(
    ("policy", "text"), [("log_repaly", "unknown policy 'log_repaly'"), ("grpc://127.0.0.1:9", "127.0.0.1:9")]
)
def test_a_policy_that_cannot_be_had_ends_a_run_before_its_scenes_are_read(policy, text, monkeypatch, capsys) -> None:
    monkeypatch.setattr("nurec_sim.serving.store.SceneStore.get", lambda *_, **__: pytest.fail("work was begun"))
    monkeypatch.setattr("nurec_sim.serving.driver.RemotePolicy.__init__.__kwdefaults__", {
        **RemotePolicy.__init__.__kwdefaults__, "connect_timeout_s": 0.3,
    })  # fmt: skip
    with pytest.raises(SystemExit) as stop:
        cli.main(["run", str(REPO / "scenarios" / "demo_clip.zip"), "--policies", policy])
    assert stop.value.code == 1
    assert text in capsys.readouterr().err


def test_a_run_that_does_not_exist_is_not_resumed_and_no_scene_is_read(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("nurec_sim.serving.store.SceneStore.get", lambda *_, **__: pytest.fail("work was begun"))
    with pytest.raises(SystemExit) as stop:
        cli.main(["demo", "--resume", str(tmp_path / "none")])
    assert stop.value.code == 1
    assert "none does not exist; give a folder written by `nurec-sim run`" in capsys.readouterr().err


# ------------------------------------------------------------------------------------------------- at Python's prompt


def test_lazy_packages_list_and_complete_their_names() -> None:
    import nurec_sim.metrics
    import nurec_sim.render.gpu
    import nurec_sim.runs
    import nurec_sim.world

    assert {"logs", "render", "sim", "runs", "__version__"} <= set(dir(nurec_sim))
    for package in (nurec_sim.evaluate, nurec_sim.metrics, nurec_sim.render, nurec_sim.render.gpu, nurec_sim.runs,
                    nurec_sim.world):  # fmt: skip
        assert dir(package) == sorted(package.__all__)
    completer = rlcompleter.Completer({"nurec_sim": nurec_sim})
    assert completer.complete("nurec_sim.metr", 0) == "nurec_sim.metrics"
    assert completer.complete("nurec_sim.runs.exe", 0).startswith("nurec_sim.runs.execute(")


def test_parts_of_the_package_load_on_first_use() -> None:
    code = (
        "import sys, nurec_sim; print('numpy' in sys.modules); nurec_sim.geometry.pose; print('numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["False", "True"], done.stderr
    with pytest.raises(AttributeError, match="nothing"):
        _ = nurec_sim.nothing
    for name in dir(nurec_sim):
        assert getattr(nurec_sim, name) is not None


def test_scenes_and_rollouts_show_themselves_in_three_lines() -> None:
    from metrics_worlds import full_rollout
    from serving_world import scene

    lines = repr(scene()).splitlines()
    assert lines == [
        "GaussianScene 'street', 2.00 s from 5000000 us",
        "  Gaussians: 454 static, 60 dynamic; sky 6x8x8, 2 tracks, no road map",
        "  cameras: front, wide, fish; LiDARs: roof",
    ]
    assert repr(scene().static) == "Gaussians(454, 0 harmonics beyond the colour)"
    lines = repr(full_rollout()).splitlines()
    assert len(lines) == 3 and lines[0].startswith("Rollout of ") and max(map(len, lines)) <= 160
