"""Files at the archive's root for AlpaSim, CARLA and NuRec tools; our own reader ignores them.

Conventions of those tools: ``T_a_b`` maps a to b; track quaternions are ``xyzw``; f-theta principal points count pixel
centres as whole numbers (ours minus 0.5). ``world_to_nre`` is the identity, so poses mean the same in every reading.

Those tools start a drive at a camera's first frame, which must lie within a path of non-zero duration. AlpaSim's first
image covers the 30 ms before the end of that frame (its default shutter). So a rig with one pose is static for the
whole scene, frames exposed outside the path or ending within ``SHUTTER_ROOM_US`` of its start are omitted, and a camera
without any frame gets one.
"""

from __future__ import annotations

import dataclasses
import uuid
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Int64

from nurec_sim import sensors
from nurec_sim.errors import ArchiveError
from nurec_sim.geometry import quat_from_matrix
from nurec_sim.scene import codec
from nurec_sim.scene.ground_mesh import encode_ply, ground_mesh
from nurec_sim.scene.opendrive.writer import opendrive_map, world_to_ecef
from nurec_sim.types import (
    CameraModel,
    FTheta,
    GaussianScene,
    LidarModel,
    RoadMap,
    Shutter,
    Track,
    Trajectory,
)

CHUNK_ID = "dummy_chunk_id"  # CARLA's client looks for this very key
FIRST_FRAME_US = 100_000
SHUTTER_ROOM_US = 50_000
_FTHETA_TERMS = 6
_NCORE_NAMES = {
    "pinhole": (
        "opencv-pinhole",
        {"radial_coeffs": "radial", "tangential_coeffs": "tangential", "thin_prism_coeffs": "thin_prism"},
    ),
    "fisheye": ("opencv-fisheye", {"radial_coeffs": "radial", "max_angle": "max_angle_rad"}),
}
_ROUNDING = 1e-9
SHUTTER_NAMES = {
    Shutter.GLOBAL: "GLOBAL",
    Shutter.TOP_TO_BOTTOM: "ROLLING_TOP_TO_BOTTOM",
    Shutter.LEFT_TO_RIGHT: "ROLLING_LEFT_TO_RIGHT",
    Shutter.BOTTOM_TO_TOP: "ROLLING_BOTTOM_TO_TOP",
    Shutter.RIGHT_TO_LEFT: "ROLLING_RIGHT_TO_LEFT",
}


def alpasim_id(scene_id: str) -> str:
    """The ``scene_id`` that AlpaSim and CARLA send for a scene of ours."""
    return scene_id if scene_id.startswith("clipgt-") else f"clipgt-{scene_id}"


def ftheta_fits(scene: GaussianScene) -> dict[str, FTheta]:
    """Every camera as an f-theta lens with both polynomials: the only model that CARLA's client reads.

    Raises:
        ArchiveError: no pixel of a camera lies in the field of its lens.
    """
    try:
        return {camera_id: sensors.fit_ftheta(camera) for camera_id, camera in scene.rig.cameras.items()}
    except ValueError as error:
        raise ArchiveError(str(error)) from error


def fit_error_px(camera: CameraModel, fit: FTheta) -> dict[str, float]:
    """Pixel error of replacing a camera's lens by its f-theta fit: root mean square and maximum."""
    camera = dataclasses.replace(camera, windshield=None)
    columns, rows = np.linspace(0.0, camera.width_px, 33), np.linspace(0.0, camera.height_px, 25)
    uv = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    rays, seen = sensors.unproject(camera, uv)
    # The farthest corner is at the fit's largest angle: rounding must not decide whether it counts.
    wider = dataclasses.replace(fit, max_angle_rad=min(fit.max_angle_rad * (1 + _ROUNDING), float(np.pi)))
    fitted, inside = sensors.project(dataclasses.replace(camera, lens=wider), rays)
    off = np.linalg.norm(fitted - uv, axis=1)[seen & inside]
    return {"rms": float(np.sqrt(np.mean(off**2))), "max": float(off.max())}


def sidecars(
    scene: GaussianScene, digest: str, fits: Mapping[str, FTheta], derived_map: RoadMap | None = None
) -> dict[str, bytes]:
    """All root files by name.

    Args:
        scene: the scene.
        digest: its ``scene_hash``, from which ``metadata.yaml`` gets its hash and UUID.
        fits: an F-theta lens per camera id, see ``ftheta_fits``.
        derived_map: the map for ``map.xodr`` if the scene has none; without either the file is omitted.
    """
    ground = encode_ply(ground_mesh(scene))
    road_map = scene.road_map if scene.road_map is not None else derived_map
    xodr = None if road_map is None else opendrive_map(scene.id, road_map, scene.ego)
    return ({} if xodr is None else {"map.xodr": xodr}) | {
        "metadata.yaml": _metadata(scene, digest),
        "data_info.json": codec.dump(_data_info(scene), "data_info.json", indent=2),
        "rig_trajectories.json": codec.dump(_rig_trajectories(scene, fits), "rig_trajectories.json"),
        "sequence_tracks.json": codec.dump(_sequence_tracks(scene), "sequence_tracks.json"),
        "mesh_ground.ply": ground,
        # Physics may request either name; walls and vehicles are not meshed.
        "mesh.ply": ground,
    }


def _metadata(scene: GaussianScene, digest: str) -> bytes:
    import yaml

    start_us, end_us = scene.span_us
    recorded = np.datetime64(start_us // 1_000_000, "s")
    metadata = {
        "scene_id": alpasim_id(scene.id),
        "version_string": "nurec_sim",
        "training_date": str(np.datetime_as_string(recorded, unit="D")),  # the recording's: archives hold no wall clock
        "dataset_hash": digest,
        "uuid": str(uuid.uuid5(uuid.NAMESPACE_URL, digest)),
        "is_resumable": False,
        "sensors": {"camera_ids": list(scene.rig.cameras), "lidar_ids": list(scene.rig.lidars)},
        "logger": {"name": None, "run_id": None, "run_url": None},
        "time_range": {"start": float(start_us), "end": float(end_us)},
        "training_step_outputs": None,
    }
    return yaml.safe_dump(metadata, sort_keys=False, allow_unicode=True).encode()


def _data_info(scene: GaussianScene) -> dict[str, Any]:
    start_us, end_us = scene.span_us
    path = drive_path(scene)
    return {
        "sequence_id": scene.id,
        "pose-range": {"start-timestamp_us": path.start_us, "end-timestamp_us": path.end_us},
        "sequence_timestamp_interval_us": {"start": start_us, "stop": end_us},
    }


def _rig_trajectories(scene: GaussianScene, fits: Mapping[str, FTheta]) -> dict[str, Any]:
    path = drive_path(scene)
    frames = camera_frames(scene)
    body = scene.rig.body
    no_sweeps = np.zeros((0, 2), np.int64)
    trajectory = {
        "sequence_id": scene.id,
        "T_rig_worlds": path.world_from_body,
        "T_rig_world_timestamps_us": path.t_us,
        "cameras_frame_timestamps_us": {_uid(scene, key): times_us for key, times_us in frames.items()},
        "cameras_frame_T_rig_worlds": {_uid(scene, key): path.at(times_us) for key, times_us in frames.items()},
        "lidars_frame_timestamps_us": {_uid(scene, key): no_sweeps for key in scene.rig.lidars},
        "rig_bbox": {"centroid": body.center_m, "dim": body.size_m, "rot": [0.0, 0.0, 0.0]},
    }
    return {
        "T_world_base": world_to_ecef(),
        "world_to_nre": {"matrix": np.eye(4)},
        "camera_calibrations": {
            _uid(scene, key): _camera_calibration(scene, index, camera, fits[key])
            for index, (key, camera) in enumerate(scene.rig.cameras.items())
        },
        "lidar_calibrations": {
            _uid(scene, key): _lidar_calibration(scene, index, lidar)
            for index, (key, lidar) in enumerate(scene.rig.lidars.items())
        },
        "rig_trajectories": [trajectory],
    }


def _uid(scene: GaussianScene, sensor_id: str) -> str:
    return f"{sensor_id}@{scene.id}"


def drive_path(scene: GaussianScene) -> Trajectory:
    """The recorded path; a single pose is held until the end of the scene."""
    if len(scene.ego.t_us) > 1:
        return scene.ego
    start_us = scene.ego.start_us
    times_us = np.array([start_us, max(scene.span_us[1] - 1, start_us + 1)])
    return Trajectory(times_us, np.repeat(scene.ego.world_from_body, 2, axis=0))


def camera_frames(scene: GaussianScene) -> dict[str, Int64[np.ndarray, "f 2"]]:
    """Exposures of every camera that clients can render: strictly increasing, at least 1 us long; one at the least.

    A camera without any takes the first exposure of another, or the first tenth of a second.
    """
    path = drive_path(scene)
    none = np.zeros((0, 2), np.int64)
    frames = {key: _on_path(scene.camera_times_us.get(key, none), path) for key in scene.rig.cameras}
    starts = [times_us[0].tolist() for times_us in frames.values() if len(times_us)]
    first = min(starts, default=[path.start_us, min(path.start_us + FIRST_FRAME_US, path.end_us)])
    return {key: times_us if len(times_us) else np.array([first]) for key, times_us in frames.items()}


def _on_path(times_us: Int64[np.ndarray, "n 2"], path: Trajectory) -> Int64[np.ndarray, "f 2"]:
    times_us = times_us[np.argsort(times_us[:, 0], kind="stable")]
    frames = np.column_stack([times_us[:, 0], np.maximum(times_us[:, 1], times_us[:, 0] + 1)])
    frames = frames[(frames[:, 0] >= path.start_us) & (frames[:, 1] <= path.end_us)]
    frames = frames[frames[:, 1] >= path.start_us + SHUTTER_ROOM_US]
    # Keep a frame only if both of its times exceed those of all frames before.
    latest = np.maximum.accumulate(frames, axis=0)
    return frames[np.concatenate([np.ones(len(frames[:1]), bool), (frames[1:] > latest[:-1]).all(axis=1)])]


def _camera_calibration(scene: GaussianScene, index: int, camera: CameraModel, fit: FTheta) -> dict[str, Any]:
    calibration = {
        "sequence_id": scene.id,
        "logical_sensor_name": camera.id,
        "unique_sensor_idx": index,
        "T_sensor_rig": camera.rig_from_camera,
        "camera_model": {"type": "ftheta", "parameters": _common_parameters(camera) | _ftheta_parameters(fit)},
    }
    if camera.lens.kind != fit.kind:
        calibration["exact_camera_model"] = _exact_model(camera)
        calibration["ftheta_fit_error_px"] = fit_error_px(camera, fit)
    return calibration


def _common_parameters(camera: CameraModel) -> dict[str, Any]:
    glass = camera.windshield
    distortion = glass and {
        "type": "bivariate-windshield",
        "reference_poly": glass.reference.name,
        "horizontal_poly": glass.horizontal,
        "vertical_poly": glass.vertical,
        "horizontal_poly_inverse": glass.horizontal_inverse,
        "vertical_poly_inverse": glass.vertical_inverse,
    }
    return {
        "resolution": [camera.width_px, camera.height_px],
        "shutter_type": SHUTTER_NAMES[camera.shutter],
        "external_distortion_parameters": distortion,
    }


def _ftheta_parameters(fit: FTheta) -> dict[str, Any]:
    def padded(polynomial: tuple[float, ...]) -> list[float]:
        return [float(c) for c in polynomial] + [0.0] * (_FTHETA_TERMS - len(polynomial))

    return {
        # NCore's f-theta counts pixel centres as whole numbers.
        "principal_point": [fit.cx_px - 0.5, fit.cy_px - 0.5],
        "reference_poly": fit.reference.name,
        "pixeldist_to_angle_poly": padded(fit.pixeldist_to_angle),
        "angle_to_pixeldist_poly": padded(fit.angle_to_pixeldist),
        "max_angle": fit.max_angle_rad,
        "linear_cde": fit.linear_cde,
    }


def _exact_model(camera: CameraModel) -> dict[str, Any]:
    """The exact lens: under NCore's names if NCore has the model, else as in ``nurec_sim/scene.json``."""
    lens, common = camera.lens, _common_parameters(camera)
    if lens.kind not in _NCORE_NAMES:
        return {"type": lens.kind, "parameters": common | {"lens": lens}}
    kind, names = _NCORE_NAMES[lens.kind]
    pairs = {"principal_point": [lens.cx_px, lens.cy_px], "focal_length": [lens.fx_px, lens.fy_px]}
    return {
        "type": kind,
        "parameters": common | pairs | {theirs: getattr(lens, ours) for theirs, ours in names.items()},
    }


def _lidar_calibration(scene: GaussianScene, index: int, lidar: LidarModel) -> dict[str, Any]:
    return {
        "sequence_id": scene.id,
        "logical_sensor_name": lidar.id,
        "unique_sensor_idx": index,
        "T_sensor_rig": lidar.rig_from_lidar,
        "lidar_model": {
            "type": "row-offset-spinning",
            "parameters": {
                "row_elevations_rad": lidar.elevation_rad,
                "column_azimuths_rad": lidar.azimuth_rad,
                "row_azimuth_offsets_rad": lidar.row_azimuth_offset_rad,
                "spinning_direction": lidar.spin.value,
                "spinning_frequency_hz": lidar.frequency_hz,
            },
        },
    }


def _sequence_tracks(scene: GaussianScene) -> dict[str, Any]:
    tracks = [track for track in scene.tracks if track.actor]  # clients treat every listed track as a road user
    samples = [_track_samples(track) for track in tracks]
    return {
        CHUNK_ID: {
            "tracks_data": {
                "tracks_id": [track.id for track in tracks],
                "tracks_label_class": [track.label for track in tracks],
                "tracks_flags": ["CONTROLLABLE|DYNAMIC" if track.controllable else "NONE" for track in tracks],
                "tracks_timestamps_us": [t_us for t_us, _ in samples],
                "tracks_poses": [poses for _, poses in samples],
            },
            "cuboidtracks_data": {"cuboids_dims": [track.size_m for track in tracks]},
        }
    }


def _track_samples(track: Track) -> tuple[np.ndarray, np.ndarray]:
    """Times and poses ``x y z qx qy qz qw`` of a track; a single sample is duplicated, as clients fit splines."""
    t_us, poses = track.path.t_us, track.path.world_from_body
    if len(t_us) == 1:
        t_us, poses = np.array([t_us[0], t_us[0] + 100_000]), np.repeat(poses, 2, axis=0)
    quat = quat_from_matrix(poses[:, :3, :3])
    return t_us, np.column_stack([poses[:, :3, 3], quat[:, [1, 2, 3, 0]]])
