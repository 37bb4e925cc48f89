"""Beam tables of common spinning LiDARs, from their public data sheets.

Elevations are nominal: a real device deviates by up to about 0.2 degrees and has per-row azimuth offsets of some
degrees (Pandar128, HDL-64E) that only its own calibration file knows; both are zero offset here. Columns follow the
firing rate at 10 Hz; ``lidar_model(columns=...)`` overrides them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from nurec_sim.types import LidarModel, Matrix4, Spin


@dataclass(frozen=True, eq=False)
class LidarTable:
    """A device: elevations from high to low, azimuth at which a sweep starts and the angle it covers, in degrees."""

    elevation_deg: Float64[np.ndarray, " rows"]
    columns: int
    range_m: tuple[float, float]
    start_azimuth_deg: float = 180.0
    sweep_deg: float = 360.0
    spin: Spin = Spin.CLOCKWISE
    frequency_hz: float = 10.0


LIDAR_TABLES: dict[str, LidarTable] = {
    # Hesai Pandar128: 0.125 degrees from +2 to -6, 0.5 above and below, one last step of 1 degree at the top.
    "PANDAR128": LidarTable(
        np.concatenate([[15.0], 14.0 - 0.5 * np.arange(25), 2 - 0.125 * np.arange(1, 65), -6 - 0.5 * np.arange(1, 39)]),
        columns=1800,
        range_m=(0.3, 200.0),
    ),
    # Hesai AT128: 128 rows 0.2 degrees apart, 120 degrees wide in steps of 0.1.
    "AT128": LidarTable(
        12.9 - 0.2 * np.arange(128), columns=1200, range_m=(0.5, 200.0), start_azimuth_deg=60.0, sweep_deg=120.0
    ),
    # Velodyne HDL-64E: an upper block of 32 lasers every 1/3 degree and a lower one every 1/2 degree.
    "HDL-64": LidarTable(
        np.concatenate([2.0 - np.arange(32) / 3, -8.83 - 0.5 * np.arange(32)]), columns=2083, range_m=(0.9, 120.0)
    ),
    # Velodyne HDL-32E: +10.67 to -30.67 degrees.
    "HDL-32": LidarTable(10.67 - 4.0 / 3.0 * np.arange(32), columns=2170, range_m=(0.9, 100.0)),
    # Velodyne VLP-32C: dense about the horizon, +15 to -25 degrees.
    "VLP-32C": LidarTable(
        np.array(
            [
                15,
                10.333,
                7,
                4.667,
                3.333,
                2.333,
                1.667,
                1.333,
                1,
                0.667,
                0.333,
                0,
                -0.333,
                -0.667,
                -1,
                -1.333,
                -1.667,
                -2,
                -2.333,
                -2.667,
                -3,
                -3.333,
                -3.667,
                -4,
                -4.667,
                -5.333,
                -6.148,
                -7.254,
                -8.843,
                -11.31,
                -15.639,
                -25,
            ]
        ),  # fmt: skip
        columns=1808,
        range_m=(0.5, 200.0),
    ),
    # Velodyne VLP-16: +15 to -15 degrees.
    "VLP-16": LidarTable(15.0 - 2.0 * np.arange(16), columns=1808, range_m=(0.5, 100.0)),
}

STAND_IN_TABLE = "PANDAR128"
"""The device that stands in for LiDARs whose beams a log does not give, for rendering."""


def lidar_model(name: str, rig_from_lidar: Matrix4, id: str | None = None, columns: int | None = None) -> LidarModel:
    """A LiDAR from its table.

    Args:
        name: a key of ``LIDAR_TABLES``.
        rig_from_lidar: its mounting pose.
        id: its name in the rig; the device's name if None.
        columns: beams per row and sweep; the device's own at 10 Hz if None.

    Raises:
        ValueError: no such device, or ``columns`` is not positive.
    """
    table = LIDAR_TABLES.get(name)
    if table is None:
        raise ValueError(f"no LiDAR table {name!r}; have {sorted(LIDAR_TABLES)}")
    count = table.columns if columns is None else columns
    if count < 1:
        raise ValueError(f"LiDAR {name!r} needs at least 1 column, got {count}")
    sign = -1.0 if table.spin is Spin.CLOCKWISE else 1.0
    azimuth_deg = table.start_azimuth_deg + sign * table.sweep_deg * np.arange(count) / count
    return LidarModel(
        id=name if id is None else id,
        elevation_rad=np.deg2rad(table.elevation_deg),
        azimuth_rad=np.deg2rad(azimuth_deg),
        row_azimuth_offset_rad=np.zeros(len(table.elevation_deg)),
        rig_from_lidar=np.asarray(rig_from_lidar, np.float64),
        spin=table.spin,
        frequency_hz=table.frequency_hz,
        range_m=table.range_m,
    )
