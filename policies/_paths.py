"""Shared by the bundled policies: plan times, and a path-tracking vehicle model."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.types import Observation, Plan

STEP_S, STEPS = 0.1, 50
MAX_LATERAL_ACCEL_MPS2 = 2.5
MAX_CURVATURE_PER_M = 0.2
FRONT_M, HALF_WIDTH_M = 3.85, 0.95
"""Default distance from rear axle to front bumper, and half width."""

AccelOf = Callable[[float, float, float], float]
"""Target acceleration at (time s, distance m, speed m/s) along the path."""


def straight_plan(observation: Observation, speed_mps: float) -> Plan:
    """Straight ahead at constant speed."""
    times = STEP_S * np.arange(1, STEPS + 1)
    return make_plan(observation, np.column_stack([speed_mps * times, np.zeros(STEPS), np.zeros(STEPS)]))


def make_plan(observation: Observation, pose: Float64[np.ndarray, "50 3"]) -> Plan:
    """A plan of 5 s at 10 Hz."""
    return Plan(observation.t_us + 100_000 * np.arange(1, STEPS + 1, dtype=np.int64), pose)


def pursue(path_m: Float64[np.ndarray, "k 2"], speed_mps: float, accel_of: AccelOf) -> Float64[np.ndarray, "50 3"]:
    """Poses of a car that tracks a path from the origin for 5 s: pure pursuit, lookahead clip(0.8 v, 4, 15) m.

    ``path_m`` starts near the car, in its frame; it is extrapolated straight beyond its end. In curves, speed is
    limited to sqrt(2.5 m/s^2 / curvature).
    """
    line = extended(path_m)
    arc = geometry.arc_length(line)
    x, y, yaw, speed, driven = 0.0, 0.0, 0.0, speed_mps, 0.0
    station = float(geometry.project_to_polyline(np.zeros((1, 2)), line)[0][0])
    poses = np.empty((STEPS, 3))
    for i in range(STEPS):
        lookahead = min(max(0.8 * speed, 4.0), 15.0)
        dx = float(np.interp(station + lookahead, arc, line[:, 0])) - x
        dy = float(np.interp(station + lookahead, arc, line[:, 1])) - y
        left = -math.sin(yaw) * dx + math.cos(yaw) * dy
        curvature = 2 * left / max(dx * dx + dy * dy, 1.0)
        curvature = min(max(curvature, -MAX_CURVATURE_PER_M), MAX_CURVATURE_PER_M)
        accel = accel_of(i * STEP_S, driven, speed)
        bend_speed = math.sqrt(MAX_LATERAL_ACCEL_MPS2 / max(abs(curvature), 1e-6))
        if speed > bend_speed:
            accel = min(accel, max(-3.0, (bend_speed - speed) / STEP_S))
        after = max(0.0, speed + accel * STEP_S)
        step = (speed + after) / 2 * STEP_S
        x += step * math.cos(yaw + curvature * step / 2)
        y += step * math.sin(yaw + curvature * step / 2)
        yaw += curvature * step
        speed, driven, station = after, driven + step, station + step
        poses[i] = x, y, yaw
    return poses


def extended(path_m: Float64[np.ndarray, "k 2"], by_m: float = 150.0) -> Float64[np.ndarray, "j 2"]:
    """A path from the car on, without duplicate points, extrapolated straight beyond its end."""
    line = [np.zeros(2)]
    for point in np.asarray(path_m, np.float64):
        # The origin is not a waypoint: a first point beside or behind the car is skipped.
        if np.linalg.norm(point - line[-1]) > 0.05 and (len(line) > 1 or point[0] > 0.0):
            line.append(point)
    tangent = line[-1] - line[-2] if len(line) > 1 else np.array([1.0, 0.0])
    line.append(line[-1] + tangent / np.linalg.norm(tangent) * by_m)
    return np.array(line)


def route_speed(observation: Observation, distance_m: float) -> float:
    """Recorded speed at a distance along the route; 0 if the route is empty."""
    if len(observation.route_m) == 0:
        return 0.0
    stations = np.linalg.norm(observation.route_m[0]) + geometry.arc_length(observation.route_m)
    return float(np.interp(distance_m, stations, observation.route_speed_mps))


def toward_speed(wanted_mps: float, speed_mps: float) -> float:
    """Acceleration that reaches the target speed in about a second, between -3 and 1.5 m/s^2."""
    return min(max(wanted_mps - speed_mps, -3.0), 1.5)
