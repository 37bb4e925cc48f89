"""``route_follower`` with a bad detector: true actors with wrong positions, each overlooked now and then.

Errors depend only on seed, actor and time, so they are the same in every world.
"""

from __future__ import annotations

from dataclasses import replace
from zlib import crc32

import numpy as np

from nurec_sim import geometry
from nurec_sim.policies.route_follower import RouteFollower
from nurec_sim.types import ActorState, Needs, Observation, Plan, Rig

OVERLOOKED, POSITION_M = 0.3, 0.5
"""Probability per plan that an actor is overlooked; standard deviation of its position along x and y."""


class NoisyPerception:
    """Follows the route with imperfect knowledge of the true actors."""

    name = "noisy_perception"
    needs = Needs(privileged=True)

    def __init__(self) -> None:
        self.driver, self.seed = RouteFollower(), 0

    def reset(self, rig: Rig, seed: int) -> None:
        """Stores the seed of the errors."""
        self.driver.reset(rig, seed)
        self.seed = seed

    def plan(self, observation: Observation) -> Plan:
        """Five seconds along the route, by what was detected."""
        seen = (self.detected(actor, observation.t_us) for actor in observation.actors or ())
        return self.driver.plan(replace(observation, actors=tuple(actor for actor in seen if actor is not None)))

    def detected(self, actor: ActorState, t_us: int) -> ActorState | None:
        """An actor as detected, or None."""
        random = np.random.default_rng([self.seed, t_us, crc32(actor.id.encode())])
        if random.random() < OVERLOOKED:
            return None
        error = np.array([*random.normal(0.0, POSITION_M, 2), 0.0])
        return replace(actor, rig_from_box=geometry.pose(np.eye(3), error) @ actor.rig_from_box)
