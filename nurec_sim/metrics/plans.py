"""Plan consistency and tracking error."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.metrics.series import make_series, times_of, unknown_series
from nurec_sim.types import Plan, Rollout, Series

MIN_SHARED = 5
DECAY = 0.1
TRACKING_AHEAD_US = 500_000


def plan_series(rollout: Rollout) -> list[Series]:
    """``plan_deviation`` (AlpaSim's weights; invalid with fewer than 5 shared times) and ``tracking_error_m``.

    A plan is in the rig frame of its start state; both metrics are computed in the world frame.
    """
    names = ("plan_deviation", "tracking_error_m")
    if not rollout.plans or not rollout.states:
        return [unknown_series(name, times_of(rollout)) for name in names]
    t_us = np.array([t for t, _ in rollout.plans], np.int64)
    ego = geometry.interpolate_poses(rollout.t_us, rollout.world_from_rig, t_us)
    plans = [plan for _, plan in rollout.plans]
    lines = [_in_world(pose, plan) for pose, plan in zip(ego, plans, strict=True)]
    deviation, tracking = np.full(len(t_us), np.nan), np.full(len(t_us), np.nan)
    for index in range(len(plans)):
        if index > 0:
            deviation[index] = _deviation(plans[index - 1], lines[index - 1], plans[index], lines[index])
        tracking[index] = _tracking_error(rollout, int(t_us[index]), ego[index], plans[index], lines[index])
    return [make_series("plan_deviation", t_us, deviation), make_series("tracking_error_m", t_us, tracking)]


def _in_world(world_from_rig: np.ndarray, plan: Plan) -> Float64[np.ndarray, "k 2"]:
    pose = np.asarray(plan.pose, np.float64)
    points = np.concatenate([pose[:, :2], np.zeros((len(pose), 1))], axis=1)
    return geometry.transform_points(world_from_rig, points)[:, :2]


def _along(plan: Plan, line: np.ndarray, t_us: np.ndarray) -> Float64[np.ndarray, "n 2"]:
    return np.stack([np.interp(t_us, plan.t_us, line[:, axis]) for axis in (0, 1)], axis=1)


def _deviation(old: Plan, old_line: np.ndarray, new: Plan, new_line: np.ndarray) -> float:
    """Mean distance at shared times after the first, with weights exp(-0.1 i)."""
    if len(old.t_us) < 2 or len(new.t_us) < 2:
        return float("nan")
    shared = np.flatnonzero((new.t_us >= old.t_us[0]) & (new.t_us <= old.t_us[-1]))[1:]
    if len(shared) < MIN_SHARED:
        return float("nan")
    apart = np.linalg.norm(new_line[shared] - _along(old, old_line, new.t_us[shared]), axis=1)
    return float(np.average(apart, weights=np.exp(-DECAY * np.arange(len(shared)))))


def _tracking_error(rollout: Rollout, now_us: int, pose: np.ndarray, plan: Plan, line: np.ndarray) -> float:
    """Distance 0.5 s after a plan; NaN if the plan or the rollout ends before.

    A plan that starts in the future is completed by the car's pose at planning time, the anchor of the controller.
    """
    later = now_us + TRACKING_AHEAD_US
    if len(plan.t_us) < 1 or later > plan.t_us[-1] or later > rollout.states[-1].t_us:
        return float("nan")
    t_us = np.concatenate([[now_us], plan.t_us]) if plan.t_us[0] > now_us else plan.t_us
    xy = np.concatenate([[pose[:2, 3]], line]) if plan.t_us[0] > now_us else line
    planned = np.array([np.interp(later, t_us, xy[:, axis]) for axis in (0, 1)])
    driven = geometry.interpolate_poses(rollout.t_us, rollout.world_from_rig, later)[:2, 3]
    return float(np.linalg.norm(planned - driven))
