"""Straight ahead at the current speed: the lower baseline."""

from __future__ import annotations

from nurec_sim.policies._paths import straight_plan
from nurec_sim.types import Needs, Observation, Plan, Rig


class ConstantVelocity:
    """Uses no sensors; never turns or brakes."""

    name = "constant_velocity"
    needs = Needs()

    def reset(self, rig: Rig, seed: int) -> None:
        """No state to reset."""

    def plan(self, observation: Observation) -> Plan:
        """Five seconds straight ahead."""
        return straight_plan(observation, observation.ego.speed_mps)
