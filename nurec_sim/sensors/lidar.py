"""Spinning LiDARs: beam directions, the beam that meets a point, and the motion of the car during a turn."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim import geometry
from nurec_sim.sensors.camera import check_camera, check_pose
from nurec_sim.types import LIDAR_SECTORS, LidarModel, Matrix4, Rig, Spin

Values = Float64[np.ndarray, " n"]


def beam_directions(lidar: LidarModel) -> Float64[np.ndarray, "rows columns 3"]:
    """Unit directions of all beams in the LiDAR's frame."""
    azimuth = lidar.azimuth_rad[None, :] + lidar.row_azimuth_offset_rad[:, None]
    elevation = np.broadcast_to(lidar.elevation_rad[:, None], azimuth.shape)
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)


def blocked_beams(lidar: LidarModel) -> Bool[np.ndarray, "rows columns"]:
    """Beams that never return; see ``LidarModel.blocked``."""
    table = np.zeros((len(lidar.elevation_rad), LIDAR_SECTORS), bool)
    table.reshape(-1)[lidar.blocked] = True
    return np.take_along_axis(table, beam_sectors(lidar), axis=1)


def beam_sectors(lidar: LidarModel) -> Int64[np.ndarray, "rows columns"]:
    """The sector of azimuth of each beam, counter-clockwise from straight behind."""
    azimuth = lidar.azimuth_rad[None, :] + lidar.row_azimuth_offset_rad[:, None]
    sector = np.floor((azimuth + np.pi) / (2 * np.pi) * LIDAR_SECTORS + 1e-9).astype(np.int64)
    return sector % LIDAR_SECTORS


def column_fraction(lidar: LidarModel) -> Float64[np.ndarray, " columns"]:
    """When within the sweep each column fires: 0 for the first, 1 for the last."""
    columns = len(lidar.azimuth_rad)
    return np.arange(columns) / max(columns - 1, 1)


def beam_coordinates(
    lidar: LidarModel, xyz_lidar: Float64[np.ndarray, "n 3"]
) -> tuple[Values, Values, Bool[np.ndarray, " n"]]:
    """Coordinates in the range image of points given in the LiDAR's frame.

    Returns:
        row [n] and column [n], fractional between neighbouring beams (whole numbers lie on a beam), and valid [n]:
        within half a beam of the grid. Around a full turn the columns wrap: between the last and the first one a
        column runs up to ``columns - 0.5`` and on from -0.5.
    """
    xyz = np.asarray(xyz_lidar, np.float64).reshape(-1, 3)
    across = np.hypot(xyz[:, 0], xyz[:, 1])
    valid = np.isfinite(xyz).all(axis=1) & (across > 0)
    across = np.where(valid, across, 1.0)
    xyz = np.where(valid[:, None], xyz, (1.0, 0.0, 0.0))
    # Elevations fall from row to row; negated they increase, as the search requires.
    row = _place(-np.arctan2(xyz[:, 2], across), -lidar.elevation_rad)
    rows, columns = len(lidar.elevation_rad), len(lidar.azimuth_rad)
    # The offset jumps from row to row (blocks of lasers), so the nearest row's is taken, not a mean.
    offset = lidar.row_azimuth_offset_rad[np.clip(np.rint(row), 0, rows - 1).astype(np.int64)]
    sign = -1.0 if lidar.spin is Spin.CLOCKWISE else 1.0
    turned = sign * (np.arctan2(xyz[:, 1], xyz[:, 0]) - offset - lidar.azimuth_rad[0])
    grid = sign * (lidar.azimuth_rad - lidar.azimuth_rad[0])
    # Wrap angles to the interval from half of the unseen gap before the first column to half of it after the last.
    gap = max(2 * np.pi - (grid[-1] - grid[0]), 0.0)
    turned = (turned + gap / 2) % (2 * np.pi) - gap / 2
    column = _place(turned, grid)
    valid &= (row >= -0.5) & (row <= rows - 0.5) & (column >= -0.5) & (column <= columns - 0.5)
    return row, column, valid


def _place(value: Values, grid: Float64[np.ndarray, " k"]) -> Values:
    """Fractional index of values in an increasing grid, extrapolated linearly beyond its ends."""
    if len(grid) == 1:
        return np.where(np.abs(value - grid[0]) < 1e-3, 0.0, -1.0)
    low = np.clip(np.searchsorted(grid, value, side="right") - 1, 0, len(grid) - 2)
    return low + (value - grid[low]) / (grid[low + 1] - grid[low])


def compensate_sweep(
    xyz_lidar: Float64[np.ndarray, "n 3"],
    world_from_lidar_fired: Float64[np.ndarray, "n 4 4"],
    world_from_lidar: Matrix4,
) -> Float64[np.ndarray, "n 3"]:
    """Points measured by a moving LiDAR, each in the frame of its own instant, in the LiDAR's frame at one instant.

    Args:
        xyz_lidar: points as measured.
        world_from_lidar_fired: pose of the LiDAR when each point was measured.
        world_from_lidar: pose at the reference instant.
    """
    world = np.einsum("nij,nj->ni", world_from_lidar_fired[:, :3, :3], xyz_lidar) + world_from_lidar_fired[:, :3, 3]
    return geometry.transform_points(geometry.inverse(world_from_lidar), world)


def check_rig(rig: Rig) -> None:
    """Check that all sensors of a rig can be used.

    Raises:
        ValueError: see ``check_camera`` and ``check_lidar``.
    """
    for camera in rig.cameras.values():
        check_camera(camera)
    for lidar in rig.lidars.values():
        check_lidar(lidar)


def check_lidar(lidar: LidarModel) -> None:
    """Check that a LiDAR can be used.

    Raises:
        ValueError: what is wrong with it: empty or unordered tables, lengths that differ, not finite, range or pose.
    """
    name = f"LiDAR {lidar.id!r}"
    check_pose(f"{name}: rig_from_lidar", lidar.rig_from_lidar)
    elevation, azimuth = np.asarray(lidar.elevation_rad), np.asarray(lidar.azimuth_rad)
    offset = np.asarray(lidar.row_azimuth_offset_rad)
    for what, values in (("elevation_rad", elevation), ("azimuth_rad", azimuth), ("row_azimuth_offset_rad", offset)):
        if values.ndim != 1 or len(values) == 0 or not np.isfinite(values).all():
            raise ValueError(f"{name}: {what} must be a list of at least 1 finite angle")
    if len(offset) != len(elevation):
        raise ValueError(f"{name}: {len(elevation)} rows but {len(offset)} row_azimuth_offset_rad")
    if np.any(np.diff(elevation) >= 0) or np.abs(elevation).max() >= np.pi / 2:
        raise ValueError(f"{name}: elevation_rad must fall from row to row and stay within (-pi/2, pi/2)")
    sign = -1.0 if lidar.spin is Spin.CLOCKWISE else 1.0
    steps = sign * np.diff(azimuth)
    if np.any(steps <= 0) or steps.sum() > 2 * np.pi:
        raise ValueError(
            f"{name}: azimuth_rad must run {lidar.spin.value} from column to column, over one turn at most"
        )
    most = len(elevation) * LIDAR_SECTORS
    if lidar.blocked.ndim != 1 or not ((lidar.blocked >= 0) & (lidar.blocked < most)).all():
        raise ValueError(f"{name}: blocked must list numbers below {most}, rows times {LIDAR_SECTORS} sectors")
    near, far = lidar.range_m
    if not 0 <= near < far:
        raise ValueError(f"{name}: range_m must be (near, far) with 0 <= near < far, got {lidar.range_m}")
    if not lidar.frequency_hz > 0:
        raise ValueError(f"{name}: frequency_hz must be positive, got {lidar.frequency_hz}")
