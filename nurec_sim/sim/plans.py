"""Validates the plans of policies."""

from __future__ import annotations

import numpy as np

from nurec_sim.errors import PlanError
from nurec_sim.types import Plan

MIN_HORIZON_US = 2_500_000
"""Minimum length of a plan beyond its observation; 5 s are recommended."""
FARTHEST_M = 10_000.0


def check_plan(plan: object, now_us: int) -> Plan:
    """A validated copy of the plan with arrays of int64 and float64.

    Poses of a plan that requests a stop are not checked, since they are not executed; unreadable ones are dropped.

    Raises:
        PlanError: not a Plan, wrong shapes, empty, not finite, times that do not increase, all in the past, or too
            short.
    """
    if not isinstance(plan, Plan):
        raise PlanError(f"the policy must return a nurec_sim.types.Plan, got {type(plan).__name__}")
    if plan.stop_session:
        return _last(plan)
    # Copies: a policy may keep and later overwrite its arrays.
    try:
        t_raw, pose = np.array(plan.t_us), np.array(plan.pose, np.float64)
    except (TypeError, ValueError) as error:
        raise PlanError(f"plan poses must be numbers [k,3] (x, y, yaw): {error}") from error
    if t_raw.size == 0:
        raise PlanError("the plan is empty; it needs poses up to at least 2.5 s ahead")
    if t_raw.ndim != 1 or pose.shape != (len(t_raw), 3):
        raise PlanError(f"a plan needs t_us [k] and pose [k,3] (x, y, yaw); got {t_raw.shape} and {pose.shape}")
    if not np.issubdtype(t_raw.dtype, np.integer):
        raise PlanError(f"plan times must be integer microseconds, got {t_raw.dtype}")
    if not np.isfinite(pose).all():
        bad = int(np.flatnonzero(~np.isfinite(pose).all(axis=1))[0])
        raise PlanError(f"plan poses must be finite; pose {bad} is {pose[bad].tolist()}")
    t_us = t_raw.astype(np.int64)
    if np.any(np.diff(t_us) <= 0):
        bad = int(np.flatnonzero(np.diff(t_us) <= 0)[0])
        raise PlanError(f"plan times must increase; {t_us[bad]} is followed by {t_us[bad + 1]}")
    ahead_s = (int(t_us[-1]) - now_us) / 1e6
    if ahead_s <= 0:
        raise PlanError(f"the plan is too late: its last pose lies {-ahead_s:.3f} s before the observation")
    if ahead_s < MIN_HORIZON_US / 1e6:
        raise PlanError(f"the plan ends {ahead_s:.3f} s ahead; it must reach at least 2.5 s (return 5 s)")
    if np.abs(pose[:, :2]).max() > FARTHEST_M:
        raise PlanError(f"plan positions must lie within {FARTHEST_M:.0f} m, got {np.abs(pose[:, :2]).max():.0f} m")
    return Plan(t_us, pose)


def _last(plan: Plan) -> Plan:
    """A plan that requests a stop, with its poses if readable."""
    try:
        t_us, pose = np.array(plan.t_us, np.int64), np.array(plan.pose, np.float64)
    except (TypeError, ValueError, OverflowError):
        t_us, pose = np.zeros(0, np.int64), np.zeros((0, 3))
    if t_us.ndim != 1 or pose.shape != (len(t_us), 3):
        t_us, pose = np.zeros(0, np.int64), np.zeros((0, 3))
    return Plan(t_us, pose, stop_session=True)
