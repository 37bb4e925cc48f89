"""Conformance test kit for policies: valid, reproducible plans.

::

    from nurec_sim.sim.conformance import check_policy
    print(check_policy(MyPolicy()))      # [] if it conforms
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nurec_sim import geometry
from nurec_sim.errors import NurecSimError
from nurec_sim.sim.flat_world import FlatWorld, flat_world, poses_along
from nurec_sim.sim.plans import check_plan
from nurec_sim.sim.policy_sensors import SIDES_RAD
from nurec_sim.sim.rollout import run_rollout
from nurec_sim.sim.scenario import Scenario
from nurec_sim.types import Needs, Observation, Plan, Policy, Rig, Track, Trajectory


def check_policy(policy: Policy) -> list[str]:
    """Runs a policy in small flat worlds and returns a list of faults, empty if it conforms.

    Checked: ``name``, ``needs``, ``reset`` and ``plan`` exist; plans are valid (``plans.check_plan``) on a straight
    road at speed, at a standstill, behind another car and at the end of the recording; a second run after ``reset``
    gives identical plans. Observations are read-only: a policy that modifies them fails.
    """
    faults = _surface(policy)
    if faults:
        return faults
    for world in (_straight(10.0), _straight(0.0), _straight(10.0, with_lead=True)):
        scenario = Scenario(name="conformance", duration_s=4.0, warm_up_s=0.5)
        watched = _Watched(policy)
        first = run_rollout(scenario, watched, world.sense, world, seed=1)
        if first.status != "ok":
            faults.append(f"{world.id}: {first.error}")
            continue
        faults += [f"{world.id}: {text}" for text in watched.faults]
        # Bitwise equality is possible because the loop itself is deterministic: any difference is the policy's.
        second = run_rollout(scenario, policy, world.sense, world, seed=1)
        if _bytes(first.plans) != _bytes(second.plans):
            faults.append(
                f"{world.id}: a second run after reset(rig, seed) gave different plans; reset all state, seed all noise"
            )
    return faults


def _surface(policy: Policy) -> list[str]:
    faults = []
    if not isinstance(getattr(policy, "name", None), str) or not policy.name:
        faults.append("name must be a non-empty string")
    if not isinstance(getattr(policy, "needs", None), Needs):
        faults.append("needs must be a nurec_sim.types.Needs")
    faults += [f"{method}() is missing" for method in ("reset", "plan") if not callable(getattr(policy, method, None))]
    return faults


class _Watched:
    """Wraps a policy and records faults in its plans."""

    def __init__(self, policy: Policy) -> None:
        self.policy, self.name, self.needs = policy, policy.name, policy.needs
        self.faults: list[str] = []

    def reset(self, rig: Rig, seed: int) -> None:
        self.policy.reset(rig, seed)

    def plan(self, observation: Observation) -> Plan:
        plan = self.policy.plan(observation)
        try:
            checked = check_plan(plan, observation.t_us)
        except NurecSimError:
            return plan  # the rollout reports it
        if not checked.stop_session and checked.t_us[-1] - observation.t_us < 4_900_000:
            self.faults.append("plans should reach 5 s ahead")
        return plan


def _bytes(plans: tuple[tuple[int, Plan], ...]) -> bytes:
    return b"".join(plan.t_us.tobytes() + plan.pose.tobytes() for _, plan in plans if not plan.stop_session)


def _straight(speed_mps: float, with_lead: bool = False) -> FlatWorld:
    line = np.array([[0.0, 0.0], [100.0, 0.0], [200.0, 0.0]])
    tracks = []
    if with_lead:
        t_us = 1_000_000 + 100_000 * np.arange(41, dtype=np.int64)
        poses = poses_along(line, 25.0 + 8.0 * np.arange(41) / 10, z_m=0.75)
        tracks.append(Track("lead", "automobile", (4.5, 1.8, 1.5), Trajectory(t_us, poses)))
    world = flat_world(
        f"straight at {speed_mps:g} m/s{' behind a car' if with_lead else ''}", line, speed_mps, 4.0, tracks
    )
    return replace(world, rig=_with_sides(world.rig))


def _with_sides(rig: Rig) -> Rig:
    """A rig whose front camera has twins that look 60 degrees to the left and to the right."""
    front = next(iter(rig.cameras.values()))
    turns = {name: geometry.pose_from_xyyaw(0.0, 0.0, yaw) for name, yaw in SIDES_RAD.items()}
    sides = [replace(front, id=f"front_{name}", rig_from_camera=turn @ front.rig_from_camera)
             for name, turn in turns.items()]  # fmt: skip
    return replace(rig, cameras={**rig.cameras, **{camera.id: camera for camera in sides}})
