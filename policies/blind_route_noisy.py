"""Follows the recorded route badly: its lateral position and speed wander, by the same amounts for the same seed.

Both errors are Ornstein-Uhlenbeck processes (Uhlenbeck and Ornstein 1930): stationary, with a correlation time.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64

from nurec_sim.policies._paths import extended, make_plan, pursue, route_speed, toward_speed
from nurec_sim.types import Needs, Observation, Plan, Rig

LATERAL_M, SPEED_FRACTION = 0.6, 0.1
"""Standard deviations."""
CORRELATION_S = 2.0


class BlindRouteNoisy:
    """Pure pursuit beside the route, with wandering lateral offset and speed; blind."""

    name = "blind_route_noisy"
    needs = Needs()

    def __init__(self) -> None:
        self.reset(Rig({}, {}), 0)

    def reset(self, rig: Rig, seed: int) -> None:
        """Draws the first errors."""
        self.random = np.random.Generator(np.random.Philox(key=seed))
        self.errors: Float64[np.ndarray, " 2"] = self.random.standard_normal(2)
        self.last_us: int | None = None

    def plan(self, observation: Observation) -> Plan:
        """Five seconds along a line beside the route."""
        self.wander(observation.t_us)
        factor = max(0.0, 1 + SPEED_FRACTION * float(self.errors[1]))

        def accel_of(t_s: float, driven_m: float, speed: float) -> float:
            return toward_speed(factor * route_speed(observation, driven_m), speed)

        line = beside(extended(observation.route_m), LATERAL_M * float(self.errors[0]))
        return make_plan(observation, pursue(line, observation.ego.speed_mps, accel_of))

    def wander(self, t_us: int) -> None:
        """Moves the errors on to a time, by the exact solution over the step."""
        elapsed_s = 0.0 if self.last_us is None else (t_us - self.last_us) / 1e6
        self.last_us = t_us
        kept = math.exp(-elapsed_s / CORRELATION_S)
        self.errors = kept * self.errors + math.sqrt(1 - kept**2) * self.random.standard_normal(2)


def beside(line: Float64[np.ndarray, "k 2"], left_m: float) -> Float64[np.ndarray, "k 2"]:
    """A line shifted to its left."""
    ahead = np.gradient(line, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return line + left_m * np.column_stack([-ahead[:, 1], ahead[:, 0]])
