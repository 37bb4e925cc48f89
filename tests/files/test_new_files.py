"""Files that appear complete or not at all, and what is said where a disk does not take them."""

import errno
import multiprocessing
import os
import pickle
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import tiny_clip
import torch
import training_clips
from repetition import slow_after
from serving_world import scene

import nurec_sim.evaluate
import nurec_sim.network.checkpoints.download
import nurec_sim.reconstruct
from nurec_sim import cli
from nurec_sim.errors import NurecSimError, WriteError
from nurec_sim.files.new_files import check_writable, new_file, write_file, writing
from nurec_sim.network.profiles import PROFILES
from nurec_sim.runs.folder import written_at_once
from nurec_sim.runs.video import CODEC_OPTIONS
from nurec_sim.scene import write_scene
from nurec_sim.training.checkpoint import Position, save_checkpoint
from nurec_sim.training.data import cache as cache_module
from nurec_sim.training.data.cache import ClipCache
from nurec_sim.training.data.generate import ClipSettings
from nurec_sim.training.data.stream import SampleStream
from nurec_sim.training.data.windows import WindowSettings
from nurec_sim.world import town_plan
from nurec_sim.world.truth_folder import TruthFolder


@contextmanager
def room_for(size: int) -> Iterator[None]:
    """No file of this process can grow beyond so many bytes, as on a disk that fills up."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def files(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, hidden ones too."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# ----------------------------------------------------------------------------------------------------------- functions


def test_a_file_that_does_not_fit_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.bin"
    write_file(path, "old\n")
    with room_for(1000), pytest.raises(WriteError) as raised:
        write_file(path, bytes(2000))
    assert files(tmp_path) == {"new/a.bin": b"old\n"}
    error = raised.value
    assert isinstance(error, OSError) and isinstance(error, NurecSimError)
    assert (error.errno, error.filename) == (errno.EFBIG, str(path))
    assert str(error).startswith(f"cannot write {path}: File too large; ")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_what_is_no_error_of_the_disk_passes(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    for error in (ValueError("no"), ConnectionResetError(errno.ECONNRESET, "gone"), OSError("a library's own")):
        with pytest.raises(type(error)) as raised, new_file(path) as file:
            file.write(b"half")
            raise error
        assert raised.value is error and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("file/a.bin", "a file lies where a folder should be"),
        ("file/b/a.bin", "a file lies where a folder should be"),
        ("folder", "a folder has that name"),
        ("n" * 300, "choose a shorter name"),
    ],
)
def test_places_that_cannot_be(tmp_path: Path, name: str, reason: str) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    for attempt in (check_writable, lambda path: write_file(path, b"x")):
        with pytest.raises(WriteError, match=reason):
            attempt(tmp_path / name)
    assert files(tmp_path) == {"file": b"mine"}


def test_a_place_is_looked_at_before_the_work_and_nothing_is_made(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "file").write_text("mine")
    check_writable(tmp_path / "a" / "b" / "c.png")
    check_writable(tmp_path / "file")
    check_writable(tmp_path / "a", folder=True)
    check_writable(tmp_path, folder=True)
    with pytest.raises(WriteError, match="a file lies where a folder should be"):
        check_writable(tmp_path / "file", folder=True)
    assert files(tmp_path) == {"file": b"mine"}
    monkeypatch.setattr(os, "access", lambda path, mode: not mode & os.W_OK)
    with pytest.raises(WriteError, match="Permission denied; choose a place where you may write"):
        check_writable(tmp_path / "a" / "c.png")


def test_a_device_is_written_to_and_stays_a_device(tmp_path: Path) -> None:
    write_file(Path("/dev/null"), bytes(100_000))
    assert Path("/dev/null").is_char_device()
    with pytest.raises(WriteError, match="cannot write /dev/full: No space left on device; make room"):
        write_file(Path("/dev/full"), bytes(100_000))


def test_arrays_that_numpy_writes_itself_are_errors_of_the_disk_too(tmp_path: Path) -> None:
    with room_for(1000), pytest.raises(WriteError, match="a.npy"), writing(tmp_path / "a.npy"):
        np.save(tmp_path / "a.npy", np.zeros(100_000))


def test_a_folder_that_does_not_fit_leaves_the_old_one(tmp_path: Path, monkeypatch) -> None:
    target = tmp_path / "rollout"
    with written_at_once(target) as part:
        (part / "a").write_text("old")
    with (
        room_for(1000),
        pytest.raises(WriteError, match=r"/rollout/b: File too large"),
        written_at_once(target) as part,
    ):
        write_file(part / "b", bytes(2000))
    assert files(tmp_path) == {"rollout/a": b"old"}

    real = os.rename

    def full(source: Path, to: Path) -> None:
        if ".part." in str(source):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(source, to)

    monkeypatch.setattr(os, "rename", full)
    with pytest.raises(WriteError, match="No space left on device"), written_at_once(target) as part:
        (part / "a").write_text("new")
    assert files(tmp_path) == {"rollout/a": b"old"}


# -------------------------------------------------------------------------------------------------------- command line

SCENARIO = "{name: brief, duration_s: 0.6, warm_up_s: 0.1, replan_s: 0.5, policies: [constant_velocity]}\n"


FIGURES = {"much": list(range(1000)), "image": {}, "lidar": None, "free_space": None, "road": None, "seconds": {},
           "counts": {"static": 1, "dynamic": 0}}  # fmt: skip


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scene, a clip and a scenario; what takes long is left out."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(nurec_sim.reconstruct, "reconstruct", lambda *_, **__: scene())
    monkeypatch.setattr(nurec_sim.evaluate, "evaluate", lambda *_, **__: FIGURES, raising=False)
    write_scene(scene(), "street.usdz")
    tiny_clip.write(tmp_path / "clip.zip")
    Path("brief.yaml").write_text(SCENARIO)
    Path("file").write_text("mine")
    return tmp_path


def one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The only line of errors of a command that ends with 1."""
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("nurec-sim: cannot write "), lines
    return lines[0]


ORDERS = {
    "render": ["render", "street.usdz", "--out", "OUT.png"],
    "lidar": ["lidar", "street.usdz", "--model", "VLP-16", "--columns", "60", "--out", "OUT.npz"],
    "reconstruct": ["reconstruct", "clip.zip", "--overwrite", "--out", "OUT.usdz"],
    "export": ["export", "street.usdz", "--overwrite", "--out", "OUT.ply"],
    "import": ["import", "old.ply", "--overwrite", "--out", "OUT.usdz"],
    "evaluate": ["evaluate", "clip.zip", "--json", "OUT.json"],
}  # fmt: skip


@pytest.mark.parametrize("verb", ORDERS)
def test_a_full_disk_is_one_line_and_the_old_file_stays(verb: str, place: Path, capsys) -> None:
    order = [word.replace("OUT", "out/x") for word in ORDERS[verb]]
    if verb == "import":
        cli.main(["export", "street.usdz", "--out", "old.ply"])
    cli.main(order)
    capsys.readouterr()
    before = files(place)
    assert any(name.startswith("out/x") for name in before)
    whole = max(len(data) for name, data in before.items() if name.startswith("out/x"))
    with room_for(whole - 1):  # the layers of an archive, which OpenUSD writes elsewhere, fit
        line = one_line(order, capsys)
    assert "out/x." in line and "File too large; " in line
    assert files(place) == before


def test_a_full_disk_of_temporary_files_names_its_variable(place: Path, capsys) -> None:
    before = files(place)
    with room_for(100):
        line = one_line(["reconstruct", "clip.zip", "--out", "x.usdz"], capsys)
    assert "temporary files in /tmp ($TMPDIR): File too large" in line.replace(tempfile.gettempdir(), "/tmp")
    assert files(place) == before


@pytest.mark.parametrize("verb", [*ORDERS, "run", "train", "world"])
def test_a_place_that_cannot_be_written_is_one_line_before_the_work(
    verb: str, place: Path, monkeypatch, capsys
) -> None:
    order = {
        "run": ["run", "street.usdz", "--scenario", "brief.yaml", "--out", "OUT"],
        "train": ["train", str(Path(nurec_sim.__file__).parent / "training/recipes/tiny.yaml"), "--out", "OUT"],
        "world": ["world", "--out", "OUT.zip"],
        **ORDERS,
    }[verb]
    if verb == "import":
        cli.main(["export", "street.usdz", "--out", "old.ply"])
    before = files(place)
    for name in ("nurec_sim.serving.store.SceneStore.get", "nurec_sim.reconstruct.reconstruct"):
        monkeypatch.setattr(name, lambda *_, **__: pytest.fail("work was begun"))
    line = one_line([word.replace("OUT", "file/x") for word in order], capsys)
    assert "file/x" in line and "a file lies where a folder should be" in line
    assert files(place) == before


@pytest.mark.parametrize("video", slow_after(1, [True, False]))
def test_a_run_on_a_full_disk_ends_with_one_line_and_goes_on_later(
    video: bool, place: Path, monkeypatch, capsys
) -> None:
    monkeypatch.setitem(CODEC_OPTIONS, "crf", "0")  # the video is the first file beyond the limit
    order = ["run", "street.usdz", "--scenario", "brief.yaml", "--video" if video else "--no-video"]
    cli.main([*order, "--out", "warm"])  # what is compiled now writes no caches later
    capsys.readouterr()
    with room_for(8_000 if video else 1_000):
        line = one_line(order, capsys)
    assert ("front.mp4" if video else "road.npz") in line, line
    assert not [name for name in files(place / "runs") if ".part" in name]
    cli.main([*order, "--resume", "runs/latest"])
    report = place / "runs" / "latest" / "report.html"
    whole = report.read_bytes()
    with room_for(100_000):
        assert "report.html" in one_line(["report", "runs/latest"], capsys)
    assert report.read_bytes() == whole


def test_logs_and_truths_that_do_not_fit_leave_nothing(tmp_path: Path) -> None:
    tiny_clip.write(tmp_path / "clip.zip")
    before = files(tmp_path)
    for path in (tmp_path / "clip.zip", tmp_path / "folder"):
        with room_for(1000), pytest.raises(WriteError, match=f"cannot write {path}: File too large"):
            tiny_clip.write(path, overwrite=True)
    truth = tmp_path / "truth"
    with room_for(1000), pytest.raises(WriteError, match=f"cannot write {truth}: File"), TruthFolder(truth) as half:
        half.add_plan(town_plan(3), {})
    assert files(tmp_path) == before


def test_a_checkpoint_that_does_not_fit_leaves_the_old_one(tmp_path: Path) -> None:
    model = torch.nn.Linear(30, 30)
    save_checkpoint(tmp_path, model, model, None, Position(1, 1.0, "a"))
    before = files(tmp_path)
    with room_for(1000), pytest.raises(WriteError, match=f"cannot write {tmp_path}/checkpoint.safetensors"):
        save_checkpoint(tmp_path, model, model, None, Position(2, 1.0, "a"))
    assert files(tmp_path) == before


def test_towns_that_cannot_be_kept_end_the_wait_for_them(tmp_path: Path, monkeypatch) -> None:
    def generate(town: int, settings: ClipSettings, folder: Path, backend: str) -> list[Path]:
        return [training_clips.write_clip(folder / "train-000000-0")]

    monkeypatch.setattr(cache_module, "generate_town", generate)
    forking = multiprocessing.get_context("fork")  # so that the process that draws has this generate, and the limit
    monkeypatch.setattr(multiprocessing, "get_context", lambda method: forking)
    said: list[str] = []
    with ClipCache(tmp_path, ClipSettings(), 1, report=said.append) as cache:
        with room_for(1000), pytest.raises(WriteError, match="train-000000-0: No space left on device"):
            cache.fill()
        assert len(said) == 1 and said[0].startswith("no more towns are generated: cannot write ")
        assert not files(tmp_path)
        stream = SampleStream(cache.clips, WindowSettings(PROFILES["tiny"]), 0, check=cache.check)
        with stream, pytest.raises(WriteError):
            next(stream)


def test_weights_that_cannot_be_kept(tmp_path: Path, monkeypatch, capsys) -> None:
    class Hub:
        @staticmethod
        def hf_hub_download(*_, **__):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "blob.incomplete")

    monkeypatch.setattr(nurec_sim.network.checkpoints.download, "hub_library", lambda: Hub)
    line = one_line(["weights", "fetch", "pa-front", "--to", str(tmp_path)], capsys)
    assert str(tmp_path) in line and "No space left on device; make room" in line


def test_output_that_cannot_be_written_is_one_line(place: Path) -> None:
    with open("/dev/full", "w") as full:
        ended = subprocess.run(
            [sys.executable, "-m", "nurec_sim.cli", "--help"], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert ended.returncode == 1 and ended.stderr == "nurec-sim: standard output: No space left on device\n"


def test_a_file_that_may_not_be_read_is_one_line(place: Path, monkeypatch, capsys) -> None:
    def refuse(*_, **__):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "clip.zip")

    monkeypatch.setattr("nurec_sim.logs.open_clip", refuse)
    with pytest.raises(SystemExit) as stop:
        cli.main(["inspect", "clip.zip"])
    assert stop.value.code == 1
    assert capsys.readouterr().err == "nurec-sim: clip.zip: Permission denied\n"
