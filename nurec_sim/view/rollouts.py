"""Rollouts in the viewer: driven path, current plan, events."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.metrics.collision import find_contacts
from nurec_sim.types import Rollout


def lines_of(rollout: Rollout, t_us: int) -> tuple[Float64[np.ndarray, "t 3"], Float64[np.ndarray, "k 3"]]:
    """The driven path, and the latest plan that was made by a time, both on the ground in the world.

    The plan starts at the car's pose when it was made; it has no points before the first one.
    """
    driven = rollout.world_from_rig[:, :3, 3]
    made = [entry for entry in rollout.plans if entry[0] <= t_us]
    if not made:
        return driven, np.zeros((0, 3))
    made_us, plan = made[-1]
    pose = geometry.interpolate_poses(rollout.t_us, rollout.world_from_rig, made_us)
    ahead = np.concatenate([np.zeros((1, 3)), np.pad(plan.pose[:, :2], ((0, 0), (0, 1)))])
    return driven, geometry.transform_points(pose, ahead)


def events_of(rollout: Rollout) -> list[tuple[int, str]]:
    """Times and texts of what happened, in order: contacts, events of the loop, the failure."""
    found = [
        (contact.t_us, f"{contact.side} contact with {contact.label or 'actor'} {contact.actor}")
        for contact in find_contacts(rollout)
    ]
    found += [(event.t_us, f"{event.kind.replace('_', ' ')}: {event.text}".rstrip(": ")) for event in rollout.events]
    if rollout.status != "ok":
        found.append((rollout.states[-1].t_us, f"failed: {rollout.error.splitlines()[0] if rollout.error else ''}"))
    return sorted(found)


def caption(rollout: Rollout, events: Sequence[tuple[int, str]], t_us: int) -> str:
    """One line about an instant: policy, time, speed, who drives, and the last of its ``events_of`` so far."""
    times = rollout.t_us
    speed = np.interp(t_us, times, [state.speed_mps for state in rollout.states])
    text = f"{rollout.policy}  {(t_us - times[0]) / 1e6:.1f} s  {speed:.1f} m/s"
    if t_us < rollout.first_closed_loop_us:
        text += "  (log)"
    happened = [what for when, what in events if when <= t_us]
    return text + (f"  {happened[-1]}" if happened else "")
