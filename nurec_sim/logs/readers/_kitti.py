"""What the layouts of KITTI have in common: rectified cameras, sweeps of an HDL-64E, the car."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry, sensors
from nurec_sim.errors import ClipError
from nurec_sim.logs import calibration
from nurec_sim.logs.storage import Storage
from nurec_sim.logs.stored import ImageFiles
from nurec_sim.types import Box, CameraModel, LidarModel, Matrix4, Pinhole, SweepPoints

LIDAR_ID = "velodyne"
COLOUR, GREY = ("image_02", "image_03"), ("image_00", "image_01")
LICENCE = "CC BY-NC-SA 3.0 (KITTI; non-commercial, attribution, share-alike)"
# Volkswagen Passat B6: 4.77 m long, 1.82 m wide, 1.1 m of it behind the rear axle.
BODY = Box((1.285, 0.0, 0.75), (4.77, 1.82, 1.5))


@dataclass(frozen=True)
class KittiFiles(ImageFiles):
    """The files of a drive as a ``types.LogSource``; sweeps are float32 x, y, z, reflectance (0..1)."""

    def sweep(self, lidar_id: str, index: int) -> SweepPoints:
        """The points of one sweep."""
        points = self.float_rows(lidar_id, index, 4)
        return SweepPoints(points[:, :3].astype(np.float64), np.clip(points[:, 3], 0.0, 1.0))


def calibration_file(storage: Storage, name: str) -> dict[str, Float64[np.ndarray, " n"]]:
    """The lines ``KEY: numbers`` of a text file; others, such as dates, are skipped.

    Raises:
        ClipError: it is missing, or not text.
    """
    found = {}
    for line in text_lines(storage, name):
        key, colon, values = line.partition(":")
        try:
            numbers = np.array(values.split(), np.float64)
        except ValueError:
            continue
        if colon and np.isfinite(numbers).all():
            found[key.strip()] = numbers
    return found


def text_lines(storage: Storage, name: str) -> list[str]:
    """The lines of a text file, without empty ones at its end.

    Raises:
        ClipError: it is missing, or not text.
    """
    try:
        return storage.read(name).decode("ascii").rstrip().splitlines()
    except UnicodeDecodeError as error:
        raise ClipError(f"{name}: must be plain text: {error}") from None


def entry(name: str, rows: Mapping[str, np.ndarray], key: str, shape: tuple[int, ...]) -> np.ndarray:
    """One entry of a calibration file in its shape.

    Raises:
        ClipError: it is missing, or has another count of numbers.
    """
    if key not in rows:
        raise ClipError(f"{name}: {key!r} is missing; have {sorted(rows)}")
    count = int(np.prod(shape))
    if rows[key].size != count:
        raise ClipError(f"{name}: {key!r} must have {count} numbers, got {rows[key].size}")
    return rows[key].reshape(shape)


def rotation_and_shift(storage: Storage, name: str) -> Matrix4:
    """The rigid transform of a file with the entries R and T.

    Raises:
        ClipError: one is missing, or R is not a rotation.
    """
    rows = calibration_file(storage, name)
    rotation = entry(name, rows, "R", (3, 3))
    if not geometry.is_rotation(rotation):
        raise ClipError(f"{name}: R is not a rotation")
    return geometry.pose(rotation, entry(name, rows, "T", (3,)))


def rectified_camera(
    name: str, projection: Float64[np.ndarray, "3 4"], size: tuple[int, int], rig_from_rectified: Matrix4
) -> CameraModel:
    """A camera of a rectified stereo rig.

    Args:
        name: its id.
        projection: P = K [I | t], from the rectified frame of camera 0; pixel centres at whole numbers.
        size: width and height of its images.
        rig_from_rectified: pose of the rectified frame of camera 0.

    Raises:
        ClipError: it is not the projection of a pinhole.
    """
    k = projection[:, :3]
    if k[0, 0] <= 0 or k[1, 1] <= 0 or k[0, 1] or k[1, 0] or k[2].tolist() != [0, 0, 1]:
        raise ClipError(f"camera {name!r}: its projection matrix is not that of a pinhole, got {projection.tolist()}")
    camera_from_rectified = geometry.pose(np.eye(3), np.linalg.solve(k, projection[:, 3]))
    return calibration.checked_camera(
        CameraModel(
            id=name,
            width_px=size[0],
            height_px=size[1],
            lens=Pinhole(k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5),
            rig_from_camera=rig_from_rectified @ geometry.inverse(camera_from_rectified),
        )
    )


def velodyne(rig_from_lidar: Matrix4) -> LidarModel:
    """The LiDAR, with the nominal table of its beams."""
    return sensors.lidar_model("HDL-64", rig_from_lidar, id=LIDAR_ID)
