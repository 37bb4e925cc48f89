"""Driving sessions, images, sweeps and actors <-> messages of the egodriver interface."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from google.protobuf import message_factory

from nurec_sim.errors import RequestError
from nurec_sim.serving.wire.discovery import (
    read_available_camera,
    read_available_lidar,
    write_available_camera,
    write_available_lidar,
)
from nurec_sim.serving.wire.messages import Procedure, pool
from nurec_sim.serving.wire.replies import read_lidar_frame, write_lidar_frame
from nurec_sim.serving.wire.requests import MAX_TIME_US, read_poses, write_poses
from nurec_sim.types import (
    ActorState,
    Box,
    CameraModel,
    LidarFrame,
    LidarModel,
    Needs,
    Rig,
    SensorRequest,
)  # fmt: skip

DRIVER_SERVICE = "egodriver.EgodriverService"
DRIVER_METHODS = {
    method.name: Procedure(
        message_factory.GetMessageClass(method.input_type), message_factory.GetMessageClass(method.output_type)
    )
    for method in pool.FindServiceByName(DRIVER_SERVICE).methods
}
"""Every procedure of a driver by name."""

MAX_SENSORS, MAX_POSES, MAX_ACTORS = 64, 5_000, 5_000
LARGEST = 1e6
"""No size, speed or rate is larger."""


@dataclass(frozen=True)
class SessionStart:
    """How a client opens a session. ``sensor_ids`` maps the policy's names of sensors to ids, if given."""

    session_id: str
    seed: int
    rig: Rig
    sensor_ids: Mapping[str, str]


@dataclass(frozen=True)
class EncodedImage:
    """A camera image as it came, not decoded. ``as_is``: it is what the policy shall see."""

    camera_id: str
    start_us: int
    end_us: int
    data: bytes
    as_is: bool = False


# ------------------------------------------------------------------------------------------------------------ sessions


def write_session_start(start: SessionStart, message) -> None:
    """Fills a ``DriveSessionRequest``."""
    message.session_uuid, message.random_seed = start.session_id, start.seed
    vehicle = message.rollout_spec.vehicle
    for camera in start.rig.cameras.values():
        write_available_camera(camera, vehicle.available_cameras.add())
    for lidar in start.rig.lidars.values():
        write_available_lidar(lidar, vehicle.available_lidars.add())
    vehicle.body.center_m.extend(start.rig.body.center_m)
    vehicle.body.size_m.extend(start.rig.body.size_m)
    vehicle.sensor_ids.update(start.sensor_ids)


def read_session_start(message) -> SessionStart:
    """The session that a ``DriveSessionRequest`` opens.

    Raises:
        RequestError: a sensor or the car's outline is malformed; the text names it.
    """
    vehicle = message.rollout_spec.vehicle
    if max(len(vehicle.available_cameras), len(vehicle.available_lidars), len(vehicle.sensor_ids)) > MAX_SENSORS:
        raise RequestError(f"a vehicle may have {MAX_SENSORS} cameras and {MAX_SENSORS} LiDARs")
    cameras: dict[str, CameraModel] = {}
    for entry in vehicle.available_cameras:
        name = _new_name("camera", entry.logical_id or entry.intrinsics.logical_id, cameras)
        with _errors_of(f"available_cameras, camera {name!r}"):
            cameras[name] = replace(read_available_camera(entry), id=name)
    lidars: dict[str, LidarModel] = {}
    for entry in vehicle.available_lidars:
        name = _new_name("LiDAR", entry.logical_id, lidars)
        with _errors_of(f"available_lidars, LiDAR {name!r}"):
            lidars[name] = read_available_lidar(entry)
    body = _read_body(vehicle.body) if vehicle.HasField("body") else Rig({}, {}).body
    rig = Rig(cameras, lidars, body)
    return SessionStart(message.session_uuid, message.random_seed, rig, dict(vehicle.sensor_ids))


@contextlib.contextmanager
def _errors_of(name: str) -> Iterator[None]:
    """Errors that begin with the name of what is read."""
    try:
        yield
    except RequestError as error:
        raise RequestError(f"{name}: {error}") from None


def _new_name(kind: str, name: str, known: Mapping[str, object]) -> str:
    if not name or name in known:
        raise RequestError(f"each {kind} needs a logical_id of its own, got {name!r} beside {sorted(known)}")
    return name


def _read_body(message) -> Box:
    center, size = tuple(message.center_m), tuple(message.size_m)
    if len(center) != 3 or len(size) != 3 or not np.isfinite(center + size).all() or min(size) <= 0:
        raise RequestError(f"vehicle.body needs 3 finite center_m and 3 positive size_m, got {center} and {size}")
    return Box(center, size)


def write_policy(name: str, needs: Needs, message) -> None:
    """Fills a ``PolicyDescription``."""
    message.name, message.image_width_px, message.privileged = name, needs.image_width_px, needs.privileged
    message.cameras.extend(needs.cameras)
    message.lidars.extend(needs.lidars)


def read_policy(message) -> tuple[str, Needs]:
    """Name and needs of a ``PolicyDescription``."""
    width = {"image_width_px": message.image_width_px} if message.image_width_px else {}
    needs = Needs(tuple(message.cameras), tuple(message.lidars), privileged=message.privileged, **width)
    return message.name, needs


# -------------------------------------------------------------------------------------------------- sensors and actors


def write_encoded_image(image: EncodedImage, message) -> None:
    """Fills a ``RolloutCameraImage``."""
    entry = message.camera_image
    entry.logical_id, entry.image_bytes, entry.as_is = image.camera_id, image.data, image.as_is
    entry.frame_start_us, entry.frame_end_us = image.start_us, image.end_us


def read_encoded_image(message) -> EncodedImage:
    """The image of a ``RolloutCameraImage``; an instant may have no length here.

    Raises:
        RequestError: the exposure ends before it begins, or a time is beyond any clock.
    """
    entry = message.camera_image
    _check_exposure(entry.frame_start_us, entry.frame_end_us)
    return EncodedImage(
        entry.logical_id, entry.frame_start_us, entry.frame_end_us, bytes(entry.image_bytes), entry.as_is
    )  # fmt: skip


def write_sweep(frame: LidarFrame, message) -> None:
    """Fills a ``RolloutLidarSweep``."""
    message.logical_id = frame.lidar.id
    message.frame_start_us, message.frame_end_us = frame.start_us, frame.end_us
    write_lidar_frame(frame, message.sweep)


def read_sweep(message, lidars: Mapping[str, LidarModel]) -> LidarFrame:
    """The sweep of a ``RolloutLidarSweep``.

    Raises:
        RequestError: no such LiDAR, a time is malformed, values are not finite, or the buffers' lengths differ.
    """
    lidar = lidars.get(message.logical_id)
    if lidar is None:
        raise RequestError(f"LiDAR {message.logical_id!r} is not of this session; have {sorted(lidars)}")
    _check_exposure(message.frame_start_us, message.frame_end_us)
    nowhere = np.tile(np.eye(4), (2, 1, 1))
    asked = SensorRequest("", lidar, message.frame_start_us, message.frame_end_us, nowhere)
    with np.errstate(over="ignore"):  # of ranges that follow from points; the check below finds them
        frame = read_lidar_frame(message.sweep, asked)
    for name, values in (("points", frame.xyz_m), ("ranges", frame.range_m), ("intensities", frame.intensity)):
        if not np.isfinite(values).all():
            raise RequestError(f"LiDAR {lidar.id!r}: {name} must be finite")
    return frame


def write_actors(actors: Sequence[ActorState], message) -> None:
    """Fills the actors of a ``RolloutActors``."""
    for actor in actors:
        entry = message.actors.add(id=actor.id, label=actor.label, size_m=actor.size_m)
        entry.velocity_mps.extend(actor.velocity_mps.tolist())
        write_poses(actor.rig_from_box[None], [entry.rig_from_box])


def read_actors(message) -> tuple[ActorState, ...]:
    """The actors of a ``RolloutActors``.

    Raises:
        RequestError: a pose, size or velocity is malformed; the text names the actor.
    """
    if len(message.actors) > MAX_ACTORS:
        raise RequestError(f"there may be {MAX_ACTORS} actors, got {len(message.actors)}")
    check_time("timestamp_us", message.timestamp_us)
    poses = read_poses([a.rig_from_box for a in message.actors], [f"actor {a.id!r}" for a in message.actors])
    result = []
    for pose, entry in zip(poses, message.actors, strict=True):
        if len(entry.size_m) != 3 or len(entry.velocity_mps) != 2:
            raise RequestError(f"actor {entry.id!r} needs 3 size_m and 2 velocity_mps")
        x, y, z = bounded(f"actor {entry.id!r}: size_m", tuple(entry.size_m))
        velocity = np.array(bounded(f"actor {entry.id!r}: velocity_mps", tuple(entry.velocity_mps)))
        result.append(ActorState(entry.id, entry.label, (x, y, z), pose, velocity))
    return tuple(result)


def check_time(name: str, t_us: int) -> None:
    """Whether a time can be one.

    Raises:
        RequestError: it is beyond any clock.
    """
    if t_us > MAX_TIME_US:
        raise RequestError(f"{name} must be microseconds below 2**62, got {t_us}")


def _check_exposure(start_us: int, end_us: int) -> None:
    check_time("frame_end_us", max(start_us, end_us))
    if start_us > end_us:
        raise RequestError(f"a frame must not end before it starts, got [{start_us}, {end_us}]")


def bounded(name: str, values: tuple[float, ...]) -> tuple[float, ...]:
    """The values, if they can be sizes, speeds or rates.

    Raises:
        RequestError: they are not finite, or too large.
    """
    if not all(abs(value) < LARGEST for value in values):  # false for what is not finite
        raise RequestError(f"{name} must be finite and below {LARGEST:g}, got {values}")
    return values
