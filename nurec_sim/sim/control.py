"""Controllers that track a plan: pure pursuit with PI speed control, or perfect tracking.

A plan is anchored at the car's pose at planning time. Its stations are arc lengths from there, so the difference
between the station due now and the distance driven since then is the integral of the speed error: the "I" of the speed
control, without wind-up.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from nurec_sim.sim.vehicle import TICK_US, VehicleLimits, VehicleState, step
from nurec_sim.types import Plan

SPEED_GAIN, STATION_GAIN = 2.5, 2.0
LOOKAHEAD_S, LOOKAHEAD_M = 0.5, (3.0, 12.0)
PREVIEW_S = 0.2


class PlannedPath:
    """A validated plan in the world, anchored at its start state."""

    def __init__(self, plan: Plan, start: VehicleState, start_us: int) -> None:
        # The car's own state replaces past poses, so that the path has no jump at the anchor.
        future = plan.t_us > start_us
        local = plan.pose[future]
        c, s = math.cos(start.yaw_rad), math.sin(start.yaw_rad)
        x = start.x_m + c * local[:, 0] - s * local[:, 1]
        y = start.y_m + s * local[:, 0] + c * local[:, 1]
        self.t_s = np.concatenate([[0.0], (plan.t_us[future] - start_us) / 1e6])
        self.x_m, self.y_m = np.concatenate([[start.x_m], x]), np.concatenate([[start.y_m], y])
        self.yaw_rad = np.unwrap(np.concatenate([[start.yaw_rad], start.yaw_rad + local[:, 2]]))
        # The first pose may lie behind the car if the car is ahead of schedule; later steps are non-negative.
        # Stations must not decrease, so a step against the heading adds no arc length.
        steps = np.hypot(np.diff(self.x_m), np.diff(self.y_m))
        backwards = np.diff(self.x_m) * np.cos(self.yaw_rad[1:]) + np.diff(self.y_m) * np.sin(self.yaw_rad[1:]) < 0
        steps = np.where(backwards, 0.0, steps)
        steps[0] = local[0, 0] if local[0, 0] < 0 else math.hypot(local[0, 0], local[0, 1])
        self.station_m = np.concatenate([[0.0], np.cumsum(steps)])
        if len(steps) > 1:  # the first step also corrects the position, so it does not give the target speed
            # A difference quotient is the speed at the middle of its interval.
            self._speed_t_s = (self.t_s[1:-1] + self.t_s[2:]) / 2
            self._speed_mps = steps[1:] / np.diff(self.t_s)[1:]
        else:
            self._speed_t_s, self._speed_mps = self.t_s[1:], np.maximum(steps / self.t_s[1:], 0.0)
        # Stations must not decrease for interpolation: a first pose behind the car replaces the anchor.
        first = 1 if steps[0] <= 0 else 0
        self._line = (self.station_m[first:], self.x_m[first:], self.y_m[first:])

    def speed_at(self, t_s: float) -> float:
        """Target speed ``t_s`` after the anchor."""
        return float(np.interp(t_s, self._speed_t_s, self._speed_mps))

    def station_at(self, t_s: float) -> float:
        """Target arc length ``t_s`` after the anchor."""
        return float(np.interp(t_s, self.t_s, self.station_m))

    def point_at(self, station_m: float) -> tuple[float, float]:
        """Point on the plan, extrapolated straight beyond its end."""
        station, x, y = self._line
        beyond = max(0.0, station_m - float(station[-1]))
        yaw = float(self.yaw_rad[-1])
        return (
            float(np.interp(station_m, station, x)) + beyond * math.cos(yaw),
            float(np.interp(station_m, station, y)) + beyond * math.sin(yaw),
        )


Controller = Callable[[PlannedPath, VehicleState, int, float, VehicleLimits], VehicleState]


def pursuit_pi(
    path: PlannedPath, state: VehicleState, since_us: int, driven_m: float, limits: VehicleLimits
) -> VehicleState:
    """One tick of pure pursuit (rear axle, lookahead 0.5 s in 3..12 m) and PI speed control with feed-forward.

    Args:
        path: the plan in the world.
        state: the car at the start of the tick.
        since_us: time since the plan was made, microseconds.
        driven_m: distance driven since the plan was made, metres.
        limits: vehicle limits and wheelbase.

    Returns:
        the car at the end of the tick.
    """
    now_s = since_us / 1e6
    wanted, soon = path.speed_at(now_s), path.speed_at(now_s + PREVIEW_S)
    # The station error is the integral of the speed error. Being a difference of positions, it cannot wind up while an
    # actuator is saturated.
    behind_m = path.station_at(now_s) - driven_m
    # Feed-forward of the planned acceleration over the next 0.2 s, about twice the actuator lag, then P and I.
    accel = (soon - wanted) / PREVIEW_S + SPEED_GAIN * (wanted - state.speed_mps) + STATION_GAIN * behind_m
    if soon < 0.05 and wanted < 0.05 and behind_m < 0.1:
        accel = min(accel, -2.0)  # hold the brake at a standstill
    lookahead = min(max(LOOKAHEAD_S * state.speed_mps, LOOKAHEAD_M[0]), LOOKAHEAD_M[1])
    x, y = path.point_at(driven_m + lookahead)
    dx, dy = x - state.x_m, y - state.y_m
    # Pure pursuit (Coulter 1992): the arc through a point at distance d and lateral offset y has curvature 2 y / d^2.
    # d^2 is at least 1 m^2, otherwise the curvature diverges where the plan ends close to the car.
    left = -math.sin(state.yaw_rad) * dx + math.cos(state.yaw_rad) * dy
    steering = math.atan(2 * left * limits.wheelbase_m / max(dx * dx + dy * dy, 1.0))
    return step(state, steering, accel, limits)


def perfect(
    path: PlannedPath, state: VehicleState, since_us: int, driven_m: float, limits: VehicleLimits
) -> VehicleState:
    """One tick of moving exactly along the plan: isolates the policy from vehicle dynamics.

    Args:
        path: the plan in the world.
        state: the car at the start of the tick; only its yaw is used, for the yaw rate.
        since_us: time since the plan was made, microseconds.
        driven_m: unused; part of the signature of all controllers.
        limits: only the wheelbase is used.

    Returns:
        the planned state at the end of the tick; it may exceed the limits.
    """
    del driven_m
    t_s = (since_us + TICK_US) / 1e6
    speed, before = path.speed_at(t_s), path.speed_at(t_s - 0.1)
    yaw = float(np.interp(t_s, path.t_s, path.yaw_rad))
    yaw_rate = (yaw - state.yaw_rad) / (TICK_US / 1e6)
    # Inverse of the bicycle model, yaw rate = v tan(steering) / wheelbase; ill-conditioned at walking pace and below.
    steering = math.atan(limits.wheelbase_m * yaw_rate / speed) if speed > 0.5 else 0.0
    return VehicleState(
        float(np.interp(t_s, path.t_s, path.x_m)),
        float(np.interp(t_s, path.t_s, path.y_m)),
        yaw,
        speed,
        (speed - before) / 0.1,
        steering,
    )


CONTROLLERS: dict[str, Controller] = {"pursuit_pi": pursuit_pi, "perfect": perfect}
