"""Why an event happened, in one sentence: the plan that led to it against the recorded drive."""

from __future__ import annotations

import math

import numpy as np

from nurec_sim import geometry
from nurec_sim.metrics.collision import Contact
from nurec_sim.types import Plan, Rollout

LED_US = 500_000
"""The plan that led to an event is the last one made at least so long before."""
AHEAD_M = 25.0
TURN_DEG, STRAIGHT_DEG = 10.0, 5.0
BESIDE_M, BRAKING_MPS2 = 0.5, -1.5


def offroad_reason(rollout: Rollout, t_us: int) -> str:
    """Why the car left the road.

    Args:
        rollout: the rollout.
        t_us: time of the first off-road state.
    """
    made = _plan_before(rollout, t_us)
    left_m = beside_path_m(rollout, t_us)
    if made is not None:
        planned, recorded = _turns_deg(rollout, *made)
        if abs(recorded) >= TURN_DEG and planned * math.copysign(1, recorded) < 0.5 * abs(recorded):
            did = (
                "stayed straight" if abs(planned) < STRAIGHT_DEG else f"turned {_side(planned)} by {abs(planned):.0f}°"
            )
            return f"the recorded path turns {_side(recorded)} by {abs(recorded):.0f}°, the plan {did}"
        if abs(planned - recorded) >= TURN_DEG:
            path = (
                "goes straight" if abs(recorded) < STRAIGHT_DEG else f"turns {_side(recorded)} by {abs(recorded):.0f}°"
            )
            return f"the plan turned {_side(planned)} by {abs(planned):.0f}° where the recorded path {path}"
    if abs(left_m) >= BESIDE_M:
        return f"the car had drifted {abs(left_m):.1f} m to the {_side(left_m)} of the recorded path"
    return f"the car was on the recorded path (within {abs(left_m):.1f} m): doubt the road's labels here"


def contact_reason(rollout: Rollout, contact: Contact) -> str:
    """Why the car touched an actor.

    Args:
        rollout: the rollout.
        contact: the contact.
    """
    speed, recorded = contact.ego_speed_mps, _recorded_speed(rollout, contact.t_us)
    if contact.side == "rear":
        return (
            f"the actor repeats its recording and ran into the back: the car drove {speed:.1f} m/s, "
            f"the recorded one {recorded:.1f} m/s at that time"
        )
    left_m = beside_path_m(rollout, contact.t_us)
    if abs(left_m) >= BESIDE_M:
        return f"the car was {abs(left_m):.1f} m to the {_side(left_m)} of the recorded path"
    made = _plan_before(rollout, contact.t_us)
    if made is not None:
        slowing = _planned_accel(made[1])
        if slowing > BRAKING_MPS2 and speed > 0.5:
            return f"the plan did not brake ({slowing:+.1f} m/s²) at {speed:.1f} m/s"
        if speed > 0.5:
            return f"the plan braked ({slowing:+.1f} m/s²), too late to stop from {speed:.1f} m/s"
    return f"the car was on the recorded path at {speed:.1f} m/s, the recorded one drove {recorded:.1f} m/s"


def beside_path_m(rollout: Rollout, t_us: int) -> float:
    """Distance of the car from the recorded path at a state, left positive."""
    line = _line(rollout)
    place = rollout.world_from_rig[_state(rollout, t_us), :2, 3]
    if len(line) < 2:
        return float(np.linalg.norm(place - line[0]))
    _, left_m = geometry.project_to_polyline(place[None], line)
    return float(left_m[0])


def _turns_deg(rollout: Rollout, made_us: int, plan: Plan) -> tuple[float, float]:
    """Change of heading over the plan, at most ``AHEAD_M``, and of the recorded path over the same length."""
    steps = np.linalg.norm(np.diff(np.vstack([[0.0, 0.0], plan.pose[:, :2]]), axis=0), axis=1)
    length = np.cumsum(steps)
    last = min(int(np.searchsorted(length, AHEAD_M)), len(length) - 1)
    planned = float(geometry.wrap_angle(plan.pose[last, 2]))
    line, heading = _line(rollout), np.unwrap(geometry.yaw_of(rollout.recorded.world_from_body))
    at = rollout.world_from_rig[_state(rollout, made_us), :2, 3]
    station = geometry.arc_length(line)
    here = station[int(np.linalg.norm(line - at, axis=1).argmin())]
    ends = np.interp([here, here + min(float(length[last]), AHEAD_M)], station, heading)
    recorded = float(ends[1] - ends[0])
    return math.degrees(planned), math.degrees(recorded)


def _planned_accel(plan: Plan) -> float:
    """Mean acceleration over the plan's first second."""
    count = max(2, int(np.searchsorted(plan.t_us, plan.t_us[0] + 1_000_000)))
    times = plan.t_us[: count + 1] / 1e6
    speed = np.linalg.norm(np.diff(plan.pose[: count + 1, :2], axis=0), axis=1) / np.diff(times)
    return float((speed[-1] - speed[0]) / max(times[-1] - times[0], 1e-6)) if len(speed) > 1 else 0.0


def _plan_before(rollout: Rollout, t_us: int) -> tuple[int, Plan] | None:
    earlier = [(made, plan) for made, plan in rollout.plans if made <= t_us - LED_US and len(plan.t_us) > 1]
    return earlier[-1] if earlier else next(iter(rollout.plans), None)


def _recorded_speed(rollout: Rollout, t_us: int) -> float:
    recorded = rollout.recorded
    if len(recorded.t_us) < 2:
        return 0.0
    pair = np.clip([t_us - 100_000, t_us + 100_000], recorded.start_us, recorded.end_us)
    first, last = recorded.at(pair)[:, :2, 3]
    return float(np.linalg.norm(last - first) / max((pair[1] - pair[0]) / 1e6, 1e-6))


def _line(rollout: Rollout) -> np.ndarray:
    return rollout.recorded.position_m[:, :2]


def _state(rollout: Rollout, t_us: int) -> int:
    return int(np.abs(rollout.t_us - t_us).argmin())


def _side(left: float) -> str:
    return "left" if left > 0 else "right"
