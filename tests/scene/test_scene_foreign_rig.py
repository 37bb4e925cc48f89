"""Rig, path, times and tracks come back from the JSON files of an archive, ours and others'."""

import dataclasses
import json

import foreign_files as made
import numpy as np
import pytest
from nurec_archives import ONE_ACTOR, small_arrays
from ply_files import standard, values
from scene_worlds import full_scene

from nurec_sim import geometry, sensors
from nurec_sim.files.zip_package import Package
from nurec_sim.scene import archive, read_scene, write_scene
from nurec_sim.types import FTheta, FThetaReference, Shutter


def off_line(line, points):
    """The largest distance of points from a line, seen from above."""
    return np.abs(geometry.project_to_polyline(points[:, :2], line[:, :2])[1]).max()


def opened(tmp_path, **kwargs):
    members = {"volume.nurec": made.volume(small_arrays(), ONE_ACTOR)} | made.json_sidecars(**kwargs)
    return read_scene(made.usdz(tmp_path / "a.usdz", members))


def same(a, b):
    """Whether two values are equal, field by field and number by number."""
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    return np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b


def test_our_own_sidecars_come_back(tmp_path):
    """Without our manifest an archive of ours is a foreign one: rig, path and tracks are those that were written."""
    scene = full_scene(0)
    write_scene(scene, tmp_path / "ours.usdz")
    with Package(tmp_path / "ours.usdz") as package:
        kept = {name: package.read(name) for name in package.names if not name.startswith("nurec_sim/")}
    foreign = read_scene(made.usdz(tmp_path / "foreign.usdz", kept))
    assert foreign.id == scene.id and foreign.span_us == scene.span_us
    for name in ("front", "left", "right", "roof"):
        assert same(foreign.rig.cameras[name], scene.rig.cameras[name]), name
    assert same(foreign.rig.body, scene.rig.body)
    for name, lidar in scene.rig.lidars.items():
        assert same(foreign.rig.lidars[name], dataclasses.replace(lidar, range_m=(0.5, 200.0)))  # no range in the file
    assert same(foreign.ego, scene.ego)
    for ours, theirs in zip(scene.tracks, foreign.tracks, strict=True):
        assert (ours.id, ours.label, ours.size_m, ours.controllable) == (
            theirs.id, theirs.label, theirs.size_m, theirs.controllable,
        )  # fmt: skip
        assert np.allclose(ours.path.at(theirs.path.t_us), theirs.path.world_from_body)
    # The rear camera has an f-theta lens, whose missing polynomial the sidecar fills in.
    pixels = np.random.default_rng(0).uniform([0, 0], [1280, 720], (100, 2))
    (rays, seen), (others, also) = (sensors.unproject(s.rig.cameras["rear"], pixels) for s in (scene, foreign))
    assert np.array_equal(seen, also) and np.allclose(rays[seen], others[seen], atol=1e-9)
    # Lanes are written as lines and arcs within 3 cm, and 0.3 m longer at both ends.
    for ours, theirs in zip(scene.road_map.lanes, foreign.road_map.lanes, strict=True):
        assert np.abs(ours[-1] - theirs[-1]).max() < 0.31 and off_line(ours, theirs[1:-1]) < 0.03
    assert len(foreign.static) == len(scene.static) + len(scene.dynamic)
    assert archive.archive_faults(tmp_path / "foreign.usdz")


def test_ftheta_principal_points_move_by_half_a_pixel(tmp_path):
    parameters = {
        "resolution": [320, 200], "shutter_type": "ROLLING_BOTTOM_TO_TOP", "external_distortion_parameters": None,
        "principal_point": [159.25, 99.5], "reference_poly": "ANGLE_TO_PIXELDIST", "max_angle": 1.2,
        "pixeldist_to_angle_poly": [0.0] * 6, "angle_to_pixeldist_poly": [0.0, 190.0, 0.0, -4.0, 0.0, 0.0],
        "linear_cde": [1.001, 0.0, 1e-4],
    }  # fmt: skip
    camera = opened(tmp_path, camera={"type": "ftheta", "parameters": parameters}).rig.cameras["front"]
    wanted = FTheta(
        159.75, 100.0, FThetaReference.ANGLE_TO_PIXELDIST, (), (0.0, 190.0, 0.0, -4.0), 1.2, (1.001, 0, 1e-4)
    )
    assert camera.lens == wanted and camera.shutter is Shutter.BOTTOM_TO_TOP
    assert np.array_equal(camera.rig_from_camera, made.FRONT)


@pytest.mark.parametrize(
    ("camera", "text"),
    [
        ({"type": "omni", "parameters": {}}, "camera model 'omni' is not known"),
        ({"type": "opencv-fisheye", "parameters": {"resolution": [4, 4]}}, "'focal_length' is missing"),
        ({"type": "ftheta"}, "a model with 'type' and 'parameters' is needed"),
        ({"type": "opencv-pinhole", "parameters": {"resolution": [4, 4], "focal_length": [0, 1],
                                                   "principal_point": [2, 2]}}, "focal lengths must be positive"),
    ],
)  # fmt: skip
def test_a_camera_that_is_not_known_is_named_and_left_out(tmp_path, camera, text):
    scene = opened(tmp_path, camera=camera)
    assert not scene.rig.cameras
    assert any(t.startswith("camera 'front' is left out: ") and text in t for t in scene.provenance["unknown"])


def test_clips_that_start_at_zero_are_shifted(tmp_path):
    shift = made.START_US - 5

    files = {name: json.loads(data) for name, data in made.json_sidecars([made.curved_track()]).items()}
    path = files["rig_trajectories.json"]["rig_trajectories"][0]
    path["T_rig_world_timestamps_us"] = [t - shift for t in path["T_rig_world_timestamps_us"]]
    path["cameras_frame_timestamps_us"] = {made.CALIBRATION: [[300_005, 330_005], [9, 8]]}
    tracks = files["sequence_tracks.json"]["dummy_chunk_id"]["tracks_data"]
    tracks["tracks_timestamps_us"] = [[t - shift for t in tracks["tracks_timestamps_us"][0]]]
    files["data_info.json"] = {"sequence_timestamp_interval_us": {"start": 5, "stop": 1_000_006}}
    scene = opened(tmp_path, **files)
    assert scene.span_us == (1_000_000, 2_000_001) and scene.ego.start_us == 1_000_000
    assert scene.tracks[0].path.start_us == 1_000_000
    assert scene.camera_times_us["front"].tolist() == [[1_300_000, 1_330_000]]
    assert any("all times are shifted by 999995 us" in text for text in scene.provenance["unknown"])


def test_tracks_with_faults_are_repaired_or_named(tmp_path):
    chunk = json.loads(made.json_sidecars([made.curved_track(n) for n in "abc"])["sequence_tracks.json"])
    data = chunk["dummy_chunk_id"]["tracks_data"]
    data["tracks_poses"][0][2] = [0] * 7
    data["tracks_timestamps_us"][0][4] = data["tracks_timestamps_us"][0][3]
    data["tracks_poses"][1] = data["tracks_poses"][1][:3]
    data["tracks_id"][2] = "a"
    data["tracks_flags"][0] = ["DYNAMIC"]
    scene = opened(tmp_path, **{"sequence_tracks.json": chunk})
    assert [(t.id, len(t.path.t_us), t.controllable) for t in scene.tracks] == [("a", 4, False)]
    unknown = "\n".join(scene.provenance["unknown"])
    assert "track 'a': 2 samples are left out" in unknown and "track 'a' is given twice" in unknown
    assert "track 'b' is left out: 6 times, but 3 poses" in unknown


def test_missing_pieces_get_defaults_that_are_named(tmp_path):
    scene = read_scene(made.usdz(tmp_path / "plain.usdz", {"volume.nurec": made.volume(small_arrays(), ONE_ACTOR)}))
    assert scene.id == "plain" and scene.span_us == (1_000_000, 2_000_000) and list(scene.rig.cameras) == ["camera"]
    unknown = "\n".join(scene.provenance["unknown"])
    for text in ("no rig_trajectories.json", "no sequence_tracks.json", "one camera looks along x", "no road map",
                 "4 Gaussians of 1 tracks without a path are not drawn: 'car-7'"):  # fmt: skip
        assert text in unknown


def test_ply_files_open_alone_and_inside(tmp_path):
    file = standard(tmp_path / "garden.ply", values(7, k=3))
    alone = read_scene(file)
    assert len(alone.static) == 7 and alone.id == "garden"
    members = {
        "readme.txt": b"x",
        "mesh.ply": b"ply no mesh",
        "points/a.ply": file.read_bytes(),
        **made.json_sidecars(),
    }
    inside = read_scene(made.usdz(tmp_path / "a.usdz", members))
    assert np.array_equal(inside.static.mean_m, alone.static.mean_m) and list(inside.rig.cameras) == ["front"]
