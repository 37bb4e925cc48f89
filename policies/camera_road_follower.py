"""Drives by one front image along free ground with the colour of the road right ahead.

The image is projected to the ground and compared with the colours right ahead of the car; of a fan of two-arc paths it
selects the one with most free space that keeps the lateral position on the road. No route, map, actors or depth.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim.policies._ground_view import (
    AHEAD_M,
    CELL_M,
    SIDE_M,
    RoadColour,
    borders,
    distance_to,
    ground_view,
    room_beside,
)
from nurec_sim.policies._paths import AccelOf, make_plan, pursue, toward_speed
from nurec_sim.types import Needs, Observation, Plan, Rig

CAR_HALF_WIDTH_M, SPARE_M = 1.25, 0.9
CURVATURES = np.array([-0.12, -0.08, -0.05, -0.03, -0.015, -0.006, 0.0, 0.006, 0.015, 0.03, 0.05, 0.08, 0.12])
FIRST_ARC_M, STEP_M = 10.0, 0.5
BORDER_LIMIT_M, BORDER_SLACK_M, NEARER, PLACE_M = 8.0, 0.2, 0.5, (8.0, 22.0)
BRAKE_MPS2, STOP_GAP_M, START_SPEED_MPS = 3.0, 3.0, 4.0
SPARE_WEIGHT, PLACE_WEIGHT, BEND_WEIGHT, S_BEND_WEIGHT, CHANGE_WEIGHT = 6.0, 9.0, 25.0, 12.0, 20.0
"""Weights of clearance, lateral displacement and curvature, in metres of free road ahead."""


class CameraRoadFollower:
    """Steers to free road-coloured ground; its speed allows stopping within the visible free distance."""

    name = "camera_road_follower"
    needs = Needs(cameras=("front",), image_width_px=320)

    def __init__(self) -> None:
        self.reset(Rig({}, {}), 0)

    def reset(self, rig: Rig, seed: int) -> None:
        """Resets road colour, lateral position and initial speed."""
        self.front_m = rig.body.center_m[0] + rig.body.size_m[0] / 2
        self.road = RoadColour()
        self.place_m: Float64[np.ndarray, " 2"] | None = None
        self.cruise_mps = 0.0
        self.curvature = 0.0

    def plan(self, observation: Observation) -> Plan:
        """Five seconds along the best path."""
        path, accel_of = self.decide(observation)
        return make_plan(observation, pursue(path, observation.ego.speed_mps, accel_of))

    def decide(self, observation: Observation) -> tuple[Float64[np.ndarray, "k 2"], AccelOf]:
        """The best path, and the acceleration along it; call it once per plan."""
        if self.cruise_mps == 0.0:
            self.cruise_mps = max(observation.ego.speed_mps, START_SPEED_MPS)
        seen, colours = ground_view(observation.cameras["front"])
        path, free_m = self.roomiest(self.road.blocked(seen, colours), seen)
        to_stop = max(0.0, free_m - self.front_m - STOP_GAP_M)

        def accel_of(t_s: float, driven_m: float, speed: float) -> float:
            safe = math.sqrt(2 * BRAKE_MPS2 * max(0.0, to_stop - driven_m))
            return max(-6.0, 4 * (safe - speed)) if safe < speed else toward_speed(min(self.cruise_mps, safe), speed)

        return path, accel_of

    def roomiest(
        self, blocked: Bool[np.ndarray, "x y"], seen: Bool[np.ndarray, "x y"]
    ) -> tuple[Float64[np.ndarray, "k 2"], float]:
        """The best two-arc path and its free distance."""
        first, second = (c.ravel() for c in np.meshgrid(CURVATURES, CURVATURES, indexing="ij"))
        station = np.arange(0.0, AHEAD_M, STEP_M)
        paths = two_arcs(first, second, station)
        row = np.clip((paths[..., 0] / CELL_M).astype(np.int64), 0, blocked.shape[0] - 1)
        column = np.floor((paths[..., 1] + SIDE_M) / CELL_M).astype(np.int64)
        outside = (column < 0) | (column >= blocked.shape[1])
        column = np.clip(column, 0, blocked.shape[1] - 1)
        near = paths[..., 0] < np.argmax(seen.any(axis=1)) * CELL_M  # below the image's lower edge
        hidden = outside | (~seen[row, column] & ~near)
        room = distance_to(blocked, CAR_HALF_WIDTH_M + SPARE_M)[row, column]
        free = free_along(station, hidden | (room < CAR_HALF_WIDTH_M))
        edges = borders(seen, blocked)
        room_to_edges = distance_to(edges, CAR_HALF_WIDTH_M + SPARE_M)[row, column]
        road = free_along(station, hidden | (room_to_edges < CAR_HALF_WIDTH_M))
        spare = mean_where(station < free[:, None], np.clip(room - CAR_HALF_WIDTH_M, 0.0, SPARE_M))
        # Free distance beyond the stopping distance from cruising speed has no value.
        enough = self.front_m + STOP_GAP_M + self.cruise_mps**2 / (2 * BRAKE_MPS2) + 4.0
        counted = (station < road[:, None]) & (station >= PLACE_M[0]) & (station < PLACE_M[1])
        gain = np.minimum(road, enough) + SPARE_WEIGHT * spare
        cost = PLACE_WEIGHT * self.displaced(edges, row, column, counted) + BEND_WEIGHT * np.abs(first)
        cost += S_BEND_WEIGHT * np.abs(second - first) + CHANGE_WEIGHT * np.abs(first - self.curvature)
        best = int(np.argmax(gain - cost))
        self.curvature = float(first[best])
        return paths[best, : max(2, int(free[best] / STEP_M))], float(free[best])

    def displaced(
        self, edges: Bool[np.ndarray, "x y"], row: np.ndarray, column: np.ndarray, counted: Bool[np.ndarray, "p s"]
    ) -> Float64[np.ndarray, " p"]:
        """Change of each path's distance to a road border relative to the initial one, in metres."""
        beside = room_beside(edges, BORDER_LIMIT_M)[:, row, column]
        rooms = np.stack([mean_where(counted, side) for side in beside])
        if self.place_m is None:
            self.place_m = rooms[:, len(CURVATURES) ** 2 // 2]  # of the straight path, the middle one
        farther = rooms - self.place_m[:, None]
        cost = np.clip(farther - BORDER_SLACK_M, 0.0, None) + NEARER * np.clip(-farther - BORDER_SLACK_M, 0.0, None)
        known = (self.place_m > 0) & (self.place_m < BORDER_LIMIT_M)
        return known @ cost


def free_along(station: Float64[np.ndarray, " s"], stops: Bool[np.ndarray, "p s"]) -> Float64[np.ndarray, " p"]:
    """Metres along each path to its first obstacle."""
    return np.where(stops.any(axis=1), station[np.argmax(stops, axis=1)], AHEAD_M)


def mean_where(mask: Bool[np.ndarray, "p s"], values: Float64[np.ndarray, "p s"]) -> Float64[np.ndarray, " p"]:
    """Mean of each row over its marked values; 0 where none is."""
    return (values * mask).sum(axis=1) / np.maximum(mask.sum(axis=1), 1)


def two_arcs(
    first: Float64[np.ndarray, " p"], second: Float64[np.ndarray, " p"], station: Float64[np.ndarray, " s"]
) -> Float64[np.ndarray, "p s 2"]:
    """Points of paths with curvature ``first`` for 10 m and ``second`` beyond."""
    bend = np.where(station < FIRST_ARC_M, first[:, None], second[:, None])
    step = np.diff(station, prepend=0.0)
    yaw = np.cumsum(bend * step, axis=1)
    middle = yaw - bend * step / 2
    return np.stack([np.cumsum(step * np.cos(middle), axis=1), np.cumsum(step * np.sin(middle), axis=1)], axis=-1)
