"""Follows the recorded route and brakes for what the front image does not show as free road."""

from __future__ import annotations

import math

import numpy as np

from nurec_sim import geometry
from nurec_sim.policies._ground_view import AHEAD_M, CELL_M, SIDE_M, RoadColour, distance_to, ground_view
from nurec_sim.policies._paths import FRONT_M, HALF_WIDTH_M, extended, make_plan, pursue, route_speed, toward_speed
from nurec_sim.types import Needs, Observation, Plan, Rig

STEP_M, BRAKE_MPS2, STOP_GAP_M = 0.5, 3.0, 3.0


class CameraBrake:
    """Pure pursuit on the route, at a speed that can stop within the road-coloured ground ahead."""

    name = "camera_brake"
    needs = Needs(cameras=("front",), image_width_px=320)

    def __init__(self) -> None:
        self.reset(Rig({}, {}), 0)

    def reset(self, rig: Rig, seed: int) -> None:
        """Forgets the colour of the road."""
        self.front_m = rig.body.center_m[0] + rig.body.size_m[0] / 2 if rig.cameras else FRONT_M
        self.half_width_m = rig.body.size_m[1] / 2 if rig.cameras else HALF_WIDTH_M
        self.road = RoadColour()

    def plan(self, observation: Observation) -> Plan:
        """Five seconds along the route."""
        seen, colours = ground_view(observation.cameras["front"])
        blocked = self.road.blocked(seen, colours)
        to_stop = max(0.0, self.free_distance(blocked, seen, extended(observation.route_m)) - self.front_m - STOP_GAP_M)

        def accel_of(t_s: float, driven_m: float, speed: float) -> float:
            safe = math.sqrt(2 * BRAKE_MPS2 * max(0.0, to_stop - driven_m))
            wanted = route_speed(observation, driven_m)
            return max(-6.0, 4 * (safe - speed)) if safe < speed else toward_speed(min(wanted, safe), speed)

        return make_plan(observation, pursue(observation.route_m, observation.ego.speed_mps, accel_of))

    def free_distance(self, blocked: np.ndarray, seen: np.ndarray, line: np.ndarray) -> float:
        """Metres along a line to the first cell that is not free over the width of the car; ``AHEAD_M`` when free."""
        station = np.arange(0.0, AHEAD_M, STEP_M)
        arc = geometry.arc_length(line)
        x, y = (np.interp(station, arc, line[:, axis]) for axis in (0, 1))
        row, column = (x / CELL_M).astype(np.int64), np.floor((y + SIDE_M) / CELL_M).astype(np.int64)
        inside = (row >= 0) & (row < blocked.shape[0]) & (column >= 0) & (column < blocked.shape[1])
        room = distance_to(blocked, self.half_width_m + CELL_M)
        # What lies outside of the image is not known to be blocked: the route goes on there.
        stops = np.zeros(len(station), bool)
        stops[inside] = (room < self.half_width_m)[row[inside], column[inside]] & seen[row[inside], column[inside]]
        return float(station[np.argmax(stops)]) if stops.any() else AHEAD_M
