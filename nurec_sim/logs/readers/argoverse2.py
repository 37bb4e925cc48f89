"""Reading logs of the Argoverse 2 sensor data set as published (Wilson et al., NeurIPS Datasets and Benchmarks 2021).

Their conventions: nanoseconds; ``a_SE3_b`` takes points of b to a, quaternions wxyz; the ego frame lies at the rear
axle; sweeps of both LiDARs are in one file in the ego frame, compensated to the time in its name; images are
undistorted, so that the coefficients k1 to k3 do not apply.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry, sensors
from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import LIMITS
from nurec_sim.logs import calibration
from nurec_sim.logs.clip import Clip, ImageRecord
from nurec_sim.logs.labels import is_movable, our_label
from nurec_sim.logs.readers._argoverse2_map import read_map
from nurec_sim.logs.readers._folders import FolderReader, numbered_files
from nurec_sim.logs.storage import Storage
from nurec_sim.logs.stored import ImageFiles
from nurec_sim.logs.sweeps import SweepRecord
from nurec_sim.types import CameraModel, LidarModel, Matrix4, Pinhole, Rig, Spin, SweepPoints, Track, Trajectory

if TYPE_CHECKING:
    import polars

POSES, SENSORS = "city_SE3_egovehicle.feather", "calibration/egovehicle_SE3_sensor.feather"
INTRINSICS, BOXES = "calibration/intrinsics.feather", "annotations.feather"
POSE = (*(QUATERNION := ("qw", "qx", "qy", "qz")), *(POSITION := ("tx_m", "ty_m", "tz_m")))
# Lasers 0 to 31 are those of the upper VLP-32C, 32 to 63 of the lower one, which hangs upside down: elevations in the
# frame of each are then those of its data sheet.
LASERS = {"up_lidar": range(0, 32), "down_lidar": range(32, 64)}
TURN_US = 100_000
_POINTS = ("x", "y", "z", "intensity", "laser_number", "offset_ns")
_TEXTS = ("sensor_name", "track_uuid", "category")
# The ego frame is at the height of the rear axle; the ground of logs is found 0.33 m below it.
RIG_FROM_EGO = geometry.pose(np.eye(3), np.array([0.0, 0.0, 0.33]))


class Argoverse2Reader(FolderReader):
    """Reads logs of the Argoverse 2 sensor data set as clips (``types.LogReader``)."""

    name = "argoverse2"
    description = f"the folder of an Argoverse 2 sensor log, with {POSES} and calibration/, or one above with one log"
    noun = "logs of Argoverse 2"

    def logs(self, path: Path) -> list[Path]:
        """Folders of logs: the path itself, or those one or two levels below it."""
        places = ("", "*/", "*/*/") if path.is_dir() else ()
        for place in places:
            if found := sorted(each.parent for each in path.glob(f"{place}{POSES}")):
                return [each for each in found if (each / SENSORS).is_file()]
        return []

    def read(self, log: Path) -> Clip:
        """The log as a clip."""
        return _read(Storage(log))


def _read(storage: Storage) -> Clip:
    sensor_rows, poses = (
        _table(storage, SENSORS, ("sensor_name", *POSE)),
        _table(storage, POSES, ("timestamp_ns", *POSE)),
    )
    rig_from_sensor = dict(zip(sensor_rows["sensor_name"], RIG_FROM_EGO @ _poses(SENSORS, sensor_rows), strict=True))
    world_from_ego = _poses(POSES, poses)
    # Coordinates of a city reach kilometres, which single precision resolves poorly.
    origin_m = np.floor(world_from_ego[0, :3, 3])
    world_from_ego[:, :3, 3] -= origin_m
    times_ns = poses["timestamp_ns"].to_numpy()
    t_us = _microseconds(times_ns)
    kept = np.concatenate([[True], np.diff(t_us) > 0])  # several sensors may share a microsecond
    if (np.diff(times_ns) < 0).any():
        raise ClipError(f"{POSES}: time goes back at row {int(np.argmax(np.diff(times_ns) < 0)) + 1}")
    ego = Trajectory(t_us[kept], (world_from_ego @ geometry.inverse(RIG_FROM_EGO))[kept])
    cameras = {each.id: each for each in _cameras(storage, rig_from_sensor)}
    images = {
        name: [_image(ns, file, camera, ego) for ns, file in _camera_files(storage, name).items()]
        for name, camera in cameras.items()
    }
    sweep_files = numbered_files(storage.path, "sensors/lidar", ".feather")
    names = [name for name in LASERS if name in rig_from_sensor] if sweep_files else []
    lidars = {name: _lidar(name, rig_from_sensor[name]) for name in names}
    sweeps = {
        name: [_sweep(ns, file, rig_from_sensor[name], ego) for ns, file in sweep_files.items()] for name in names
    }
    maps = sorted(storage.path.glob("map/log_map_archive_*.json"))
    return Clip(
        id=storage.path.name,
        rig=Rig(cameras, lidars),
        ego=ego,
        images=images,
        sweeps=sweeps,
        source=_Files(storage, images, sweeps, rig_from_sensor),
        tracks=list(_tracks(storage, times_ns, world_from_ego)) if storage.exists(BOXES) else (),
        road_map=read_map(storage, f"map/{maps[0].name}", origin_m) if maps else None,
        facts={
            "dataset": f"Argoverse 2 sensor {storage.path.name}",
            "licence": "CC BY-NC-SA 4.0 (Argoverse 2; non-commercial, attribution, share-alike)",
            "world": f"city coordinates less {origin_m.tolist()} m",
        },
        rig_from_log=RIG_FROM_EGO,
    )


def _lidar(name: str, rig_from_lidar: Matrix4) -> LidarModel:
    lidar = sensors.lidar_model("VLP-32C", rig_from_lidar, id=name)
    if name == "up_lidar":
        return lidar
    # Times of its points run with the azimuth in its own frame, whose z axis points down.
    return replace(lidar, spin=Spin.COUNTERCLOCKWISE, azimuth_rad=-lidar.azimuth_rad)


@dataclass(frozen=True)
class _Files(ImageFiles):
    """The files of a log as a ``types.LogSource``."""

    rig_from_sensor: dict[str, Matrix4]

    def sweep(self, lidar_id: str, index: int) -> SweepPoints:
        """The points of one of the LiDARs, in its own frame."""
        file = self.sweeps[lidar_id][index].file
        table = _table(self.storage, file, _POINTS)
        laser = table["laser_number"].to_numpy()
        own = (laser >= LASERS[lidar_id].start) & (laser < LASERS[lidar_id].stop)
        points = np.stack([table[name].to_numpy()[own].astype(np.float64) for name in "xyz"], axis=1)
        lidar_from_ego = geometry.inverse(self.rig_from_sensor[lidar_id]) @ RIG_FROM_EGO
        return SweepPoints(
            geometry.transform_points(lidar_from_ego, points),
            table["intensity"].to_numpy()[own].astype(np.float32) / 255,
            table["offset_ns"].to_numpy()[own].astype(np.int64) // 1000,
        )


def _table(storage: Storage, name: str, columns: Sequence[str]) -> polars.DataFrame:
    """A feather file that has these columns, of numbers but for names.

    Raises:
        ClipError: it is missing, damaged, too large, or lacks a column.
    """
    import polars

    data = storage.read(name)
    try:
        rows = polars.scan_ipc(io.BytesIO(data)).select(polars.len()).collect().item()  # from headers only
        if rows > LIMITS.table_rows:
            raise ClipError(f"{name} has {rows:,} rows; at most {LIMITS.table_rows:,} are read")
        table = polars.read_ipc(io.BytesIO(data))
    except (polars.exceptions.PolarsError, polars.exceptions.PanicException, OSError, ValueError) as error:
        raise ClipError(f"{name} is no readable feather file ({str(error)[:200]})") from None
    for column in columns:
        if column not in table.columns:
            raise ClipError(f"{name}: column {column!r} is missing; have {table.columns}")
        if column not in _TEXTS and not table.schema[column].is_numeric():
            raise ClipError(f"{name}: column {column!r} must hold numbers, got {table.schema[column]}")
        if table[column].null_count():
            raise ClipError(f"{name}: column {column!r} has empty entries")
    if not table.height and columns != _POINTS:
        raise ClipError(f"{name}: has no rows")
    return table


def _columns(name: str, table: polars.DataFrame, columns: Sequence[str]) -> Float64[np.ndarray, "n k"]:
    """Columns of finite numbers."""
    values = table.select(columns).to_numpy().astype(np.float64)
    if not np.isfinite(values).all():
        raise ClipError(f"{name}: {', '.join(columns)} must be finite")
    return values


def _poses(name: str, table: polars.DataFrame) -> Float64[np.ndarray, "n 4 4"]:
    quaternions = _columns(name, table, QUATERNION)
    lengths = np.linalg.norm(quaternions, axis=1)
    if (np.abs(lengths - 1) > 0.01).any():
        raise ClipError(f"{name}: row {int(np.argmax(np.abs(lengths - 1)))}: the quaternion is not of length 1")
    poses = np.tile(np.eye(4), (table.height, 1, 1))
    poses[:, :3, :3] = geometry.matrix_from_quat(quaternions / lengths[:, None])
    poses[:, :3, 3] = _columns(name, table, POSITION)
    return poses


def _microseconds(ns: Any) -> Any:
    return (ns + 500) // 1000


def _camera_files(storage: Storage, name: str) -> dict[int, str]:
    return numbered_files(storage.path, f"sensors/cameras/{name}", ".jpg")


def _cameras(storage: Storage, rig_from_sensor: dict[str, Matrix4]) -> Iterator[CameraModel]:
    """Cameras that have images."""
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
    table = _table(storage, INTRINSICS, ("sensor_name", *names))
    for name, row in zip(table["sensor_name"], _columns(INTRINSICS, table, names), strict=True):
        if not _camera_files(storage, name):
            continue
        if name not in rig_from_sensor:
            raise ClipError(f"{SENSORS}: {name!r} is missing; have {sorted(rig_from_sensor)}")
        fx, fy, cx, cy, width, height = row
        lens = Pinhole(fx, fy, cx + 0.5, cy + 0.5)
        yield calibration.checked_camera(CameraModel(name, int(width), int(height), lens, rig_from_sensor[name]))


def _image(ns: int, file: str, camera: CameraModel, ego: Trajectory) -> ImageRecord:
    t_us = _microseconds(ns)
    pose = ego.at(t_us) @ camera.rig_from_camera
    return ImageRecord(file, t_us, t_us, np.stack([pose, pose]))


def _sweep(ns: int, file: str, rig_from_lidar: Matrix4, ego: Trajectory) -> SweepRecord:
    t_us = _microseconds(ns)
    return SweepRecord(file, t_us, t_us, t_us + TURN_US, ego.at(t_us) @ rig_from_lidar)


def _tracks(
    storage: Storage, pose_times_ns: Int64[np.ndarray, " t"], world_from_ego: Float64[np.ndarray, "t 4 4"]
) -> Iterator[Track]:
    """Boxes of the same ``track_uuid``; each is in the ego frame at its own time, for which there is a pose."""
    sizes = ("length_m", "width_m", "height_m")
    table = _table(storage, BOXES, ("timestamp_ns", "track_uuid", "category", *sizes, *POSE))
    times_ns = table["timestamp_ns"].to_numpy()
    row = np.clip(np.searchsorted(pose_times_ns, times_ns), 0, len(pose_times_ns) - 1)
    if (wrong := np.flatnonzero(pose_times_ns[row] != times_ns)).size:
        raise ClipError(f"{BOXES}: row {wrong[0]}: there is no pose at {times_ns[wrong[0]]} ns in {POSES}")
    poses, size = world_from_ego[row] @ _poses(BOXES, table), _columns(BOXES, table, sizes)
    if (size <= 0).any():
        raise ClipError(f"{BOXES}: row {int(np.argmin(size.min(axis=1)))}: sizes must be positive")
    name, category = table["track_uuid"].to_numpy(), table["category"].to_numpy()
    for track in dict.fromkeys(name):
        rows = np.flatnonzero(name == track)
        rows = rows[np.argsort(times_ns[rows], kind="stable")]
        t_us = _microseconds(times_ns[rows])
        if (np.diff(t_us) <= 0).any():
            raise ClipError(f"{BOXES}: track {track!r} has two boxes at one time")
        label = our_label(category[rows[0]])
        length, width, height = (float(value) for value in np.median(size[rows], axis=0))
        yield Track(track, label, (length, width, height), Trajectory(t_us, poses[rows]), is_movable(label))
