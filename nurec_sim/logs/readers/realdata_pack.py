"""Reading packs of real driving data (schema ``realdata-pack-1``): one LiDAR, rectified pinhole cameras, boxes.

Their conventions: seconds; ``T_a_b`` maps b to a; the ego frame's height above the road is ``-ground_z_in_ego_m``;
pixel centres are at integers (ours at +0.5).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from nurec_sim import geometry, sensors
from nurec_sim.errors import ClipError
from nurec_sim.logs import calibration, fields
from nurec_sim.logs.boxes import BoxTracks
from nurec_sim.logs.clip import Clip, ImageRecord
from nurec_sim.logs.labels import our_label
from nurec_sim.logs.readers._schema import SchemaReader
from nurec_sim.logs.storage import Storage, checked_name
from nurec_sim.logs.stored import StoredFiles
from nurec_sim.logs.sweeps import SweepRecord
from nurec_sim.types import CameraModel, LidarModel, Matrix4, Pinhole, Rig, Track, Trajectory

SCHEMA = "realdata-pack-1"
LIDAR_ID = "lidar"
FULL_BYTE = 255.0
LATEST_S = 1e12
_TABLE_OF_WORDS = {
    "hdl-64": "HDL-64",
    "hdl-32": "HDL-32",
    "vlp-16": "VLP-16",
    "pandar128": "PANDAR128",
    "at128": "AT128",
}


class RealdataPackReader(SchemaReader):
    """Reads packs as clips, their rig frame moved to the ground (``types.LogReader``)."""

    name = "realdata-pack"
    schema = SCHEMA

    def read(self, storage: Storage, meta: dict[str, Any]) -> Clip:
        """The pack as a clip."""
        calib = storage.read_json(calibration.CALIBRATION_FILE)
        rig_from_ego = calibration.ground_shift(calib)
        ego_from_rig = geometry.inverse(rig_from_ego)
        frames = fields.of_kind("frames.json", storage.read_json("frames.json"), "frames", list)
        if not frames:
            raise ClipError("frames.json: there are no frames")
        cameras = {
            name: _camera(name, row, rig_from_ego)
            for name, row in fields.of_kind(calibration.CALIBRATION_FILE, calib, "cameras", dict).items()
        }
        facts = {key: value for key, value in meta.items() if key != "schema"}
        lidars: dict[str, LidarModel] = {}
        sweeps: dict[str, list[SweepRecord]] = {}
        scale, lidar_from_file = FULL_BYTE, np.eye(4)
        if calib.get("lidar") is not None:
            rate = fields.number("meta.json", meta, "rate_hz", default=10.0)
            lidar, lidar_from_file, note = _lidar(calib["lidar"], rig_from_ego, rate)
            lidars[LIDAR_ID] = lidar
            facts["lidar_note"] = note
            scale = calibration.positive_scale(f"{calibration.CALIBRATION_FILE}: lidar", calib["lidar"])
            if scale == 1:
                scale = FULL_BYTE  # "as in the source": bytes over their full range
            sweeps[LIDAR_ID] = list(_sweeps(frames, lidar_from_file))
        times = [_microseconds(f"frames.json: frame {i}", frame, "timestamp_s") for i, frame in enumerate(frames)]
        for index in range(1, len(times)):
            if times[index] <= times[index - 1]:
                raise ClipError(
                    f"frames.json: frame {index}: time goes back or stands still, "
                    f"{times[index]} us after {times[index - 1]} us"
                )
        world_from_ego = [
            fields.transform(f"frames.json: frame {i}", frame, "T_world_ego") for i, frame in enumerate(frames)
        ]
        images = {name: list(_images(frames, name)) for name in cameras}
        return Clip(
            id=fields.of_kind("meta.json", meta, "name", str),
            rig=Rig(cameras, lidars),
            ego=Trajectory(np.array(times, np.int64), np.array(world_from_ego) @ ego_from_rig),
            images=images,
            sweeps=sweeps,
            source=StoredFiles(storage, images, sweeps, {LIDAR_ID: scale}, lidar_from_file),
            tracks=_tracks(frames, times, world_from_ego),
            facts=facts,
            rig_from_log=rig_from_ego,
        )


def _microseconds(where: str, row: Any, key: str) -> int:
    seconds = fields.number(where, row, key)
    if not abs(seconds) <= LATEST_S:
        raise ClipError(f"{where}: {key!r} must lie within {LATEST_S:g} seconds of 0, got {seconds}")
    return round(seconds * 1e6)


def _camera(name: str, row: Any, rig_from_ego: Matrix4) -> CameraModel:
    where = f"{calibration.CALIBRATION_FILE}: camera {name!r}"
    model = fields.of_kind(where, row, "model", str, default="pinhole_rectified")
    if model != "pinhole_rectified":
        raise ClipError(f"{where}: model {model!r} is unknown; packs have 'pinhole_rectified'")
    if fields.of_kind(where, row, "distortion", list, default=[]):
        raise ClipError(f"{where}: a rectified camera has no distortion, got {row['distortion']}")
    k = fields.array(where, row, "K", (3, 3))
    if k[0, 1] != 0:
        raise ClipError(f"{where}: K has a skew of {k[0, 1]}, which is not supported")
    return calibration.checked_camera(
        CameraModel(
            id=name,
            width_px=fields.integer(where, row, "width"),
            height_px=fields.integer(where, row, "height"),
            lens=Pinhole(k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5),
            rig_from_camera=rig_from_ego @ fields.transform(where, row, "T_ego_cam"),
        )
    )


def _lidar(row: Any, rig_from_ego: Matrix4, rate_hz: float) -> tuple[LidarModel, Matrix4, str]:
    """The LiDAR, the quarter turn that makes its x axis point forward, and a note on the chosen beam table."""
    where = f"{calibration.CALIBRATION_FILE}: lidar"
    model = fields.of_kind(where, row, "model", str)
    rig_from_file = rig_from_ego @ fields.transform(where, row, "T_ego_lidar")
    forward = rig_from_file[0, :2]  # the car's x axis in the axes of the file
    quarters = round(float(np.arctan2(forward[1], forward[0])) / (np.pi / 2))
    lidar_from_file = np.rint(geometry.pose(geometry.rotation_from_yaw(-quarters * np.pi / 2), np.zeros(3)))
    table = next((table for word, table in _TABLE_OF_WORDS.items() if word in model.lower()), None)
    note = f"{model}: nominal {table} table"
    if table is None:
        note = f"{model}: no table of its beams is known; {sensors.STAND_IN_TABLE} stands in"
    rig_from_lidar = rig_from_file @ geometry.inverse(lidar_from_file)
    lidar = sensors.lidar_model(table or sensors.STAND_IN_TABLE, rig_from_lidar, id=LIDAR_ID)
    return dataclasses.replace(lidar, frequency_hz=rate_hz), lidar_from_file, note


def _sweeps(frames: list[Any], lidar_from_file: Matrix4) -> Iterator[SweepRecord]:
    file_from_lidar = geometry.inverse(lidar_from_file)
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict) or frame.get("lidar") is None:
            continue
        row, where = frame["lidar"], f"frames.json: frame {index}: lidar"
        t_us = _microseconds(where, row, "timestamp_s")
        turn = "t_start_s" in row and "t_end_s" in row
        start_us = _microseconds(where, row, "t_start_s") if turn else t_us
        end_us = _microseconds(where, row, "t_end_s") if turn else t_us
        if not start_us <= t_us <= end_us:
            raise ClipError(f"{where}: needs t_start_s <= timestamp_s <= t_end_s, got {start_us}, {t_us}, {end_us} us")
        yield SweepRecord(
            file=checked_name(fields.of_kind(where, row, "file", str)),
            t_us=t_us,
            start_us=start_us,
            end_us=end_us,
            world_from_lidar=fields.transform(where, row, "T_world_lidar") @ file_from_lidar,
            compensated=fields.of_kind(where, row, "motion_compensated", bool),
        )


def _images(frames: list[Any], camera_id: str) -> Iterator[ImageRecord]:
    for index, frame in enumerate(frames):
        rows = fields.of_kind(f"frames.json: frame {index}", frame, "cameras", dict)
        if camera_id not in rows:
            continue
        row, where = rows[camera_id], f"frames.json: frame {index}: camera {camera_id!r}"
        t_us = _microseconds(where, row, "timestamp_s")
        pose = fields.transform(where, row, "T_world_cam")
        yield ImageRecord(checked_name(fields.of_kind(where, row, "file", str)), t_us, t_us, np.stack([pose, pose]))


def _tracks(frames: list[Any], times: list[int], world_from_ego: list[Matrix4]) -> list[Track]:
    """Tracks from boxes with the same ``track_id``; a box without one becomes a track of a single pose."""
    boxes = BoxTracks()
    for index, frame in enumerate(frames):
        for number, box in enumerate(fields.of_kind(f"frames.json: frame {index}", frame, "boxes", list, default=[])):
            where = f"frames.json: frame {index}: box {number}"
            label = fields.of_kind(where, box, "type", str)
            known = box.get("track_id")
            name = f"{our_label(label)}-{index}-{number}" if known is None else str(known)
            length, width, height = fields.array(where, box, "size_lwh", (3,)).tolist()
            pose = world_from_ego[index] @ _ego_from_box(where, box)
            boxes.add(where, name, label, times[index], pose, (length, width, height))
    return boxes.tracks()


def _ego_from_box(where: str, box: Any) -> Matrix4:
    """Pose of a box centre in the log's ego frame: with its full rotation where known, else its yaw."""
    if box.get("R_ego_box") is not None:
        rotation = fields.array(where, box, "R_ego_box", (3, 3))
        if not geometry.is_rotation(rotation):
            raise ClipError(f"{where}: R_ego_box is not a rotation")
    else:
        rotation = geometry.rotation_from_yaw(fields.number(where, box, "yaw_ego"))
    return geometry.pose(rotation, fields.array(where, box, "center_ego", (3,)))
