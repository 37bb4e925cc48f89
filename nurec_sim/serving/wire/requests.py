"""Render requests, images and sweeps <-> messages."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float64, UInt8

from nurec_sim.errors import RequestError
from nurec_sim.render.images.encode import available_formats, encode_image
from nurec_sim.render.requests import check_pose_pair
from nurec_sim.serving.wire.messages import ImageFormat
from nurec_sim.serving.wire.poses import check_interval, read_poses, write_poses
from nurec_sim.serving.wire.sensor_specs import read_camera, read_lidar, write_camera, write_lidar
from nurec_sim.types import CameraFrame, CameraModel, LidarFilter, LidarFrame, LidarModel, SensorRequest

_ENCODER = {
    ImageFormat.PNG: "png",
    ImageFormat.JPEG: "jpeg",
    ImageFormat.JPEG2000: "jpeg2000",
    ImageFormat.RGB_UINT8_PLANAR: "rgb_planar",
    ImageFormat.AVC: "avc",
    ImageFormat.AV1: "av1",
}
_LOSSLESS = (ImageFormat.PNG, ImageFormat.RGB_UINT8_PLANAR)
DEFAULT_QUALITY = 95
DEFAULT_DISTANCE_THRESHOLD_M = 1.0
"""Of a request that enables the distance filter without saying how far is too far."""

Sensor = TypeVar("Sensor", CameraModel, LidarModel)


@dataclass(frozen=True)
class ImageOptions:
    """How a camera image is finished: file format, quality, and the ego mask laid over it."""

    format: int = ImageFormat.PNG
    quality: int = DEFAULT_QUALITY
    """1..100; without effect on PNG and raw planes."""
    ego_mask: tuple[str, str] | None = None
    """(rig, camera) of the mask, or None. The rig may be empty: the one that has a mask of this camera."""


# ------------------------------------------------------------------------------------------------------------ requests


def write_camera_request(request: SensorRequest, message, *, scene_id: str) -> None:
    """Fills an ``RGBRenderRequest`` that asks for lossless pixels (``RGB_UINT8_PLANAR``).

    Raises:
        RequestError: the frame is empty, a pose is not finite or not rigid, or tracks are hidden.
    """
    camera = _sensor_of(request, CameraModel)
    message.resolution_w, message.resolution_h = camera.width_px, camera.height_px
    write_camera(camera, message.camera_intrinsics)
    message.image_format = ImageFormat.RGB_UINT8_PLANAR
    if not request.apply_isp:
        message.apply_isp = False
    _write_frame(request, message, scene_id)


def write_lidar_request(request: SensorRequest, message, *, scene_id: str) -> None:
    """Fills a ``LidarRenderRequest``.

    Raises:
        RequestError: the frame is empty, a pose is not finite or not rigid, or tracks are hidden.
    """
    write_lidar(_sensor_of(request, LidarModel), message.lidar_config)
    _write_frame(request, message, scene_id)


def _sensor_of(request: SensorRequest, kind: type[Sensor]) -> Sensor:
    if not isinstance(request.sensor, kind):
        raise RequestError(f"the sensor must be a {kind.__name__}, got {type(request.sensor).__name__}")
    return request.sensor


def _write_frame(request: SensorRequest, message, scene_id: str) -> None:
    message.scene_id = scene_id
    if request.hidden:
        raise RequestError(
            f"hidden must be empty, got {sorted(request.hidden)}: the interface has no field for it; a server whose "
            "option only_listed_actors is on hides the moving actors that a request does not list"
        )
    check_interval(request.start_us, request.end_us)
    message.frame_start_us, message.frame_end_us = request.start_us, request.end_us
    _write_pair(f"sensor {request.sensor.id!r}: world_from_sensor", request.world_from_sensor, message.sensor_pose)
    for track_id, pair in request.actors.items():
        added = message.dynamic_objects.add(track_id=track_id)
        _write_pair(f"actor {track_id!r}: world_from_box", pair, added.pose_pair)


def _write_pair(name: str, pair: Float64[np.ndarray, "2 4 4"], message) -> None:
    check_pose_pair(name, pair)
    write_poses(np.asarray(pair, np.float64), [message.start_pose, message.end_pose])


def read_camera_request(message, cameras: Mapping[str, CameraModel]) -> tuple[SensorRequest, ImageOptions]:
    """The request and the options of an ``RGBRenderRequest``; ``cameras`` are the scene's own.

    Raises:
        RequestError: a field is missing or malformed; the text names it.
    """
    options = _read_image_options(message)
    camera = read_camera(message.camera_intrinsics, message.resolution_w, message.resolution_h, cameras)
    apply_isp = message.apply_isp if message.HasField("apply_isp") else True
    return dataclasses.replace(_read_frame(message, camera), apply_isp=apply_isp), options


def read_lidar_request(message) -> tuple[SensorRequest, LidarFilter]:
    """The request of a ``LidarRenderRequest``, and which of its beams return.

    Raises:
        RequestError: a field is missing or malformed; the text names it.
    """
    return _read_frame(message, read_lidar(message.lidar_config)), _read_lidar_filter(message.render_filter)


def _read_lidar_filter(message) -> LidarFilter:
    """Thresholds that are left out are ``LidarFilter``'s own; the distance filter is off unless it is enabled."""
    given = {name: getattr(message, name) for name in ("raydrop_threshold", "opacity_threshold")
             if message.HasField(name)}  # fmt: skip
    distance = message.distance_filter_threshold if message.HasField("distance_filter_threshold") else None
    try:
        checked = LidarFilter(**given, distance_threshold_m=distance)
    except RequestError as error:
        raise RequestError(
            f"render_filter: {error}".replace("distance_threshold_m", "distance_filter_threshold")
        ) from None
    enabled = message.enable_distance_filter
    limit = (DEFAULT_DISTANCE_THRESHOLD_M if distance is None else distance) if enabled else None
    return dataclasses.replace(checked, distance_threshold_m=limit)


def _read_frame(message, sensor) -> SensorRequest:
    check_interval(message.frame_start_us, message.frame_end_us)
    if not message.HasField("sensor_pose"):
        raise RequestError("sensor_pose is missing: the sensor's poses in the world at the frame's start and end")
    tracks = {entry.track_id: entry.pose_pair for entry in message.dynamic_objects}
    pairs = {"sensor_pose": message.sensor_pose}
    pairs |= {f"dynamic_objects[{track_id!r}].pose_pair": pair for track_id, pair in tracks.items()}
    names = [f"{name}.{end}" for name in pairs for end in ("start_pose", "end_pose")]
    poses = read_poses([pose for pair in pairs.values() for pose in (pair.start_pose, pair.end_pose)], names)
    first, *others = poses.reshape(-1, 2, 4, 4)
    actors = dict(zip(tracks, others, strict=True))
    return SensorRequest(message.scene_id, sensor, message.frame_start_us, message.frame_end_us, first, actors)


def _read_image_options(message) -> ImageOptions:
    if _ENCODER.get(message.image_format) not in available_formats():
        allowed = ", ".join(f"{number.name} ({number.value})" for number in offered_formats())
        given = ImageFormat(message.image_format).name if message.image_format in list(ImageFormat) else "unknown"
        raise RequestError(f"image_format must be one of {allowed}; got {given} ({message.image_format})")
    lossless = message.image_format in _LOSSLESS
    quality = DEFAULT_QUALITY if lossless else message.image_quality or DEFAULT_QUALITY
    if not 1 <= quality <= 100:
        name = ImageFormat(message.image_format).name
        raise RequestError(f"image_quality of a {name} must lie in 1..100 (0 means {DEFAULT_QUALITY}), got {quality}")
    mask = (
        message.ego_mask_id.rig_config_id,
        message.ego_mask_id.camera_logical_id or message.camera_intrinsics.logical_id,
    )
    return ImageOptions(
        message.image_format,
        round(quality),
        mask if message.insert_ego_mask else None,
    )


def offered_formats() -> tuple[enum.IntEnum, ...]:
    """Image formats for which this installation has an encoder."""
    return tuple(number for number, name in _ENCODER.items() if name in available_formats())


# -------------------------------------------------------------------------------------------------------------- frames


def write_image(rgb: UInt8[np.ndarray, "h w 3"], options: ImageOptions, message) -> None:
    """Fills an ``RGBRenderReturn``."""
    message.image_bytes = encode_image(rgb, _ENCODER[options.format], options.quality)


def read_camera_frame(message, request: SensorRequest, field: str = "image_bytes") -> CameraFrame:
    """The frame of an ``RGBRenderReturn`` to a request made by ``write_camera_request``.

    ``field`` is what errors call the picture.

    Raises:
        RequestError: the reply has another size than asked for.
    """
    camera = _sensor_of(request, CameraModel)
    shape = (3, camera.height_px, camera.width_px)
    if len(message.image_bytes) != int(np.prod(shape)):
        raise RequestError(
            f"camera {camera.id!r}: {field} must hold {camera.width_px}x{camera.height_px} planar RGB, "
            f"{int(np.prod(shape)):,} bytes, got {len(message.image_bytes):,}"
        )
    import cv2

    rgb = cv2.merge(list(np.frombuffer(message.image_bytes, np.uint8).reshape(shape)))  # far quicker than NumPy's copy
    return CameraFrame(camera, request.start_us, request.end_us, rgb)


def write_lidar_frame(frame: LidarFrame, message) -> None:
    """Fills a ``LidarRenderReturn``; only the buffers, not the repeated fields."""
    message.num_points = len(frame.xyz_m)
    message.point_xyzs_buffer = np.ascontiguousarray(frame.xyz_m, "<f4").tobytes()
    message.point_intensities_buffer = np.ascontiguousarray(frame.intensity, "<f4").tobytes()
    message.point_ranges_buffer = np.ascontiguousarray(frame.range_m, "<f4").tobytes()
    message.point_beams_buffer = np.ascontiguousarray(frame.beam, "<i4").tobytes()


def read_lidar_frame(message, request: SensorRequest) -> LidarFrame:
    """The sweep of a ``LidarRenderReturn``.

    From servers without our additions, ranges are the points' norms and beams are -1.

    Raises:
        RequestError: the buffers have different lengths.
    """
    lidar = _sensor_of(request, LidarModel)
    xyz = _read_buffer(message, "point_xyzs_buffer", "<f4")
    intensity = _read_buffer(message, "point_intensities_buffer", "<f4")
    if not len(xyz):
        xyz, intensity = np.array(message.point_xyzs, "<f4"), np.array(message.point_intensities, "<f4")
    n = message.num_points
    ranges, beam = (
        _read_buffer(message, "point_ranges_buffer", "<f4"),
        _read_buffer(message, "point_beams_buffer", "<i4"),
    )
    if len(xyz) != 3 * n or len(intensity) != n or len(ranges) not in (0, n) or len(beam) not in (0, n):
        raise RequestError(
            f"lidar {lidar.id!r}: num_points says {n}, but there are {len(xyz)} point_xyzs, {len(intensity)} "
            f"point_intensities, {len(ranges)} point_ranges and {len(beam)} point_beams"
        )
    xyz = xyz.reshape(n, 3).astype(np.float32)
    ranges = ranges.astype(np.float32) if len(ranges) else np.linalg.norm(xyz, axis=1)
    beam = beam.astype(np.int32) if len(beam) else np.full(n, -1, np.int32)
    return LidarFrame(lidar, request.start_us, request.end_us, xyz, ranges, intensity.astype(np.float32), beam)


def _read_buffer(message, name: str, kind: str) -> np.ndarray:
    data = getattr(message, name)
    if len(data) % 4:
        raise RequestError(f"{name} must hold 4 bytes a value, got {len(data)} bytes")
    return np.frombuffer(data, kind)
