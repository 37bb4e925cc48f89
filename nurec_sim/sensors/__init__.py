"""Camera and LiDAR models: point to pixel or beam, pixel to ray, and the instant at which each is measured."""

from nurec_sim.sensors.camera import (
    check_camera,
    in_image,
    pixel_ray_strips,
    pixel_rays,
    project,
    project_rolling,
    scaled_camera,
    shutter_fraction,
    unproject,
)
from nurec_sim.sensors.ftheta_fit import fill_ftheta, fit_ftheta
from nurec_sim.sensors.lidar import (
    beam_coordinates,
    beam_directions,
    beam_sectors,
    blocked_beams,
    check_lidar,
    check_rig,
    column_fraction,
    compensate_sweep,
)
from nurec_sim.sensors.lidar_tables import LIDAR_TABLES, STAND_IN_TABLE, LidarTable, lidar_model
from nurec_sim.sensors.range_map import RangeMap, range_map

__all__ = [
    "LIDAR_TABLES",
    "STAND_IN_TABLE",
    "LidarTable",
    "RangeMap",
    "beam_coordinates",
    "beam_directions",
    "beam_sectors",
    "blocked_beams",
    "check_camera",
    "check_lidar",
    "check_rig",
    "column_fraction",
    "compensate_sweep",
    "fill_ftheta",
    "fit_ftheta",
    "in_image",
    "lidar_model",
    "pixel_ray_strips",
    "pixel_rays",
    "project",
    "project_rolling",
    "range_map",
    "scaled_camera",
    "shutter_fraction",
    "unproject",
]
