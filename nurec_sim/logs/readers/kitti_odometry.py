"""Reading sequences of the KITTI odometry benchmark as published: rectified cameras, compensated sweeps, poses.

Their conventions: ``poses/NN.txt`` has poses of the rectified camera 0 in its first frame (x right, y down, z forward);
``Tr`` takes points of the LiDAR to it; pixel centres are at whole numbers.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import image_size
from nurec_sim.logs.clip import Clip, ImageRecord
from nurec_sim.logs.readers import _kitti as kitti
from nurec_sim.logs.readers._folders import FolderReader, numbered_files
from nurec_sim.logs.storage import Storage
from nurec_sim.logs.sweeps import SweepRecord
from nurec_sim.types import Rig, Trajectory

COLOUR, GREY = ("image_2", "image_3"), ("image_0", "image_1")
# The benchmark has no frame of the car. Fig. 3 of Geiger et al. 2013: the LiDAR is 0.76 m ahead of the rear axle and
# 1.73 m high; it is taken to be level.
RIG_FROM_VELO = geometry.pose(np.eye(3), np.array([0.76, 0.0, 1.73]))
SEQUENCE = re.compile(r"\d\d")
FILES, POSES = ("calib.txt", "times.txt"), "poses"
LATEST_S = 1e9


class KittiOdometryReader(FolderReader):
    """Reads sequences of the KITTI odometry benchmark as clips (``types.LogReader``)."""

    name = "kitti-odometry"
    description = "a folder sequences/NN of the KITTI odometry benchmark with calib.txt and times.txt, and poses/NN.txt"
    noun = "sequences of KITTI odometry"

    def logs(self, path: Path) -> list[Path]:
        """Folders of sequences: the path itself, or those in ``sequences`` below it."""
        if not path.is_dir():
            return []
        found = [path] if SEQUENCE.fullmatch(path.resolve().name) else [*path.glob("*"), *path.glob("sequences/*")]
        return sorted(
            each
            for each in found
            if SEQUENCE.fullmatch(each.resolve().name) and all((each / name).is_file() for name in FILES)
        )

    def beside(self, log: Path) -> list[Path]:
        """The poses."""
        return [log.parents[1] / POSES / f"{log.name}.txt"]

    def read(self, log: Path) -> Clip:
        """The sequence as a clip."""
        return _read(Storage(log.parents[1]), log.name)


def _read(storage: Storage, sequence: str) -> Clip:
    folder = f"sequences/{sequence}"
    rows = kitti.calibration_file(storage, f"{folder}/calib.txt")
    rectified_from_velo = np.vstack([kitti.entry(f"{folder}/calib.txt", rows, "Tr", (3, 4)), [0, 0, 0, 1]])
    rig_from_rectified = RIG_FROM_VELO @ geometry.inverse(rectified_from_velo)
    times = [round(1e6 * seconds[0]) for seconds in _numbers(storage, f"{folder}/times.txt", 1)]
    poses_file = f"{POSES}/{sequence}.txt"
    if not storage.exists(poses_file):
        raise ClipError(f"{poses_file} is missing: the benchmark publishes poses for the sequences 00 to 10")
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    rows_of_poses = _numbers(storage, poses_file, 12)
    if not times or len(rows_of_poses) != len(times):
        raise ClipError(f"{poses_file} has {len(rows_of_poses)} poses for {len(times)} times in {folder}/times.txt")
    poses[:, :3] = np.array(rows_of_poses).reshape(-1, 3, 4)
    if (np.diff(times) <= 0).any():
        raise ClipError(f"{folder}/times.txt: time goes back or stands still")
    # The world is the rig frame at the first pose, so that z points up.
    world_from_rig = rig_from_rectified @ poses @ geometry.inverse(rig_from_rectified)
    ego = Trajectory(np.array(times, np.int64), world_from_rig)
    files = {name: _files(storage, f"{folder}/{name}", ".png", len(times)) for name in (*COLOUR, *GREY)}
    names = [name for name in COLOUR if files[name]] or [name for name in GREY if files[name]]
    cameras, images = {}, {}
    for name in names:
        first = next(iter(files[name].values()))
        try:
            size = image_size(storage.read(first))
        except ValueError as error:
            raise ClipError(f"{first} {error}") from None
        projection = kitti.entry(f"{folder}/calib.txt", rows, f"P{name[-1]}", (3, 4))
        cameras[name] = kitti.rectified_camera(name, projection, size, rig_from_rectified)
        images[name] = [
            ImageRecord(file, times[i], times[i], np.stack([world_from_rig[i] @ cameras[name].rig_from_camera] * 2))
            for i, file in files[name].items()
        ]
    lidars, sweeps = {}, {}
    if sweep_files := _files(storage, f"{folder}/velodyne", ".bin", len(times)):
        lidars = {kitti.LIDAR_ID: kitti.velodyne(RIG_FROM_VELO)}
        sweeps = {
            kitti.LIDAR_ID: [
                SweepRecord(file, times[i], times[i], times[i], world_from_rig[i] @ RIG_FROM_VELO)
                for i, file in sweep_files.items()
            ]
        }
    if not images and not sweeps:
        raise ClipError(f"{folder}: holds no images and no sweeps; image_2, velodyne and others are looked at")
    return Clip(
        id=f"kitti_odometry_{sequence}",
        rig=Rig(cameras, lidars, kitti.BODY),
        ego=ego,
        images=images,
        sweeps=sweeps,
        source=kitti.KittiFiles(storage, images, sweeps),
        facts={"dataset": f"KITTI odometry {sequence}", "licence": kitti.LICENCE, "poses": "of the benchmark"},
    )


def _files(storage: Storage, folder: str, suffix: str, count: int) -> dict[int, str]:
    """Files of a sensor by the line of their time."""
    found = numbered_files(storage.path, folder, suffix)
    if found and max(found) >= count:
        raise ClipError(f"{found[max(found)]}: has no time: there are {count}")
    return found


def _numbers(storage: Storage, name: str, count: int) -> list[list[float]]:
    """Lines of ``count`` finite numbers each."""
    rows = []
    for number, line in enumerate(kitti.text_lines(storage, name), start=1):
        try:
            row = [float(text) for text in line.split()]
        except ValueError:
            row = []
        if len(row) != count or not (np.abs(row) < LATEST_S).all():
            raise ClipError(f"{name} line {number}: must have {count} numbers, got {line[:60]!r}")
        rows.append(row)
    return rows
