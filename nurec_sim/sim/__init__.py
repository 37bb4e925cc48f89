"""Ego dynamics, controllers and the rollout loop."""

from nurec_sim.sim.policy_sensors import SceneFacts
from nurec_sim.sim.rollout import run_rollout
from nurec_sim.sim.scenario import Scenario, load_scenario, make_scenario, scenario_file, shipped_scenarios

__all__ = [
    "Scenario",
    "SceneFacts",
    "load_scenario",
    "make_scenario",
    "run_rollout",
    "scenario_file",
    "shipped_scenarios",
]
