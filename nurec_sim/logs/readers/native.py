"""Reading clips in our own format (schema ``nurec-sim-clip-1``), described in ``docs/clip_format.md``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.logs import calibration, fields, tables
from nurec_sim.logs.clip import Clip, ImageRecord
from nurec_sim.logs.readers._schema import SchemaReader
from nurec_sim.logs.storage import Storage, checked_name
from nurec_sim.logs.stored import StoredFiles
from nurec_sim.logs.sweeps import SweepRecord
from nurec_sim.logs.write import SCHEMA
from nurec_sim.types import CameraModel, LidarModel, Matrix4, Trajectory


class NativeReader(SchemaReader):
    """Reads clip folders (``types.LogReader``)."""

    name = "nurec-sim-clip"
    schema = SCHEMA

    def read(self, storage: Storage, meta: dict[str, Any]) -> Clip:
        """The clip."""
        calib = storage.read_json(calibration.CALIBRATION_FILE)
        rig, scales = calibration.rig_from_json(calib)
        ego_from_rig = geometry.inverse(calibration.ground_shift(calib))
        frames = storage.read_json("frames.json")
        recorded = tables.trajectory_from_json(
            "frames.json: ego", fields.required("frames.json", frames, "ego"), "T_world_ego"
        )
        ego = Trajectory(recorded.t_us, recorded.world_from_body @ ego_from_rig)
        image_rows = _grouped(frames, "cameras", list(rig.cameras))
        images = {name: list(_images(rows, rig.cameras[name], ego)) for name, rows in image_rows.items()}
        sweep_rows = _grouped(frames, "lidars", list(rig.lidars))
        sweeps = {name: list(_sweeps(rows, rig.lidars[name], ego)) for name, rows in sweep_rows.items()}
        tracks: list[Any] = []
        if storage.exists("tracks.json"):
            tracks = fields.of_kind("tracks.json", storage.read_json("tracks.json"), "tracks", list)
        parsed = [tables.track_from_json(index, row) for index, row in enumerate(tracks)]
        names = [track.id for track in parsed]
        if doubles := sorted({name for name in names if names.count(name) > 1}):
            raise ClipError(f"tracks.json: track id {doubles[0]!r} appears twice")
        return Clip(
            id=fields.of_kind("meta.json", meta, "name", str),
            rig=rig,
            ego=ego,
            images=images,
            sweeps=sweeps,
            source=StoredFiles(storage, images, sweeps, scales),
            tracks=parsed,
            road_map=tables.map_from_json(storage.read_json("map.json")) if storage.exists("map.json") else None,
            facts={key: value for key, value in meta.items() if key != "schema"},
            rig_from_log=geometry.inverse(ego_from_rig),
        )


def _grouped(frames: dict[str, Any], group: str, known: list[str]) -> dict[str, list[Any]]:
    """Rows per sensor; a sensor without rows recorded nothing."""
    rows = fields.of_kind("frames.json", frames, group, dict, default={})
    if unknown := sorted(set(rows) - set(known)):
        raise ClipError(f"frames.json: {group} has {unknown[0]!r}, which is not in calib.json; have {known}")
    return {name: fields.of_kind(f"frames.json: {group}", rows, name, list) for name in rows}


def _interval(where: str, row: Any) -> tuple[int, int]:
    start_us, end_us = fields.integer(where, row, "start_us"), fields.integer(where, row, "end_us")
    if start_us > end_us:
        raise ClipError(f"{where}: start_us {start_us} is after end_us {end_us}")
    return start_us, end_us


def _images(rows: list[Any], camera: CameraModel, ego: Trajectory) -> Iterator[ImageRecord]:
    for index, row in enumerate(rows):
        where = f"frames.json: camera {camera.id!r} frame {index}"
        start_us, end_us = _interval(where, row)
        poses = ego.at(np.array([start_us, end_us])) @ camera.rig_from_camera
        if row.get("T_world_cam") is not None:
            poses = _pose_pair(where, row)
        yield ImageRecord(checked_name(fields.of_kind(where, row, "file", str)), start_us, end_us, poses)


def _pose_pair(where: str, row: Any) -> Float64[np.ndarray, "2 4 4"]:
    """Poses at both ends of an exposure, [2,4,4] in the file, or one [4,4] for both."""
    value = row["T_world_cam"]
    if isinstance(value, list) and len(value) == 2:
        return np.stack([fields.transform(where, {"T_world_cam": one}, "T_world_cam") for one in value])
    pose = fields.transform(where, row, "T_world_cam")
    return np.stack([pose, pose])


def _sweeps(rows: list[Any], lidar: LidarModel, ego: Trajectory) -> Iterator[SweepRecord]:
    for index, row in enumerate(rows):
        where = f"frames.json: LiDAR {lidar.id!r} sweep {index}"
        start_us, end_us = _interval(where, row)
        t_us = fields.integer(where, row, "t_us") if "t_us" in row else end_us
        if not start_us <= t_us <= end_us:
            raise ClipError(f"{where}: needs start_us <= t_us <= end_us, got {start_us}, {t_us}, {end_us}")
        pose: Matrix4 = ego.at(t_us) @ lidar.rig_from_lidar
        if row.get("T_world_lidar") is not None:
            pose = fields.transform(where, row, "T_world_lidar")
        yield SweepRecord(
            file=checked_name(fields.of_kind(where, row, "file", str)),
            t_us=t_us,
            start_us=start_us,
            end_us=end_us,
            world_from_lidar=pose,
            compensated=fields.of_kind(where, row, "motion_compensated", bool, default=True),
        )
