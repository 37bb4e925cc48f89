"""Checks of render requests, so that nothing malformed reaches a kernel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim import geometry, sensors
from nurec_sim.errors import OutOfRangeError, RequestError, TooLargeError
from nurec_sim.render.cpu.grid import grid_key
from nurec_sim.types import CameraModel, GaussianScene, LidarModel, SensorRequest

MAX_SIDE_PX = 8192
MAX_RAYS = 7680 * 4320
MOST_KNOWN = 1024
"""How many checked sensors are remembered, at most."""
CAMERA_OUTPUTS = ("rgb", "depth", "alpha", "label", "normal")
SENSED_OUTPUTS = ("rgb", "depth", "alpha", "label")
"""What ``sense`` requests of cameras by default."""


def ray_count(request: SensorRequest) -> int:
    """Pixels or beams of a frame."""
    sensor = request.sensor
    if isinstance(sensor, LidarModel):
        return len(sensor.elevation_rad) * len(sensor.azimuth_rad)
    return sensor.width_px * sensor.height_px


def check_request(request: SensorRequest, scene: GaussianScene) -> None:
    """Check a request against a scene.

    Raises:
        RequestError: the sensor, a pose or the exposure is malformed.
        TooLargeError: more pixels or beams than allowed.
        OutOfRangeError: the exposure does not lie within ``scene.span_us``, its end included as an instant.
    """
    check_sensor(request.sensor)
    check_pose_pair(f"sensor {request.sensor.id!r}: world_from_sensor", request.world_from_sensor)
    _check_actors(request)
    _check_exposure(request, scene)


def check_sensor(sensor: CameraModel | LidarModel) -> None:
    """Check a sensor.

    Raises:
        RequestError: it is malformed.
        TooLargeError: more pixels or beams than allowed.
    """
    if not isinstance(sensor, (CameraModel, LidarModel)):
        raise RequestError(f"the sensor must be a CameraModel or a LidarModel, got {type(sensor).__name__}")
    try:
        if isinstance(sensor, CameraModel):
            sensors.check_camera(sensor)
        else:
            sensors.check_lidar(sensor)
    except ValueError as error:
        raise RequestError(str(error)) from None
    if isinstance(sensor, CameraModel):
        width, height, what = sensor.width_px, sensor.height_px, "pixels"
    else:
        width, height, what = len(sensor.azimuth_rad), len(sensor.elevation_rad), "beams"
    if max(width, height) > MAX_SIDE_PX or width * height > MAX_RAYS:
        raise TooLargeError(
            f"sensor {sensor.id!r}: {width} x {height} {what} are too many; "
            f"at most {MAX_SIDE_PX} a side and {MAX_RAYS} in all"
        )


def _check_exposure(request: SensorRequest, scene: GaussianScene) -> None:
    if request.end_us <= request.start_us:
        raise RequestError(f"an exposure must end after it starts, got [{request.start_us}, {request.end_us}) us")
    first, end = scene.span_us
    if request.start_us < first or request.end_us > end + 1:
        raise OutOfRangeError(
            f"scene {scene.id!r} covers [{first}, {end}] us, the request asks for "
            f"[{request.start_us}, {request.end_us})"
        )


def sensor_key(sensor: CameraModel | LidarModel) -> tuple | None:
    """All that ``check_sensor`` looks at, as something hashable; None if the sensor is malformed.

    A sensor whose key was seen before needs no other check.
    """
    try:
        pose = np.asarray(sensor.rig_from_camera if isinstance(sensor, CameraModel) else sensor.rig_from_lidar)
        key = (pose.shape, pose.dtype.char, pose.tobytes(), grid_key(sensor))
        hash(key)
    except (AttributeError, TypeError, ValueError):
        return None
    return key


def check_requests(
    requests: Sequence[SensorRequest], scene: GaussianScene, known: set[tuple | None]
) -> tuple[Float64[np.ndarray, "n 2 4 4"], Float64[np.ndarray, "m 2 4 4"]]:
    """``check_request`` of many, their poses all at once.

    Args:
        requests: requests for frames.
        scene: the scene they are for.
        known: keys of sensors that were checked before (``sensor_key``); those checked now are added.

    Returns:
        Poses of the sensors, and of all actors, request after request.

    Raises:
        RequestError, OutOfRangeError, TooLargeError: see ``check_request``.
    """
    pairs = [request.world_from_sensor for request in requests]
    for request in requests:
        pairs.extend(request.actors.values())
    poses = _stacked(pairs)
    first, end = scene.span_us
    sound = all(first <= r.start_us < r.end_us <= end + 1 for r in requests)
    keys = {sensor_key(request.sensor) for request in requests}
    # Something is wrong or new: the full check names the first fault, or finds none.
    if poses is None or not sound or not keys <= known:
        for request in requests:
            check_request(request, scene)
        poses = np.array(pairs, np.float64)
        if len(known) > MOST_KNOWN:
            known.clear()
        known |= keys
    return poses[: len(requests)], poses[len(requests) :]


def _stacked(pairs: Sequence[np.ndarray]) -> Float64[np.ndarray, "n 2 4 4"] | None:
    """Pairs of poses in one array; None if one of them is not [2,4,4], not finite, or not rigid."""
    try:
        # Cheap tests in bulk; what exactly is wrong is found by ``check_pose_pair``.
        if not {2}.issuperset(map(len, pairs)):
            return None
        poses = np.concatenate(pairs)
    except (TypeError, ValueError):
        return None
    if poses.shape != (2 * len(pairs), 4, 4) or poses.dtype.kind not in "fiu":
        return None
    poses = poses.astype(np.float64, copy=False)
    if not (geometry.are_rotations(poses[:, :3, :3]) & are_affine(poses)).all():
        return None
    return poses.reshape(-1, 2, 4, 4)


def check_outputs(outputs: Sequence[str]) -> None:
    """Check that a camera has such outputs.

    Raises:
        RequestError: one is unknown.
    """
    unknown = sorted(set(outputs) - set(CAMERA_OUTPUTS))
    if unknown:
        raise RequestError(f"unknown outputs {unknown}; have {list(CAMERA_OUTPUTS)}")


def check_camera_call(request: SensorRequest, outputs: Sequence[str]) -> None:
    """Check that the sensor is a camera and that its outputs exist.

    Raises:
        RequestError: it is a LiDAR, or an output is unknown.
    """
    check_outputs(outputs)
    if isinstance(request.sensor, LidarModel):
        raise RequestError(f"render_camera needs a camera, sensor {request.sensor.id!r} is a LiDAR")


def check_lidar_call(request: SensorRequest) -> None:
    """Check that the sensor is a LiDAR.

    Raises:
        RequestError: it is a camera.
    """
    if isinstance(request.sensor, CameraModel):
        raise RequestError(f"render_lidar needs a LiDAR, sensor {request.sensor.id!r} is a camera")


def _check_actors(request: SensorRequest) -> None:
    """``check_pose_pair`` of every actor, all at once."""
    if not request.actors:
        return
    if _stacked([np.asarray(pair) for pair in request.actors.values()]) is not None:
        return
    for name, pair in request.actors.items():  # one of them is wrong
        check_pose_pair(f"actor {name!r}: world_from_box", pair)


def are_affine(poses: Float64[np.ndarray, "n 4 4"]) -> Bool[np.ndarray, " n"]:
    """Which matrices are finite and end in the row 0 0 0 1."""
    entries = np.ascontiguousarray(poses.reshape(-1, 16).T)  # numpy is slow at reductions of many small matrices
    return np.isfinite(entries).all(axis=0) & (entries[12:] == [[0], [0], [0], [1]]).all(axis=0)


def check_pose_pair(name: str, pair: np.ndarray) -> None:
    """Check the two poses at the start and the end of an exposure.

    Raises:
        RequestError: they are not [2,4,4], not finite, or not rigid.
    """
    poses = np.asarray(pair)
    if poses.shape != (2, 4, 4) or poses.dtype.kind not in "fiu":
        raise RequestError(f"{name} must be two 4 x 4 poses [2,4,4], got {poses.dtype} {list(poses.shape)}")
    if not np.isfinite(poses).all():
        raise RequestError(f"{name} must be finite")
    for pose in poses:
        if not geometry.is_rotation(pose[:3, :3]):
            determinant = np.linalg.det(pose[:3, :3])
            raise RequestError(f"{name} has a 3 x 3 part that is not a rotation (determinant {determinant:.4f})")
        if not np.array_equal(pose[3], (0.0, 0.0, 0.0, 1.0)):
            raise RequestError(f"{name} must end in the row 0 0 0 1, got {pose[3].tolist()}")
