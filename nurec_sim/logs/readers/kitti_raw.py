"""Reading drives of KITTI raw as published (Geiger et al., "Vision meets Robotics", IJRR 2013; development kit).

Their conventions: the calibration of a day lies beside its drives; ``calib_a_to_b`` takes points of a to b; pixel
centres are at whole numbers; sweeps are not motion compensated; tracklets are in the frame of the LiDAR.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.logs.clip import Clip, ImageRecord
from nurec_sim.logs.readers import _kitti as kitti
from nurec_sim.logs.readers._folders import FolderReader, numbered_files
from nurec_sim.logs.readers._kitti_tracklets import read_tracklets
from nurec_sim.logs.storage import Storage
from nurec_sim.logs.sweeps import SweepRecord, prolonged
from nurec_sim.types import CameraModel, Matrix4, Rig, Trajectory

DRIVE = re.compile(r"\d{4}_\d\d_\d\d_drive_\d{4}_sync")
CAM_TO_CAM, VELO_TO_CAM, IMU_TO_VELO = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt"
TRACKLETS = "tracklet_labels.xml"
# Fig. 3 of the paper: the GPS/IMU unit is 0.05 m behind the rear axle, 0.32 m left of the middle, 0.93 m high.
RIG_FROM_IMU = geometry.pose(np.eye(3), np.array([-0.05, 0.32, 0.93]))
EARTH_RADIUS_M = 6378137.0
POSE_VALUES = 6
_TIME = re.compile(r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?")


class KittiRawReader(FolderReader):
    """Reads drives of KITTI raw as clips (``types.LogReader``)."""

    name = "kitti-raw"
    description = (
        "the folder of a KITTI raw drive, such as 2011_09_26_drive_0002_sync, in the folder of its day with "
        f"{CAM_TO_CAM}, or a folder above with one drive"
    )
    noun = "drives of KITTI raw"

    def logs(self, path: Path) -> list[Path]:
        """Folders of drives: the path itself, or those one or two levels below it."""
        if not path.is_dir():
            return []
        if DRIVE.fullmatch(path.resolve().name):
            return [path]
        found = sorted([*path.glob("*_drive_*_sync"), *path.glob("*/*_drive_*_sync")])
        return [each for each in found if DRIVE.fullmatch(each.name) and each.is_dir()]

    def beside(self, log: Path) -> list[Path]:
        """The calibration of the day."""
        return [log.parent / name for name in (CAM_TO_CAM, VELO_TO_CAM, IMU_TO_VELO)]

    def read(self, log: Path) -> Clip:
        """The drive as a clip."""
        return _read(Storage(log.parent), log.name)


def _read(storage: Storage, drive: str) -> Clip:
    velo_from_imu = kitti.rotation_and_shift(storage, IMU_TO_VELO)
    rig_from_velo = RIG_FROM_IMU @ geometry.inverse(velo_from_imu)
    sweep_files = numbered_files(storage.path, f"{drive}/velodyne_points/data", ".bin")
    sweep_times = {
        name: _times(storage, f"{drive}/velodyne_points/timestamps{name}.txt") if sweep_files else []
        for name in ("_start", "", "_end")
    }
    image_files = {name: numbered_files(storage.path, f"{drive}/{name}/data", ".png") for name in kitti.COLOUR}
    if not any(image_files.values()):
        image_files = {name: numbered_files(storage.path, f"{drive}/{name}/data", ".png") for name in kitti.GREY}
    image_files = {name: files for name, files in image_files.items() if files}
    image_times = {name: _times(storage, f"{drive}/{name}/timestamps.txt") for name in image_files}
    if not sweep_files and not image_files:
        raise ClipError(f"{drive}: holds no images and no sweeps; image_02/data, velodyne_points/data are looked at")
    turns = [tuple(_at(sweep_times[name], i, file) for name in sweep_times) for i, file in sweep_files.items()]
    instants = [_at(image_times[name], i, file) for name, files in image_files.items() for i, file in files.items()]
    recorded = _poses(storage, drive)
    ego = _covering(recorded, [*instants, *(t for turn in turns for t in turn)])
    cameras = _cameras(storage, image_files, rig_from_velo)
    seen_at = {index: turn[1] for index, turn in zip(sweep_files, turns, strict=True)}
    images = {
        name: [
            _image(file, _at(image_times[name], i, file), seen_at.get(i), cameras[name], ego)
            for i, file in files.items()
        ]
        for name, files in image_files.items()
    }
    lidars, sweeps = {}, {}
    if sweep_files:
        lidars = {kitti.LIDAR_ID: kitti.velodyne(rig_from_velo)}
        sweeps = {kitti.LIDAR_ID: list(_sweeps(sweep_files, turns, rig_from_velo, ego))}
    tracks = []
    if storage.exists(f"{drive}/{TRACKLETS}"):
        world_from_velo = {i: ego.at(t_us) @ rig_from_velo for i, t_us in seen_at.items()}
        tracks = read_tracklets(storage, f"{drive}/{TRACKLETS}", seen_at, world_from_velo)
    return Clip(
        id=drive,
        rig=Rig(cameras, lidars, kitti.BODY),
        ego=ego,
        images=images,
        sweeps=sweeps,
        source=kitti.KittiFiles(storage, images, sweeps),
        tracks=tracks,
        facts={"dataset": f"KITTI raw {drive}", "licence": kitti.LICENCE, "poses": "GPS/IMU (oxts), as recorded"},
        rig_from_log=RIG_FROM_IMU,
    )


def _times(storage: Storage, name: str) -> list[int | None]:
    """Times of a file, one per line, in microseconds; None for an empty line, as drives have for a missing sweep."""
    lines = kitti.text_lines(storage, name)
    return [_microseconds(f"{name} line {n + 1}", line) if line.strip() else None for n, line in enumerate(lines)]


def _microseconds(where: str, text: str) -> int:
    """A time such as 2011-09-26 13:02:44.327963904 in whole microseconds since 1970."""
    found = _TIME.fullmatch(text.strip())
    try:
        if found is None:
            raise ValueError
        seconds = int(np.datetime64(f"{found[1]}T{found[2]}", "s").astype(np.int64))
    except ValueError:
        raise ClipError(f"{where}: must be a time like 2011-09-26 13:02:44.327963904, got {text[:40]!r}") from None
    return seconds * 1_000_000 + (int((found[3] or "").ljust(9, "0")) + 500) // 1000


def _at(times: Sequence[int | None], index: int, file: str) -> int:
    t_us = times[index] if index < len(times) else None
    if t_us is None:
        raise ClipError(f"{file}: has no time: the time stamps beside it have {len(times)} lines")
    return t_us


def _poses(storage: Storage, drive: str) -> Trajectory:
    """Poses of the rig by GPS/IMU; the first is at the origin and looks along x, roll and pitch as recorded."""
    files = numbered_files(storage.path, f"{drive}/oxts/data", ".txt")
    if not files:
        raise ClipError(f"{drive}/oxts/data: there are no poses; files like 0000000000.txt are read")
    all_times = _times(storage, f"{drive}/oxts/timestamps.txt")
    times: list[int] = []
    values = []
    for index, file in files.items():
        t_us = _at(all_times, index, file)
        # The receiver repeats or sets back a time now and then; such a pose has no time of its own.
        if not times or t_us > times[-1]:
            times.append(t_us)
            values.append(_pose_values(storage, file))
    latitude, longitude, altitude, roll, pitch, yaw = np.array(values).T
    # Mercator projection at the scale of the first latitude, as in the development kit.
    scale = np.cos(np.radians(latitude[0])) * EARTH_RADIUS_M
    east, north = scale * np.radians(longitude), scale * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))
    world_from_imu = np.tile(np.eye(4), (len(times), 1, 1))
    world_from_imu[:, :3, :3] = _rotations(roll, pitch, yaw)
    world_from_imu[:, :3, 3] = np.stack([east, north, altitude], axis=1)
    origin = geometry.pose(geometry.rotation_from_yaw(yaw[0]), world_from_imu[0, :3, 3])
    poses = geometry.inverse(origin) @ world_from_imu @ geometry.inverse(RIG_FROM_IMU)
    return Trajectory(np.array(times, np.int64), poses)


def _pose_values(storage: Storage, file: str) -> list[float]:
    """Latitude and longitude in degrees, altitude, roll, pitch and yaw."""
    texts = " ".join(kitti.text_lines(storage, file)).split()[:POSE_VALUES]
    try:
        values = [float(text) for text in texts]
    except ValueError:
        values = []
    if len(values) < POSE_VALUES or not np.isfinite(values).all() or not abs(values[0]) < 90:
        raise ClipError(f"{file}: must begin with latitude, longitude, altitude, roll, pitch and yaw, got {texts}")
    return values


def _rotations(
    roll: Float64[np.ndarray, " n"], pitch: Float64[np.ndarray, " n"], yaw: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3 3"]:
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in (roll, pitch, yaw))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.array(rows).transpose(2, 0, 1)


def _covering(ego: Trajectory, times: Sequence[int]) -> Trajectory:
    """The trajectory, prolonged at constant velocity if a sensor recorded before its first or after its last pose."""
    margin = max(ego.start_us - min(times), max(times) - ego.end_us, 0)
    return prolonged(ego, margin) or ego


def _cameras(storage: Storage, names: Collection[str], rig_from_velo: Matrix4) -> dict[str, CameraModel]:
    if not names:
        return {}
    rows = kitti.calibration_file(storage, CAM_TO_CAM)
    camera0_from_velo = kitti.rotation_and_shift(storage, VELO_TO_CAM)
    rectified_from_camera0 = geometry.pose(kitti.entry(CAM_TO_CAM, rows, "R_rect_00", (3, 3)), np.zeros(3))
    rig_from_rectified = rig_from_velo @ geometry.inverse(rectified_from_camera0 @ camera0_from_velo)
    cameras = {}
    for name in names:
        number = name.removeprefix("image_")
        width, height = (int(value) for value in kitti.entry(CAM_TO_CAM, rows, f"S_rect_{number}", (2,)))
        projection = kitti.entry(CAM_TO_CAM, rows, f"P_rect_{number}", (3, 4))
        cameras[name] = kitti.rectified_camera(name, projection, (width, height), rig_from_rectified)
    return cameras


def _image(file: str, t_us: int, triggered_us: int | None, camera: CameraModel, ego: Trajectory) -> ImageRecord:
    # The LiDAR triggers the cameras when it looks ahead, which is the time of its sweep; stamps of images come 10 ms
    # later. With poses at the stamps, points and images fit less well.
    pose = ego.at(t_us if triggered_us is None else triggered_us) @ camera.rig_from_camera
    return ImageRecord(file, t_us, t_us, np.stack([pose, pose]))


def _sweeps(
    files: dict[int, str], turns: Sequence[tuple[int, ...]], rig_from_velo: Matrix4, ego: Trajectory
) -> Iterator[SweepRecord]:
    for file, (start_us, t_us, end_us) in zip(files.values(), turns, strict=True):
        if not start_us <= t_us <= end_us:
            raise ClipError(
                f"{PurePosixPath(file).name}: needs start <= time <= end, got {start_us}, {t_us}, {end_us} us"
            )
        yield SweepRecord(file, t_us, start_us, end_us, ego.at(t_us) @ rig_from_velo, compensated=False)
