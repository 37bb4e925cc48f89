"""How well surfaces seen ahead agree with the same surfaces seen behind later on."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from nurec_sim import geometry
from nurec_sim.logs.clip import Clip
from nurec_sim.logs.odometry.static_points import moving_tracks, static_points

DRIVEN_M = 22.0
NEAR_M = 30.0
OVER_GROUND_M = 0.3
PAIRS = 8
FEWEST_POINTS = 200


def agreement_m(clip: Clip, lidar_id: str) -> float | None:
    """Median distance of points seen behind the car to the nearest point seen ahead, 22 m earlier on the way.

    Points of the ground do not count: they are close to each other wherever the car was. The spacing of the beams alone
    gives about 0.1 m.

    Args:
        clip: the log.
        lidar_id: the LiDAR.

    Returns:
        The distance in metres; None if the car drove less than 22 m.
    """
    times = np.array([record.t_us for record in clip.sweep_records(lidar_id)], np.int64)
    if not len(times):
        return None
    path = clip.ego.at(times)[:, :3, 3]
    driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    later = np.searchsorted(driven, driven + DRIVEN_M)
    first = np.flatnonzero(later < len(times))
    moving = moving_tracks(clip)
    distances = []
    for index in first[np.unique(np.linspace(0, len(first) - 1, min(PAIRS, len(first))).round().astype(int))]:
        ahead, behind = (static_points(clip, lidar_id, int(i), moving) for i in (index, later[index]))
        ahead = ahead[(ahead[:, 0] > 0) & (ahead[:, 2] > OVER_GROUND_M)]
        behind = behind[(behind[:, 0] < 0) & (behind[:, 2] > OVER_GROUND_M)]
        behind = behind[np.linalg.norm(behind, axis=1) < NEAR_M]
        if min(len(ahead), len(behind)) < FEWEST_POINTS:
            continue
        then, now = (clip.ego.at(times[i]) for i in (index, later[index]))
        world = geometry.transform_points(now, behind)
        back_then = geometry.transform_points(geometry.inverse(then), world)
        # What was not in sight then has no partner at all.
        distance, _ = cKDTree(ahead).query(back_then[back_then[:, 0] > 5.0], distance_upper_bound=3.0)
        distances.append(distance[np.isfinite(distance)])
    return float(np.median(np.concatenate(distances))) if distances else None
