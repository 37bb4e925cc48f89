"""Follows the recorded route at its speed and sees nothing: what a policy gains by looking is measured against it."""

from __future__ import annotations

from nurec_sim.policies._paths import make_plan, pursue, route_speed, toward_speed
from nurec_sim.types import Needs, Observation, Plan, Rig


class BlindRoute:
    """Pure pursuit on the route at the recorded speed, blind to everything else."""

    name = "blind_route"
    needs = Needs()

    def reset(self, rig: Rig, seed: int) -> None:
        """Has no state."""

    def plan(self, observation: Observation) -> Plan:
        """Five seconds along the route."""

        def accel_of(t_s: float, driven_m: float, speed: float) -> float:
            return toward_speed(route_speed(observation, driven_m), speed)

        return make_plan(observation, pursue(observation.route_m, observation.ego.speed_mps, accel_of))
