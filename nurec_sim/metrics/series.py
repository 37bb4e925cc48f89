"""The register of per-rollout metrics: name, unit, reduction and meaning; every score is made through it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nurec_sim.types import Reduce, Rollout, Series


@dataclass(frozen=True)
class Metric:
    """How one metric is counted, reduced to one number, and read."""

    unit: str
    reduce: Reduce
    meaning: str


METRICS: dict[str, Metric] = {
    "eval_relevant": Metric("bool", Reduce.MAX, "1 once the policy drives, 0 during the forced replay of the log"),
    "collision_any": Metric("bool", Reduce.MAX, "the ego box touches an actor's box"),
    "collision_front": Metric("bool", Reduce.MAX, "a contact that meets the front bumper"),
    "collision_lateral": Metric("bool", Reduce.MAX, "a contact that meets neither bumper"),
    "collision_rear": Metric("bool", Reduce.MAX, "a contact that meets the rear bumper but not the front one"),
    "collision_at_fault": Metric("bool", Reduce.MAX, "a front or lateral contact"),
    "collision_delta_v_mps": Metric("m/s", Reduce.MAX, "change of ego speed in a plastic impact of equal masses"),
    "offroad": Metric("bool", Reduce.MAX, "footprint off the road-class Gaussians for two states in a row"),
    "offroad_max_excursion_m": Metric("m", Reduce.MAX, "deepest reach of the footprint beyond all possible road"),
    "offroad_area_frac": Metric("share", Reduce.MAX, "share of the footprint that is certainly not on road"),
    "offroad_unknown_frac": Metric("share", Reduce.MEAN, "share of states where the grid cannot decide"),
    "offroad_true": Metric(
        "bool", Reduce.MAX, "a corner more than 0.3 m outside the map's drivable area, two in a row"
    ),
    "progress": Metric("share", Reduce.LAST, "arc length reached on the recorded path over its whole length"),
    "progress_rel": Metric("share", Reduce.MIN, "arc length reached over what the recording had reached by then"),
    "dist_to_gt_trajectory": Metric("m", Reduce.MAX, "distance to the recorded path"),
    "dist_to_gt_location": Metric("m", Reduce.MAX, "distance to the recorded position at the same time"),
    "dist_traveled_m": Metric("m", Reduce.LAST, "length of the driven path since the policy took over"),
    "gt_dist_traveled_m": Metric("m", Reduce.LAST, "length of the whole recorded path"),
    "min_distance_to_obstacle_m": Metric("m", Reduce.MIN, "gap to the nearest actor's box"),
    "ttc_s": Metric("s", Reduce.MIN, "time to contact at constant velocity with actors ahead; 3 = none within 3 s"),
    "comfort": Metric("bool", Reduce.MIN, "all six motion signals are within the nuPlan bounds"),
    "lon_accel_mps2": Metric("m/s2", Reduce.MAX, "size of the longitudinal acceleration"),
    "lat_accel_mps2": Metric("m/s2", Reduce.MAX, "size of the lateral acceleration"),
    "yaw_rate_radps": Metric("rad/s", Reduce.MAX, "size of the yaw rate"),
    "yaw_accel_radps2": Metric("rad/s2", Reduce.MAX, "size of the yaw acceleration"),
    "lon_jerk_mps3": Metric("m/s3", Reduce.MAX, "size of the longitudinal jerk"),
    "jerk_mps3": Metric("m/s3", Reduce.MAX, "rate of change of the size of the acceleration"),
    "kinematic_infeasible": Metric("bool", Reduce.MAX, "an executed step that no car could drive"),
    "plan_infeasible": Metric("bool", Reduce.MEAN, "a plan with a step that no car could drive"),
    "plan_deviation": Metric("m", Reduce.MEAN, "distance between successive plans at shared times"),
    "tracking_error_m": Metric("m", Reduce.MEAN, "distance between the planned and the executed position after 0.5 s"),
}
"""Every metric that ``score_rollout`` returns, in this order; names, reductions as in AlpaSim where it has them."""


def make_series(name: str, t_us: np.ndarray, values: np.ndarray, valid: np.ndarray | bool = True) -> Series:
    """A registered metric over time; values that are not finite become invalid."""
    metric = METRICS[name]
    values = np.asarray(values, np.float64)
    known = np.broadcast_to(np.asarray(valid, bool), values.shape) & np.isfinite(values)
    return Series(name, metric.unit, np.asarray(t_us, np.int64), np.where(known, values, np.nan), known, metric.reduce)


def unknown_series(name: str, t_us: np.ndarray) -> Series:
    """A metric that could not be computed at any time."""
    return make_series(name, t_us, np.full(len(t_us), np.nan), False)


def times_of(rollout: Rollout) -> np.ndarray:
    """State times; one time for a rollout that failed before its first state, so that it still has its rows."""
    return rollout.t_us if rollout.states else np.array([rollout.first_closed_loop_us], np.int64)


def speed_of(world_from_body: np.ndarray, t_us: np.ndarray) -> np.ndarray:
    """Planar velocities [t, 2] in m/s by central differences; zero where fewer than two poses are known."""
    xy = np.asarray(world_from_body, np.float64)[:, :2, 3]
    velocity = np.zeros_like(xy)
    known = np.flatnonzero(np.isfinite(xy).all(axis=1))
    if len(known) >= 2:
        velocity[known] = np.gradient(xy[known], np.asarray(t_us)[known] / 1e6, axis=0)
    return velocity
