"""The wire contract: message classes of ``protos/``, and what takes them to the types of ``nurec_sim.types`` and back.

Nothing outside this folder knows what a message looks like, except that ``service`` and ``client`` copy plain fields.
"""

from nurec_sim.wire.messages import (
    METHODS,
    SERVICE,
    SERVICE_PATHS,
    ImageFormat,
    Method,
    common,
    egodriver,
    parse,
    pool,
    sensorsim,
)
from nurec_sim.wire.poses import read_track, read_trajectory, write_track, write_trajectory
from nurec_sim.wire.requests import (
    ImageOptions,
    read_camera_frame,
    read_camera_request,
    read_lidar_frame,
    read_lidar_request,
    write_camera_request,
    write_image,
    write_lidar_frame,
    write_lidar_request,
)
from nurec_sim.wire.sensors import (
    read_camera,
    read_lidar,
    read_mounting,
    write_camera,
    write_lidar,
    write_mounting,
)
from nurec_sim.wire.status import code_of, error_of, number_of

__all__ = [
    "METHODS",
    "SERVICE",
    "SERVICE_PATHS",
    "ImageFormat",
    "ImageOptions",
    "Method",
    "code_of",
    "common",
    "egodriver",
    "error_of",
    "number_of",
    "parse",
    "pool",
    "read_camera",
    "read_camera_frame",
    "read_camera_request",
    "read_lidar",
    "read_lidar_frame",
    "read_lidar_request",
    "read_mounting",
    "read_track",
    "read_trajectory",
    "sensorsim",
    "write_camera",
    "write_camera_request",
    "write_image",
    "write_lidar",
    "write_lidar_frame",
    "write_lidar_request",
    "write_mounting",
    "write_track",
    "write_trajectory",
]
