import dataclasses
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import tiny_clip

from nurec_sim import geometry, logs
from nurec_sim.errors import ClipError
from nurec_sim.logs.kept import Kept
from nurec_sim.logs.moved import later
from nurec_sim.logs.stored import StoredFiles, encode_points
from nurec_sim.logs.sweeps import prolonged
from nurec_sim.types import Pinhole, Rig, Track, Trajectory


def same_model(a, b) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))


@pytest.mark.parametrize("name", ["clip", "clip.zip"])
def test_what_is_written_is_read_back(tmp_path, name):
    clip = logs.open_clip(tiny_clip.write(tmp_path / name))
    rig = tiny_clip.rig()
    assert clip.id == "tiny" and clip.facts["seed"] == 3
    assert list(clip.rig.cameras) == list(rig.cameras) and clip.rig.body == rig.body
    assert all(same_model(clip.rig.cameras[key], rig.cameras[key]) for key in rig.cameras)
    assert same_model(clip.rig.lidars["top"], rig.lidars["top"])
    assert np.array_equal(clip.ego.world_from_body, tiny_clip.ego().world_from_body)
    assert clip.span_us == (tiny_clip.START_US, tiny_clip.START_US + 300_001)
    for index in range(tiny_clip.FRAMES):
        assert np.array_equal(clip.image("left", index), tiny_clip.image("left", index))
        written, read = tiny_clip.sweep(index), clip.sweep("top", index)
        assert np.abs(read.xyz_m - written.xyz_m).max() < 1e-9
        assert np.array_equal(read.point_t_us, written.point_t_us) and read.t_us == written.t_us
        assert np.allclose(read.intensity, written.intensity, atol=1e-6)
        assert np.array_equal(read.world_from_lidar, written.world_from_lidar)
    for read, written in zip(clip.tracks, tiny_clip.tracks(), strict=True):
        assert (read.id, read.label, read.size_m, read.controllable) == (
            written.id, written.label, written.size_m, written.controllable)  # fmt: skip
        assert np.array_equal(read.path.world_from_body, written.path.world_from_body)
    assert np.array_equal(clip.road_map.drivable[0][1], tiny_clip.road_map().drivable[0][1])
    assert np.array_equal(clip.road_map.lanes[0], tiny_clip.road_map().lanes[0])
    assert logs.check_clip(clip) == []


def test_camera_poses_follow_the_ego_unless_the_log_knows_better(tmp_path):
    known = np.stack([geometry.pose_from_xyyaw(1, 2, 0.3), geometry.pose_from_xyyaw(1.5, 2, 0.3)])
    entries = [dataclasses.replace(e, world_from_camera=known) if getattr(e, "camera_id", "") == "wide" else e
               for e in tiny_clip.frames()]  # fmt: skip
    clip = logs.open_clip(tiny_clip.write(tmp_path / "clip", frames=entries))
    times = clip.camera_times_us("front")
    assert times[1].tolist() == [2_100_000, 2_120_000]
    expected = clip.ego.at(times[1]) @ clip.rig.cameras["front"].rig_from_camera
    assert np.array_equal(clip.world_from_camera("front", 1), expected)
    assert not np.array_equal(expected[0], expected[1])
    assert np.array_equal(clip.world_from_camera("wide", 1), known)


def test_the_same_clip_gives_the_same_bytes(tmp_path):
    first, second = (tiny_clip.write(tmp_path / name).read_bytes() for name in ("a.zip", "b.zip"))
    assert first == second


def test_frames_are_consumed_one_by_one(tmp_path):
    pulled = []

    def watched():
        for entry in tiny_clip.frames():
            done = len(list(tmp_path.glob(".clip.*/clip/**/*.png"))) + len(list(tmp_path.glob(".clip.*/**/*.npz")))
            pulled.append(done)
            yield entry

    tiny_clip.write(tmp_path / "clip", frames=watched())
    assert pulled == list(range(len(pulled))) and len(pulled) == 12


def test_a_clip_appears_complete_or_not_at_all(tmp_path):
    def breaking():
        yield from list(tiny_clip.frames())[:5]
        raise RuntimeError("the sensor fell off")

    with pytest.raises(RuntimeError, match="fell off"):
        tiny_clip.write(tmp_path / "clip", frames=breaking())
    assert list(tmp_path.iterdir()) == []


def test_an_existing_clip_is_replaced_only_when_told(tmp_path):
    path = tiny_clip.write(tmp_path / "clip")
    with pytest.raises(ClipError, match="exists; choose another path or allow overwriting"):
        tiny_clip.write(path, id="other")
    assert logs.open_clip(path).id == "tiny"
    with pytest.raises(ClipError, match="names 'rear'"):
        bad = [logs.CameraEntry("rear", 2_000_000, 2_000_000, tiny_clip.image("rear", 0))]
        tiny_clip.write(path, id="other", frames=bad, overwrite=True)
    assert logs.open_clip(path).id == "tiny"
    tiny_clip.write(path, id="other", overwrite=True)
    assert logs.open_clip(path).id == "other"
    assert [item.name for item in tmp_path.iterdir()] == ["clip"]


def entry(**changes) -> logs.CameraEntry:
    return dataclasses.replace(logs.CameraEntry("front", 2_000_000, 2_000_000, tiny_clip.image("front", 0)), **changes)


@pytest.mark.parametrize(
    "changes, text",
    [
        ({"frames": [entry(camera_id="rear")]}, "a frame names 'rear', which the rig does not have; cameras: .'front'"),
        ({"frames": [entry(), entry()]}, "frame 1 of 'front': starts at 2000000 us, not after the frame before"),
        ({"frames": [entry(start_us=5)]}, "frame 0 of 'front': needs 1000000 <= start <= end, got 5, 2000000 us"),
        ({"frames": [entry(image=np.zeros((48, 60, 3), np.uint8))]}, r"needs uint8 pixels \(48, 64, 3\), got uint8"),
        ({"frames": [entry(world_from_camera=np.eye(4))]}, r"world_from_camera must be finite \[2,4,4\], got \(4, 4\)"),
        ({"ego": Trajectory(np.array([5]), np.eye(4)[None])}, "clips start at 1000000 us or later; .* is at 5"),
        ({"rig": Rig({"a/b": tiny_clip.rig().cameras["front"]}, {})}, "sensor id 'a/b' cannot name a folder"),
        ({"facts": {"x": float("nan")}}, "meta.json cannot be written as JSON"),
        ({"tracks": [dataclasses.replace(t, size_m=(np.inf, 1, 1)) for t in tiny_clip.tracks()]}, "tracks.json cannot"),
    ],
)
def test_wrong_input_is_refused(tmp_path, changes, text):
    with pytest.raises(ClipError, match=text):
        tiny_clip.write(tmp_path / "clip", **changes)
    assert list(tmp_path.iterdir()) == []


def test_a_broken_camera_is_refused(tmp_path):
    camera = dataclasses.replace(tiny_clip.rig().cameras["front"], lens=Pinhole(0, 1, 1, 1))
    with pytest.raises(ClipError, match="camera 'front': focal lengths must be positive"):
        tiny_clip.write(tmp_path / "clip", rig=Rig({"front": camera}, {}))


def test_jpeg_images_keep_their_colours_and_given_files_their_bytes(tmp_path):
    clip = logs.open_clip(tiny_clip.write(tmp_path / "a", jpeg_quality=95))
    error = clip.image("front", 1).astype(float) - tiny_clip.image("front", 1)
    assert np.abs(error).mean() < 2
    data = (tmp_path / "a/images/front/0001.jpg").read_bytes()
    clip = logs.open_clip(tiny_clip.write(tmp_path / "b", frames=[entry(image=data)]))
    assert (tmp_path / "b/images/front/0000.jpg").read_bytes() == data
    assert clip.frame_count("front") == 1 and clip.frame_count("left") == 0 and clip.sweep_count("top") == 0


def test_raw_sweeps_are_compensated_by_the_egos_motion(tmp_path):
    """Each beam is measured where the LiDAR is at that instant of the turn; reading brings all to one pose."""
    path = tiny_clip.write(tmp_path / "clip")
    lidar, ego = tiny_clip.rig().lidars["top"], tiny_clip.ego()
    start_us, end_us, middle_us = 2_100_000, 2_200_000, 2_150_000
    azimuth = np.deg2rad(np.arange(179, -180, -2.0))
    times = middle_us + np.rint(-azimuth / (2 * np.pi) * (end_us - start_us)).astype(np.int64)
    measured = 15 * np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)
    world = np.array(
        [
            geometry.transform_points(pose @ lidar.rig_from_lidar, point)
            for pose, point in zip(ego.at(times), measured, strict=True)
        ]
    )
    still = geometry.transform_points(geometry.inverse(ego.at(middle_us) @ lidar.rig_from_lidar), world)
    rows = json.loads((path / "frames.json").read_text())
    rows["lidars"]["top"][1] |= {"t_us": middle_us, "motion_compensated": False}
    del rows["lidars"]["top"][1]["T_world_lidar"]
    (path / "frames.json").write_text(json.dumps(rows))
    assert np.abs(measured - still).max() > 0.4
    # With and without times: the azimuth tells them too.
    for arrays in ({"dt_us": (times - start_us).astype(np.int32)}, {}):
        np.savez(path / "lidar/top/0001.npz", dxyz_mm=encode_points(measured), **arrays)
        assert np.abs(logs.open_clip(path).sweep("top", 1).xyz_m - still).max() < 1e-3


def test_a_turn_beyond_the_trajectory_goes_on_at_its_last_speed():
    straight = Trajectory(
        np.array([1_000_000, 1_100_000, 1_200_000]),
        np.array([geometry.pose_from_xyyaw(x, 0, 0) for x in (0.0, 1.0, 3.0)]),
    )
    longer = prolonged(straight, 50_000)
    assert longer.position_m[[0, -1], 0].tolist() == [-0.5, 4.0]
    assert prolonged(Trajectory(straight.t_us[:1], straight.world_from_body[:1]), 50_000) is None
    curve = Trajectory(straight.t_us[:2], np.array([np.eye(4), geometry.pose_from_xyyaw(1, 0, 0.2)]))
    assert geometry.yaw_of(prolonged(curve, 250_000).world_from_body[-1]) == pytest.approx(0.7)


def test_images_and_sweeps_are_read_only_and_kept(tmp_path):
    clip = logs.open_clip(tiny_clip.write(tmp_path / "clip"))
    assert clip.image("front", 0) is clip.image("front", 0)
    assert clip.sweep("top", 2) is clip.sweep("top", 2)
    with pytest.raises(ValueError, match="read-only"):
        clip.image("front", 0)[0, 0] = 0
    with pytest.raises(ValueError, match="read-only"):
        clip.sweep("top", 0).xyz_m[0] = 0


def test_a_sweep_is_decoded_once_for_a_log_and_those_made_from_it(tmp_path, monkeypatch):
    clip = logs.open_clip(tiny_clip.write(tmp_path / "clip"))
    read, plain = [], type(clip.source).sweep
    monkeypatch.setattr(type(clip.source), "sweep", lambda self, *key: read.append(key) or plain(self, *key))
    before = clip.sweep("top", 1).xyz_m
    changed = later(clip, 1_000)
    assert changed.sweep("top", 1).t_us == clip.sweep("top", 1).t_us + 1_000
    np.testing.assert_array_equal(changed.sweep("top", 1).xyz_m, before)
    assert read == [("top", 1)]
    other = logs.open_clip(tmp_path / "clip").replaced()
    changed = other.replaced()
    changed.source = StoredFiles(*(getattr(other.source, name) for name in vars(other.source)))
    assert len(other.sweep("top", 1).xyz_m) == len(changed.sweep("top", 1).xyz_m) and len(read) == 3


def test_what_is_kept_is_bounded_and_the_first_stay():
    kept, made = Kept(10, len), []
    for _ in range(2):
        for text in ("four", "five5", "more", "1"):
            assert kept.get(text, lambda text=text: made.append(text) or text) == text
    assert made == ["four", "five5", "more", "1", "more"]


def test_unknown_sensors_and_frames_are_named(tmp_path):
    clip = logs.open_clip(tiny_clip.write(tmp_path / "clip"))
    with pytest.raises(ClipError, match="clip 'tiny' has no camera 'rear'; have .'front', 'left', 'wide'"):
        clip.image("rear", 0)
    with pytest.raises(ClipError, match="camera 'front' has frames 0 to 2, asked for 3"):
        clip.image("front", 3)
    with pytest.raises(ClipError, match="LiDAR 'top' has frames 0 to 2, asked for -1"):
        clip.sweep("top", -1)


def test_a_zip_may_hold_the_clip_in_a_folder(tmp_path):
    folder = tiny_clip.write(tmp_path / "clip")
    with zipfile.ZipFile(tmp_path / "packed.zip", "w") as archive:
        for file in folder.rglob("*"):
            archive.write(file, f"some/where/{file.relative_to(folder)}")
    clip = logs.open_clip(tmp_path / "packed.zip")
    assert np.array_equal(clip.image("front", 0), tiny_clip.image("front", 0))
    assert clip.road_map is not None and logs.check_clip(clip) == []


def test_labels_of_other_vocabularies_become_ours(tmp_path):
    path = Trajectory(np.array([2_000_000]), np.eye(4)[None])
    given = {
        "Car": "automobile",
        "Van": "automobile",
        "Truck": "heavy_truck",
        "Pedestrian": "person",
        "Cyclist": "rider",
        "Tram": "train",
        "Misc": "other_vehicle",
        "Bus": "bus",
        "Traffic Cone": "traffic_cone",
    }
    tracks = [Track(name, name, (1.0, 1.0, 1.0), path) for name in given]
    clip = logs.open_clip(tiny_clip.write(tmp_path / "clip", tracks=tracks))
    assert {track.id: track.label for track in clip.tracks} == given


def test_the_summary_names_sensors_rates_and_contents(tmp_path):
    summary = logs.describe_clip(logs.open_clip(tiny_clip.write(tmp_path / "clip")))
    facts = dict(summary.facts)
    assert facts["span"] == "2000000 to 2300001 us (0.300 s)"
    assert facts["ego"] == "7 poses at 20.00 Hz, 3.0 m driven"
    assert facts["boxes"] == "4 in 2 tracks"
    assert facts["tracks"] == "1 with more than one pose; 1 automobile, 1 traffic_cone"
    assert facts["map"] == "1 drivable area, 1 lane"
    assert facts["log: licence"] == "none"
    assert summary.sensors == (
        ("front", "pinhole, distorted", "64 x 48", "3", "10.00", "0.220", "top_to_bottom"),
        ("left", "fisheye", "64 x 48", "3", "10.00", "0.220", "global"),
        ("wide", "ftheta, windshield", "64 x 48", "3", "10.00", "0.220", "left_to_right"),
        ("top", "VLP-16", "16 x 90", "3", "10.00", "0.300", "clockwise"),
    )


def test_the_documented_example_runs(tmp_path, monkeypatch):
    text = (Path(__file__).parents[2] / "docs" / "clip_format.md").read_text()
    example = text.split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "docs/clip_format.md", "exec"), {})
    clip = logs.open_clip(tmp_path / "my_clip")
    assert clip.frame_count("front") == 1 and logs.check_clip(clip) == []


@pytest.mark.parametrize("start_us, offset_us", [(0, 1_000_000), (999_999, 1_000_000), (-2_300_000, 4_000_000)])
def test_a_log_that_starts_too_early_is_read_later_by_whole_seconds(tmp_path, start_us, offset_us):
    path = tiny_clip.write(tmp_path / "clip")
    wanted = logs.open_clip(path)
    shift = start_us - tiny_clip.START_US

    def move(row: object) -> None:
        if isinstance(row, dict):
            for key, value in row.items():
                if key in ("t_us", "start_us", "end_us"):
                    row[key] = [t + shift for t in value] if isinstance(value, list) else value + shift
                else:
                    move(value)
        elif isinstance(row, list):
            for item in row:
                move(item)

    for name in ("frames.json", "tracks.json"):
        value = json.loads((path / name).read_text())
        move(value)
        (path / name).write_text(json.dumps(value))
    clip = logs.open_clip(path)
    assert clip.time_offset_us == offset_us and clip.span_us[0] == start_us + offset_us
    late_us = start_us + offset_us - tiny_clip.START_US
    assert clip.span_us[1] == wanted.span_us[1] + late_us
    assert np.array_equal(clip.ego.t_us, wanted.ego.t_us + late_us)
    assert np.array_equal(clip.camera_times_us("left"), wanted.camera_times_us("left") + late_us)
    assert np.array_equal(clip.tracks[0].path.t_us, wanted.tracks[0].path.t_us + late_us)
    assert np.array_equal(clip.world_from_camera("front", 1), wanted.world_from_camera("front", 1))
    sweep, same = clip.sweep("top", 1), wanted.sweep("top", 1)
    assert np.array_equal(sweep.point_t_us, same.point_t_us + late_us) and sweep.t_us == same.t_us + late_us
    assert np.array_equal(sweep.xyz_world_m, same.xyz_world_m)
    assert dict(logs.describe_clip(clip).facts)["times"] == f"those of the log and {offset_us} us"
    assert logs.check_clip(path) == []


def test_a_log_that_starts_late_enough_keeps_its_times(tmp_path):
    clip = logs.open_clip(tiny_clip.write(tmp_path / "clip"))
    assert clip.time_offset_us == 0 and "times" not in dict(logs.describe_clip(clip).facts)
