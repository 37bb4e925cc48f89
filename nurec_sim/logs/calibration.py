"""Rigs to JSON and back, with the fields of ``types``.

Poses in files are named ``T_a_b``: a 4x4 matrix that maps coordinates in b to a.
"""

from __future__ import annotations

import dataclasses
import enum
from typing import Any

import numpy as np

from nurec_sim import geometry, sensors
from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import LIMITS
from nurec_sim.lenses import decode_parameters, encode_parameters, lens_class
from nurec_sim.logs import fields
from nurec_sim.types import Box, CameraModel, LidarModel, Rig, Shutter, Spin, Windshield

CALIBRATION_FILE = "calib.json"
MAX_COLUMNS = 1 << 14
"""Maximum number of LiDAR columns; real devices have up to 4,000 per revolution."""


def rig_to_json(rig: Rig, intensity_scale: int) -> dict[str, Any]:
    """The contents of ``calib.json`` for a rig.

    Raises:
        ClipError: a camera's lens is not of a registered kind.
    """
    return {
        "ego_frame": "x forward, y left, z up, origin at the rear axle on the ground",
        "ground_z_in_ego_m": 0.0,
        "body": _plain(rig.body),
        "cameras": {name: _camera_to_json(camera) for name, camera in rig.cameras.items()},
        "lidars": {
            name: {**_lidar_to_json(lidar), "intensity_scale": intensity_scale} for name, lidar in rig.lidars.items()
        },
    }


def _camera_to_json(camera: CameraModel) -> dict[str, Any]:
    try:
        lens_class(camera.lens.kind)
    except ValueError as error:
        raise ClipError(f"{CALIBRATION_FILE}: camera {camera.id!r}: {error}") from None
    row = {
        "width": camera.width_px,
        "height": camera.height_px,
        "lens": {"model": camera.lens.kind, **encode_parameters(camera.lens)},
        "shutter": camera.shutter.value,
        "T_ego_cam": np.asarray(camera.rig_from_camera, np.float64).tolist(),
    }
    if camera.windshield is not None:
        row["windshield"] = encode_parameters(camera.windshield)
    return row


def _lidar_to_json(lidar: LidarModel) -> dict[str, Any]:
    row = _plain(lidar)
    row["T_ego_lidar"] = row.pop("rig_from_lidar")
    del row["id"]
    return row


def _plain(value: Any) -> Any:
    """Converts dataclasses, enums, tuples and arrays to plain JSON values."""
    if dataclasses.is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def rig_from_json(calib: dict[str, Any]) -> tuple[Rig, dict[str, float]]:
    """The rig from ``calib.json``, its frame moved to the ground, and the intensity scale of each LiDAR.

    Raises:
        ClipError: a field is missing or wrong.
    """
    rig_from_ego = ground_shift(calib)
    body = Rig({}, {}).body
    if "body" in calib:
        where = f"{CALIBRATION_FILE}: body"
        center, size = (fields.array(where, calib["body"], key, (3,)) for key in ("center_m", "size_m"))
        body = Box((center[0], center[1], center[2]), (size[0], size[1], size[2]))
    cameras = {
        name: camera_from_json(name, row, rig_from_ego)
        for name, row in fields.of_kind(CALIBRATION_FILE, calib, "cameras", dict).items()
    }
    lidars, scales = {}, {}
    for name, row in fields.of_kind(CALIBRATION_FILE, calib, "lidars", dict).items():
        lidars[name] = lidar_from_json(name, row, rig_from_ego)
        scales[name] = positive_scale(f"{CALIBRATION_FILE}: LiDAR {name!r}", row)
    return Rig(cameras, lidars, body), scales


def ground_shift(calib: dict[str, Any]) -> np.ndarray:
    """rig_from_ego: the rig frame is on the ground, directly below the origin of the log's ego frame."""
    height = fields.number(CALIBRATION_FILE, calib, "ground_z_in_ego_m", default=0.0)
    return geometry.pose(np.eye(3), np.array([0.0, 0.0, -height]))


def positive_scale(where: str, row: dict[str, Any]) -> float:
    """The divisor that maps stored intensities to 0..1."""
    scale = fields.number(where, row, "intensity_scale", default=255.0)
    if scale <= 0:
        raise ClipError(f"{where}: intensity_scale must be positive, got {scale}")
    return scale


def camera_from_json(name: str, row: Any, rig_from_ego: np.ndarray) -> CameraModel:
    """Parses one camera of ``calib.json``.

    Raises:
        ClipError: a field is missing or wrong.
    """
    where = f"{CALIBRATION_FILE}: camera {name!r}"
    lens_row = fields.of_kind(where, row, "lens", dict)
    kind = fields.of_kind(f"{where}: lens", lens_row, "model", str)
    glass_row = row.get("windshield")
    try:
        lens = lens_class(kind)
    except ValueError as error:
        raise ClipError(f"{where}: {error}") from None
    camera = CameraModel(
        id=name,
        width_px=fields.integer(where, row, "width"),
        height_px=fields.integer(where, row, "height"),
        lens=_decoded(f"{where}: lens", lens, {k: v for k, v in lens_row.items() if k != "model"}),
        rig_from_camera=rig_from_ego @ fields.transform(where, row, "T_ego_cam"),
        shutter=_member(where, Shutter, row.get("shutter", Shutter.GLOBAL.value)),
        windshield=None if glass_row is None else _decoded(f"{where}: windshield", Windshield, glass_row),
    )
    return checked_camera(camera)


def checked_camera(camera: CameraModel) -> CameraModel:
    """Returns the camera if it is valid.

    Raises:
        ClipError: it is invalid, or has too many pixels.
    """
    try:
        sensors.check_camera(camera)
        if camera.width_px * camera.height_px > LIMITS.image_pixels:
            size = f"{camera.width_px} x {camera.height_px}"
            raise ValueError(f"camera {camera.id!r} may have {LIMITS.image_pixels:,} pixels, got {size}")
    except ValueError as error:
        raise ClipError(f"{CALIBRATION_FILE}: {error}") from error
    return camera


def _decoded(where: str, cls: type[Any], row: Any) -> Any:
    try:
        return decode_parameters(cls, row)
    except ValueError as error:
        raise ClipError(f"{where}: {error}") from None


def _member(where: str, kind: type[enum.Enum], value: Any) -> Any:
    allowed = [member.value for member in kind]
    if value not in allowed:
        raise ClipError(f"{where}: {kind.__name__.lower()} {value!r} is unknown; known are {allowed}")
    return kind(value)


def lidar_from_json(name: str, row: Any, rig_from_ego: np.ndarray) -> LidarModel:
    """Parses one LiDAR of ``calib.json``: explicit angles, or the name of a ``table`` (and ``columns``).

    Raises:
        ClipError: a field is missing or wrong, or the table is unknown.
    """
    where = f"{CALIBRATION_FILE}: LiDAR {name!r}"
    pose = rig_from_ego @ fields.transform(where, row, "T_ego_lidar")
    try:
        if "table" in row:
            columns = fields.integer(where, row, "columns") if "columns" in row else None
            if columns is not None and columns > MAX_COLUMNS:  # an array of that length is allocated
                raise ClipError(f"{where}: 'columns' must be at most {MAX_COLUMNS}, got {columns}")
            return sensors.lidar_model(fields.of_kind(where, row, "table", str), pose, id=name, columns=columns)
        near_far = fields.array(where, row, "range_m", (2,)) if "range_m" in row else (0.5, 200.0)
        lidar = LidarModel(
            id=name,
            elevation_rad=fields.array(where, row, "elevation_rad", (None,)),
            azimuth_rad=fields.array(where, row, "azimuth_rad", (None,)),
            row_azimuth_offset_rad=fields.array(where, row, "row_azimuth_offset_rad", (None,)),
            rig_from_lidar=pose,
            spin=_member(where, Spin, row.get("spin", Spin.CLOCKWISE.value)),
            frequency_hz=fields.number(where, row, "frequency_hz", default=10.0),
            range_m=(float(near_far[0]), float(near_far[1])),
        )
        sensors.check_lidar(lidar)
        beams = len(lidar.elevation_rad) * len(lidar.azimuth_rad)
        if beams > LIMITS.sweep_points:
            raise ValueError(f"LiDAR {name!r} may have {LIMITS.sweep_points:,} beams a turn, got {beams:,}")
    except ValueError as error:
        raise ClipError(f"{CALIBRATION_FILE}: {error}") from error
    return lidar
