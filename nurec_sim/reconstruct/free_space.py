"""Free space along recorded LiDAR beams: Gaussians that would have stopped beams which passed are not there.

A recorded beam ends at its return; whatever it crossed before is empty. Every Gaussian is tested with the beams that
meet its ellipsoid: those that end well behind it speak against it, those that end at it speak for it. So thin and
grazing footprints are judged by the space that they really occupy, and foliage, of which some beams return, stays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32

from nurec_sim import geometry
from nurec_sim.compute.angles import arctan2
from nurec_sim.compute.cores import in_order
from nurec_sim.compute.kernels import kernel, unchecked_kernel
from nurec_sim.reconstruct import beam_counting
from nurec_sim.reconstruct.beam_counting import COLUMNS, MOST_CELLS, NEAREST_M, STEP_RAD
from nurec_sim.types import Clip, Gaussians, Sweep

BEAM_SHARE = 0.25
"""A beam that passes a centre this close meets the Gaussian, however small; as a share of the mean angle between beams.
What lies between beams that all pass is taken for free as well."""
VOTES = 3
"""Fewer beams through a Gaussian do not remove it."""
MOST_SWEEPS = 64
"""Sweeps that a log is thinned to, evenly; bounds time and memory."""
CHUNK = 8192
"""Gaussians that are tested together: a sweep then stays in the cache."""


@dataclass(frozen=True)
class SweepBeams:
    """The beams of one sweep in the axes of its LiDAR at the sweep's reference time, and an image to find them by.

    Attributes:
        t_us: start and end of the sweep.
        world_from_lidar: axes at the reference time; the origin is where the sensor was in the middle of the sweep.
        drift_m: how far the sensor moved during the sweep.
        beams: unit direction, range (m) and firing time (fraction of the sweep) of each return.
        image: [rows, COLUMNS] a beam in each angular cell, -1 without.
        reach_m: [rows, COLUMNS] its range, metres; -1 without.
        farthest_m: [rows, COLUMNS] the largest of these ranges among the cells in which a beam that meets a Gaussian
            with its centre in this cell may be looked for.
        low: elevation of the image's first row, in cells.
        width_rad: half of the width of a beam.
        fraction: mean firing time of each column, as a fraction of the sweep.
    """

    t_us: tuple[int, int]
    world_from_lidar: Float64[np.ndarray, "4 4"]
    drift_m: Float64[np.ndarray, " 3"]
    beams: Float32[np.ndarray, "n 5"]
    image: Int32[np.ndarray, "rows columns"]
    reach_m: Float32[np.ndarray, "rows columns"]
    farthest_m: Float32[np.ndarray, "rows columns"]
    low: int
    width_rad: float
    fraction: Float64[np.ndarray, " columns"]

    @property
    def middle_us(self) -> int:
        """The middle of the sweep."""
        return sum(self.t_us) // 2

    @cached_property
    def lidar_from_world(self) -> Float64[np.ndarray, "4 4"]:
        """The inverse of ``world_from_lidar``."""
        return geometry.inverse(self.world_from_lidar)


@dataclass(frozen=True)
class BeamCounts:
    """Recorded beams that met n Gaussians, up to about ``beam_counting.ENOUGH`` for each.

    Attributes:
        passed: those that ended behind it by more than ``beam_counting.MARGIN_M`` and ``MARGIN_SHARE``.
        stopped: those that ended within this distance before or behind it.
        through: those that ended behind it by more than ``beam_counting.NOISE_M`` and ``NOISE_SHARE``, across its
            surface.
        ended: those that ended within this distance.
    """

    passed: Int32[np.ndarray, " n"]
    stopped: Int32[np.ndarray, " n"]
    through: Int32[np.ndarray, " n"]
    ended: Int32[np.ndarray, " n"]

    @property
    def free(self) -> Bool[np.ndarray, " n"]:
        """Whether they say that nothing is there: at least ``VOTES`` passed, and more than stopped."""
        return (self.passed >= VOTES) & (self.passed > self.stopped)

    @property
    def ended_share(self) -> Float64[np.ndarray, " n"]:
        """Share that ended there within the noise, of those that came so far; 1 where none did."""
        return (self.ended + 1) / (self.ended + self.through + 1)

    @property
    def stopped_share(self) -> Float64[np.ndarray, " n"]:
        """Share that ended there within the margin for poses, of those that came so far; 1 where none did."""
        return (self.stopped + 1) / (self.stopped + self.passed + 1)


def sweep_beams(clip: Clip, lidar: str, sweep: Sweep) -> SweepBeams:
    """The beams of a recorded sweep; each starts where the sensor was when it was fired."""
    rig_from_lidar = clip.rig.lidars[lidar].rig_from_lidar
    # The sweep's own pose is the reference; the ego trajectory only adds the motion around it.
    reference = geometry.inverse(clip.ego.at(sweep.t_us) @ rig_from_lidar)
    poses = [
        sweep.world_from_lidar @ reference @ clip.ego.at(t) @ rig_from_lidar for t in (sweep.start_us, sweep.end_us)
    ]
    start, end = (pose[:3, 3] for pose in poses)
    pose = sweep.world_from_lidar.copy()
    middle = (start + end) / 2
    drift = (end - start) @ pose[:3, :3]
    fired = np.clip((sweep.point_t_us - sweep.start_us) / max(sweep.end_us - sweep.start_us, 1), 0, 1)
    pose[:3, 3] = middle
    along = sweep.xyz_m + (sweep.world_from_lidar[:3, 3] - middle) @ pose[:3, :3] - (fired - 0.5)[:, None] * drift
    return _beams((sweep.start_us, sweep.end_us), pose, drift, along, fired)


def _beams(t_us, world_from_lidar, drift_m, along, fired) -> SweepBeams:
    beams, distance, row, column, count, total = _in_cells(along, fired)
    low = int(row.min(initial=0))
    image = np.full((int(row.max(initial=0)) - low + 1, COLUMNS), -1, np.int32)
    _fill_image(row - low, column, distance, image)
    mean = total / np.maximum(count, 1)
    # Columns without returns were fired after the one before them.
    last = np.maximum.accumulate(np.where(count > 0, np.arange(COLUMNS), -1))
    last[last < 0] = last[-1]
    width = BEAM_SHARE * STEP_RAD * np.sqrt(len(image) * np.count_nonzero(count) / max(len(distance), 1))
    reach = np.where(image >= 0, beams[image, 3], np.float32(-1)) if len(beams) else np.full_like(image, -1, np.float32)
    farthest = _farthest(reach)
    return SweepBeams(t_us, world_from_lidar, drift_m, beams, image, reach, farthest, low, width, mean[last])


def _farthest(reach_m: Float32[np.ndarray, "rows columns"]) -> Float32[np.ndarray, "rows columns"]:
    """The largest range up to ``MOST_CELLS`` rows and columns away, across the seam; one more for rounding."""
    cells = int(np.ceil(MOST_CELLS)) + 1
    around = np.concatenate([reach_m[:, -cells:], reach_m, reach_m[:, :cells]], axis=1)
    window = np.ones((2 * cells + 1, 2 * cells + 1), np.uint8)
    return np.ascontiguousarray(cv2.dilate(around, window)[:, cells:-cells])


@unchecked_kernel
def _in_cells(along, fired):
    """Beams [n,5] that ended farther than ``NEAREST_M``, their exact ranges and the rows and columns of their cells.

    And for each column: how many there are, and the sum of their firing times.
    """
    beams, distance = np.empty((len(along), 5), np.float32), np.empty(len(along))
    row, column = np.empty(len(along), np.int64), np.empty(len(along), np.int64)
    count, total = np.zeros(COLUMNS, np.int64), np.zeros(COLUMNS)
    n = 0
    for i in range(len(along)):
        x, y, z = along[i, 0], along[i, 1], along[i, 2]
        size = np.sqrt(x * x + y * y + z * z)
        if not NEAREST_M < size < np.inf:
            continue
        beams[n, 0], beams[n, 1], beams[n, 2], beams[n, 3], beams[n, 4] = x / size, y / size, z / size, size, fired[i]
        distance[n] = size
        row[n] = np.int64(np.floor(arctan2(z, np.sqrt(x * x + y * y)) / STEP_RAD))
        column[n] = np.int64(np.floor((arctan2(y, x) + np.pi) / STEP_RAD)) % COLUMNS
        count[column[n]] += 1
        total[column[n]] += fired[i]
        n += 1
    return beams[:n], distance[:n], row[:n], column[:n], count, total


@kernel
def _fill_image(row, column, distance, image):
    """The nearest of the beams that share a cell: the far ones would carve what the near ones returned from."""
    for i in range(len(distance)):
        there = image[row[i], column[i]]
        if there < 0 or distance[i] <= distance[there]:
            image[row[i], column[i]] = i


def chosen_sweeps(clip: Clip, hold_out: Collection[int], most: int = MOST_SWEEPS) -> list[tuple[str, int]]:
    """LiDAR and index of the sweeps whose beams are used: ``most`` at most, evenly, none of ``hold_out``."""
    every = [
        (lidar, i) for lidar in clip.rig.lidars for i in range(len(clip.sweep_times_us(lidar))) if i not in hold_out
    ]
    return [every[k] for k in np.unique(np.linspace(0, len(every) - 1, min(most, len(every))).round().astype(int))]


def balls(xyz_m: Float64[np.ndarray, "n 3"], sigma_m: Float32[np.ndarray, " n"]) -> Gaussians:
    """Points as round Gaussians, to test them."""
    one = Gaussians.empty(len(xyz_m))
    return dataclasses.replace(
        one, mean_m=xyz_m.astype(np.float32), scale_m=np.repeat(sigma_m.astype(np.float32)[:, None], 3, axis=1)
    )


def in_free_space(
    gaussians: Gaussians,
    sweeps: Sequence[SweepBeams],
    world_from_body: Callable[[int], Float64[np.ndarray, "4 4"] | None] = lambda t_us: np.eye(4),
    box_m: Sequence[float] = (0.0, 0.0, 0.0),
) -> Bool[np.ndarray, " n"]:
    """Gaussians that at least ``VOTES`` recorded beams passed through, and more than ended there; see ``count_beams``.

    What lies in the body's box stays: beams pass through the windows of a car and do not return from black paint.
    """
    return count_beams(gaussians, sweeps, world_from_body, box_m).free


def weighed(gaussians: Gaussians, ended_share: Float64[np.ndarray, " n"]) -> Gaussians:
    """The Gaussians as opaque as recorded beams found them: less, the more beams passed through them.

    A beam that meets a surface goes through about two of its Gaussians, so the opacity falls with the square of the
    share of beams that ended there. Foliage, bars and what reaches over the edge of a surface let light through.

    Args:
        gaussians: as opaque as where nothing passes.
        ended_share: see ``BeamCounts``.
    """
    return dataclasses.replace(gaussians, opacity=(gaussians.opacity * ended_share**2).astype(np.float32))


def count_beams(
    gaussians: Gaussians,
    sweeps: Sequence[SweepBeams],
    world_from_body: Callable[[int], Float64[np.ndarray, "4 4"] | None] = lambda t_us: np.eye(4),
    box_m: Sequence[float] = (0.0, 0.0, 0.0),
) -> BeamCounts:
    """How many recorded beams went through each Gaussian, and how many ended at it.

    Args:
        gaussians: in the frame of a rigid body.
        sweeps: recorded beams.
        world_from_body: where the body is at a time in microseconds; None if unknown. The static world by default.
        box_m: size of the body's box, if it has one; what lies in it is not tested.
    """
    tested = np.flatnonzero((np.abs(gaussians.mean_m) >= np.asarray(box_m) / 2).any(axis=1))
    counts = np.zeros((len(tested), 4), np.int32)
    jobs = []
    # Sweeps far apart first: a few beams then show a Gaussian from different sides. The golden ratio spreads best.
    for k in np.argsort(np.arange(len(sweeps)) * 0.6180339887498949 % 1.0, kind="stable"):
        sweep = sweeps[k]
        world = world_from_body(sweep.middle_us)
        if world is not None:
            pose = sweep.lidar_from_world @ world
            found = sweep.beams, sweep.image, sweep.reach_m, sweep.farthest_m
            jobs.append((pose, sweep.drift_m, *found, sweep.low, sweep.width_rad, sweep.fraction))

    def count(start: int) -> None:
        part = slice(start, start + CHUNK)
        mine = tested[part]
        shapes = beam_counting.ellipsoids(gaussians.mean_m[mine], gaussians.quat_wxyz[mine], gaussians.scale_m[mine])
        for job in jobs:
            beam_counting.count(*shapes, *job, counts[part])

    for _ in in_order(count, range(0, len(tested), CHUNK)):
        pass
    every = np.zeros((4, len(gaussians)), np.int32)
    every[:, tested] = counts.T
    return BeamCounts(*every)
