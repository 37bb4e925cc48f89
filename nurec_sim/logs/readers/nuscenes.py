"""Reading scenes of nuScenes as published (Caesar et al., CVPR 2020): tables of a version, samples and sweeps.

Their conventions: microseconds; quaternions wxyz; sizes are width, length, height; the ego frame lies below the rear
axle on the ground; the LiDAR looks along its y axis; sweeps are compensated to their end, which is their stamp (points
have the elevation of their beam at the end of a turn only); images are undistorted, pixel centres at whole numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nurec_sim import geometry, sensors
from nurec_sim.errors import ClipError
from nurec_sim.logs import calibration, fields
from nurec_sim.logs.clip import Clip, ImageRecord
from nurec_sim.logs.labels import is_movable, our_label
from nurec_sim.logs.readers._nuscenes_tables import Row, matching_rows, reference, small_table
from nurec_sim.logs.storage import Storage, checked_name
from nurec_sim.logs.stored import ImageFiles
from nurec_sim.logs.sweeps import SweepRecord
from nurec_sim.types import Box, CameraModel, LidarModel, Matrix4, Pinhole, Rig, SweepPoints, Track, Trajectory

TURN_US = 50_000
NAMES_SHOWN = 12
# The LiDAR of the files looks along y; ours along x.
FILE_FROM_LIDAR = geometry.pose(geometry.rotation_from_yaw(np.pi / 2), np.zeros(3)).round()
# Renault Zoe: 4.084 m long, 1.73 m wide, 0.66 m of it behind the rear axle.
BODY = Box((1.384, 0.0, 0.781), (4.084, 1.73, 1.562))
_WORDS = {"construction": "construction_vehicle", "emergency": "emergency_vehicle"}


class NuScenesReader:
    """Reads scenes of nuScenes as clips (``types.LogReader``)."""

    name = "nuscenes"
    description = (
        "a nuScenes folder (v1.0-mini or another version beside samples and sweeps) followed by the name of a scene, "
        "as in nuscenes/scene-0061"
    )

    def can_open(self, path: Path) -> bool:
        """Whether it is a folder of nuScenes, one of its versions, or either followed by the name of a scene."""
        return bool(_versions(path) or (not path.exists() and _versions(path.parent)))

    def open(self, path: Path) -> Clip:
        """The scene as a clip.

        Raises:
            ClipError: a table, a record or a value is missing or wrong, there is no such scene, or none was named
                and there are several.
        """
        versions, wanted = _versions(path), None
        if not versions:
            versions, wanted = _versions(path.parent), path.name
        scenes = [(each, row) for each in versions for row in small_table(each, "scene").values()]
        names = [fields.of_kind("scene.json", row, "name", str) for _, row in scenes]
        chosen = [pair for pair, name in zip(scenes, names, strict=True) if wanted is None or name == wanted]
        if len(chosen) != 1:
            more = f" and {len(names) - NAMES_SHOWN} more" if len(names) > NAMES_SHOWN else ""
            listed = f"{', '.join(names[:NAMES_SHOWN])}{more}"
            if wanted is not None and not chosen:
                raise ClipError(f"nuScenes has no scene {wanted!r}; have {listed}")
            raise ClipError(
                f"holds {len(chosen)} scenes of nuScenes of that description in "
                f"{', '.join(each.name for each in versions)}; name one behind the folder, as in "
                f"{path.name}/{names[0] if names else 'scene-0061'}: {listed}"
            )
        return _Scene(*chosen[0]).clip()


def _versions(path: Path) -> list[Path]:
    """Folders with tables: the path itself, or those in it."""
    found = [path] if (path / "sample_data.json").is_file() else sorted(path.glob("v1.0-*"))
    return [each.resolve() for each in found if (each / "scene.json").is_file() and (each / "ego_pose.json").is_file()]


@dataclass(frozen=True)
class _Files(ImageFiles):
    """The files of a scene as a ``types.LogSource``; sweeps are float32 x, y, z, intensity (0..255), ring."""

    def sweep(self, lidar_id: str, index: int) -> SweepPoints:
        """The points of one sweep."""
        points = self.float_rows(lidar_id, index, 5)
        xyz = geometry.transform_points(geometry.inverse(FILE_FROM_LIDAR), points[:, :3].astype(np.float64))
        return SweepPoints(xyz, np.clip(points[:, 3] / 255, 0.0, 1.0).astype(np.float32))


class _Scene:
    """The records of one scene."""

    def __init__(self, version: Path, scene: Row) -> None:
        self.version, self.row = version, scene
        self.name = fields.of_kind("scene.json", scene, "name", str)
        token = fields.of_kind("scene.json", scene, "token", str)
        self.samples = {row["token"]: row for row in matching_rows(version, "sample", "scene_token", token.__eq__)}
        if not self.samples:
            raise ClipError(f"sample.json has no record of scene {self.name!r}")
        calibrated, kinds = small_table(version, "calibrated_sensor"), small_table(version, "sensor")
        self.data: dict[str, list[tuple[Row, Row]]] = {}
        self.modality: dict[str, str] = {}
        for row in matching_rows(version, "sample_data", "sample_token", self.samples.__contains__):
            where = f"sample_data.json: record {row.get('token')!r}"
            mounted = reference(calibrated, "calibrated_sensor", _text(where, row, "calibrated_sensor_token"), where)
            sensor = reference(kinds, "sensor", _text("calibrated_sensor.json", mounted, "sensor_token"), where)
            channel, modality = (_text("sensor.json", sensor, key) for key in ("channel", "modality"))
            if modality in ("camera", "lidar"):
                self.modality[channel] = modality
                self.data.setdefault(channel, []).append((row, mounted))
        for rows in self.data.values():
            rows.sort(key=lambda pair: _time("sample_data.json", pair[0]))
        used = {_text("sample_data.json", row, "ego_pose_token") for rows in self.data.values() for row, _ in rows}
        if not used:
            raise ClipError(f"sample_data.json has no camera and no LiDAR of scene {self.name!r}")
        poses = {row["token"]: row for row in matching_rows(version, "ego_pose", "token", used.__contains__)}
        self.poses = {token: _pose(f"ego_pose.json: record {token!r}", row) for token, row in poses.items()}
        times = {_time("ego_pose.json", row): token for token, row in poses.items()}
        if missing := sorted(used - set(poses)):
            raise ClipError(f"ego_pose.json has no record {missing[0]!r}")
        # Coordinates of a map reach kilometres, which single precision resolves poorly.
        self.origin_m = np.floor(self.poses[times[min(times)]][:3, 3])
        for pose in self.poses.values():
            pose[:3, 3] -= self.origin_m
        stamps = sorted(times)
        self.ego = Trajectory(np.array(stamps), np.array([self.poses[times[t_us]] for t_us in stamps]))

    def clip(self) -> Clip:
        cameras, images = {}, {}
        lidars, sweeps = {}, {}
        for channel, rows in self.data.items():
            if self.modality[channel] == "camera":
                cameras[channel] = _camera(channel, *rows[0])
                images[channel] = [self._image(row, cameras[channel]) for row, _ in rows]
            else:
                lidars[channel] = _lidar(channel, rows[0][1])
                sweeps[channel] = [self._sweep(row, lidars[channel]) for row, _ in rows]
        storage = Storage(self.version.parent)
        return Clip(
            id=self.name,
            rig=Rig(cameras, lidars, BODY),
            ego=self.ego,
            images=images,
            sweeps=sweeps,
            source=_Files(storage, images, sweeps),
            tracks=list(self._tracks()),
            facts={
                "dataset": f"nuScenes {self.version.name} {self.name}",
                "licence": "CC BY-NC-SA 4.0 with the nuScenes terms of use (non-commercial)",
                "world": f"map coordinates less {self.origin_m.tolist()} m",
                "scene": str(self.row.get("description", "")),
            },
        )

    def _image(self, row: Row, camera: CameraModel) -> ImageRecord:
        t_us = _time("sample_data.json", row)
        pose = self.poses[row["ego_pose_token"]] @ camera.rig_from_camera
        return ImageRecord(_file(row), t_us, t_us, np.stack([pose, pose]))

    def _sweep(self, row: Row, lidar: LidarModel) -> SweepRecord:
        t_us = _time("sample_data.json", row)
        pose = self.poses[row["ego_pose_token"]] @ lidar.rig_from_lidar
        return SweepRecord(_file(row), t_us, t_us - TURN_US, t_us, pose)

    def _tracks(self) -> Iterator[Track]:
        """Boxes of the same instance at the times of the samples, in between which they are interpolated."""
        instances, categories = small_table(self.version, "instance"), small_table(self.version, "category")
        boxes: dict[str, list[tuple[int, Matrix4, Any]]] = {}
        for row in matching_rows(self.version, "sample_annotation", "sample_token", self.samples.__contains__):
            where = f"sample_annotation.json: record {row.get('token')!r}"
            pose = _pose(where, row)
            pose[:3, 3] -= self.origin_m
            width, length, height = fields.array(where, row, "size", (3,))
            if min(width, length, height) <= 0:
                raise ClipError(f"{where}: size must be positive, got {row['size']}")
            t_us = _time("sample.json", self.samples[row["sample_token"]])
            boxes.setdefault(_text(where, row, "instance_token"), []).append((t_us, pose, (length, width, height)))
        for token, rows in boxes.items():
            rows.sort(key=lambda box: box[0])
            times = np.array([box[0] for box in rows])
            if (np.diff(times) <= 0).any():
                raise ClipError(f"sample_annotation.json: instance {token!r} has two boxes at one time")
            instance = reference(instances, "instance", token, "sample_annotation.json")
            category = _text("instance.json", instance, "category_token")
            label = _label(_text("category.json", reference(categories, "category", category, "instance.json"), "name"))
            length, width, height = (float(value) for value in np.median([box[2] for box in rows], axis=0))
            path = Trajectory(times, np.array([box[1] for box in rows]))
            yield Track(token, label, (length, width, height), path, is_movable(label))


def _label(category: str) -> str:
    """Our label for names such as ``vehicle.bus.rigid``, ``human.pedestrian.adult`` or ``animal``."""
    parts = category.split(".")
    word = parts[1] if len(parts) > 1 else parts[0]
    return our_label(_WORDS.get(word, word) if parts[0] == "vehicle" else word)


def _text(where: str, row: Row, key: str) -> str:
    return str(fields.of_kind(where, row, key, str))


def _time(where: str, row: Row) -> int:
    return fields.integer(where, row, "timestamp")


def _file(row: Row) -> str:
    return checked_name(_text("sample_data.json", row, "filename"))


def _pose(where: str, row: Mapping[str, Any]) -> Matrix4:
    """A pose from translation and rotation (wxyz)."""
    quaternion = fields.array(where, row, "rotation", (4,))
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > 0.01:
        raise ClipError(f"{where}: the rotation is not a quaternion of length 1, got {row['rotation']}")
    return geometry.pose(geometry.matrix_from_quat(quaternion / length), fields.array(where, row, "translation", (3,)))


def _camera(channel: str, row: Row, mounted: Row) -> CameraModel:
    where = f"calibrated_sensor.json: {channel}"
    k = fields.array(where, mounted, "camera_intrinsic", (3, 3))
    return calibration.checked_camera(
        CameraModel(
            id=channel,
            width_px=fields.integer(f"sample_data.json: {channel}", row, "width"),
            height_px=fields.integer(f"sample_data.json: {channel}", row, "height"),
            lens=Pinhole(k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5),
            rig_from_camera=_pose(where, mounted),
        )
    )


def _lidar(channel: str, mounted: Row) -> LidarModel:
    pose = _pose(f"calibrated_sensor.json: {channel}", mounted) @ FILE_FROM_LIDAR
    lidar = sensors.lidar_model("HDL-32", pose, id=channel, columns=TURN_US * 2170 // 100_000)
    return replace(lidar, frequency_hz=1e6 / TURN_US)
