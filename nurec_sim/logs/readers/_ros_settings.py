"""The YAML file beside a ROS 2 bag, or one that names it: which topics to read, and what the bag does not say."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nurec_sim import geometry, sensors
from nurec_sim.errors import ClipError
from nurec_sim.logs import calibration, fields
from nurec_sim.logs.readers._ros_sensors import UNITS_PER_S
from nurec_sim.logs.readers._ros_storage import read_yaml
from nurec_sim.types import CameraModel, Matrix4, Shutter

SETTINGS_FILE = "nurec_sim.yaml"


@dataclass(frozen=True, eq=False)
class CameraSettings:
    """A camera of a bag; what is None is found in the bag."""

    topic: str
    info: str | None = None
    frame: str | None = None
    base_from_sensor: Matrix4 | None = None
    lens: CameraModel | None = None
    rectified: bool | None = None
    shutter: Shutter = Shutter.GLOBAL
    readout_us: int = 0
    delay_us: int = 0


@dataclass(frozen=True, eq=False)
class LidarSettings:
    """A LiDAR of a bag; what is None is found in the bag."""

    topic: str
    frame: str | None = None
    base_from_sensor: Matrix4 | None = None
    beams: str | None = None
    time_field: str | None = None
    time_unit: str | None = None
    compensated: bool = False
    intensity_scale: float | None = None


@dataclass(frozen=True)
class Settings:
    """All of the file; sensors that are None are looked for."""

    world: str | None = None
    base: str = "base_link"
    ground_z_m: float = 0.0
    poses: str | None = None
    cameras: dict[str, CameraSettings] | None = None
    lidars: dict[str, LidarSettings] | None = None


def settings_file(path: Path) -> Path:
    """The YAML file of a bag, whether it exists or not; the path itself if it is one."""
    if path.suffix in (".yaml", ".yml"):
        return path
    return path / SETTINGS_FILE if path.is_dir() else path.with_suffix(".yaml")


def read_settings(path: Path) -> tuple[Path, Settings]:
    """The bag and its settings: from the YAML file that is given, or from the one beside the bag if there is one.

    ``drive.yaml`` is beside ``drive.mcap``, ``nurec_sim.yaml`` is in a folder.

    Raises:
        ClipError: a key is unknown or its value wrong; the text names the file, the key, and what is allowed.
    """
    file = settings_file(path)
    if not file.is_file():
        return path, Settings()
    content = read_yaml(file)
    if file == path:
        path = file.parent / fields.of_kind(file.name, content, "bag", str)
        if not path.exists():
            raise ClipError(f"{file.name}: there is no bag at {str(path)!r}")
    return path, _settings(file.name, content)


def _settings(where: str, row: dict[str, Any]) -> Settings:
    _no_others(where, row, ("bag", "world", "base", "ground_z_m", "poses", "cameras", "lidars"))
    cameras, lidars = (
        None if row.get(key) is None else fields.of_kind(where, row, key, dict) for key in ("cameras", "lidars")
    )
    return Settings(
        world=_text(where, row, "world"),
        base=_text(where, row, "base") or Settings.base,
        ground_z_m=fields.number(where, row, "ground_z_m", default=0.0),
        poses=_text(where, row, "poses"),
        cameras=None if cameras is None else {str(k): _camera(f"{where}: camera {k!r}", v) for k, v in cameras.items()},
        lidars=None if lidars is None else {str(k): _lidar(f"{where}: LiDAR {k!r}", v) for k, v in lidars.items()},
    )


def _camera(where: str, row: Any) -> CameraSettings:
    allowed = ("topic", "info", "frame", "T_base_sensor", "lens", "width", "height", "rectified", "shutter")
    _no_others(where, row, (*allowed, "readout_us", "delay_us"))
    shutter = row.get("shutter", Shutter.GLOBAL.value)
    if shutter not in (known := [each.value for each in Shutter]):
        raise ClipError(f"{where}: shutter {shutter!r} is unknown; known are {known}")
    readout_us, delay_us = (fields.integer(where, {key: 0} | row, key) for key in ("readout_us", "delay_us"))
    if readout_us < 0:
        raise ClipError(f"{where}: readout_us must not be negative, got {readout_us}")
    lens = None
    if row.get("lens") is not None:
        # As in calib.json of our clips; the pose is set later.
        lens = calibration.camera_from_json(where, {"T_ego_cam": np.eye(4).tolist(), **row}, np.eye(4))
    return CameraSettings(
        topic=fields.of_kind(where, row, "topic", str),
        info=_text(where, row, "info"),
        frame=_text(where, row, "frame"),
        base_from_sensor=_mounting(where, row),
        lens=lens,
        rectified=fields.of_kind(where, row, "rectified", bool) if row.get("rectified") is not None else None,
        shutter=Shutter(shutter),
        readout_us=readout_us,
        delay_us=delay_us,
    )


def _lidar(where: str, row: Any) -> LidarSettings:
    _no_others(where, row, ("topic", "frame", "T_base_sensor", "beams", "time", "compensated", "intensity_scale"))
    time = fields.of_kind(where, row, "time", dict, default={})
    _no_others(f"{where}: time", time, ("field", "unit"))
    beams, unit = _text(where, row, "beams"), _text(where, time, "unit")
    for what, value, known in (("beams", beams, sensors.LIDAR_TABLES), ("unit", unit, UNITS_PER_S)):
        if value is not None and value not in known:
            raise ClipError(f"{where}: {what} {value!r} is unknown; known are {list(known)}")
    return LidarSettings(
        topic=fields.of_kind(where, row, "topic", str),
        frame=_text(where, row, "frame"),
        base_from_sensor=_mounting(where, row),
        beams=beams,
        time_field=_text(where, time, "field"),
        time_unit=unit,
        compensated=fields.of_kind(where, row, "compensated", bool, default=False),
        intensity_scale=calibration.positive_scale(where, row) if row.get("intensity_scale") is not None else None,
    )


def _no_others(where: str, row: Any, allowed: Collection[str]) -> None:
    if not isinstance(row, dict):
        raise ClipError(f"{where}: must hold keys and values, got {type(row).__name__}")
    if others := sorted(str(key) for key in row if key not in allowed):
        raise ClipError(f"{where}: unknown key {others[0]!r}; known are {list(allowed)}")


def _text(where: str, row: dict[str, Any], key: str) -> str | None:
    return None if row.get(key) is None else str(fields.of_kind(where, row, key, str))


def _mounting(where: str, row: dict[str, Any]) -> Matrix4 | None:
    """Pose of the sensor in the base frame."""
    if row.get("T_base_sensor") is None:
        return None
    pose = fields.transform(where, row, "T_base_sensor")
    if not geometry.is_rotation(pose[:3, :3]):
        raise ClipError(f"{where}: T_base_sensor holds no rotation")
    return pose
