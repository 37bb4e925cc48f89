"""Comfort of the executed motion and feasibility of motions and plans.

Bounds and smoothing (Savitzky-Golay, order 2, window 8 for accelerations and 5 for derivatives) are nuPlan's,
infeasibility is Waymax' inverse bicycle model (docs/metrics.md).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim import geometry
from nurec_sim.metrics.series import make_series, times_of, unknown_series
from nurec_sim.types import Rollout, Series

BOUNDS: dict[str, tuple[float, float]] = {
    "lon_accel_mps2": (-4.05, 2.40),
    "lat_accel_mps2": (-4.89, 4.89),
    "yaw_rate_radps": (-0.95, 0.95),
    "yaw_accel_radps2": (-1.93, 1.93),
    "lon_jerk_mps3": (-4.13, 4.13),
    "jerk_mps3": (-8.37, 8.37),
}
"""Comfortable range of each signal (nuPlan)."""
ACCEL_WINDOW, DERIVATIVE_WINDOW, ORDER = 8, 5, 2
MAX_ACCEL_MPS2 = 10.4
MAX_CURVATURE_PER_M = 0.3
_STILL_M = 1e-3  # for shorter steps direction and curvature are noise


def comfort_series(rollout: Rollout) -> list[Series]:
    """``comfort`` and the magnitudes of the six signals; invalid with fewer than 8 evenly spaced states."""
    t_us = times_of(rollout)
    signals = motion_signals(rollout)
    if signals is None:
        return [unknown_series(name, t_us) for name in ("comfort", *BOUNDS)]
    within = np.logical_and.reduce(
        [(signals[name] >= low) & (signals[name] <= high) for name, (low, high) in BOUNDS.items()]
    )
    return [
        make_series("comfort", t_us, within),
        *(make_series(name, t_us, np.abs(signals[name])) for name in BOUNDS),
    ]


def braking_series(rollout: Rollout) -> Series:
    """``braking_mps2``: how hard the car brakes in every state; 0 while it does not."""
    accel = np.array([state.accel_mps2 for state in rollout.states])
    t_us = times_of(rollout)
    return (
        make_series("braking_mps2", t_us, np.maximum(-accel, 0.0))
        if len(accel)
        else unknown_series("braking_mps2", t_us)
    )


def motion_signals(rollout: Rollout) -> dict[str, Float64[np.ndarray, " t"]] | None:
    """The six smoothed signals while the policy drives, NaN before; None if they cannot be computed."""
    from scipy.signal import savgol_filter

    # Only policy-driven states enter the filter: its window must not mix in the log replay. Savitzky-Golay filters need
    # even spacing and at least one full window.
    driven = np.flatnonzero(times_of(rollout) >= rollout.first_closed_loop_us)
    if len(rollout.states) == 0 or len(driven) < ACCEL_WINDOW:
        return None
    states = [rollout.states[index] for index in driven]
    steps = np.diff([state.t_us for state in states])
    if np.any(steps != steps[0]):
        return None
    dt_s = float(steps[0]) / 1e6

    def smooth(values: np.ndarray) -> np.ndarray:
        return savgol_filter(values, ACCEL_WINDOW, ORDER)

    def rate(values: np.ndarray) -> np.ndarray:
        return savgol_filter(values, DERIVATIVE_WINDOW, ORDER, deriv=1, delta=dt_s)

    speed = np.array([state.speed_mps for state in states])
    yaw = np.unwrap(geometry.yaw_of(rollout.world_from_rig[driven]))
    lon_accel = smooth(np.array([state.accel_mps2 for state in states]))
    yaw_rate = rate(yaw)
    lat_accel = smooth(speed * yaw_rate)
    signals = {
        "lon_accel_mps2": lon_accel,
        "lat_accel_mps2": lat_accel,
        "yaw_rate_radps": yaw_rate,
        "yaw_accel_radps2": rate(yaw_rate),
        "lon_jerk_mps3": rate(lon_accel),
        "jerk_mps3": rate(np.hypot(lon_accel, lat_accel)),
    }
    full = {name: np.full(len(rollout.states), np.nan) for name in signals}
    for name, values in signals.items():
        full[name][driven] = values
    return full


def infeasible_steps(
    t_us: Int64[np.ndarray, " t"], xy_m: Float64[np.ndarray, "t 2"], yaw_rad: Float64[np.ndarray, " t"]
) -> Bool[np.ndarray, " t"]:
    """Whether the motion into each pose exceeds 10.4 m/s2 or a curvature of 0.3 1/m; False for the first poses."""
    t_s = (np.asarray(t_us) - t_us[0]) / 1e6
    heading = np.stack([np.cos(yaw_rad[:-1]), np.sin(yaw_rad[:-1])], axis=1)
    step = np.diff(xy_m, axis=0)
    moved = np.linalg.norm(step, axis=1)
    # Inverse bicycle model: speed from displacement (signed by the heading), acceleration from successive speeds at
    # the middles of their steps, curvature as turned angle over distance.
    speed = np.sign(np.sum(step * heading, axis=1)) * moved / np.diff(t_s)
    middle = (t_s[1:] + t_s[:-1]) / 2
    bad = np.zeros(len(t_s), bool)
    turned = np.abs(geometry.wrap_angle(np.diff(yaw_rad)))
    # Multiplied out, with a margin, so that a standing car with a noisy yaw is not infeasible.
    bad[1:] |= turned > MAX_CURVATURE_PER_M * moved + _STILL_M
    bad[2:] |= np.abs(np.diff(speed) / np.diff(middle)) > MAX_ACCEL_MPS2
    return bad


def feasibility_series(rollout: Rollout) -> list[Series]:
    """``kinematic_infeasible`` of the executed states and ``plan_infeasible`` of each plan."""
    t_us = times_of(rollout)
    if len(rollout.states) < 3:
        executed = unknown_series("kinematic_infeasible", t_us)
    else:
        poses = rollout.world_from_rig
        bad = infeasible_steps(t_us, poses[:, :2, 3], geometry.yaw_of(poses))
        executed = make_series("kinematic_infeasible", t_us, bad, np.arange(len(t_us)) >= 2)
    plan_t_us = np.array([t for t, _ in rollout.plans], np.int64)
    bad_plans = np.full(len(plan_t_us), np.nan)
    for index, (_, plan) in enumerate(rollout.plans):
        if len(plan.t_us) >= 3 and np.isfinite(plan.pose).all() and np.all(np.diff(plan.t_us) > 0):
            bad_plans[index] = infeasible_steps(plan.t_us, plan.pose[:, :2], plan.pose[:, 2]).any()
    if len(plan_t_us) == 0:
        return [executed, unknown_series("plan_infeasible", t_us)]
    return [executed, make_series("plan_infeasible", plan_t_us, bad_plans)]
