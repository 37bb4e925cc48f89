"""The demo rig: three cameras and one spinning LiDAR."""

from __future__ import annotations

import numpy as np

from nurec_sim import geometry
from nurec_sim.types import CameraModel, LidarModel, Matrix4, Pinhole, Rig, Spin

CAMERAS = {  # yaw (deg), horizontal field of view (deg), position in the rig (m)
    "camera_front": (0.0, 82.0, (1.75, 0.0, 1.45)),
    "camera_front_left": (58.0, 74.0, (1.55, 0.5, 1.45)),
    "camera_front_right": (-58.0, 74.0, (1.55, -0.5, 1.45)),
}
LIDAR_ID = "lidar_top"
# Columns: the camera's right, down and forward axes in a rig frame of x forward, y left, z up.
CAMERA_FROM_RIG_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def street_rig(width_px: int = 448, height_px: int = 256, lidar_rows: int = 48, lidar_columns: int = 600) -> Rig:
    """The rig of the demo clip, in any resolution.

    Args:
        width_px: image width of every camera, at least 16.
        height_px: image height, at least 16.
        lidar_rows: laser rows, at least 2.
        lidar_columns: firings per turn, at least 8.

    Raises:
        ValueError: images smaller than 16 pixels, or a LiDAR with fewer than 2 rows or 8 columns.
    """
    if min(width_px, height_px) < 16 or lidar_rows < 2 or lidar_columns < 8:
        raise ValueError(
            "a rig needs images of at least 16 x 16 pixels and a LiDAR of at least 2 rows and 8 columns, "
            f"got {width_px} x {height_px} and {lidar_rows} x {lidar_columns}"
        )
    cameras = {}
    for name, (yaw_deg, view_deg, place) in CAMERAS.items():
        focal = width_px / 2 / np.tan(np.deg2rad(view_deg) / 2)
        # The horizon is above the image centre, to show more road than sky.
        lens = Pinhole(focal, focal, width_px / 2, 0.44 * height_px)
        rotation = geometry.rotation_from_yaw(np.deg2rad(yaw_deg)) @ CAMERA_FROM_RIG_AXES
        cameras[name] = CameraModel(name, width_px, height_px, lens, geometry.pose(rotation, np.array(place)))
    mount = geometry.pose(np.eye(3), np.array([1.1, 0.0, 1.9]))
    return Rig(cameras, {LIDAR_ID: dense_near_horizon(lidar_rows, lidar_columns, mount)})


def dense_near_horizon(rows: int, columns: int, rig_from_lidar: Matrix4) -> LidarModel:
    """A clockwise LiDAR with the densest rows around the horizon, reaching up to roofs."""
    # A third of the rows looks down at the road, a fifth up, and the rest lies within 9 degrees below and 6 above the
    # horizon.
    steep, high = rows // 3, rows // 5
    bands = ((-26.0, -9.0, steep), (-9.0, 6.0, rows - steep - high), (6.0, 21.0, high))
    elevation_deg = np.concatenate([np.linspace(low, top, count, endpoint=False) for low, top, count in bands])
    return LidarModel(
        id=LIDAR_ID,
        elevation_rad=np.deg2rad(elevation_deg[::-1]),
        azimuth_rad=np.pi - 2 * np.pi * (np.arange(columns) + 0.5) / columns,
        row_azimuth_offset_rad=np.zeros(rows),
        rig_from_lidar=rig_from_lidar,
        spin=Spin.CLOCKWISE,
        frequency_hz=10.0,
        range_m=(0.8, 120.0),
    )
