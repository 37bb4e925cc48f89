"""The files for other simulators, read the way AlpaSim, CARLA and OpenDRIVE tools read them."""

import dataclasses
import json
import re
import zipfile

import numpy as np
import pytest
import yaml
from scene_worlds import END_US, START_US, curved_path, empty_scene, full_scene, hilly_road, road_height

from nurec_sim import geometry, sensors
from nurec_sim.scene import alpasim_id, read_scene, scene_hash, write_scene
from nurec_sim.scene.ground_mesh import ground_mesh
from nurec_sim.scene.opendrive.writer import opendrive_map, world_to_ecef
from nurec_sim.scene.sidecars import camera_frames
from nurec_sim.types import RoadMap


@pytest.fixture(scope="module")
def scene():
    return full_scene(0)


@pytest.fixture(scope="module")
def files(scene, tmp_path_factory):
    path = write_scene(scene, tmp_path_factory.mktemp("sidecars") / "a.usdz")
    with zipfile.ZipFile(path) as package:
        return {name: package.read(name) for name in package.namelist()}


def test_metadata(scene, files):
    metadata = yaml.safe_load(files["metadata.yaml"])
    assert metadata["scene_id"] == alpasim_id(scene.id) == f"clipgt-{scene.id}"
    assert alpasim_id("clipgt-1") == "clipgt-1"
    for key in ("version_string", "training_date", "dataset_hash", "uuid"):
        assert isinstance(metadata[key], str) and metadata[key], key
    assert metadata["dataset_hash"] == scene_hash(scene)
    assert metadata["is_resumable"] is False
    assert metadata["sensors"] == {"camera_ids": list(scene.rig.cameras), "lidar_ids": list(scene.rig.lidars)}
    assert metadata["time_range"] == {"start": float(START_US), "end": float(END_US)}
    assert set(metadata["logger"]) == {"name", "run_id", "run_url"}


def test_data_info(scene, files):
    info = json.loads(files["data_info.json"])
    assert info["sequence_id"] == scene.id
    assert info["sequence_timestamp_interval_us"] == {"start": START_US, "stop": END_US}
    assert info["pose-range"]["start-timestamp_us"] == scene.ego.start_us


def test_rig_trajectories(scene, files):
    rig = json.loads(files["rig_trajectories.json"])
    assert np.array_equal(rig["world_to_nre"]["matrix"], np.eye(4))
    (trajectory,) = rig["rig_trajectories"]
    assert trajectory["sequence_id"] == scene.id
    assert np.array_equal(trajectory["T_rig_worlds"], scene.ego.world_from_body)
    assert trajectory["T_rig_world_timestamps_us"] == scene.ego.t_us.tolist()
    box = trajectory["rig_bbox"]
    assert (box["centroid"], box["dim"], box["rot"]) == ([1.4, 0.01, 0.75], [4.9, 1.9, 1.5], [0, 0, 0])
    uids = [f"{camera_id}@{scene.id}" for camera_id in scene.rig.cameras]
    assert list(rig["camera_calibrations"]) == list(trajectory["cameras_frame_timestamps_us"]) == uids
    front, roof = (trajectory["cameras_frame_timestamps_us"][f"{name}@{scene.id}"] for name in ("front", "roof"))
    assert front == scene.camera_times_us["front"][1:].tolist()  # the first ends 30 ms after the first pose
    assert roof == [[START_US + 60_005, START_US + 60_006]]  # clients refuse an exposure without length
    poses = np.array(trajectory["cameras_frame_T_rig_worlds"][uids[0]])
    assert np.allclose(poses, scene.ego.at(scene.camera_times_us["front"][1:]), atol=1e-12)
    assert list(rig["lidar_calibrations"]) == [f"{lidar_id}@{scene.id}" for lidar_id in scene.rig.lidars]


def project_like_ncore(parameters, ray):
    """F-theta by the client's own convention: whole-number pixel centres, exact polynomial forward or by Newton."""
    ray = ray / np.linalg.norm(ray)
    angle = np.arccos(ray[2])
    polynomial = np.polynomial.Polynomial(parameters["angle_to_pixeldist_poly"])
    radius = polynomial(angle)
    if parameters["reference_poly"] == "PIXELDIST_TO_ANGLE":
        backward = np.polynomial.Polynomial(parameters["pixeldist_to_angle_poly"])
        for _ in range(3):
            radius -= (backward(radius) - angle) / backward.deriv()(radius)
    c, d, e = parameters["linear_cde"]
    direction = ray[:2] / np.linalg.norm(ray[:2])
    return np.array([[c, d], [e, 1]]) @ (radius * direction) + parameters["principal_point"] + 0.5


@pytest.mark.parametrize("camera_id", ["rear", "left", "right", "roof"])
def test_every_camera_is_offered_as_ftheta(scene, files, camera_id):
    camera = scene.rig.cameras[camera_id]
    calibration = json.loads(files["rig_trajectories.json"])["camera_calibrations"][f"{camera_id}@{scene.id}"]
    assert calibration["logical_sensor_name"] == camera_id
    assert np.array_equal(calibration["T_sensor_rig"], camera.rig_from_camera)
    model = calibration["camera_model"]
    assert model["type"] == "ftheta"
    parameters = model["parameters"]
    assert parameters["resolution"] == [1280, 720]
    assert len(parameters["pixeldist_to_angle_poly"]) == len(parameters["angle_to_pixeldist_poly"]) == 6
    assert parameters["pixeldist_to_angle_poly"][1] > 0 and parameters["angle_to_pixeldist_poly"][1] > 0
    for ray in ([0.3, -0.1, 1.0], [-0.5, 0.3, 1.0], [0.1, 0.25, 1.0]):
        uv, valid = sensors.project(camera, np.array([ray]))
        assert valid.all()
        tolerance_px = 0.01 if camera.lens.kind == "ftheta" else 1.0
        assert np.abs(project_like_ncore(parameters, np.array(ray)) - uv[0]).max() < tolerance_px
    exact = calibration.get("exact_camera_model")
    assert (exact is None) == (camera.lens.kind == "ftheta")


def test_exact_lens_windshield_and_shutter_are_told(scene, files):
    calibration = json.loads(files["rig_trajectories.json"])["camera_calibrations"][f"front@{scene.id}"]
    camera = scene.rig.cameras["front"]
    exact = calibration["exact_camera_model"]
    assert exact["type"] == "opencv-pinhole"
    assert exact["parameters"]["principal_point"] == [camera.lens.cx_px, camera.lens.cy_px]
    assert exact["parameters"]["radial_coeffs"] == list(camera.lens.radial)
    parameters = calibration["camera_model"]["parameters"]
    assert parameters["shutter_type"] == "ROLLING_TOP_TO_BOTTOM"
    glass = parameters["external_distortion_parameters"]
    assert glass["reference_poly"] == "BACKWARD"
    assert glass["horizontal_poly"] == list(camera.windshield.horizontal)


def test_tracks(scene, files):
    (chunk,) = json.loads(files["sequence_tracks.json"]).items()
    assert chunk[0] == "dummy_chunk_id"
    data = chunk[1]["tracks_data"]
    assert data["tracks_id"] == ["1/car", "1:car"]
    assert data["tracks_label_class"] == ["automobile", "person"]
    assert data["tracks_flags"] == ["CONTROLLABLE|DYNAMIC", "NONE"]
    assert chunk[1]["cuboidtracks_data"]["cuboids_dims"] == [[4.5, 1.9, 1.6], [0.6, 0.7, 1.8]]
    for track, times, poses in zip(scene.tracks, data["tracks_timestamps_us"], data["tracks_poses"], strict=True):
        assert len(times) == len(poses) >= 2
        assert (np.diff(times) > 0).all()
        for t_us, (x, y, z, qx, qy, qz, qw) in zip(times, poses, strict=True):
            pose = geometry.pose(geometry.matrix_from_quat(np.array([qw, qx, qy, qz])), np.array([x, y, z]))
            assert np.allclose(pose, track.path.at(t_us), atol=1e-9)


# ------------------------------------------------------------------------------------------------------- OpenDRIVE


def test_a_scene_without_a_map_gets_none(tmp_path):
    scene = dataclasses.replace(full_scene(0), road_map=None)
    with zipfile.ZipFile(write_scene(scene, tmp_path / "a.usdz")) as package:
        assert "map.xodr" not in package.namelist()
    assert opendrive_map("a", RoadMap(), scene.ego) is None
    derived = RoadMap(((np.array([[-6.0, -6.0], [50.0, -6.0], [50.0, 40.0], [-6.0, 40.0]]),),))
    with zipfile.ZipFile(write_scene(scene, tmp_path / "b.usdz", derived_map=derived)) as package:
        assert b"<road " in package.read("map.xodr")
    assert read_scene(tmp_path / "b.usdz").road_map is None  # it is no truth to judge by


def test_first_frames_leave_room_for_the_shutter_of_alpasim():
    """KITTI's first frame ends 9.94 ms after the first pose; AlpaSim renders the 30 ms before a frame's end."""
    ends_us = np.array([9_940, 49_999, 50_000, 113_000]) + START_US
    frames = np.column_stack([ends_us - 9_000, ends_us])
    scene = dataclasses.replace(full_scene(0), camera_times_us={"front": frames})
    assert camera_frames(scene)["front"].tolist() == frames[2:].tolist()
    assert camera_frames(scene)["rear"].tolist() == frames[2:3].tolist()


def test_map_coordinates_are_world_coordinates():
    """East, north, up at the geo-reference's origin, by the WGS84 definition, is what T_world_base says."""
    text = opendrive_map("a", full_scene(0).road_map, curved_path()).decode()
    reference = re.search(r"<geoReference><!\[CDATA\[(.*)\]\]></geoReference>", text).group(1)
    latitude, longitude = (np.radians(float(re.search(rf"\+{k}_0=(\S+)", reference).group(1))) for k in ("lat", "lon"))
    east = np.array([-np.sin(longitude), np.cos(longitude), 0])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    wanted = np.column_stack([east, np.cross(up, east), up, 6378137.0 * up])
    assert np.allclose(world_to_ecef()[:3], wanted)


# ---------------------------------------------------------------------------------------------------------- meshes


def read_ply(data):
    """Vertices and triangles of a binary PLY, by its header."""
    header, body = data.split(b"end_header\n", 1)
    assert b"format binary_little_endian 1.0" in header
    vertex_count, face_count = (
        int(re.search(rb"element %s (\d+)" % kind, header).group(1)) for kind in (b"vertex", b"face")
    )
    vertices = np.frombuffer(body, "<f4", vertex_count * 3).reshape(-1, 3)
    faces = np.frombuffer(body, [("count", "u1"), ("index", "<i4", 3)], face_count, vertex_count * 12)
    assert len(body) == vertex_count * 12 + face_count * 13
    assert (faces["count"] == 3).all()
    return vertices, faces["index"]


def height_at(vertices, triangles, xy):
    """Heights of a mesh under points, NaN beside it: every point against every triangle."""
    a, b, c = (vertices[triangles[:, k]].astype(float) for k in range(3))
    (abx, aby), (acx, acy) = (b - a)[:, :2].T, (c - a)[:, :2].T
    area = abx * acy - aby * acx
    assert (area > 0).all()  # counter-clockwise seen from above
    heights = np.full(len(xy), np.nan)
    for k, (x, y) in enumerate(xy):
        px, py = x - a[:, 0], y - a[:, 1]
        v, w = (px * acy - py * acx) / area, (abx * py - aby * px) / area
        inside = np.flatnonzero((v >= -1e-6) & (w >= -1e-6) & (v + w <= 1 + 1e-6))
        if len(inside):
            t = inside[0]
            heights[k] = a[t, 2] + v[t] * (b[t, 2] - a[t, 2]) + w[t] * (c[t, 2] - a[t, 2])
    return heights


def test_ground_mesh_lies_on_the_road(tmp_path):
    scene = hilly_road()
    with zipfile.ZipFile(write_scene(scene, tmp_path / "a.usdz")) as package:
        vertices, triangles = read_ply(package.read("mesh_ground.ply"))
        assert package.read("mesh.ply") == package.read("mesh_ground.ply")
    points = scene.static.mean_m[10:].astype(float)[::20]
    difference = height_at(vertices, triangles, points[:, :2]) - points[:, 2]
    assert np.abs(difference).max() < 0.1
    assert vertices[:, 2].max() < points[:, 2].max() + 0.1  # ten outliers hang 40 m above the road


def test_ground_mesh_closes_the_hole_under_the_car():
    scene = hilly_road()
    mesh = ground_mesh(scene)
    path = curved_path().at(np.arange(START_US, curved_path().end_us, 50_000))
    xy = (path[:, :2, 3:] + path[:, :2, 1:2] * np.linspace(-2, 2, 5)).transpose(0, 2, 1).reshape(-1, 2)
    difference = height_at(mesh.vertices_m, mesh.triangles, xy) - road_height(*xy.T)
    assert np.abs(difference).max() < 0.1


def test_ground_mesh_without_road_follows_the_path():
    scene = dataclasses.replace(empty_scene(), ego=curved_path())
    mesh = ground_mesh(scene)
    knots = curved_path().position_m
    heights = height_at(mesh.vertices_m, mesh.triangles, knots[:, :2])
    assert np.abs(heights - knots[:, 2]).max() < 0.1


def test_ground_mesh_of_a_standing_car_is_flat_ground_around_it():
    mesh = ground_mesh(empty_scene())
    x, y = np.meshgrid(np.linspace(-2.9, 2.9, 7), np.linspace(-2.9, 2.9, 7))
    assert np.allclose(
        height_at(mesh.vertices_m, mesh.triangles, np.column_stack([x.ravel(), y.ravel()])), 0, atol=1e-9
    )
