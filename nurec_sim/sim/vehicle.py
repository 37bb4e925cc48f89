"""Kinematic bicycle model at the rear axle, exact for constant steering and acceleration within a step."""

from __future__ import annotations

import math
from dataclasses import dataclass

TICK_US = 10_000
"""Time step of vehicle model and controller."""


@dataclass(frozen=True)
class VehicleLimits:
    """Vehicle limits; defaults as in ``docs/closed_loop.md``."""

    wheelbase_m: float = 2.85
    steering_rad: float = 0.6
    steering_rate_radps: float = 0.6
    min_accel_mps2: float = -8.0
    max_accel_mps2: float = 4.0
    lag_s: float = 0.1


@dataclass(frozen=True)
class VehicleState:
    """Planar pose of the rear axle in the world, speed, and lagged actuator states."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    accel_mps2: float = 0.0
    steering_rad: float = 0.0

    def yaw_rate_radps(self, limits: VehicleLimits) -> float:
        """Yaw rate from steering angle and speed."""
        return self.speed_mps * math.tan(self.steering_rad) / limits.wheelbase_m


def advance(state: VehicleState, dt_s: float, limits: VehicleLimits) -> VehicleState:
    """Moves for ``dt_s`` with constant steering and acceleration: the rear axle follows an exact circular arc.

    A braking car stops within the step and never rolls backwards.
    """
    speed, accel = state.speed_mps, state.accel_mps2
    moving_s = dt_s
    # A negative final speed implies braking (accel < 0), so the car stops after speed / -accel.
    if speed + accel * dt_s < 0:
        moving_s = speed / -accel
    distance = speed * moving_s + 0.5 * accel * moving_s**2
    turn = distance * math.tan(state.steering_rad) / limits.wheelbase_m
    half = turn / 2
    # The displacement along a circular arc is its chord, at the mean heading of start and end.
    # Chord of the arc; sin(x)/x by its series near 0, where the quotient loses precision.
    chord = distance * (math.sin(half) / half if abs(half) > 1e-4 else 1 - half**2 / 6)
    return VehicleState(
        state.x_m + chord * math.cos(state.yaw_rad + half),
        state.y_m + chord * math.sin(state.yaw_rad + half),
        state.yaw_rad + turn,
        max(0.0, speed + accel * moving_s),
        accel if moving_s == dt_s else 0.0,
        state.steering_rad,
    )


def actuate(
    state: VehicleState, steering_rad: float, accel_mps2: float, dt_s: float, limits: VehicleLimits
) -> VehicleState:
    """Actuator response to commands: limits, first-order lag, bounded steering rate.

    Args:
        state: the car; pose and speed are kept.
        steering_rad: commanded steering angle of the front wheels, left positive.
        accel_mps2: commanded longitudinal acceleration.
        dt_s: duration of the command.
        limits: vehicle limits and lag.
    """
    # Exact solution of the lag x' = (target - x) / lag over the step, so the response is independent of its length.
    follow = 1 - math.exp(-dt_s / limits.lag_s)
    target = _clip(steering_rad, -limits.steering_rad, limits.steering_rad)
    most = limits.steering_rate_radps * dt_s
    steering = state.steering_rad + _clip(follow * (target - state.steering_rad), -most, most)
    wanted = _clip(accel_mps2, limits.min_accel_mps2, limits.max_accel_mps2)
    accel = state.accel_mps2 + follow * (wanted - state.accel_mps2)
    return VehicleState(state.x_m, state.y_m, state.yaw_rad, state.speed_mps, accel, steering)


def step(
    state: VehicleState, steering_rad: float, accel_mps2: float, limits: VehicleLimits, dt_s: float = TICK_US / 1e6
) -> VehicleState:
    """One step of the car under commands: actuators first, then the exact arc.

    Args:
        state: the car at the start of the step.
        steering_rad: commanded steering angle of the front wheels, left positive.
        accel_mps2: commanded longitudinal acceleration.
        limits: vehicle limits.
        dt_s: length of the step.
    """
    return advance(actuate(state, steering_rad, accel_mps2, dt_s, limits), dt_s, limits)


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
