"""Registry of per-rollout metrics: name, unit, reduction and meaning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nurec_sim.types import Reduce, Rollout, Series


@dataclass(frozen=True)
class Metric:
    """Unit, reduction and meaning of a metric."""

    unit: str
    reduce: Reduce
    meaning: str


METRICS: dict[str, Metric] = {
    "eval_relevant": Metric("bool", Reduce.MAX, "1 while the policy drives, 0 during the log replay"),
    "collision_any": Metric("bool", Reduce.MAX, "the ego box touches an actor's box"),
    "collision_front": Metric("bool", Reduce.MAX, "a contact at the front bumper"),
    "collision_lateral": Metric("bool", Reduce.MAX, "a contact at neither bumper"),
    "collision_rear": Metric("bool", Reduce.MAX, "a contact at the rear but not the front bumper"),
    "collision_at_fault": Metric("bool", Reduce.MAX, "a front or lateral contact"),
    "collision_delta_v_mps": Metric("m/s", Reduce.MAX, "change of ego speed in a plastic impact of equal masses"),
    "offroad": Metric("bool", Reduce.MAX, "footprint off the road-class Gaussians for two states in a row"),
    "offroad_max_excursion_m": Metric("m", Reduce.MAX, "largest excursion of the footprint beyond all possible road"),
    "offroad_area_frac": Metric("share", Reduce.MAX, "fraction of the footprint that is certainly off the road"),
    "offroad_unknown_frac": Metric("share", Reduce.MEAN, "fraction of states in which the grid gives no answer"),
    "offroad_true": Metric(
        "bool", Reduce.MAX, "a corner more than 0.3 m outside the map's drivable area, two in a row"
    ),
    "progress": Metric("share", Reduce.LAST, "arc length reached on the recorded path, relative to its length"),
    "progress_rel": Metric("share", Reduce.MIN, "arc length reached, relative to the recording's at that time"),
    "dist_to_gt_trajectory": Metric("m", Reduce.MAX, "distance to the recorded path"),
    "dist_to_gt_location": Metric("m", Reduce.MAX, "distance to the recorded position at the same time"),
    "dist_traveled_m": Metric("m", Reduce.LAST, "distance driven by the policy"),
    "gt_dist_traveled_m": Metric("m", Reduce.LAST, "length of the whole recorded path"),
    "min_distance_to_obstacle_m": Metric("m", Reduce.MIN, "gap to the nearest actor's box"),
    "ttc_s": Metric("s", Reduce.MIN, "time to contact at constant velocity with actors ahead; 3 = none within 3 s"),
    "braking_mps2": Metric("m/s2", Reduce.MAX, "deceleration along the car's own axis, not smoothed"),
    "comfort": Metric("bool", Reduce.MIN, "all six motion signals are within the nuPlan bounds"),
    "lon_accel_mps2": Metric("m/s2", Reduce.MAX, "magnitude of the longitudinal acceleration"),
    "lat_accel_mps2": Metric("m/s2", Reduce.MAX, "magnitude of the lateral acceleration"),
    "yaw_rate_radps": Metric("rad/s", Reduce.MAX, "magnitude of the yaw rate"),
    "yaw_accel_radps2": Metric("rad/s2", Reduce.MAX, "magnitude of the yaw acceleration"),
    "lon_jerk_mps3": Metric("m/s3", Reduce.MAX, "magnitude of the longitudinal jerk"),
    "jerk_mps3": Metric("m/s3", Reduce.MAX, "rate of change of the acceleration magnitude"),
    "kinematic_infeasible": Metric("bool", Reduce.MAX, "an executed step that is dynamically infeasible"),
    "plan_infeasible": Metric("bool", Reduce.MEAN, "a plan with a dynamically infeasible step"),
    "plan_deviation": Metric("m", Reduce.MEAN, "distance between successive plans at shared times"),
    "tracking_error_m": Metric("m", Reduce.MEAN, "distance between the planned and the executed position after 0.5 s"),
    "support": Metric("share", Reduce.MEAN, "support of the images that the policy got, by recorded views"),
    "support_least": Metric("share", Reduce.MIN, "least support of an instant's images that the policy got"),
}
"""All metrics of ``score_rollout``, in this order; names and reductions as in AlpaSim where it has them."""


def make_series(name: str, t_us: np.ndarray, values: np.ndarray, valid: np.ndarray | bool = True) -> Series:
    """A registered metric over time.

    Args:
        name: a key of ``METRICS``.
        t_us: times [t], microseconds.
        values: values [t] in the metric's unit; non-finite ones are invalid.
        valid: validity [t], or one for all times.
    """
    metric = METRICS[name]
    values = np.asarray(values, np.float64)
    known = np.broadcast_to(np.asarray(valid, bool), values.shape) & np.isfinite(values)
    return Series(name, metric.unit, np.asarray(t_us, np.int64), np.where(known, values, np.nan), known, metric.reduce)


def unknown_series(name: str, t_us: np.ndarray) -> Series:
    """A metric without valid samples."""
    return make_series(name, t_us, np.full(len(t_us), np.nan), False)


def times_of(rollout: Rollout) -> np.ndarray:
    """State times; a single time for a rollout without states, so that it still has rows."""
    return rollout.t_us if rollout.states else np.array([rollout.first_closed_loop_us], np.int64)


def speed_of(world_from_body: np.ndarray, t_us: np.ndarray) -> np.ndarray:
    """Planar velocities [t, 2] in m/s by central differences; zero with fewer than two known poses."""
    xy = np.asarray(world_from_body, np.float64)[:, :2, 3]
    velocity = np.zeros_like(xy)
    known = np.flatnonzero(np.isfinite(xy).all(axis=1))
    if len(known) >= 2:
        velocity[known] = np.gradient(xy[known], np.asarray(t_us)[known] / 1e6, axis=0)
    return velocity
