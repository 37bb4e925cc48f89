"""Sweeps as their sensor fired them: motion compensation undone."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.logs.points import instants_of, moved_points
from nurec_sim.logs.sweeps import prolonged
from nurec_sim.types import Clip, Sweep


def as_fired(clip: Clip, lidar: str, sweep: Sweep) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "2 4 4"]]:
    """Undoes motion compensation: returns in the sensor frame at firing time, and the poses at sweep start and end."""
    rig_from_lidar = clip.rig.lidars[lidar].rig_from_lidar
    ego = prolonged(clip.ego, sweep.end_us - sweep.start_us) or clip.ego
    # The sweep's own pose in the log is the reference; the ego trajectory only contributes the motion around it.
    fix = sweep.world_from_lidar @ geometry.inverse(ego.at(sweep.t_us) @ rig_from_lidar)
    poses = fix @ ego.at(np.array([sweep.start_us, sweep.end_us])) @ rig_from_lidar
    if not len(sweep.point_t_us):
        return np.zeros((0, 3)), poses
    instants = instants_of(sweep.point_t_us, ego)
    fired = fix @ ego.at(instants) @ rig_from_lidar
    return moved_points(sweep.xyz_world_m, sweep.point_t_us, instants, geometry.inverse(fired)), poses


def fired_fraction(sweep: Sweep) -> Float64[np.ndarray, " n"]:
    """When within the sweep each point was measured, 0 to 1."""
    return np.clip((sweep.point_t_us - sweep.start_us) / max(sweep.end_us - sweep.start_us, 1), 0, 1)
