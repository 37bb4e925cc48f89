"""Files of other programs, written from their descriptions without the code that reads them."""

import gzip
import io
import json
import struct
import zipfile

import numpy as np

from nurec_sim import geometry
from nurec_sim.types import (
    Box,
    CameraModel,
    Gaussians,
    Label,
    Pinhole,
    Rig,
    Shutter,
    Track,
    Trajectory,
)

START_US = 1_700_000_000_000_000
SH_C0 = 0.28209479177387814
FRONT = np.array([[0.0, 0.0, 1.0, 1.7], [-1.0, 0.0, 0.0, 0.1], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])
CALIBRATION = "front@clip-1"


def gaussians(count, seed, low, high, label=Label.OTHER, degree=3):
    """Gaussians in a box of space, none symmetric; values survive half precision."""
    rng = np.random.default_rng(seed)

    def half(values):
        return values.astype(np.float16).astype(np.float32)

    k = (degree + 1) ** 2 - 1
    quat = rng.normal(size=(count, 4))
    return Gaussians(
        mean_m=half(rng.uniform(low, high, (count, 3))),
        quat_wxyz=geometry.quat_normalize(half(quat)).astype(np.float32),
        scale_m=np.exp(half(np.log(rng.uniform(0.05, 0.5, (count, 3))))).astype(np.float32),
        opacity=(1 / (1 + np.exp(-half(rng.normal(1, 1, count))))).astype(np.float32),
        rgb=(0.5 + SH_C0 * half(rng.normal(size=(count, 3)))).astype(np.float32),
        normal=np.zeros((count, 3), np.float32),
        label=np.full(count, label, np.uint8),
        intensity=np.full(count, np.nan, np.float32),
        sh_rest=half(rng.normal(size=(count, k, 3)) * 0.2) if k else None,
    )


def pre_activation(part):
    """(positions, rotations, scales, densities, albedo, specular) as trainers keep them."""
    rest = np.zeros((len(part), 15, 3))
    if part.sh_rest is not None:
        rest[:, : part.sh_rest.shape[1]] = part.sh_rest
    logit = np.log(part.opacity.astype(float) / (1 - part.opacity.astype(float)))
    return {
        "positions": part.mean_m,
        "rotations": part.quat_wxyz * 1.7,
        "scales": np.log(part.scale_m),
        "densities": logit[:, None],
        "features_albedo": (part.rgb - 0.5) / SH_C0,
        "features_specular": rest.reshape(len(part), 45),
    }


def curved_track(name="car-7", count=6):
    """A left turn on a slope, in no plane of symmetry."""
    t = np.arange(count)
    poses = []
    for k in t:
        roll = np.array([[1, 0, 0], [0, np.cos(0.1), -np.sin(0.1)], [0, np.sin(0.1), np.cos(0.1)]])
        turn = geometry.rotation_from_yaw(0.3 + 0.15 * k) @ roll
        poses.append(geometry.pose(turn, np.array([9.0 + 1.3 * k, -2.0 + 0.4 * k, 1.1 + 0.05 * k])))
    return Track(name, "automobile", (4.5, 1.9, 1.6), Trajectory(START_US + t * 200_000, np.stack(poses)))


def rig():
    lens = Pinhole(200.0, 202.0, 158.0, 101.0)
    return Rig({"front": CameraModel("front", 320, 200, lens, FRONT.copy(), Shutter.TOP_TO_BOTTOM)}, {},
               Box((1.4, 0.05, 0.75), (4.9, 1.9, 1.5)))  # fmt: skip


def ego():
    poses = [geometry.pose_from_xyyaw(0.8 * k, 0.1 * k, 0.02 * k, 0.01 * k) for k in range(6)]
    return Trajectory(START_US + np.arange(6) * 200_000, np.stack(poses))


def xyzw_poses(path):
    quat = geometry.quat_from_matrix(path.world_from_body[:, :3, :3])
    return np.column_stack([path.position_m, quat[:, 1:], quat[:, :1]]).tolist()


def json_sidecars(tracks=(), nre_from_world=None, camera=None, **changes):
    """``rig_trajectories.json``, ``sequence_tracks.json`` and ``data_info.json`` of the rig and path above."""
    lens = rig().cameras["front"].lens
    parameters = {
        "resolution": [320, 200], "shutter_type": "ROLLING_TOP_TO_BOTTOM", "external_distortion_parameters": None,
        "focal_length": [lens.fx_px, lens.fy_px], "principal_point": [lens.cx_px, lens.cy_px],
        "radial_coeffs": [0.0] * 6, "tangential_coeffs": [0.0] * 2, "thin_prism_coeffs": [0.0] * 4,
    }  # fmt: skip
    model = camera or {"type": "opencv-pinhole", "parameters": parameters}
    nre = np.eye(4) if nre_from_world is None else nre_from_world
    path = ego()
    trajectories = {
        "T_world_base": np.eye(4).tolist(),
        "world_to_nre": {"matrix": nre.tolist()},
        "camera_calibrations": {
            CALIBRATION: {"logical_sensor_name": "front", "sequence_id": "clip-1", "unique_sensor_idx": 0,
                          "T_sensor_rig": FRONT.tolist(), "camera_model": model}
        },
        "rig_trajectories": [
            {"sequence_id": "clip-1", "T_rig_worlds": path.world_from_body.tolist(),
             "T_rig_world_timestamps_us": path.t_us.tolist(),
             "cameras_frame_timestamps_us": {CALIBRATION: [[START_US + 300_000, START_US + 330_000]]},
             "rig_bbox": {"centroid": [1.4, 0.05, 0.75], "dim": [4.9, 1.9, 1.5], "rot": [0, 0, 0]}}
        ],
    }  # fmt: skip
    chunk = {
        "tracks_data": {
            "tracks_id": [t.id for t in tracks], "tracks_label_class": [t.label for t in tracks],
            "tracks_flags": ["CONTROLLABLE|DYNAMIC"] * len(tracks),
            "tracks_timestamps_us": [t.path.t_us.tolist() for t in tracks],
            "tracks_poses": [xyzw_poses(t.path) for t in tracks],
        },
        "cuboidtracks_data": {"cuboids_dims": [list(t.size_m) for t in tracks]},
    }  # fmt: skip
    info = {
        "sequence_id": "clip-1",
        "pose-range": {"start-timestamp_us": START_US, "end-timestamp_us": START_US + 1_000_000},
        "sequence_timestamp_interval_us": {"start": START_US, "stop": START_US + 3_000_001},
    }
    files = {"rig_trajectories.json": trajectories, "sequence_tracks.json": {"dummy_chunk_id": chunk},
             "data_info.json": info}  # fmt: skip
    return {name: json.dumps(content).encode() for name, content in (files | changes).items()}


# ------------------------------------------------------------------------------------------------------------- msgpack


def packed(value):
    """A value as msgpack, by the format's table."""
    if value is None or isinstance(value, bool):
        return {None: b"\xc0", False: b"\xc2", True: b"\xc3"}[value]
    if isinstance(value, int):
        return struct.pack(">Bq", 0xD3, value)
    if isinstance(value, float):
        return struct.pack(">Bd", 0xCB, value)
    if isinstance(value, str):
        return struct.pack(">BI", 0xDB, len(value.encode())) + value.encode()
    if isinstance(value, bytes):
        return struct.pack(">BI", 0xC6, len(value)) + value
    if isinstance(value, (list, tuple)):
        return struct.pack(">BI", 0xDD, len(value)) + b"".join(map(packed, value))
    return struct.pack(">BI", 0xDF, len(value)) + b"".join(packed(k) + packed(v) for k, v in value.items())


def nurec_arrays(layers, tracks=None, sky=None, extra=None):
    """Arrays of a reconstruction by name; ``layers`` are Gaussians, or (Gaussians, cuboid ids)."""
    arrays = {}
    for layer, content in layers.items():
        part, ids = content if isinstance(content, tuple) else (content, None)
        for name, values in pre_activation(part).items():
            arrays[f"gaussians_nodes.{layer}.{name}"] = values
        arrays[f"gaussians_nodes.{layer}.n_active_features"] = np.array(3, np.int64)
        if ids is not None:
            arrays[f"gaussians_nodes.{layer}.gaussian_cuboid_ids"] = np.asarray(ids, np.int32)
    if sky is not None:
        arrays["background.textures"] = sky[None]
    return arrays | (extra or {})


def volume(arrays, track_ids=None, config=None, half=True, level=1):
    """``volume.nurec``."""
    state = {"._extra_state": {"obj_track_ids": track_ids or {}}}
    for name, values in arrays.items():
        stored = values if values.dtype.kind == "i" else values.astype(np.float16 if half else np.float32)
        state[f".{name}"], state[f".{name}.shape"] = stored.tobytes(), list(stored.shape)
    layers = {name.split(".")[1] for name in arrays if name.startswith("gaussians_nodes")}
    usual = {"density_activation": "sigmoid", "scale_activation": "exp", "rotation_activation": "normalize",
             "particle": {"density_kernel_planar": False, "density_kernel_degree": 2}}  # fmt: skip
    settings = {"layers": {name: usual for name in layers}, "background": {"name": "sky-env-map"}}
    content = {"nre_data": {"version": "26.4.96", "model": "nre", "config": config or settings, "state_dict": state}}
    return gzip.compress(packed(content), level, mtime=0)


# ---------------------------------------------------------------------------------------------------------- checkpoint


class _Foreign:
    """Stands for an object of the program that trained."""


def checkpoint(arrays, track_ids=None):
    """``checkpoint.ckpt`` of ``torch.save``, with objects that nobody here can import."""
    import torch

    state = {f"model.{name}": torch.from_numpy(np.array(v if v.dtype.kind == "i" else v.astype(np.float32)))
             for name, v in arrays.items()}  # fmt: skip
    state["model._extra_state"] = {"obj_track_ids": track_ids or {}}
    state["post_processings.0.ppisp.color_params"] = torch.zeros(2, 8)
    buffer = io.BytesIO()
    torch.save({"state_dict": state, "hyper_parameters": _Foreign(), "epoch": 7}, buffer)
    result = io.BytesIO()
    with zipfile.ZipFile(buffer) as made, zipfile.ZipFile(result, "w", zipfile.ZIP_STORED) as writer:
        for entry in made.namelist():
            data = made.read(entry)
            writer.writestr(entry, data.replace(b"foreign_files", b"nre.models") if entry.endswith(".pkl") else data)
    return result.getvalue()


def usdz(path, members):
    """A zip of stored members that are not aligned, as third parties write them."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as writer:
        for name, data in members.items():
            writer.writestr(name, data)
    return path


ROOT_LAYER = (
    b'#usda 1.0\n(\n    defaultPrim = "World"\n    metersPerUnit = 1\n    upAxis = "Z"\n)\n\ndef Xform "World"\n{\n}\n'
)


# ----------------------------------------------------------------------------------------------------- particle fields


def _tuples(rows):
    return "[" + ", ".join("(" + ", ".join(repr(float(v)) for v in row) + ")" for row in rows) + "]"


def particle_field(part, name="splats", half=False, ops="", extra=""):
    """A ParticleField prim as text."""
    h = "h" if half else ""
    degree = 0 if part.sh_rest is None else int(np.sqrt(part.sh_rest.shape[1] + 1)) - 1
    dc = ((part.rgb - 0.5) / SH_C0)[:, None]
    coefficients = dc if part.sh_rest is None else np.concatenate([dc, part.sh_rest], axis=1)
    kinds = ("point3h", "quath", "half3", "half") if half else ("point3f", "quatf", "float3", "float")
    opacities = "[" + ", ".join(repr(float(v)) for v in part.opacity) + "]"
    return f"""
    def ParticleField3DGaussianSplat "{name}"
    {{
        {kinds[0]}[] positions{h} = {_tuples(part.mean_m)}
        {kinds[1]}[] orientations{h} = {_tuples(part.quat_wxyz)}
        {kinds[2]}[] scales{h} = {_tuples(part.scale_m)}
        {kinds[3]}[] opacities{h} = {opacities}
        uniform int radiance:sphericalHarmonicsDegree = {degree}
        {kinds[2]}[] radiance:sphericalHarmonicsCoefficients{h} = {_tuples(coefficients.reshape(-1, 3))}
        {ops}
        {extra}
    }}
"""


def stage(body, up="Z", meters=1, ops="", head=""):
    """A USD layer as text, its content under ``/World``."""
    return f"""#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = {meters}
    upAxis = "{up}"
{head})

def Xform "World"
{{
    {ops}
{body}
}}
""".encode()
