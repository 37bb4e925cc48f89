"""Which LiDAR returns belong to something that moves: those whose place the beams of other sweeps pass through.

Free space does not move. A return in a place that beams crossed shortly before or afterwards comes from an object that
was not there yet, or is no longer there. The ground is left out: beams graze it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim import geometry
from nurec_sim.reconstruct.free_space import VOTES, SweepBeams, balls, count_beams, sweep_beams
from nurec_sim.reconstruct.lift.ground import Ground, find_ground
from nurec_sim.reconstruct.lift.settings import GroundSettings
from nurec_sim.types import Clip, Sweep

REACH_M = 60.0
"""Returns from farther away are too sparse for boxes."""
CELL_M = 0.2
"""One return in each cell of this edge is tested."""
HEIGHT_M = (0.3, 4.5)
"""Above the ground; lower is the ground and kerbs, higher are crowns of trees."""
WINDOW_US = 3_000_000
"""Sweeps within this time before and after have a say: poses drift over longer ones."""
MOST_SWEEPS = 24
"""Sweeps of a window that have a say."""
BALL_M = 0.15
"""Standard deviation of a return as a round Gaussian: about the distance between beams at 40 m."""
CROSSED = 8
"""Beams through a return, by those that ended at it, both within their noise, that make it one of a slow mover."""
GROUND = GroundSettings(cell_m=0.2, reach_m=REACH_M)


@dataclass(frozen=True, eq=False)
class Seen:
    """The returns of one sweep off the ground.

    Attributes:
        xyz_m: returns in the world, one in each cell.
        fired_us: when each was measured; what moves is where it was then.
        height_m: above the ground.
        moving: whether their place is free in other sweeps.
        crossed: whether nearly all beams of other sweeps that came so far went through it, within their noise. This
            tells earlier that something moves that moves slowly or ahead of the car, which only a few sweeps see past;
            but it is true of foliage, too.
    """

    xyz_m: Float64[np.ndarray, "n 3"]
    fired_us: Int64[np.ndarray, " n"]
    height_m: Float64[np.ndarray, " n"]
    moving: Bool[np.ndarray, " n"]
    crossed: Bool[np.ndarray, " n"]


def main_lidar(clip: Clip, hold_out: Collection[int]) -> tuple[str, list[int]] | None:
    """The LiDAR with the most returns in its first sweep, and its sweeps that may be read; None without two sweeps."""
    usable = {
        name: [index for index in range(len(clip.sweep_times_us(name))) if index not in hold_out]
        for name in clip.rig.lidars
    }
    names = [name for name, indices in usable.items() if len(indices) > 1]
    if not names:
        return None
    best = max(names, key=lambda name: len(clip.sweep(name, usable[name][0]).xyz_m)) if len(names) > 1 else names[0]
    return best, usable[best]


def off_ground(clip: Clip, lidar: str, indices: Collection[int]) -> Iterator[Seen]:
    """The sweeps of a LiDAR one after the other; two are enough, but only several tell what moves.

    Args:
        clip: the driving log.
        lidar: one of its LiDARs.
        indices: the sweeps that may be read, ascending.
    """
    ground = _ground(clip, lidar, indices)
    times = clip.sweep_times_us(lidar).sum(axis=1) // 2
    window: deque[tuple[int, SweepBeams]] = deque()
    waiting: deque[tuple[int, Sweep]] = deque()

    def finish() -> Seen:
        t_us, sweep = waiting.popleft()
        while window[0][0] < t_us - WINDOW_US:
            window.popleft()
        others = [beams for at, beams in window if at != t_us]
        return _seen(clip, sweep, ground, [others[k] for k in _spread(len(others))])

    for index in indices:
        sweep, t_us = clip.sweep(lidar, index), int(times[index])
        while waiting and waiting[0][0] < t_us - WINDOW_US:
            yield finish()
        window.append((t_us, sweep_beams(clip, lidar, sweep)))
        waiting.append((t_us, sweep))
    while waiting:
        yield finish()


def _spread(count: int) -> list[int]:
    return sorted(set(np.linspace(0, count - 1, min(MOST_SWEEPS, count)).round().astype(int).tolist()))


def _ground(clip: Clip, lidar: str, indices: Collection[int]) -> Ground:
    clouds = []
    for index in indices:
        xyz, _ = _near(clip, clip.sweep(lidar, index))
        clouds.append(xyz[_thinned(xyz, CELL_M)])
    times = clip.ego.t_us
    poses = clip.ego.at(np.unique(np.clip(clip.sweep_times_us(lidar).reshape(-1), times[0], times[-1])))
    return find_ground(np.concatenate(clouds), poses, GROUND)


def _near(clip: Clip, sweep: Sweep) -> tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, " n"]]:
    """Returns within reach in the world, without those from the recording car itself, and when they were measured."""
    distance = np.linalg.norm(sweep.xyz_m, axis=1)
    near = np.isfinite(distance) & (distance > 0.5) & (distance < REACH_M)
    xyz, fired_us = sweep.xyz_world_m[near], sweep.point_t_us[near]
    in_rig = geometry.transform_points(geometry.inverse(clip.ego.at(sweep.t_us)), xyz)
    others = ~geometry.points_in_box(in_rig - clip.rig.body.center_m, clip.rig.body.size_m, 0.3)
    return xyz[others], fired_us[others]


def _seen(clip: Clip, sweep: Sweep, ground: Ground, others: list[SweepBeams]) -> Seen:
    xyz, fired_us = _near(clip, sweep)
    height = ground.above(xyz)
    rows = np.flatnonzero((height > HEIGHT_M[0]) & (height < HEIGHT_M[1]))
    rows = rows[_thinned(xyz[rows], CELL_M)]
    counts = count_beams(balls(xyz[rows], np.full(len(rows), BALL_M, np.float32)), others)
    crossed = (counts.through >= VOTES) & (counts.through > CROSSED * counts.ended)
    return Seen(xyz[rows], fired_us[rows], height[rows], counts.free, crossed)


def _thinned(xyz: Float64[np.ndarray, "n 3"], cell_m: float) -> Int64[np.ndarray, " m"]:
    """Rows of the first point in each cell of a grid."""
    cells = np.floor(xyz / cell_m).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    key = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])
