"""Named hand-made worlds for tests; each is its own renderer: ``run_rollout(scenario, policy, w.sense, w)``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nurec_sim import geometry
from nurec_sim.sim.flat_world import LOG_STEP_US, START_US, FlatWorld, flat_world, poses_along
from nurec_sim.types import Track, Trajectory

CAR_M = (4.5, 1.8, 1.5)


def car(track_id: str, line: np.ndarray, station_m: np.ndarray, start_us: int = START_US) -> Track:
    """A car whose box centre is at ``station_m[i]`` along a line every 0.1 s."""
    t_us = start_us + LOG_STEP_US * np.arange(len(station_m), dtype=np.int64)
    return Track(track_id, "automobile", CAR_M, Trajectory(t_us, poses_along(line, station_m, z_m=CAR_M[2] / 2)))


def straight_line(length_m: float = 300.0, y_m: float = 0.0) -> np.ndarray:
    return np.array([[0.0, y_m], [length_m / 2, y_m], [length_m, y_m]])


def straight_road(speed_mps: float = 10.0, duration_s: float = 8.0) -> FlatWorld:
    """Along x in the right lane of a 7 m road, alone."""
    return flat_world("straight-road", straight_line(), speed_mps, duration_s)


def parked_car_ahead(distance_m: float = 45.0, speed_mps: float = 10.0, duration_s: float = 8.0) -> FlatWorld:
    """A car stands in the ego's lane; the recorded ego (a ghost) drove through it."""
    steps = int(duration_s * 10) + 1
    track = car("parked", straight_line(), np.full(steps, distance_m))
    return replace(flat_world("parked-car-ahead", straight_line(), speed_mps, duration_s), tracks=(track,))


def braking_lead(gap_m: float = 22.0, speed_mps: float = 10.0, duration_s: float = 8.0) -> FlatWorld:
    """A lead car at the ego's speed brakes by 5 m/s^2 after 1.5 s and stays; the recorded ego (a ghost) drove on."""
    t_s = np.arange(int(duration_s * 10) + 1) / 10
    speeds = np.clip(speed_mps - 5.0 * np.maximum(t_s - 1.5, 0.0), 0.0, None)
    station = gap_m + np.concatenate([[0.0], np.cumsum((speeds[1:] + speeds[:-1]) / 20)])
    world = flat_world("braking-lead", straight_line(), speed_mps, duration_s)
    return replace(world, tracks=(car("lead", straight_line(), station),))


def curve(radius_m: float = 40.0, speed_mps: float = 8.0, duration_s: float = 8.0) -> FlatWorld:
    """20 m straight, then a left-hand curve."""
    angle = np.linspace(0.0, 2.4, 25)
    bend = np.column_stack([20.0 + radius_m * np.sin(angle), radius_m * (1 - np.cos(angle))])
    return flat_world("curve", np.concatenate([[[0.0, 0.0]], bend]), speed_mps, duration_s)


def hill(slope: float = 0.1, speed_mps: float = 10.0, duration_s: float = 6.0) -> FlatWorld:
    """Straight uphill: the recorded car pitches up and rises."""
    world = straight_road(speed_mps, duration_s)
    poses = world.ego.world_from_body.copy()
    poses[:, 2, 3] = slope * poses[:, 0, 3]
    pitch = -np.arctan(slope)
    c, s = np.cos(pitch), np.sin(pitch)
    poses[:, :3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return replace(world, id="hill", ego=Trajectory(world.ego.t_us, poses))


def single_pose() -> FlatWorld:
    """A log of one instant."""
    world = straight_road()
    return replace(world, id="single-pose", ego=first_poses(world, 1), span_us=(START_US, START_US + 1))


def two_poses() -> FlatWorld:
    """A log of two poses 0.1 s apart."""
    world = straight_road()
    return replace(world, id="two-poses", ego=first_poses(world, 2), span_us=(START_US, START_US + 100_001))


def standing(duration_s: float = 4.0) -> FlatWorld:
    """The ego never moved, and a GPS-like jitter of 1 cm is in its poses."""
    world = flat_world("standing", straight_line(), 0.0, duration_s)
    poses = world.ego.world_from_body.copy()
    poses[:, :2, 3] += 0.01 * np.sin(np.arange(len(poses)))[:, None]
    return replace(world, ego=Trajectory(world.ego.t_us, poses))


def shifted_in_time(world: FlatWorld, by_us: int) -> FlatWorld:
    """The same world on another clock."""
    return replace(
        world,
        ego=Trajectory(world.ego.t_us + by_us, world.ego.world_from_body),
        tracks=tuple(
            replace(track, path=Trajectory(track.path.t_us + by_us, track.path.world_from_body))
            for track in world.tracks
        ),
        span_us=(world.span_us[0] + by_us, world.span_us[1] + by_us),
    )


def moved(world: FlatWorld, world_from_old: np.ndarray) -> FlatWorld:
    """The same world under another world frame (a turn about z and a shift)."""
    return replace(
        world,
        ego=Trajectory(world.ego.t_us, world_from_old @ world.ego.world_from_body),
        tracks=tuple(
            replace(track, path=Trajectory(track.path.t_us, world_from_old @ track.path.world_from_body))
            for track in world.tracks
        ),
        road_m=geometry.transform_points(world_from_old, np.column_stack([world.road_m, np.zeros(len(world.road_m))]))[
            :, :2
        ],
    )


def first_poses(world: FlatWorld, count: int) -> Trajectory:
    return Trajectory(world.ego.t_us[:count], world.ego.world_from_body[:count])
