"""Replays the recorded drive, as a sanity check of a scene."""

from __future__ import annotations

import numpy as np

from nurec_sim.policies._paths import STEP_S, STEPS, make_plan, straight_plan
from nurec_sim.types import Needs, Observation, Plan, Rig


class LogReplay:
    """The recorded future as a plan; beyond its end it continues at the last speed and heading."""

    name = "log_replay"
    needs = Needs()

    def reset(self, rig: Rig, seed: int) -> None:
        """No state to reset."""

    def plan(self, observation: Observation) -> Plan:
        """The recorded poses of the next 5 s."""
        recorded = observation.recorded_pose[:STEPS]
        if len(recorded) == 0:
            return straight_plan(observation, observation.ego.speed_mps)
        pose = np.empty((STEPS, 3))
        pose[: len(recorded)] = recorded
        last = recorded[-1]
        speed = observation.ego.speed_mps
        if len(recorded) > 1:
            speed = float(np.linalg.norm(last[:2] - recorded[-2, :2])) / STEP_S
        beyond = speed * STEP_S * np.arange(1, STEPS - len(recorded) + 1)
        pose[len(recorded) :, 0] = last[0] + beyond * np.cos(last[2])
        pose[len(recorded) :, 1] = last[1] + beyond * np.sin(last[2])
        pose[len(recorded) :, 2] = last[2]
        return make_plan(observation, pose)
