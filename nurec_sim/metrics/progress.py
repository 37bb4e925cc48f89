"""Progress along the recorded path, deviation from it, and gaps to other road users.

All positions are those of the ego's box centre, as in AlpaSim; the recorded path is the box centre's too.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.metrics.boxes import (
    BoxPath,
    actor_boxes,
    body_boxes,
    ego_boxes,
    heights_overlap,
    outline_gap,
    rectangle_distance,
)
from nurec_sim.metrics.series import make_series, speed_of, times_of, unknown_series
from nurec_sim.types import Rollout, Series

SEARCH_WINDOW_M = 30.0
"""Maximum step between projections, so that self-crossing routes stay unambiguous."""
TTC_HORIZON_S = 3.0
TTC_STEP_S = 0.1

_PATH_METRICS = ("progress", "progress_rel", "dist_to_gt_trajectory", "dist_to_gt_location", "dist_traveled_m")


def progress_series(rollout: Rollout) -> list[Series]:
    """``progress``, ``progress_rel``, both distances to the recording, both distances travelled."""
    t_us = times_of(rollout)
    if not rollout.states:
        return [unknown_series(name, t_us) for name in (*_PATH_METRICS, "gt_dist_traveled_m")]
    centre = ego_boxes(rollout).world_from_box[:, :2, 3]
    body = rollout.rig.body
    line = body_boxes(rollout.recorded.world_from_body, body).world_from_box[:, :2, 3]
    there = body_boxes(rollout.recorded.at(t_us), body).world_from_box[:, :2, 3]
    relevant = t_us >= rollout.first_closed_loop_us
    steps = np.linalg.norm(np.diff(centre, axis=0, prepend=centre[:1]), axis=1)
    steps[~relevant] = 0
    if relevant.any():
        steps[np.argmax(relevant)] = 0  # the step into the first counted state belongs to the log replay
    length = geometry.arc_length(line)
    inside_log = (t_us >= rollout.recorded.start_us) & (t_us <= rollout.recorded.end_us)
    series = [
        make_series("dist_to_gt_location", t_us, np.linalg.norm(centre - there, axis=1), inside_log),
        make_series("dist_traveled_m", t_us, np.cumsum(steps)),
        make_series("gt_dist_traveled_m", t_us, np.full(len(t_us), length[-1])),
    ]
    if length[-1] < 0.1:  # a stationary recording has no path for progress
        away = np.linalg.norm(centre - line[0], axis=1)
        series.append(make_series("dist_to_gt_trajectory", t_us, away))
        return [*series, unknown_series("progress", t_us), unknown_series("progress_rel", t_us)]
    reached, away = _follow(centre, line, length)
    # Relative to the recording at the same time, at most 1: being ahead of it earns nothing. Within the first 0.1 m the
    # quotient is undefined.
    by_now = np.interp(t_us, rollout.recorded.t_us, length)
    relative = np.where(by_now > 0.1, np.minimum(reached, by_now) / np.maximum(by_now, 0.1), 1.0)
    return [
        *series,
        make_series("dist_to_gt_trajectory", t_us, away),
        make_series("progress", t_us, reached / length[-1]),
        make_series("progress_rel", t_us, relative),
    ]


def _follow(
    points: Float64[np.ndarray, "t 2"], line: Float64[np.ndarray, "k 2"], length: Float64[np.ndarray, " k"]
) -> tuple[Float64[np.ndarray, " t"], Float64[np.ndarray, " t"]]:
    """Arc length and distance of each point's projection, each near the previous one."""
    reached, away = np.zeros(len(points)), np.zeros(len(points))
    first, last = 0, len(line)
    for index, point in enumerate(points):
        along, offset = geometry.project_to_polyline(point[None], line[first:last])
        reached[index], away[index] = along[0] + length[first], abs(offset[0])
        first = max(int(np.searchsorted(length, reached[index] - SEARCH_WINDOW_M, side="right")) - 1, 0)
        last = min(int(np.searchsorted(length, reached[index] + SEARCH_WINDOW_M)) + 1, len(line))
        first = min(first, last - 2)
    return reached, away


def proximity_series(rollout: Rollout) -> list[Series]:
    """``min_distance_to_obstacle_m`` and ``ttc_s``; invalid at times without any actor."""
    t_us = times_of(rollout)
    boxes = actor_boxes(rollout)
    if not rollout.states or not boxes:
        return [unknown_series("min_distance_to_obstacle_m", t_us), unknown_series("ttc_s", t_us)]
    ego = ego_boxes(rollout)
    nearest, ttc = np.full(len(t_us), np.inf), np.full(len(t_us), np.inf)
    ego_velocity = speed_of(ego.world_from_box, t_us)
    for actor in boxes.values():
        level = actor.present & heights_overlap(ego, actor)
        gap = np.where(level, outline_gap(ego, actor), np.inf)
        nearest = np.minimum(nearest, gap)
        ttc = np.minimum(ttc, _time_to_contact(ego, ego_velocity, actor, speed_of(actor.world_from_box, t_us), gap))
    present = np.isfinite(nearest)
    ttc = np.minimum(ttc, TTC_HORIZON_S)
    return [
        make_series("min_distance_to_obstacle_m", t_us, nearest, present),
        make_series("ttc_s", t_us, ttc, present),
    ]


def _time_to_contact(
    ego: BoxPath, ego_velocity: np.ndarray, actor: BoxPath, actor_velocity: np.ndarray, gap_m: np.ndarray
) -> Float64[np.ndarray, " t"]:
    """First time at which both boxes, moved at constant velocity, overlap; infinite if later than the horizon.

    As in nuPlan, an actor counts only if its centre is ahead of the ego's, there is no contact yet, and the ego moves.
    """
    offset = actor.world_from_box[:, :2, 3] - ego.world_from_box[:, :2, 3]
    yaw = geometry.yaw_of(ego.world_from_box)
    ahead = offset[:, 0] * np.cos(yaw) + offset[:, 1] * np.sin(yaw) > 0
    closing = np.linalg.norm(ego_velocity - actor_velocity, axis=1)
    moving = np.linalg.norm(ego_velocity, axis=1) > 0.005
    # A gap larger than the relative motion within the horizon cannot close; this skips most of the box tests.
    near = np.flatnonzero(ahead & moving & (gap_m > 0) & (gap_m <= closing * TTC_HORIZON_S))
    ttc = np.full(len(gap_m), np.inf)
    if len(near) == 0:
        return ttc
    ahead_s = np.arange(1, round(TTC_HORIZON_S / TTC_STEP_S) + 1) * TTC_STEP_S
    poses = [
        np.repeat(box.world_from_box[near][:, None], len(ahead_s), axis=1) for box in (ego, actor)
    ]  # [near, steps, 4, 4]
    for pose, velocity in zip(poses, (ego_velocity, actor_velocity), strict=True):
        pose[..., :2, 3] += velocity[near][:, None] * ahead_s[None, :, None]
    hit = rectangle_distance(poses[0], ego.length_width_m, poses[1], actor.length_width_m) <= 0
    ttc[near] = np.where(hit.any(axis=1), ahead_s[np.argmax(hit, axis=1)], np.inf)
    return ttc
