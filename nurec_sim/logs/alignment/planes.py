"""Points of a log that lie on planes which several of its sweeps have seen: the ground, walls, sides of parked cars."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim.compute.cores import in_order
from nurec_sim.logs.clip import Clip
from nurec_sim.logs.odometry.static_points import moving_tracks, standing
from nurec_sim.types import Track

FARTHEST_M = 50.0
GROUND_CELL_M, WALL_CELL_M = 0.4, 0.8
HEIGHT_M, SLOPE = 0.5, 0.05
"""Ground lies within the height of the road below the car, and this much more per metre of distance."""
ROUGH_M = 0.1
"""Largest standard deviation across a plane: that of the errors to be found, not that of kerbs and leaves."""
FEWEST_POINTS = 4
FLAT, WIDE = 0.1, 0.05
"""Variances of the points of a wall by the next larger one: across it at most, along its shorter side at least."""
UPRIGHT = 0.5
"""Largest vertical part of the normal of a wall."""
MOST_POINTS, MOST_IN_ALL = 12_000, 800_000
"""Per sweep, and in a log; evenly chosen from more."""

Vectors = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class PlanePoints:
    """Points on planes.

    Attributes:
        lidar: of each sweep, the index of its LiDAR in the order of the rig.
        t_us: its time.
        turn: its rotation ``world_from_lidar``.
        sweep: of each point, the index of its sweep.
        at_us: time of the pose that moves the point: when it was measured, or, where the log has compensated for the
            motion of the car already, the time of the sweep.
        beam_m: the point in the frame of its LiDAR when it was measured, as recorded.
        xyz_m: the point in the world.
        normal: of its plane.
        plane: number of its plane, counted from 0.
    """

    lidar: Int64[np.ndarray, " sweeps"]
    t_us: Int64[np.ndarray, " sweeps"]
    turn: Float64[np.ndarray, "sweeps 3 3"]
    sweep: Int64[np.ndarray, " n"]
    at_us: Int64[np.ndarray, " n"]
    beam_m: Vectors
    xyz_m: Vectors
    normal: Vectors
    plane: Int64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.plane)

    @property
    def across_m(self) -> Float64[np.ndarray, " n"]:
        """Distance of each point from the mean of its plane, along the normal."""
        count = np.bincount(self.plane)
        mean = np.stack([np.bincount(self.plane, each) / count for each in self.xyz_m.T], axis=1)
        return np.sum((self.xyz_m - mean[self.plane]) * self.normal, axis=1)


def plane_points(clip: Clip, hold_out: Collection[int] = ()) -> PlanePoints:
    """Points on planes that at least two sweeps have seen.

    The ground is taken to be level in squares of ``GROUND_CELL_M``; walls are looked for in cubes of ``WALL_CELL_M``.

    Args:
        clip: a log with at least one sweep that is not held out.
        hold_out: indices of sweeps that must not be read, of every LiDAR.

    Raises:
        ClipError: a sweep cannot be read.
    """
    moving = moving_tracks(clip)
    jobs = [
        (number, name, index)
        for number, name in enumerate(clip.rig.lidars)
        for index in range(clip.sweep_count(name))
        if index not in hold_out
    ]
    most = min(MOST_POINTS, MOST_IN_ALL // max(len(jobs), 1))
    parts = list(in_order(lambda job: _of_sweep(clip, *job[1:], moving, most), jobs))
    records = [clip.sweep_records(name)[index] for _, name, index in jobs]
    t_us = np.array([record.t_us for record in records], np.int64)
    at_us, beam, xyz, low = (np.concatenate(column) for column in zip(*parts, strict=True))
    sweep = np.repeat(np.arange(len(jobs)), [len(part[0]) for part in parts])
    ground, up = _ground(xyz, t_us[sweep], low), np.array([0.0, 0.0, 1.0])
    wall, normals = _walls(xyz, t_us[sweep], ~low)
    plane = np.where(ground >= 0, ground, np.where(wall >= 0, wall + ground.max(initial=-1) + 1, -1))
    found = np.flatnonzero(plane >= 0)
    return PlanePoints(
        lidar=np.array([number for number, _, _ in jobs], np.int64),
        t_us=t_us,
        turn=np.array([record.world_from_lidar[:3, :3] for record in records]),
        sweep=sweep[found],
        at_us=at_us[found],
        beam_m=beam[found],
        xyz_m=xyz[found],
        normal=np.where((ground >= 0)[:, None], up, normals)[found],
        plane=np.unique(plane[found], return_inverse=True)[1],
    )


def _of_sweep(
    clip: Clip, lidar: str, index: int, moving: list[Track], most: int
) -> tuple[Int64[np.ndarray, " n"], Vectors, Vectors, Bool[np.ndarray, " n"]]:
    """Some points of a sweep that stand still: times, as fired, in the world, and whether they are near the ground."""
    sweep = clip.sweep(lidar, index)
    keep, rig_m = standing(clip, sweep, moving)
    level = np.hypot(rig_m[:, 0], rig_m[:, 1])
    found = np.flatnonzero(keep & (level < FARTHEST_M))
    found = found[:: len(found) // most + 1]
    beam, at_us = sweep.xyz_m[found], np.full(len(found), sweep.t_us, np.int64)
    if not clip.sweep_records(lidar)[index].compensated:
        at_us = sweep.point_t_us[found]
        beam = beam + _driven_m(clip, sweep.t_us, sweep.point_t_us[found]) @ sweep.world_from_lidar[:3, :3]
    low = np.abs(rig_m[found, 2]) < HEIGHT_M + SLOPE * level[found]
    return at_us, beam, sweep.xyz_world_m[found], low


def _driven_m(clip: Clip, t_us: int, point_t_us: Int64[np.ndarray, " n"]) -> Vectors:
    """From the car at the time of each point to the car at that of the sweep, in the world.

    Turns of the car do not change the elevation of a beam.
    """
    span = np.clip(np.array([t_us - 50_000, t_us + 50_000]), clip.ego.start_us, clip.ego.end_us)
    if span[0] == span[1]:
        return np.zeros((len(point_t_us), 3))
    ends = clip.ego.at(span)[:, :3, 3]
    return ((t_us - point_t_us) / (span[1] - span[0]))[:, None] * (ends[1] - ends[0])


def _ground(xyz: Vectors, t_us: Int64[np.ndarray, " n"], may: Bool[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """The level square of each point, -1 for none."""
    rows = np.flatnonzero(may)
    cell = _numbered(np.floor(xyz[rows, :2] / GROUND_CELL_M).astype(np.int64))
    count = np.bincount(cell)
    mean = np.bincount(cell, xyz[rows, 2]) / count
    spread = np.sqrt(np.bincount(cell, (xyz[rows, 2] - mean[cell]) ** 2) / count)
    good = (count >= FEWEST_POINTS) & (spread < ROUGH_M) & _seen_twice(cell, t_us[rows])
    result = np.full(len(xyz), -1)
    result[rows] = np.where(good[cell], cell, -1)
    return result


def _walls(
    xyz: Vectors, t_us: Int64[np.ndarray, " n"], may: Bool[np.ndarray, " n"]
) -> tuple[Int64[np.ndarray, " n"], Vectors]:
    """The cube of each point whose points lie on an upright plane, -1 for none, and the plane's normal."""
    rows = np.flatnonzero(may)
    result, normals = np.full(len(xyz), -1), np.zeros((len(xyz), 3))
    if not len(rows):
        return result, normals
    cell = _numbered(np.floor(xyz[rows] / WALL_CELL_M).astype(np.int64))
    count = np.bincount(cell)
    mean = np.stack([np.bincount(cell, each) / count for each in xyz[rows].T], axis=1)
    off = xyz[rows] - mean[cell]
    covariance = np.empty((len(count), 3, 3))
    for one in range(3):
        for two in range(3):
            covariance[:, one, two] = np.bincount(cell, off[:, one] * off[:, two]) / count
    variance, axes = np.linalg.eigh(covariance)
    good = (count >= 3 * FEWEST_POINTS) & (variance[:, 0] < ROUGH_M**2) & (np.abs(axes[:, 2, 0]) < UPRIGHT)
    good &= (variance[:, 0] < FLAT * variance[:, 1]) & (variance[:, 1] > WIDE * variance[:, 2])
    good &= _seen_twice(cell, t_us[rows])
    result[rows] = np.where(good[cell], cell, -1)
    normals[rows] = axes[cell, :, 0]
    return result, normals


def _numbered(cells: Int64[np.ndarray, "n d"]) -> Int64[np.ndarray, " n"]:
    """Cells of a grid counted from 0."""
    key = np.zeros(len(cells), np.int64)
    for column in (cells - cells.min(axis=0, initial=0)).T:
        key = (key << 21) | column
    return np.unique(key, return_inverse=True)[1]


def _seen_twice(cell: Int64[np.ndarray, " n"], t_us: Int64[np.ndarray, " n"]) -> Bool[np.ndarray, " cells"]:
    """Which cells have points of two sweeps."""
    size = cell.max(initial=-1) + 1
    first, last = np.full(size, np.iinfo(np.int64).max), np.full(size, np.iinfo(np.int64).min)
    np.minimum.at(first, cell, t_us)
    np.maximum.at(last, cell, t_us)
    return last > first
