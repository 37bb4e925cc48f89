"""Readers of scene archives that do what AlpaSim's and CARLA's do, from their descriptions, and fail where they fail.

They share no code with the package: a missing key is a KeyError, a ragged table a ValueError.
"""

import functools
import json
import re
import zipfile
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
import yaml
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation


class InvalidSceneError(Exception):
    """What AlpaSim raises for a scene without the size of the car."""


@dataclass
class Artifact:
    scene_id: str
    camera_ids: list
    render_start_us: int
    path_us: np.ndarray
    vehicle: dict
    actors: dict
    map_kind: str | None
    ground: tuple


def read_json(package, name):
    return json.loads(package.read(name))


def rig_poses(trajectory):
    """Times and (position, quaternion) as AlpaSim's trajectories hold them."""
    times = np.array(trajectory["T_rig_world_timestamps_us"])
    assert times.dtype == np.int64
    matrices = np.array(trajectory["T_rig_worlds"], np.float32).reshape(-1, 4, 4)
    assert len(matrices) == len(times.astype(np.uint64))
    if (np.diff(times) <= 0).any():
        raise ValueError("timestamps must increase")
    quat = Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
    assert (np.abs(np.linalg.norm(quat, axis=1) - 1) < 1e-4).all()
    return times, matrices


def read_artifact(path, smooth=True):
    """A scene as AlpaSim's runtime has it before its first step."""
    assert path.name.endswith(".usdz")
    with zipfile.ZipFile(path) as package:
        names = set(package.namelist())
        metadata = yaml.safe_load(package.read("metadata.yaml"))
        for key in ("scene_id", "version_string", "training_date", "dataset_hash", "uuid"):
            assert type(metadata[key]) is str, key
        assert type(metadata["is_resumable"]) is bool
        assert all(type(each) is str for key in ("camera_ids", "lidar_ids") for each in metadata["sensors"][key])
        assert {"name", "run_id", "run_url"} >= set(metadata["logger"])
        assert float(metadata["time_range"]["start"]) < float(metadata["time_range"]["end"])
        rig = read_json(package, "rig_trajectories.json")
        tracks = read_json(package, "sequence_tracks.json")
        try:
            map_kind = artifact_map(package, names, rig)
        except Exception:  # theirs catches all, too: a map that cannot be read is no map
            map_kind = None
        ground = read_mesh(package.read("mesh_ground.ply"))
    (trajectory,) = rig["rig_trajectories"]
    np.array(rig["world_to_nre"]["matrix"]).reshape(4, 4)
    assert isinstance(trajectory["sequence_id"], str)
    path_us, _ = rig_poses(trajectory)
    first = path_us[:1].astype(np.uint64) - np.uint64(500_000)
    assert first[0] < 2**63, "half a second before the start is negative"
    names_of = {uid: camera["logical_sensor_name"] for uid, camera in rig["camera_calibrations"].items()}
    ends = []
    for uid in names_of:
        frames = trajectory["cameras_frame_timestamps_us"][uid]
        for start, end in frames:
            assert type(start) is int and type(end) is int and end > start
        assert all(a < b for a, b in zip(frames, frames[1:], strict=False))
        ends.append(frames[0][1])
    render_start_us = min(ends)
    assert path_us[0] <= render_start_us < path_us[-1] + 1, "rendering starts where the rig has no pose"
    return Artifact(metadata["scene_id"], list(names_of.values()), render_start_us, path_us,
                    vehicle_box(trajectory), artifact_actors(tracks, smooth), map_kind, ground)  # fmt: skip


def vehicle_box(trajectory):
    box = trajectory["rig_bbox"]
    if box is None:
        raise InvalidSceneError("no rig_bbox, and no vehicle in the configuration")
    centroid, dim = np.array(box["centroid"]), np.array(box["dim"])
    assert np.abs(box["rot"]).max() < 1e-6 and len(dim) == 3 and dim.min() > 0
    return {"size": dim, "offset_x": centroid[0] - dim[0] / 2, "offset_z": centroid[2] - dim[2] / 2}


def artifact_actors(document, smooth):
    (chunk,) = document.values()
    data, dims = chunk["tracks_data"], chunk["cuboidtracks_data"]["cuboids_dims"]
    actors = {}
    columns = (data["tracks_id"], data["tracks_label_class"], data["tracks_flags"], data["tracks_timestamps_us"],
               data["tracks_poses"], dims)  # fmt: skip
    for track_id, label, flags, times, poses, size in zip(*columns, strict=True):
        times, poses = np.array(times), np.array(poses, np.float64)
        assert (
            isinstance(track_id, str)
            and isinstance(label, str)
            and times.dtype == np.int64
            and poses.shape == (len(times), 7)
            and (np.diff(times) > 0).all()
        )
        assert np.abs((poses[:, 3:] ** 2).sum(axis=1) - 1).max() < 1e-4
        if smooth:
            seconds = (times - times[0]) / 1e6
            poses[:, :3] = make_interp_spline(seconds, poses[:, :3], k=1 if len(times) < 4 else 3)(seconds)
            if len(times) < 2:
                raise ValueError("a spline needs two points")
        assert len(size) == 3 and min(size) > 0
        actors[track_id] = {"label": label, "is_static": "CONTROLLABLE" not in flags, "t_us": times, "poses": poses}
    return actors


_map_root = functools.cache(ElementTree.fromstring)
"""Most archives hold the same map."""


def artifact_map(package, names, rig):
    """The first map of the known kinds."""
    for folder in ("map_data", "clipgt", "fastmap"):
        if any(name.startswith(folder + "/") for name in names):
            return folder
    if "map.xodr" not in names:
        return None
    root = _map_root(package.read("map.xodr"))
    assert root.find("header/geoReference").text.strip()
    assert np.array(rig["T_world_base"]).shape == (4, 4)
    return "map.xodr"


def read_mesh(data):
    """Vertices and triangles of a PLY mesh, ascii or binary."""
    header, body = data.split(b"end_header\n", 1)
    lines = header.decode().split("\n")
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element")}
    if "format ascii 1.0" in lines:
        rows = body.decode().split("\n")
        vertices = np.array([[float(w) for w in row.split()[:3]] for row in rows[: counts["vertex"]]])
        faces = np.array([[int(w) for w in row.split()] for row in rows[counts["vertex"] :][: counts["face"]]])
        assert (faces[:, 0] == 3).all()
        return vertices, faces[:, 1:]
    assert "format binary_little_endian 1.0" in lines
    assert [line for line in lines if "property" in line][:3] == [f"property float {axis}" for axis in "xyz"]
    vertices = np.frombuffer(body, "<f4", 3 * counts["vertex"]).reshape(-1, 3)
    row = np.dtype([("n", "u1"), ("corners", "<i4", 3)])
    faces = np.frombuffer(body, row, counts["face"], 12 * counts["vertex"])
    assert (faces["n"] == 3).all() and len(faces) and faces["corners"].max() < len(vertices)
    return vertices, faces["corners"]


# ----------------------------------------------------------------------------------------------------------- CARLA


def read_carla(path, served):
    """What CARLA's client takes from an archive, and whether it finds it among the ids that a server lists."""
    with zipfile.ZipFile(path) as package:
        info = read_json(package, "data_info.json")
        rig = read_json(package, "rig_trajectories.json")
        chunk = read_json(package, "sequence_tracks.json")["dummy_chunk_id"]
        xodr = package.read("map.xodr").decode()
    span = info["pose-range"]["start-timestamp_us"], info["pose-range"]["end-timestamp_us"]
    assert span[0] < span[1]
    if not any(info["sequence_id"] in scene_id for scene_id in served):
        raise TimeoutError("no server lists the scene")
    assert _map_root(xodr).findall("road")
    (trajectory,) = rig["rig_trajectories"]
    times, matrices = rig_poses(trajectory)
    assert times[0] <= span[0] and span[1] <= times[-1]
    cameras = {}
    for camera in rig["camera_calibrations"].values():
        cameras[camera["logical_sensor_name"]] = carla_camera(camera)
    assert cameras
    data = chunk["tracks_data"]
    columns = ("tracks_id", "tracks_label_class", "tracks_flags", "tracks_timestamps_us", "tracks_poses")
    actors = {}
    for track_id, label, flags, times, poses, size in zip(
        *(data[name] for name in columns), chunk["cuboidtracks_data"]["cuboids_dims"], strict=True
    ):
        Rotation.from_quat(np.array(poses).reshape(len(times), 7)[:, 3:])
        assert np.abs((np.array(poses)[:, 3:] ** 2).sum(axis=1) - 1).max() < 1e-4
        assert (np.diff(np.array(times)) > 0).all()
        assert track_id + label and len(np.array(size) * np.ones(3)) == 3
        actors[track_id] = {"flags": flags, "size": size, "t_us": times, "poses": poses}
    controllable = {key: actor for key, actor in actors.items() if "CONTROLLABLE" in actor["flags"]}
    return {"scene_id": info["sequence_id"], "span": span, "cameras": cameras, "actors": controllable,
            "world_from_map": carla_alignment(xodr, np.array(rig["T_world_base"]))}  # fmt: skip


def carla_camera(camera):
    """The fields of an f-theta camera spec; no other model is read."""
    assert camera["camera_model"]["type"] == "ftheta"
    parameters = camera["camera_model"]["parameters"]
    shutters = ("ROLLING_TOP_TO_BOTTOM", "ROLLING_LEFT_TO_RIGHT", "ROLLING_BOTTOM_TO_TOP", "ROLLING_RIGHT_TO_LEFT")
    spec = {key: parameters[key] for key in ("external_distortion_parameters", "reference_poly", "max_angle")}
    spec |= {key: [float(c) for c in parameters[key]] for key in ("pixeldist_to_angle_poly", "angle_to_pixeldist_poly")}
    assert 0 < spec["max_angle"] < 3.2 and spec["reference_poly"] in ("PIXELDIST_TO_ANGLE", "ANGLE_TO_PIXELDIST")
    assert parameters["shutter_type"] in (*shutters, "GLOBAL")
    width, height = parameters["resolution"]
    x, y = parameters["principal_point"]
    c, d, e = parameters["linear_cde"]
    assert len(spec["pixeldist_to_angle_poly"]) == len(spec["angle_to_pixeldist_poly"]) == 6
    return spec | {"resolution": (width, height), "principal_point": (x, y), "linear": np.array([[c, d], [e, 1.0]]),
                   "rig_from_camera": np.array(camera["T_sensor_rig"]).reshape(4, 4)}  # fmt: skip


def carla_alignment(xodr, world_to_ecef):
    """Map to world: east-north-up at the geo-reference, from ECEF, from the scene's base frame."""
    text = re.search(r"<geoReference>(.*?)</geoReference>", xodr, re.S)
    found = [re.search(rf"\+{name}_0=([-.\d]+)", text.group(1) if text else "") for name in ("lat", "lon")]
    if None in found:
        return np.eye(4)
    latitude, longitude = (np.radians(float(match.group(1))) for match in found)
    east = np.array([-np.sin(longitude), np.cos(longitude), 0])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    ecef_from_enu = np.eye(4)
    ecef_from_enu[:3] = np.column_stack([east, np.cross(up, east), up, 6378137.0 * up])  # on the equator
    return np.linalg.inv(ecef_from_enu) @ world_to_ecef


def carla_project(spec, ray):
    """A pixel (corner origin) by the client's f-theta: the reference polynomial is exact."""
    angle = np.arccos(ray[2] / np.linalg.norm(ray))
    backward = np.polynomial.Polynomial(spec["pixeldist_to_angle_poly"])
    radius = np.polynomial.Polynomial(spec["angle_to_pixeldist_poly"])(angle)
    if spec["reference_poly"] == "PIXELDIST_TO_ANGLE":
        for _ in range(3):
            radius -= (backward(radius) - angle) / backward.deriv()(radius)
    direction = np.array(ray[:2]) / np.linalg.norm(ray[:2])
    return spec["linear"] @ (radius * direction) + spec["principal_point"] + 0.5
