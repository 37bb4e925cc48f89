"""Follows the recorded route and keeps its distance to ground-truth actors: the upper scripted baseline.

Privileged: it uses ground-truth actors instead of sensors. Steering is pure pursuit, speed the Intelligent Driver Model
(Treiber et al. 2000) behind the nearest actor that is, or by constant velocity will be, in its corridor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nurec_sim import geometry
from nurec_sim.policies._paths import FRONT_M, HALF_WIDTH_M, extended, make_plan, pursue, route_speed
from nurec_sim.types import ActorState, Needs, Observation, Plan, Rig

TIME_GAP_S, STANDSTILL_GAP_M, ACCEL_MPS2, COMFORT_BRAKE_MPS2, HARDEST_BRAKE_MPS2 = 1.5, 2.0, 1.5, 3.0, 8.0
CORRIDOR_MARGIN_M = 0.3
FORESIGHT_S = np.arange(0.0, 3.1, 0.5)
REACH_MARGIN_M = 3.0


@dataclass(frozen=True)
class Obstacle:
    """An obstacle in the corridor: current distance from the front bumper, and speed along the path."""

    gap_m: float
    speed_mps: float


class RouteFollower:
    """Pure pursuit on the route, IDM behind ground-truth actors."""

    name = "route_follower"
    needs = Needs(privileged=True)

    def __init__(self) -> None:
        self.front_m, self.half_width_m = FRONT_M, HALF_WIDTH_M

    def reset(self, rig: Rig, seed: int) -> None:
        """Stores the dimensions of the car."""
        self.front_m = rig.body.center_m[0] + rig.body.size_m[0] / 2
        self.half_width_m = rig.body.size_m[1] / 2

    def plan(self, observation: Observation) -> Plan:
        """Five seconds along the route."""
        line = extended(observation.route_m)
        ego_speed = observation.ego.speed_mps
        found = (self.obstacle(actor, line, ego_speed) for actor in observation.actors or ())
        obstacles = [obstacle for obstacle in found if obstacle is not None]

        def accel_of(t_s: float, driven_m: float, speed: float) -> float:
            wanted = route_speed(observation, driven_m)
            gaps = [(max(o.gap_m + o.speed_mps * t_s - driven_m, 0.01), o.speed_mps) for o in obstacles]
            return min([_free(wanted, speed)] + [idm(speed, wanted, gap, lead) for gap, lead in gaps])

        return make_plan(observation, pursue(observation.route_m, ego_speed, accel_of))

    def obstacle(self, actor: ActorState, line: np.ndarray, ego_speed: float) -> Obstacle | None:
        """An actor as an obstacle on the path, at the earliest time it blocks the ego."""
        if actor.rig_from_box[0, 3] + actor.size_m[0] / 2 < 0:
            return None  # behind the ego
        corners = geometry.box_corners_xy(actor.rig_from_box, actor.size_m[0], actor.size_m[1])
        outline = np.concatenate([corners, (corners + np.roll(corners, 1, axis=0)) / 2])
        # Speeds along and across the path, so that an actor following a curve stays in the corridor.
        station, lateral = geometry.project_to_polyline(outline, line)
        soon = geometry.project_to_polyline(outline + 0.1 * actor.velocity_mps, line)
        along, across = float((soon[0] - station).mean()) / 0.1, float((soon[1] - lateral).mean()) / 0.1
        for t_s in FORESIGHT_S:
            beside = lateral + across * t_s
            crosses = beside.min() < 0 < beside.max()
            gap = float(station.min()) + along * t_s - self.front_m
            if not crosses and np.abs(beside).min() > self.half_width_m + CORRIDOR_MARGIN_M:
                continue
            if gap < -self.front_m / 2 or (t_s > 0 and gap > ego_speed * t_s + REACH_MARGIN_M):
                continue  # passed, or still out of reach, by then
            lead_speed = max(0.0, along)
            return Obstacle(gap - lead_speed * t_s, lead_speed)
        return None


def _free(wanted: float, speed: float) -> float:
    """Acceleration on a free road."""
    if speed > wanted:
        return max(-COMFORT_BRAKE_MPS2, wanted - speed)
    return ACCEL_MPS2 * (1 - (speed / max(wanted, 0.1)) ** 4)


def idm(speed: float, wanted: float, gap: float, lead_speed: float) -> float:
    """The Intelligent Driver Model's acceleration behind a car at ``gap`` metres."""
    approach = speed * (speed - lead_speed) / (2 * math.sqrt(ACCEL_MPS2 * COMFORT_BRAKE_MPS2))
    desired = STANDSTILL_GAP_M + max(0.0, speed * TIME_GAP_S + approach)
    free = _free(wanted, speed)
    return max(-HARDEST_BRAKE_MPS2, min(free, free - ACCEL_MPS2 * (desired / gap) ** 2))
