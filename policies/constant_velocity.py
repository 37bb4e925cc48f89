"""Straight on at the speed of now: the floor that every driver must beat."""

from __future__ import annotations

from nurec_sim.policies._paths import straight_plan
from nurec_sim.types import Needs, Observation, Plan, Rig


class ConstantVelocity:
    """Sees nothing, turns nowhere, never brakes."""

    name = "constant_velocity"
    needs = Needs()

    def reset(self, rig: Rig, seed: int) -> None:
        """Nothing to forget."""

    def plan(self, observation: Observation) -> Plan:
        """Five seconds straight ahead."""
        return straight_plan(observation, observation.ego.speed_mps)
