"""Range images of Waymo's LiDARs: their beams, and the points of a sweep.

Their conventions: rows run from high to low, columns clockwise from behind the car in the axes of the vehicle; channels
are range (negative: no return), intensity, elongation, and a flag; inclinations are listed from low to high.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry, sensors
from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import LIMITS
from nurec_sim.logs.readers._waymo_tables import Tables
from nurec_sim.types import LidarModel, Matrix4, SweepPoints

RETURN = "range_image_return1"
TURN_US = 100_000
CHANNELS, POSE_CHANNELS = 4, 6


def lidar_model(
    id: str, shape: tuple[int, int], inclination_rad: Float64[np.ndarray, " k"], extrinsic: Matrix4
) -> LidarModel:
    """The LiDAR that made range images of a size.

    Args:
        id: its name.
        shape: rows and columns.
        inclination_rad: the elevation of each row, or the lowest and the highest edge of equal rows, from low to high.
        extrinsic: pose of the LiDAR in the frame of the vehicle.

    Raises:
        ClipError: the inclinations do not fit the rows.
    """
    rows, columns = shape
    if len(inclination_rad) == 2 != rows:
        low, high = inclination_rad
        inclination_rad = low + (np.arange(rows) + 0.5) / rows * (high - low)
    if len(inclination_rad) != rows:
        raise ClipError(f"LiDAR {id!r}: {len(inclination_rad)} beam inclinations for {rows} rows")
    # Column 0 looks along -x of the vehicle, whatever the yaw of the LiDAR.
    azimuth = np.pi - (np.arange(columns) + 0.5) / columns * 2 * np.pi - geometry.yaw_of(extrinsic)
    lidar = LidarModel(id, np.asarray(inclination_rad)[::-1].copy(), azimuth, np.zeros(rows), extrinsic)
    try:
        sensors.check_lidar(lidar)
    except ValueError as error:
        raise ClipError(str(error)) from None
    return lidar


def range_image(tables: Tables, component: str, row: int, channels: int) -> Float64[np.ndarray, "h w c"]:
    """A range image of first returns.

    Raises:
        ClipError: it is missing or damaged, or its size is wrong.
    """
    table = tables.row(component, row, (f"{RETURN}.values", f"{RETURN}.shape"))
    values, shape = (table[f"{RETURN}.{name}"].explode().to_numpy() for name in ("values", "shape"))
    if (
        shape.shape != (3,)
        or shape[2] != channels
        or shape.min() < 1
        or int(np.prod(shape.astype(float))) != len(values)
    ):
        raise ClipError(
            f"{component}: a range image must have the shape [rows, columns, {channels}], "
            f"got {shape.tolist()} and {len(values):,} values"
        )
    if shape[0] * shape[1] > LIMITS.sweep_points:
        raise ClipError(f"{component}: {shape[0]} x {shape[1]} beams; a sweep may have {LIMITS.sweep_points:,}")
    return values.astype(np.float64).reshape(shape)


def sweep_points(
    lidar: LidarModel,
    image: Float64[np.ndarray, "h w 4"],
    beam_poses: Float64[np.ndarray, "h w 6"] | None,
    world_from_vehicle: Matrix4,
) -> SweepPoints:
    """The points of a range image, in the frame of the LiDAR at the pose of the frame.

    Args:
        lidar: its model.
        image: the range image.
        beam_poses: roll, pitch, yaw, x, y, z of the vehicle in the world when each beam was fired; None if the car did
            not move between them.
        world_from_vehicle: pose of the frame.

    Raises:
        ClipError: the images differ in size from the model or each other.
    """
    directions = sensors.beam_directions(lidar)
    for other in (image, beam_poses):
        if other is not None and other.shape[:2] != directions.shape[:2]:
            raise ClipError(f"range image of {other.shape[:2]}, but the first one has {directions.shape[:2]}")
    hit = image[:, :, 0] > 0
    xyz_m = directions[hit] * image[hit][:, :1]
    if beam_poses is not None:
        vehicle = geometry.transform_points(lidar.rig_from_lidar, xyz_m)
        poses = beam_poses[hit]
        world = np.einsum("nij,nj->ni", _rotations(poses[:, :3]), vehicle) + poses[:, 3:]
        back = geometry.inverse(world_from_vehicle @ lidar.rig_from_lidar)
        xyz_m = geometry.transform_points(back, world)
    columns = image.shape[1]
    dt_us = np.broadcast_to(np.rint((np.arange(columns) + 0.5) / columns * TURN_US).astype(np.int64), hit.shape)
    # Intensities have no upper bound; tanh is what the data set's own pictures use.
    return SweepPoints(xyz_m, np.tanh(np.maximum(image[hit][:, 1], 0.0)).astype(np.float32), dt_us[hit])


def _rotations(roll_pitch_yaw: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3 3"]:
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(roll_pitch_yaw).T, np.sin(roll_pitch_yaw).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
