"""Requests for frames, and the poses in them <-> messages.

The wire's poses are float32 position and ``wxyz`` quaternion; ours travel beside them in double precision
(``Pose.exact``), so that a remote rollout equals a local one bit for bit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.compute.turns import rest
from nurec_sim.errors import RequestError
from nurec_sim.render.images.encode import available_formats
from nurec_sim.render.requests import check_pose_pair
from nurec_sim.serving.wire.messages import ImageFormat
from nurec_sim.serving.wire.replies import DEFAULT_QUALITY, ENCODER, ImageOptions, offered_formats, sensor_of
from nurec_sim.serving.wire.sensor_specs import read_camera, read_lidar, write_camera, write_lidar
from nurec_sim.types import CameraModel, LidarFilter, LidarModel, Matrix4, SensorRequest

_LOSSLESS = (ImageFormat.PNG, ImageFormat.RGB_UINT8_PLANAR)
DEFAULT_DISTANCE_THRESHOLD_M = 1.0
"""Of a request that enables the distance filter without saying how far is too far."""
_AT_ONCE = 1024
"""Poses read in a few milliseconds."""
QUAT_TOLERANCE = 1e-3
"""How far a quaternion's squared norm may be from 1; clients round to float32, AlpaSim itself allows 1e-4."""

MAX_TIME_US = 2**62
"""Times beyond this are rejected, so that sums of two still fit int64."""


# ------------------------------------------------------------------------------------------------------------- requests


def write_camera_request(request: SensorRequest, message, *, scene_id: str) -> None:
    """Fills an ``RGBRenderRequest`` that asks for lossless pixels (``RGB_UINT8_PLANAR``).

    Raises:
        RequestError: the frame is empty, a pose is not finite or not rigid, or tracks are hidden.
    """
    camera = sensor_of(request, CameraModel)
    message.resolution_w, message.resolution_h = camera.width_px, camera.height_px
    write_camera(camera, message.camera_intrinsics)
    message.image_format = ImageFormat.RGB_UINT8_PLANAR
    if not request.apply_isp:
        message.apply_isp = False
    message.insert_ego_mask = request.show_ego
    _write_frame(request, message, scene_id)


def write_lidar_request(request: SensorRequest, message, *, scene_id: str) -> None:
    """Fills a ``LidarRenderRequest``.

    Raises:
        RequestError: the frame is empty, a pose is not finite or not rigid, or tracks are hidden.
    """
    write_lidar(sensor_of(request, LidarModel), message.lidar_config)
    _write_frame(request, message, scene_id)


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
    if ENCODER.get(message.image_format) not in available_formats():
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


def check_interval(start_us: int, end_us: int) -> None:
    """Whether [start, end) is a valid frame.

    Raises:
        RequestError: it is empty or reversed, or a time is beyond any clock.
    """
    if end_us > MAX_TIME_US or start_us > MAX_TIME_US:
        raise RequestError(f"frame_start_us {start_us} and frame_end_us {end_us} must be microseconds below 2**62")
    if start_us >= end_us:
        raise RequestError(
            f"a frame is the half-open interval [frame_start_us, frame_end_us) and needs start < end, "
            f"got [{start_us}, {end_us}); an instant t is [t, t + 1)"
        )


# ---------------------------------------------------------------------------------------------------------------- poses


def write_poses(poses: Float64[np.ndarray, "n 4 4"], messages: Sequence) -> None:
    """Fills one ``common.Pose`` message per pose."""
    quats = geometry.quat_from_matrix(poses[:, :3, :3]).tolist()
    for pose, (w, x, y, z), message in zip(poses, quats, messages, strict=True):
        message.vec.x, message.vec.y, message.vec.z = pose[:3, 3].tolist()
        message.quat.w, message.quat.x, message.quat.y, message.quat.z = w, x, y, z
        message.exact.extend(pose.ravel().tolist())


def read_poses(messages: Sequence, names: Sequence[str]) -> Float64[np.ndarray, "n 4 4"]:
    """Poses of ``common.Pose`` messages; ``names`` identify them in errors.

    Raises:
        RequestError: a value is not finite, a quaternion is not a unit one, or ``exact`` is not a rigid transform.
        CancelledError, DeadlinePassedError: see ``compute.turns.rest``.
    """
    parts = []
    for first in range(0, len(messages), _AT_ONCE):
        if first:  # few poses take no time
            rest()
        parts.append(_read_some(messages[first : first + _AT_ONCE], names[first : first + _AT_ONCE]))
    return np.concatenate([np.zeros((0, 4, 4)), *parts])


def _read_some(messages: Sequence, names: Sequence[str]) -> Float64[np.ndarray, "n 4 4"]:
    position = np.array([(m.vec.x, m.vec.y, m.vec.z) for m in messages], np.float64).reshape(-1, 3)
    quat = np.array([(m.quat.w, m.quat.x, m.quat.y, m.quat.z) for m in messages], np.float64).reshape(-1, 4)
    norm2 = np.sum(quat * quat, axis=1)
    finite = np.isfinite(norm2 + np.sum(position * position, axis=1))  # squares of float32 do not overflow
    bad = np.flatnonzero(~(finite & (np.abs(norm2 - 1) <= QUAT_TOLERANCE)))
    if len(bad):
        i = int(bad[0])
        values = f"vec (x, y, z) = {_text(position[i])}, quat (w, x, y, z) = {_text(quat[i])}"
        if not finite[i]:
            raise RequestError(f"{names[i]} must be finite, got {values}")
        raise RequestError(
            f"{names[i]} must have a unit quaternion (squared norm 1 within {QUAT_TOLERANCE}), "
            f"got squared norm {norm2[i]:.6g}: {values}"
        )
    result = np.tile(np.eye(4), (len(messages), 1, 1))
    result[:, :3, 3] = position
    result[:, :3, :3] = geometry.matrix_from_quat(quat)
    given, exact = _read_exact(messages, names)
    # A client that copied a message of ours and edited `vec` or `quat` leaves a stale `exact` behind.
    turned = np.abs(exact[:, :3, :3] - result[given, :3, :3]).max(axis=(1, 2), initial=0)
    moved = np.abs(exact[:, :3, 3] - position[given]).max(axis=1, initial=0)
    fresh = (turned <= 1e-6) & (moved <= 1e-6 * np.maximum(1.0, np.abs(position[given]).max(axis=1, initial=0)))
    result[given[fresh]] = exact[fresh]
    return result


def _read_exact(
    messages: Sequence, names: Sequence[str]
) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, "k 4 4"]]:
    """Which messages have ``exact``, and it."""
    given: list[int] = []
    values: list[float] = []
    for i, message in enumerate(messages):
        count = len(message.exact)
        if count == 0:
            continue
        if count != 16:
            raise RequestError(f"{names[i]}.exact must have 16 values (a row-major 4x4) or none, got {count}")
        given.append(i)
        values.extend(message.exact)
    exact = np.array(values, np.float64).reshape(-1, 4, 4)
    sound = geometry.are_rotations(exact[:, :3, :3]) & np.isfinite(exact).all(axis=(1, 2))
    bad = np.flatnonzero(~(sound & (exact[:, 3] == (0, 0, 0, 1)).all(axis=1)))
    if len(bad):
        raise RequestError(
            f"{names[given[bad[0]]]}.exact must be a rigid transform with last row 0 0 0 1, "
            f"got {_text(exact[bad[0]].ravel())}"
        )
    return np.array(given, np.int64), exact


def _text(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in values) + ")"


def write_mounting(rig_from_sensor: Matrix4, message) -> None:
    """Fills the ``common.Pose`` of a sensor in its rig (named ``rig_to_camera``, but it is ``rig_from_camera``)."""
    write_poses(rig_from_sensor[None], [message])


def read_mounting(message, name: str) -> Matrix4:
    """The pose of a sensor in its rig."""
    return read_poses([message], [name])[0]
