"""Where the car was and how it moved <-> messages of the egodriver interface.

Poses are of the rig in the session's local frame, which is our world. A dynamic state should be in the rig frame of its
pose: x forward, so a car that does not slide has no other speed. Not every client keeps to that, so this module only
reads what is reported; ``serving.driver.motion`` decides what is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nurec_sim.errors import RequestError
from nurec_sim.serving.wire.driving import MAX_POSES, bounded, check_time
from nurec_sim.serving.wire.requests import read_poses, write_poses
from nurec_sim.types import EgoState, Matrix4


@dataclass(frozen=True)
class ReportedMotion:
    """Ego motion as reported by a client: velocity along x and y, acceleration along x.

    ``exact`` if it comes in fields of ours; only then there is a steering angle. Else it is a dynamic state.
    """

    velocity_mps: tuple[float, float]
    accel_mps2: float
    yaw_rate_radps: float
    steering_rad: float = 0.0
    exact: bool = False


@dataclass(frozen=True)
class ReportedState:
    """A rig pose, and the motion that the client reports there, if any."""

    t_us: int
    world_from_rig: Matrix4
    motion: ReportedMotion | None = None


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


def read_states(message) -> list[ReportedState]:
    """The states of a ``RolloutEgoTrajectory``. Fewer dynamic states than poses belong to the last poses.

    Raises:
        RequestError: a pose, a time or a motion is malformed; the text names it.
    """
    poses, dynamic, exact = message.trajectory.poses, message.dynamic_states, message.motion
    if len(poses) > MAX_POSES:
        raise RequestError(f"a trajectory may have {MAX_POSES} poses, got {len(poses)}")
    if len(dynamic) > len(poses) or len(exact) not in (0, len(poses)):
        raise RequestError(
            f"dynamic_states must be at most one a pose, and motion one a pose or none; "
            f"got {len(dynamic)} and {len(exact)} for {len(poses)} poses"
        )
    world_from_rig = read_poses([p.pose for p in poses], [f"trajectory[{i}]" for i in range(len(poses))])
    states, first = [], len(poses) - len(dynamic)
    for i, sample in enumerate(poses):
        check_time(f"trajectory[{i}].timestamp_us", sample.timestamp_us)
        motion = None
        if len(exact):
            motion = _read_exact(f"motion[{i}]", exact[i])
        elif i >= first and dynamic[i - first].HasField("linear_velocity"):
            motion = _read_dynamic(f"dynamic_states[{i - first}]", dynamic[i - first])
        states.append(ReportedState(sample.timestamp_us, world_from_rig[i], motion))
    return states


def _read_exact(name: str, motion) -> ReportedMotion:
    values = (motion.speed_mps, motion.accel_mps2, motion.yaw_rate_radps, motion.steering_rad)
    speed, accel, yaw_rate, steering = bounded(name, values)
    return ReportedMotion((speed, 0.0), accel, yaw_rate, steering, exact=True)


def _read_dynamic(name: str, dynamic) -> ReportedMotion:
    velocity = dynamic.linear_velocity
    values = (velocity.x, velocity.y, dynamic.linear_acceleration.x, dynamic.angular_velocity.z)
    x, y, accel, yaw_rate = bounded(name, values)
    return ReportedMotion((x, y), accel, yaw_rate)
