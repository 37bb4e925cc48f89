"""Adaptive cruise control by LiDAR: follows the recorded route and keeps its distance to what the sweep shows."""

from __future__ import annotations

from nurec_sim.policies._paths import extended, make_plan, pursue, route_speed
from nurec_sim.policies.lidar_aeb import LidarAeb
from nurec_sim.policies.route_follower import idm
from nurec_sim.types import Needs, Observation, Plan, Rig

FREE_M = 1e3


class LidarCruise:
    """Pure pursuit on the route, Intelligent Driver Model behind the nearest LiDAR obstacle."""

    name = "lidar_cruise"
    needs = Needs(lidars=("any",))

    def __init__(self) -> None:
        self.eyes = LidarAeb()

    def reset(self, rig: Rig, seed: int) -> None:
        """Forgets the obstacle of the last plan."""
        self.eyes.reset(rig, seed)

    def plan(self, observation: Observation) -> Plan:
        """Five seconds along the route, behind the obstacle."""
        distance, lead_speed = self.eyes.obstacle(observation, extended(observation.route_m))

        def accel_of(t_s: float, driven_m: float, speed: float) -> float:
            gap = FREE_M if distance is None else max(distance + lead_speed * t_s - driven_m, 0.01)
            return idm(speed, route_speed(observation, driven_m), gap, lead_speed)

        return make_plan(observation, pursue(observation.route_m, observation.ego.speed_mps, accel_of))
