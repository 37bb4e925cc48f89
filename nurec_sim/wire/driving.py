"""Driving sessions, ego states, images, sweeps and actors <-> messages of the egodriver interface.

Ego poses are of the rig in the session's local frame, which is our world. A dynamic state is in the rig frame of its
pose: x forward, so a car that does not slide has no other speed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from google.protobuf import message_factory

from nurec_sim.errors import RequestError
from nurec_sim.types import (
    ActorState,
    Box,
    CameraModel,
    EgoState,
    LidarFrame,
    LidarModel,
    Needs,
    Rig,
    SensorRequest,
)  # fmt: skip
from nurec_sim.wire.messages import Method, pool
from nurec_sim.wire.poses import MAX_TIME_US, read_poses, write_poses
from nurec_sim.wire.requests import read_lidar_frame, write_lidar_frame
from nurec_sim.wire.sensors import read_camera, read_lidar, read_mounting, write_camera, write_lidar, write_mounting

DRIVER_SERVICE = "egodriver.EgodriverService"
DRIVER_METHODS = {
    method.name: Method(
        message_factory.GetMessageClass(method.input_type), message_factory.GetMessageClass(method.output_type)
    )
    for method in pool.FindServiceByName(DRIVER_SERVICE).methods
}
"""Every procedure of a driver by name."""

MAX_SENSORS, MAX_POSES, MAX_ACTORS = 64, 5_000, 5_000
LARGEST = 1e6
"""No size, speed or rate is larger."""
WHEELBASE_M = 2.85
"""Of the car that a client does not describe: its steering angle follows from its yaw rate."""


@dataclass(frozen=True)
class SessionStart:
    """What a client says when it opens a session. ``sensor_ids`` are the policy's names of sensors, where it says."""

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
        entry = vehicle.available_cameras.add(logical_id=camera.id)
        write_camera(camera, entry.intrinsics)
        write_mounting(camera.rig_from_camera, entry.rig_to_camera)
    for lidar in start.rig.lidars.values():
        entry = vehicle.available_lidars.add(logical_id=lidar.id)
        write_lidar(lidar, entry.lidar_config)
        write_mounting(lidar.rig_from_lidar, entry.rig_from_lidar)
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
        try:
            camera = read_camera(entry.intrinsics, 0, 0, {})
        except RequestError as error:
            raise RequestError(f"available_cameras, camera {name!r}: {error}") from None
        mounting = read_mounting(entry.rig_to_camera, f"rig_to_camera of camera {name!r}")
        cameras[name] = replace(camera, id=name, rig_from_camera=mounting)
    lidars: dict[str, LidarModel] = {}
    for entry in vehicle.available_lidars:
        name = _new_name("LiDAR", entry.logical_id, lidars)
        mounting = read_mounting(entry.rig_from_lidar, f"rig_from_lidar of LiDAR {name!r}")
        lidars[name] = replace(read_lidar(entry.lidar_config), id=name, rig_from_lidar=mounting)
    body = _read_body(vehicle.body) if vehicle.HasField("body") else Rig({}, {}).body
    rig = Rig(cameras, lidars, body)
    return SessionStart(message.session_uuid, message.random_seed, rig, dict(vehicle.sensor_ids))


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


# ----------------------------------------------------------------------------------------------------------------- ego


def write_states(states: Sequence[EgoState], message) -> None:
    """Fills a ``RolloutEgoTrajectory``."""
    samples = [message.trajectory.poses.add(timestamp_us=state.t_us) for state in states]
    write_poses(np.array([state.world_from_rig for state in states]), [sample.pose for sample in samples])
    for state in states:
        dynamic = message.dynamic_states.add()
        dynamic.linear_velocity.x, dynamic.linear_acceleration.x = state.speed_mps, state.accel_mps2
        dynamic.linear_acceleration.y = state.speed_mps * state.yaw_rate_radps
        dynamic.angular_velocity.z = state.yaw_rate_radps
        message.motion.add(
            speed_mps=state.speed_mps, accel_mps2=state.accel_mps2, yaw_rate_radps=state.yaw_rate_radps,
            steering_rad=state.steering_rad,
        )  # fmt: skip


def read_states(message) -> list[EgoState]:
    """The ego states of a ``RolloutEgoTrajectory``; the speed is NaN where the message does not tell it.

    Fewer dynamic states than poses belong to the last poses.

    Raises:
        RequestError: a pose, a time or a motion is malformed; the text names it.
    """
    poses, dynamic, motion = message.trajectory.poses, message.dynamic_states, message.motion
    if len(poses) > MAX_POSES:
        raise RequestError(f"a trajectory may have {MAX_POSES} poses, got {len(poses)}")
    if len(dynamic) > len(poses) or len(motion) not in (0, len(poses)):
        raise RequestError(
            f"dynamic_states must be at most one a pose, and motion one a pose or none; "
            f"got {len(dynamic)} and {len(motion)} for {len(poses)} poses"
        )
    world_from_rig = read_poses([p.pose for p in poses], [f"trajectory[{i}]" for i in range(len(poses))])
    states, first = [], len(poses) - len(dynamic)
    for i, sample in enumerate(poses):
        check_time(f"trajectory[{i}].timestamp_us", sample.timestamp_us)
        values: tuple[float, ...] = (math.nan, 0.0, 0.0, 0.0)
        if len(motion):
            values = _bounded(f"motion[{i}]", (motion[i].speed_mps, motion[i].accel_mps2, motion[i].yaw_rate_radps,
                                              motion[i].steering_rad))  # fmt: skip
        elif i >= first and dynamic[i - first].HasField("linear_velocity"):
            values = _read_dynamic(f"dynamic_states[{i - first}]", dynamic[i - first])
        states.append(EgoState(sample.timestamp_us, world_from_rig[i], *values))
    return states


def _read_dynamic(name: str, dynamic) -> tuple[float, ...]:
    speed, accel = dynamic.linear_velocity.x, dynamic.linear_acceleration.x
    yaw_rate = dynamic.angular_velocity.z
    _bounded(name, (speed, accel, yaw_rate))
    steering = math.atan(yaw_rate * WHEELBASE_M / speed) if speed > 0.5 else 0.0
    return speed, accel, yaw_rate, steering


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
        x, y, z = _bounded(f"actor {entry.id!r}: size_m", tuple(entry.size_m))
        velocity = np.array(_bounded(f"actor {entry.id!r}: velocity_mps", tuple(entry.velocity_mps)))
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


def _bounded(name: str, values: tuple[float, ...]) -> tuple[float, ...]:
    if not all(abs(value) < LARGEST for value in values):  # false for what is not finite
        raise RequestError(f"{name} must be finite and below {LARGEST:g}, got {values}")
    return values
