"""Ego motion: from poses, and from the velocities that a client reports where they agree with the poses.

AlpaSim's runtime (commit 3032e0c) sends velocities in the local frame with its first poses, and zeros for as long as
the car is made to follow the recording; only later ones are what they should be. Its poses are always right.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from nurec_sim import geometry
from nurec_sim.serving.wire.driving_states import ReportedMotion, ReportedState
from nurec_sim.types import EgoState

STEP_US = 40_000
"""Shortest interval over which motion is measured, if poses cover it: a frame of 25 Hz."""
LEAST_STEP_US, LONGEST_STEP_US = 5_000, 1_000_000
"""Limits of the interval: float32 poses do not resolve less, and within more a car can stop or turn."""
SPEED_SLACK_MPS, YAW_RATE_SLACK_RADPS, SLACK = 0.1, 0.05, 0.15
"""Reported motion agrees with the poses within an absolute tolerance plus a relative one (``SLACK``).

The poses give the mean over a step: from 10 m/s, braking by 8 m/s^2 for 0.1 s, that is 4 % more than the speed at its
end. A velocity in the local frame passes only within 9 degrees of the rig's heading, where its x is 1 % too small.
"""
WHEELBASE_M = 2.85
"""Assumed wheelbase, to compute the steering angle from the yaw rate."""
LEAST_STEERED_MPS = 0.5


@dataclass(frozen=True)
class _Measured:
    """Mean velocity ahead and to the left, and yaw rate, over a step between two poses."""

    ahead_mps: float
    left_mps: float
    yaw_rate_radps: float


def ego_states(told: Sequence[ReportedState], which: Iterable[int]) -> list[EgoState]:
    """Ego states at some of the reported states, ordered by time, with the motion to be used.

    Motion in fields of ours is taken as it is. Otherwise it is that of the poses, measured back from each state, or
    forth from the first one. A dynamic state whose velocity agrees with it is the better one, being of the instant; its
    yaw rate has to agree too. With a single pose there is nothing to compare: the size of the velocity counts, which is
    the same in any frame; without any report the speed is 0.
    """
    return [_ego_state(told[i], _measured(told, i)) for i in which]


def _ego_state(state: ReportedState, measured: _Measured | None) -> EgoState:
    told = state.motion
    if told is not None and told.exact:
        speed, accel, yaw_rate, steering = told.velocity_mps[0], told.accel_mps2, told.yaw_rate_radps, told.steering_rad
        return EgoState(state.t_us, state.world_from_rig, speed, accel, yaw_rate, steering)
    speed, accel, yaw_rate = _used_motion(told, measured)
    steering = math.atan(yaw_rate * WHEELBASE_M / speed) if speed > LEAST_STEERED_MPS else 0.0
    return EgoState(state.t_us, state.world_from_rig, speed, accel, yaw_rate, steering)


def _used_motion(told: ReportedMotion | None, measured: _Measured | None) -> tuple[float, float, float]:
    """Speed, acceleration and yaw rate."""
    if measured is None:
        return (0.0, 0.0, 0.0) if told is None else (math.hypot(*told.velocity_mps), 0.0, told.yaw_rate_radps)
    speed, yaw_rate = measured.ahead_mps, measured.yaw_rate_radps
    if told is None:
        return speed, 0.0, yaw_rate
    off = math.hypot(told.velocity_mps[0] - speed, told.velocity_mps[1] - measured.left_mps)
    if off > SPEED_SLACK_MPS + SLACK * abs(speed):
        return speed, 0.0, yaw_rate
    if abs(told.yaw_rate_radps - yaw_rate) <= YAW_RATE_SLACK_RADPS + SLACK * abs(yaw_rate):
        yaw_rate = told.yaw_rate_radps
    return told.velocity_mps[0], told.accel_mps2, yaw_rate


def _measured(told: Sequence[ReportedState], index: int) -> _Measured | None:
    """Motion between a state and the next one before it that is far enough in time, or else after it."""
    here = told[index]
    before = _far_enough(here, told[:index][::-1])
    one, two = (before, here) if before is not None else (here, _far_enough(here, told[index + 1 :]))
    if two is None:
        return None
    step = geometry.inverse(one.world_from_rig) @ two.world_from_rig
    elapsed_s, turn = (two.t_us - one.t_us) / 1e6, float(geometry.yaw_of(step))
    # On an arc, the chord has the heading of the middle.
    c, s = math.cos(turn / 2), math.sin(turn / 2)
    x, y = step[0, 3] / elapsed_s, step[1, 3] / elapsed_s
    return _Measured(float(c * x + s * y), float(c * y - s * x), turn / elapsed_s)


def _far_enough(here: ReportedState, others: Sequence[ReportedState]) -> ReportedState | None:
    """Of states that are ever farther in time, the first that is a step away, or the farthest that will do."""
    found = None
    for other in others:
        elapsed_us = abs(other.t_us - here.t_us)
        if elapsed_us > LONGEST_STEP_US:
            break
        if elapsed_us >= LEAST_STEP_US:
            found = other
        if elapsed_us >= STEP_US:
            break
    return found
