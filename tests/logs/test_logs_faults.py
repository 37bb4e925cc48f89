import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_clip
from hypothesis import given, settings
from hypothesis import strategies as st
from repetition import slow_after

from nurec_sim import geometry, logs
from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import Limits
from nurec_sim.logs import storage


@pytest.fixture
def clip_folder(tmp_path) -> Path:
    return tiny_clip.write(tmp_path / "clip", jpeg_quality=95)


def edit(folder: Path, name: str, change: Callable[[dict[str, Any]], object]) -> None:
    value = json.loads((folder / name).read_text())
    change(value)
    (folder / name).write_text(json.dumps(value))


def only_fault(path: Path) -> str:
    faults = logs.check_clip(path)
    assert len(faults) == 1, faults
    return faults[0]


def test_a_sound_clip_has_no_faults(clip_folder):
    assert logs.check_clip(clip_folder) == []


@pytest.mark.parametrize("keep, text", [(0, "must be a PNG or a JPEG file"), (300, "is truncated: 300 bytes")])
def test_truncated_images_are_found(clip_folder, keep, text):
    file = clip_folder / "images/left/0001.jpg"
    file.write_bytes(file.read_bytes()[:keep])
    fault = only_fault(clip_folder)
    assert fault.startswith("camera 'left' frame 1: clip: ") and "images/left/0001.jpg" in fault and text in fault


def test_images_that_cannot_be_decoded_are_found(clip_folder):
    (clip_folder / "images/left/0001.jpg").write_bytes(
        b"\xff\xd8\xff\xc0\0\x11\x08\0\x10\0\x10" + b"garbage" * 9 + b"\xff\xd9"
    )
    assert only_fault(clip_folder) == "camera 'left' frame 1: clip: image images/left/0001.jpg cannot be decoded"


def test_missing_files_are_found(clip_folder):
    (clip_folder / "images/front/0002.jpg").unlink()
    (clip_folder / "lidar/top/0000.npz").unlink()
    assert logs.check_clip(clip_folder) == [
        "camera 'front' frame 2: clip: file images/front/0002.jpg is missing",
        "LiDAR 'top' sweep 0: clip: file lidar/top/0000.npz is missing",
    ]


def test_images_of_another_size_are_found(clip_folder):
    edit(clip_folder, "calib.json", lambda calib: calib["cameras"]["wide"].update(width=66))
    faults = logs.check_clip(clip_folder)
    assert len(faults) == 3
    assert faults[0].endswith("is 64 x 48 pixels, but the calibration of 'wide' says 66 x 48")


def test_truncated_sweeps_are_found(clip_folder):
    file = clip_folder / "lidar/top/0001.npz"
    file.write_bytes(file.read_bytes()[:-200])
    fault = only_fault(clip_folder)
    assert fault.startswith("LiDAR 'top' sweep 1: clip: lidar/top/0001.npz is not a readable .npz file")


@pytest.mark.parametrize(
    "arrays, text",
    [
        ({"xyz": np.zeros((3, 4))}, "needs whole numbers dxyz_mm [3,n], got nothing"),
        ({"dxyz_mm": np.full((3, 4), np.nan)}, "needs whole numbers dxyz_mm [3,n], got float64 (3, 4)"),
        (
            {"dxyz_mm": np.zeros((3, 4), np.int32), "intensity": np.zeros(5, np.uint8)},
            "4 points but intensity of shape",
        ),
        ({"dxyz_mm": np.zeros((3, 0), np.int32)}, "it holds no points"),
        ({"dxyz_mm": np.full((3, 4), 2**30, np.int32)}, "m away"),
        ({"dxyz_mm": np.array([[{}]], object)}, "dxyz_mm must hold plain values, got object"),
    ],
)
def test_sweeps_with_wrong_arrays_are_found(clip_folder, arrays, text):
    np.savez(clip_folder / "lidar/top/0002.npz", **arrays)
    fault = only_fault(clip_folder)
    assert fault.startswith("LiDAR 'top' sweep 2") and "lidar/top/0002.npz" in fault and text in fault


def test_sweeps_that_no_camera_sees_are_found(tmp_path):
    far_off = geometry.pose_from_xyyaw(-3000, 0, 0)
    frames = [
        tiny_clip.moved(entry, far_off)
        if getattr(entry, "lidar_id", "") and entry.sweep.start_us == 2_100_000
        else entry
        for entry in tiny_clip.frames()
    ]
    path = tiny_clip.write(tmp_path / "clip", frames=frames)
    assert only_fault(path) == (
        "LiDAR 'top' sweep 1 (lidar/top/0001.npz): none of its points projects into any camera; "
        "a calibration or pose is wrong"
    )


def test_times_that_go_back_are_found_and_the_clip_is_refused(clip_folder):
    def back(frames: dict[str, Any]) -> None:
        frames["cameras"]["left"][2] |= {"start_us": 2_050_000, "end_us": 2_060_000}

    edit(clip_folder, "frames.json", back)
    text = "camera 'left' frame 2: time goes back or stands still, 2050000 us after 2100000 us"
    assert only_fault(clip_folder) == text
    with pytest.raises(ClipError, match=f"clip: {text}"):
        logs.open_clip(clip_folder)


def test_poses_that_are_no_rotations_are_all_found(clip_folder):
    def spoil(frames: dict[str, Any]) -> None:
        frames["ego"]["T_world_ego"][6][0][0] = 1.2
        frames["lidars"]["top"][1]["T_world_lidar"][2][2] = -1.0

    edit(clip_folder, "frames.json", spoil)
    faults = logs.check_clip(clip_folder)
    assert faults[0].startswith("ego pose 6: the 3 x 3 part of the pose is not a rotation (off by 0.4")
    assert faults[1].startswith("LiDAR 'top' sweep 1: the 3 x 3 part of the pose is not a rotation")
    with pytest.raises(ClipError, match="clip: ego pose 6"):
        logs.open_clip(clip_folder)


def set_path(*keys: Any, value: Any) -> Callable[[dict[str, Any]], None]:
    """An edit that sets one field deep in a JSON value; ``...`` as value removes it."""

    def change(row: Any) -> None:
        for key in keys[:-1]:
            row = row[key]
        if value is ...:
            del row[keys[-1]]
        else:
            row[keys[-1]] = value

    return change


FRONT = ("cameras", "front")


@pytest.mark.parametrize(
    "name, change, text",
    [
        (
            "meta.json",
            set_path("schema", value="nuplan"),
            "no log reader knows this format; it is a folder with calib",
        ),
        ("meta.json", set_path("schema", value=...), "no log reader knows this format"),
        ("meta.json", set_path("name", value=7), "meta.json: 'name' must be a str, got int"),
        ("calib.json", set_path("cameras", value=...), "calib.json: 'cameras' is missing; have .'body'"),
        (
            "calib.json",
            set_path(*FRONT, "width", value="64"),
            "camera 'front': 'width' must be a whole number, got '64'",
        ),
        (
            "calib.json",
            set_path(*FRONT, "lens", "model", value="orb"),
            "unknown lens model 'orb'; known are .'fisheye', 'ftheta', 'pinhole'",
        ),
        ("calib.json", set_path(*FRONT, "lens", "k1", value=1), "camera 'front': lens: unknown field 'k1'; known are"),
        ("calib.json", set_path(*FRONT, "lens", "fx_px", value=-3), "camera 'front': focal lengths must be positive"),
        ("calib.json", set_path(*FRONT, "lens", "radial", value=[1]), "radial needs 6 coefficients, got 1"),
        ("calib.json", set_path(*FRONT, "shutter", value="slow"), "shutter 'slow' is unknown; known are .'global'"),
        ("calib.json", set_path(*FRONT, "T_ego_cam", 0, 0, value=3), "rig_from_camera has a 3 x 3 part that is not a"),
        ("calib.json", set_path(*FRONT, "T_ego_cam", 3, 0, value=3), "'T_ego_cam' must end in the row 0 0 0 1"),
        ("calib.json", set_path(*FRONT, "T_ego_cam", value=[[1]]), "'T_ego_cam' must have the shape 4 x 4, got .1, 1"),
        (
            "calib.json",
            set_path("lidars", "top", "intensity_scale", value=0),
            "intensity_scale must be positive, got 0",
        ),
        ("calib.json", set_path(*FRONT, "width", value=10**9), "may have 33,177,600 pixels, got 1000000000 x 48"),
        (
            "calib.json",
            set_path("lidars", "top", value={"T_ego_lidar": np.eye(4).tolist(), "table": "VLP-16", "columns": 10**12}),
            "'columns' must be at most 16384, got 1000000000000",
        ),
        ("calib.json", set_path("lidars", "top", "table", value="X"), "no LiDAR table 'X'; have .'AT128'"),
        ("calib.json", set_path("lidars", "top", "azimuth_rad", value=[0, 1]), "azimuth_rad must run clockwise"),
        ("calib.json", set_path("body", value={"size_m": [1, 2, 3]}), "calib.json: body: 'center_m' is missing"),
        ("frames.json", set_path("ego", "t_us", 3, value=7), "ego: t_us goes back or stands still at pose 3 .7 us"),
        ("frames.json", set_path("ego", "t_us", value=[]), "'t_us' must be a list of whole microseconds with"),
        ("frames.json", set_path("ego", "T_world_ego", value=[1]), "'T_world_ego' must have the shape 7 x 4 x 4"),
        ("frames.json", set_path("cameras", "rear", value=[]), "cameras has 'rear', which is not in calib.json"),
        ("frames.json", set_path(*FRONT, 1, "file", value="../a"), "'../a' is not allowed: a clip names its files by"),
        ("frames.json", set_path(*FRONT, 1, "file", value="/etc/x"), "'/etc/x' is not allowed"),
        ("frames.json", set_path(*FRONT, 1, "end_us", value=1), "'front' frame 1: start_us 2100000 is after end_us 1"),
        ("frames.json", set_path(*FRONT, 1, "start_us", value=0.5), "'start_us' must be a whole number, got 0.5"),
        ("frames.json", set_path("lidars", "top", 0, "t_us", value=9), "needs start_us <= t_us <= end_us, got"),
        ("tracks.json", set_path("tracks", 1, "id", value="7"), "tracks.json: track id '7' appears twice"),
        ("tracks.json", set_path("tracks", 0, "size_lwh", value=[1, 0, 1]), "track 0: size_lwh must be positive"),
        ("tracks.json", set_path("tracks", 0, "label", value=...), "tracks.json: track 0: 'label' is missing"),
        ("map.json", set_path("drivable", 0, "outer", value=[[0, 0]]), "drivable area 0: a ring needs at least 3"),
        ("map.json", set_path("drivable", 0, "holes", value=[[1]]), "hole 0: 'hole' must have the shape n x 2"),
        ("map.json", set_path("lanes", 0, value=[[0, 0, 0]]), "map.json: lane 0 needs at least 2 points, got 1"),
        ("map.json", set_path("lanes", 0, value=["a"]), "lane 0: 'lane' must be lists of numbers"),
    ],
)
def test_wrong_fields_are_named(clip_folder, name, change, text):
    edit(clip_folder, name, change)
    with pytest.raises(ClipError, match=text) as caught:
        logs.open_clip(clip_folder)
    assert str(caught.value).startswith("clip: ")
    assert only_fault(clip_folder) == str(caught.value)


@pytest.mark.parametrize(
    "text, fault",
    [
        ("{", "frames.json is not valid JSON"),
        ("[]", "frames.json must hold a JSON object, got list"),
        ('{"ego": NaN}', "NaN is not a number that JSON knows"),
        ("[" * 100_000, "frames.json is not valid JSON"),
        ("\xff", "frames.json is not valid JSON"),
    ],
)
def test_broken_json_is_named(clip_folder, text, fault):
    (clip_folder / "frames.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ClipError, match=f"clip: .*{fault}"):
        logs.open_clip(clip_folder)


def test_paths_that_are_no_clips_are_named(tmp_path):
    with pytest.raises(ClipError, match="no clip at .*nowhere': give a log, such as a clip folder or a .zip of one"):
        logs.open_clip(tmp_path / "nowhere")
    with pytest.raises(
        ClipError,
        match="no log reader knows this format; it is an empty folder. Known are\n(  .*\n)*  nurec-sim-clip: ",
    ):
        logs.open_clip(tmp_path)
    (tmp_path / "file").write_text("hello")
    with pytest.raises(ClipError, match="file: no log reader knows this format; it is a file of 5 bytes"):
        logs.open_clip(tmp_path / "file")
    (tmp_path / "street.usdz").write_text("hello")
    with pytest.raises(ClipError, match="street.usdz: no log .*; it is a scene archive, which a reconstruction of a"):
        logs.open_clip(tmp_path / "street.usdz")


@pytest.mark.parametrize("name", ["../meta.json", "/meta.json", "a/../../meta.json", "C:/meta.json"])
def test_zips_that_climb_out_are_refused(tmp_path, name):
    with zipfile.ZipFile(tmp_path / "evil.zip", "w") as archive:
        archive.writestr("meta.json", "{}")
        archive.writestr(zipfile.ZipInfo(name), "{}")
    with pytest.raises(ClipError, match="evil.zip: file name '.*' is not allowed"):
        logs.open_clip(tmp_path / "evil.zip")


def test_zips_without_a_clip_or_too_large_are_refused(tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("readme.txt", "x" * 100)
    with pytest.raises(ClipError, match="other.zip: no log reader knows this format"):
        logs.open_clip(tmp_path / "other.zip")
    monkeypatch.setattr(storage, "LIMITS", Limits(file_bytes=99))
    with pytest.raises(ClipError, match="readme.txt unpacks to 100 bytes; at most 99 are allowed"):
        logs.open_clip(tmp_path / "other.zip")


def test_damaged_zips_are_found(tmp_path):
    path = tiny_clip.write(tmp_path / "clip.zip")
    data = bytearray(path.read_bytes())
    place = data.index(b"\x89PNG") + 60  # inside of the first image
    data[place : place + 4] = b"\0\0\0\0"
    path.write_bytes(data)
    fault = only_fault(path)
    assert fault.startswith("camera 'front' frame 0: clip.zip: file images/front/0000.png in the zip is damaged")


def test_zips_that_are_cut_short_are_named(tmp_path):
    path = tiny_clip.write(tmp_path / "clip.zip")
    size = path.stat().st_size // 2
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(ClipError, match=f"it is a file of {size:,} bytes, a .zip that is cut short or damaged. Known"):
        logs.open_clip(path)


def test_large_files_are_not_read(clip_folder, monkeypatch):
    monkeypatch.setattr(storage, "LIMITS", Limits(file_bytes=10))
    with pytest.raises(ClipError, match="file meta.json has .* bytes; at most 10 are allowed"):
        logs.open_clip(clip_folder)


@pytest.fixture(scope="module")
def spoiled_clip(tmp_path_factory) -> Path:
    """A clip whose tables a test may spoil; ``*.good`` keeps them."""
    folder = tiny_clip.write(tmp_path_factory.mktemp("spoiled") / "clip")
    for file in folder.glob("*.json"):
        (folder / f"{file.name}.good").write_bytes(file.read_bytes())
    return folder


def places(value: Any, path: tuple = ()) -> list[tuple]:
    """All places in a JSON value; of long lists the first two entries."""
    keys = list(value) if isinstance(value, dict) else range(min(len(value), 2)) if isinstance(value, list) else ()
    return [found for key in keys for found in [(*path, key), *places(value[key], (*path, key))]]


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(
    name=st.sampled_from(["meta.json", "calib.json", "frames.json", "tracks.json", "map.json"]),
    chance=st.integers(0, 10**6),
    value=st.sampled_from([None, "x", "", -1, 0, 1e308, 10**400, True, [], {}, [[]], [None], {"a": 1}, ...]),
)
def test_whatever_stands_in_a_table_the_error_is_a_clip_error(spoiled_clip, name, chance, value):
    good = (spoiled_clip / f"{name}.good").read_bytes()
    row = json.loads(good)
    found = places(row)
    set_path(*found[chance % len(found)], value=value)(row)
    (spoiled_clip / name).write_text(json.dumps(row))
    try:
        clip = logs.open_clip(spoiled_clip)
        assert clip.span_us[0] >= 1_000_000 and logs.describe_clip(clip).facts
        clip.sweep("top", 0), clip.image("front", 0)
    except ClipError as error:
        assert str(error).startswith(("clip: ", "clip 'tiny'"))
    finally:
        (spoiled_clip / name).write_bytes(good)


@pytest.fixture(scope="module")
def packed_clip(tmp_path_factory) -> bytes:
    return tiny_clip.write(tmp_path_factory.mktemp("packed") / "clip.zip", jpeg_quality=95).read_bytes()


@pytest.mark.parametrize("repetition", slow_after(1, range(3)))
@settings(max_examples=50, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), noise=st.binary(min_size=1, max_size=8))
def test_whatever_byte_of_a_zip_is_broken_the_error_is_a_clip_error(
    tmp_path_factory, packed_clip, repetition, place, noise
):
    data = bytearray(packed_clip)
    start = int(place * len(data))
    data[start : start + len(noise)] = noise
    path = tmp_path_factory.mktemp("broken") / "clip.zip"
    path.write_bytes(data)
    assert all(fault.strip() for fault in logs.check_clip(path))


@pytest.mark.parametrize("repetition", slow_after(1, range(3)))
@settings(max_examples=50, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), noise=st.binary(min_size=1, max_size=8), name=st.sampled_from(
    ["lidar/top/0000.npz", "images/front/0000.jpg"]))  # fmt: skip
def test_whatever_byte_of_a_file_is_broken_the_error_is_a_clip_error(spoiled_clip, repetition, place, noise, name):
    file = spoiled_clip / name.replace("jpg", "png")
    good = file.read_bytes()
    data = bytearray(good)
    start = int(place * len(data))
    data[start : start + len(noise)] = noise
    file.write_bytes(data)
    try:
        assert all(fault.strip() for fault in logs.check_clip(spoiled_clip))
    finally:
        file.write_bytes(good)
