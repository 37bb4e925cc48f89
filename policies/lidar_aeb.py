"""Automatic emergency braking: follows the recorded route and brakes for LiDAR obstacles."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.policies._paths import (
    FRONT_M,
    HALF_WIDTH_M,
    extended,
    make_plan,
    pursue,
    route_speed,
    toward_speed,
)
from nurec_sim.types import LidarFrame, Needs, Observation, Plan, Rig

CELL_M, RANGE_M, SIDE_M = 1.0, 60.0, 12.0
MIN_HEIGHT_M, MAX_HEIGHT_M = 0.5, 2.2
CORRIDOR_MARGIN_M, SIDE_MARGIN_M = 0.25, 2.0
MIN_POINTS, STEEPEST = 5, 0.06
TTC_S, BRAKE_MPS2, STOP_GAP_M = 2.0, 4.0, 2.0
"""Brakes if the time to collision is below 2 s, or the distance below v^2 / (2 * 4) + 2 m."""


class LidarAeb:
    """Uses only the LiDAR points in its own corridor."""

    name = "lidar_aeb"
    needs = Needs(lidars=("any",))

    def __init__(self) -> None:
        self.reset(Rig({}, {}), 0)

    def reset(self, rig: Rig, seed: int) -> None:
        """Resets the obstacle of the last plan."""
        self.front_m = rig.body.center_m[0] + rig.body.size_m[0] / 2 if rig.lidars else FRONT_M
        self.half_width_m = rig.body.size_m[1] / 2 if rig.lidars else HALF_WIDTH_M
        self.last: tuple[int, float] | None = None

    def plan(self, observation: Observation) -> Plan:
        """Five seconds along the route, braking for obstacles."""
        brake = self.brake_for(observation, extended(observation.route_m))

        def accel_of(t_s: float, driven_m: float, now: float) -> float:
            return -brake if brake else toward_speed(route_speed(observation, driven_m), now)

        return make_plan(observation, pursue(observation.route_m, observation.ego.speed_mps, accel_of))

    def brake_for(self, observation: Observation, line: Float64[np.ndarray, "k 2"]) -> float:
        """Deceleration (m/s^2) for the nearest obstacle along a path; 0 if none is needed."""
        speed = observation.ego.speed_mps
        distance, lead_speed = self.obstacle(observation, line)
        if distance is None:
            return 0.0
        closing = speed - lead_speed
        too_soon = closing > 0.1 and distance / closing < TTC_S
        braking_m = max(0.0, speed**2 - lead_speed**2) / (2 * BRAKE_MPS2) + STOP_GAP_M
        if not (too_soon or distance < braking_m):
            return 0.0
        return min(max(speed**2 / (2 * max(distance - STOP_GAP_M / 2, 0.5)), BRAKE_MPS2), 8.0)

    def obstacle(self, observation: Observation, line: Float64[np.ndarray, "k 2"]) -> tuple[float | None, float]:
        """Metres to the nearest obstacle along a path (None when free) and its speed; call it once per plan."""
        distance = self.free_distance(points_in_rig(observation.lidars["any"]), line)
        speed = self.speed_of_obstacle(observation, distance)
        self.last = None if distance is None else (observation.t_us, distance)
        return distance, speed

    def free_distance(self, points: Float64[np.ndarray, "n 3"], line: Float64[np.ndarray, "k 2"]) -> float | None:
        """Metres from the front bumper to the nearest obstacle in the corridor along ``line``; None when free."""
        obstacles = points[above_ground(points)]
        sides = line[line[:, 0] < RANGE_M, 1]
        between = (obstacles[:, 1] > sides.min() - SIDE_MARGIN_M) & (obstacles[:, 1] < sides.max() + SIDE_MARGIN_M)
        obstacles = obstacles[between]
        if len(obstacles) == 0:
            return None
        station, lateral = geometry.project_to_polyline(obstacles[:, :2], line)
        inside = (np.abs(lateral) < self.half_width_m + CORRIDOR_MARGIN_M) & (station > self.front_m + 0.2)
        nearest = np.sort(station[inside & (station < RANGE_M)])
        if len(nearest) < MIN_POINTS:
            return None
        # Isolated points are noise; an obstacle has five points within a metre.
        solid = nearest[MIN_POINTS - 1 :] - nearest[: len(nearest) - MIN_POINTS + 1] < 1.0
        return float(nearest[np.argmax(solid)]) - self.front_m if solid.any() else None

    def speed_of_obstacle(self, observation: Observation, distance: float | None) -> float:
        """Obstacle speed along the path from the last two sweeps; 0 if newly detected."""
        if distance is None or self.last is None:
            return 0.0
        elapsed_s = (observation.t_us - self.last[0]) / 1e6
        past = [state for state in observation.history if state.t_us >= self.last[0]]
        driven = float(np.linalg.norm(past[-1].world_from_rig[:2, 3] - past[0].world_from_rig[:2, 3])) if past else 0.0
        speed = (distance + driven - self.last[1]) / elapsed_s
        return speed if 0.5 < speed < 40.0 else 0.0


def points_in_rig(frame: LidarFrame) -> Float64[np.ndarray, "n 3"]:
    """Returns in the rig frame, in the region ahead."""
    points = geometry.transform_points(frame.lidar.rig_from_lidar, frame.xyz_m)
    ahead = (points[:, 0] > 0) & (points[:, 0] < RANGE_M) & (np.abs(points[:, 1]) < SIDE_M)
    # Rendered sweeps have stray returns below the road, which would turn the road around them into obstacles.
    return points[ahead & (points[:, 2] > -0.3 - STEEPEST * points[:, 0])]


def above_ground(points: Float64[np.ndarray, "n 3"]) -> np.ndarray:
    """Mask of points above the ground, by height over the lowest point in the 3 x 3 neighbourhood of 1 m cells."""
    columns = int(2 * SIDE_M / CELL_M) + 2
    rows = int(RANGE_M / CELL_M) + 2
    row = (points[:, 0] / CELL_M).astype(np.int64) + 1
    column = ((points[:, 1] + SIDE_M) / CELL_M).astype(np.int64) + 1
    ground = np.full((rows + 1, columns + 1), np.inf)
    np.minimum.at(ground, (row, column), points[:, 2])
    around = [np.roll(ground, (i, j), axis=(0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    height = points[:, 2] - np.minimum.reduce(around)[row, column]
    return (height > MIN_HEIGHT_M) & (height < MAX_HEIGHT_M)
