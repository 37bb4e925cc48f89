"""Readers of other formats: found, asked, checked; the document's example is one of a made-up format."""

import importlib.metadata
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_clip
from doc_examples import names_of

from nurec_sim import logs, plugins
from nurec_sim.errors import ClipError
from nurec_sim.logs import reader as log_reader
from nurec_sim.logs.readers.native import NativeReader
from nurec_sim.logs.sweeps import SweepRecord, compensated_sweep
from nurec_sim.serving.store.sources import find_sources
from nurec_sim.types import SweepPoints

FORWARD = [(0, 0.0), (100_000, 1.0), (200_000, 2.0)]
"""Times in microseconds and metres driven."""


@pytest.fixture(scope="module")
def example() -> dict:
    return names_of("write_a_log_reader.md")


@pytest.fixture
def folder(tmp_path) -> Path:
    path = tmp_path / "drive"
    path.mkdir()
    rows = [f"{t},{x},0.5,0.1" for t, x in FORWARD]
    (path / "poses.csv").write_text("\n".join(["t_us,x_m,y_m,yaw_rad", *rows]))
    for t, _ in FORWARD:
        picture = np.full((48, 64, 3), (10, 20, 1 + t // 1000), np.uint8)  # blue, green, red
        assert cv2.imwrite(str(path / f"{t}.png"), picture)
    return path


@pytest.fixture
def install(monkeypatch):
    """Makes classes look like readers of installed packages."""

    def as_installed(**classes):
        class Point:
            def __init__(self, name, load):
                self.name, self.load = name, load

        points = [Point(name, lambda made=made: made) for name, made in classes.items()]
        monkeypatch.setattr(plugins, "entry_points", lambda group: points if group == "nurec_sim.logs" else [])

    return as_installed


def test_the_documents_example_keeps_the_contract(example, folder):
    assert logs.check_reader(folder, example["CsvReader"]()) == []


def test_an_installed_reader_opens_its_logs_and_ours_stay_ours(example, folder, install, tmp_path):
    install(csv=example["CsvReader"])
    clip = logs.open_clip(folder)
    assert (clip.id, clip.format, clip.path, clip.time_offset_us) == ("drive", "csv-and-png", folder, 1_000_000)
    assert clip.camera_times_us("front").tolist() == [[t + 1_000_000] * 2 for t, _ in FORWARD]
    assert clip.image("front", 2)[0, 0].tolist() == [201, 20, 10] and not clip.image("front", 2).flags.writeable
    # The camera sits 1.6 m ahead of the axle and 1.5 m up; the car has driven 2 m and is turned by 0.1 rad.
    place = clip.world_from_camera("front", 2)[0][:3, 3]
    assert np.allclose(place, [2 + 1.6 * np.cos(0.1), 0.5 + 1.6 * np.sin(0.1), 1.5])
    assert dict(logs.describe_clip(clip).facts)["format"] == "csv-and-png"
    assert logs.check_clip(folder) == [] and clip.ego_mask("front") is None
    assert find_sources(folder) == [folder] and logs.is_log(folder) and not logs.is_log(tmp_path)
    assert logs.open_clip(tiny_clip.write(tmp_path / "own")).format == "nurec-sim-clip"


def test_a_reader_can_be_given_by_hand(example, folder):
    with pytest.raises(
        ClipError, match="drive: no log reader knows this format; it is a folder with 0.png, 100000.png"
    ):
        logs.open_clip(folder)
    assert logs.open_clip(folder, example["CsvReader"]()).id == "drive"
    with pytest.raises(ClipError, match="unknown log reader 'kitty'; have .*'native', .*'realdata_pack'.*my_reader.py"):
        logs.open_clip(folder, "kitty")


def test_unknown_formats_name_those_that_are_known(example, install, tmp_path):
    install(csv=example["CsvReader"])
    with pytest.raises(ClipError) as caught:
        logs.open_clip(tmp_path)
    for text in ("an empty folder", "nurec-sim-clip: a folder, or a .zip", "csv-and-png: a folder with poses.csv",
                 "docs/write_a_log_reader.md"):  # fmt: skip
        assert text in str(caught.value)


def test_a_broken_reader_is_reported_by_name_and_breaks_no_other(example, folder, install, tmp_path):
    class Careless(NativeReader):
        name = "careless"

        def can_open(self, path):
            return path.stem > 3

    install(careless=Careless, bad=dict, csv=example["CsvReader"])
    with pytest.warns(RuntimeWarning) as warned:
        assert logs.open_clip(folder).format == "csv-and-png"
    texts = [str(each.message) for each in warned]
    assert any("log reader 'bad' is not a log reader: it lacks can_open, open" in text for text in texts)
    assert any("log reader 'careless' cannot look at drive: TypeError" in text for text in texts)
    with pytest.raises(ClipError, match="log reader 'bad' is not a log reader"):
        logs.open_clip(tmp_path)


def spoilt(reader: type, **methods) -> object:
    return type("Spoilt", (reader,), methods)()


@pytest.mark.parametrize(
    "method, text",
    [
        (lambda self, path: 1 / 0, "log reader 'csv-and-png' failed: ZeroDivisionError"),
        (lambda self, path: {}, "log reader 'csv-and-png' must return a nurec_sim.logs.Clip, got dict"),
    ],
)
def test_what_a_reader_does_wrong_names_it(example, folder, method, text):
    wrong = spoilt(example["CsvReader"], open=method)
    with pytest.raises(ClipError, match=f"drive: {text}"):
        logs.open_clip(folder, wrong)
    assert any(text in fault for fault in logs.check_reader(folder, wrong))


def test_what_a_source_gives_is_checked(example, folder, monkeypatch):
    clip = logs.open_clip(folder, example["CsvReader"]())
    source = example["Images"]
    for image, text in [
        (np.zeros((48, 64, 3)), r"drive: image 0.png: must be uint8 \[h,w,3\], got float64"),
        (np.zeros((8, 64, 3), np.uint8), "image 0.png is 64 x 8 pixels, but the calibration of 'front' says 64 x 48"),
        (None, "drive: image 0.png cannot be read: AttributeError"),
    ]:
        monkeypatch.setattr(source, "image", lambda self, camera_id, index, image=image: image)
        with pytest.raises(ClipError, match=text):
            clip.image("front", 0)
    monkeypatch.setattr(source, "ego_mask", lambda self, camera_id: np.zeros((4, 4), bool))
    with pytest.raises(ClipError, match=r"ego mask of camera 'front': must be bool \(48, 64\), got bool \(4, 4\)"):
        clip.ego_mask("front")


@pytest.mark.parametrize(
    "points, text",
    [
        (SweepPoints(np.zeros((2, 2))), r"points must be finite numbers \[n,3\], got float64 \(2, 2\)"),
        (SweepPoints(np.full((2, 3), np.nan)), "points must be finite numbers"),
        (SweepPoints(np.zeros((2, 3)), np.array([0, 7.0])), r"intensities must lie in 0..1, got 0 to 7"),
        (SweepPoints(np.zeros((2, 3)), None, np.zeros(3, int)), r"2 points but dt_us of shape \(3,\)"),
    ],
)
def test_points_of_a_source_are_checked(points, text):
    lidar, ego = tiny_clip.rig().lidars["top"], tiny_clip.ego()
    with pytest.raises(ClipError, match=text):
        compensated_sweep(SweepRecord("a.bin", 5, 5, 5, np.eye(4)), points, lidar, ego)


def test_points_without_motion_compensation_are_moved_by_the_ego():
    """A car at 10 m/s along x: a point measured 0.1 s before the reference time is 1 m nearer by then."""
    lidar = tiny_clip.rig().lidars["top"]
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 2.0
    ego = type(tiny_clip.ego())(np.array([1_000_000, 1_200_000]), poses)
    record = SweepRecord("a.bin", 1_100_000, 1_000_000, 1_100_000, ego.at(1_100_000), compensated=False)
    sweep = compensated_sweep(
        record, SweepPoints(np.array([[9.0, 0, 0]] * 2), None, np.array([0, 100_000])), lidar, ego
    )
    assert sweep.point_t_us.tolist() == [1_000_000, 1_100_000]
    assert np.allclose(sweep.xyz_m[:, 0], [8, 9], atol=1e-3) and not sweep.xyz_m.flags.writeable


@pytest.mark.parametrize(
    "methods, text",
    [
        ({"name": ""}, "name must not be empty"),
        ({"description": 3}, "it lacks description (str)"),
        ({"can_open": lambda self, path: True}, "can_open must answer False for an empty folder, got True"),
        ({"can_open": lambda self, path: False}, "can_open must answer True for the log, got False"),
        ({"can_open": lambda self, path: path.read_text() != ""}, "an empty folder, got IsADirectoryError"),
    ],
)
def test_the_kit_says_what_to_mend(example, folder, methods, text):
    assert any(text in fault for fault in logs.check_reader(folder, spoilt(example["CsvReader"], **methods)))


def test_the_kit_finds_images_that_change_and_errors_of_other_kinds(example, folder, monkeypatch):
    random = np.random.default_rng(0)
    monkeypatch.setattr(example["Images"], "image", lambda *_: random.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    faults = logs.check_reader(folder, example["CsvReader"]())
    assert "camera 'front' frame 0: another image when read again" in faults
    wrong = spoilt(example["CsvReader"], open=lambda self, path: (path / "poses.csv").read_text())
    assert (
        "open must raise a ClipError for an empty folder, got FileNotFoundError" in logs.check_reader(folder, wrong)[0]
    )


def test_our_own_readers_keep_the_contract(tmp_path):
    faults = logs.check_reader(tiny_clip.write(tmp_path / "clip.zip"), NativeReader())
    assert faults == []


def test_damaged_logs_are_told_from_unknown_ones(tmp_path):
    (tmp_path / "meta.json").write_text("{")
    with pytest.raises(ClipError, match="meta.json is not valid JSON"):
        log_reader.find_reader(tmp_path)


def test_installed_packages_are_asked_for_by_the_documented_group():
    assert plugins.LOG_READERS.group == "nurec_sim.logs" and plugins.METHODS.group == "nurec_sim.methods"
    assert list(importlib.metadata.entry_points(group="nurec_sim.logs")) == []
