"""Free space along recorded LiDAR beams: Gaussians that would have stopped beams which passed are not there.

A recorded beam ends at its return; whatever it crossed before is empty. Every Gaussian is tested with the beams that
meet its ellipsoid: those that end well behind it speak against it, those that end at it speak for it. So thin and
grazing footprints are judged by the space that they really occupy, and foliage, of which some beams return, stays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32

from nurec_sim import geometry
from nurec_sim.compute.cores import in_order
from nurec_sim.compute.kernels import inner, kernel
from nurec_sim.types import Clip, Gaussians, Sweep

STEP_RAD = np.radians(0.2)
"""Cells of a sweep's image: about one beam of a scanner with 64 rows each."""
COLUMNS = 1800
BEAM_SHARE = 0.25
"""A beam that passes a centre this close meets the Gaussian, however small; as a share of the mean angle between beams.
What lies between beams that all pass is taken for free as well."""
MEETS = 1.5
"""Squared Mahalanobis distance within which a beam meets a Gaussian: it would lose half of its light there."""
MARGIN_M, MARGIN_SHARE = 0.3, 0.02
"""A beam ends at a Gaussian within this distance along it, plus a share of its range: noise of poses and surfaces."""
NOISE_M, NOISE_SHARE = 0.04, 0.002
"""The same for how opaque a Gaussian is: noise only. By the margin foliage before a wall would be as opaque as that."""
LEAST_FACING = 0.15
"""Noise is measured across the surface; along a grazing beam it is longer, by one over this cosine at most."""
FARTHEST_M = 60.0
"""Poses and boxes are too inaccurate to carve farther away."""
VOTES = 3
"""Fewer beams through a Gaussian do not remove it."""
ENOUGH, CLEAR = 24, 6
"""Beams that decide, and those that do if nearly all agree; more are not looked for."""
MOST_SWEEPS = 64
"""Sweeps that a log is thinned to, evenly; bounds time and memory."""
THINNEST_M = 1e-4
NEAREST_M = 1.0
MOST_CELLS = 3.0
"""Beams are looked for this far from the direction of a centre, in cells, and not between the sensor and the car."""
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


@dataclass(frozen=True)
class BeamCounts:
    """Recorded beams that met n Gaussians, up to about ``ENOUGH`` for each.

    Attributes:
        passed: those that ended behind it by more than ``MARGIN_M`` and ``MARGIN_SHARE``.
        stopped: those that ended within this distance before or behind it.
        through: those that ended behind it by more than ``NOISE_M`` and ``NOISE_SHARE``, across its surface.
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
    distance = np.linalg.norm(along, axis=1)
    good = np.isfinite(distance) & (distance > NEAREST_M)
    along, distance, fired = along[good] / distance[good, None], distance[good], fired[good]
    row = np.floor(np.arcsin(np.clip(along[:, 2], -1, 1)) / STEP_RAD).astype(np.int64)
    column = np.floor((np.arctan2(along[:, 1], along[:, 0]) + np.pi) / STEP_RAD).astype(np.int64) % COLUMNS
    low = int(row.min(initial=0))
    image = np.full((int(row.max(initial=0)) - low + 1, COLUMNS), -1, np.int32)
    _fill_image(row - low, column, distance, image)
    count = np.bincount(column, minlength=COLUMNS)
    mean = np.bincount(column, fired, minlength=COLUMNS) / np.maximum(count, 1)
    # Columns without returns were fired after the one before them.
    last = np.maximum.accumulate(np.where(count > 0, np.arange(COLUMNS), -1))
    last[last < 0] = last[-1]
    width = BEAM_SHARE * STEP_RAD * np.sqrt(len(image) * np.count_nonzero(count) / max(len(distance), 1))
    beams = np.column_stack([along, distance, fired]).astype(np.float32)
    reach = np.where(image >= 0, beams[image, 3], np.float32(-1)) if len(beams) else np.full_like(image, -1, np.float32)
    farthest = _farthest(reach)
    return SweepBeams(t_us, world_from_lidar, drift_m, beams, image, reach, farthest, low, width, mean[last])


def _farthest(reach_m: Float32[np.ndarray, "rows columns"]) -> Float32[np.ndarray, "rows columns"]:
    """The largest range up to ``MOST_CELLS`` rows and columns away, across the seam; one more for rounding."""
    cells = int(np.ceil(MOST_CELLS)) + 1
    around = np.concatenate([reach_m[:, -cells:], reach_m, reach_m[:, :cells]], axis=1)
    window = np.ones((2 * cells + 1, 2 * cells + 1), np.uint8)
    return np.ascontiguousarray(cv2.dilate(around, window)[:, cells:-cells])


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
        world = world_from_body(sum(sweep.t_us) // 2)
        if world is not None:
            pose = geometry.inverse(sweep.world_from_lidar) @ world
            found = sweep.beams, sweep.image, sweep.reach_m, sweep.farthest_m
            jobs.append((pose, sweep.drift_m, *found, sweep.low, sweep.width_rad, sweep.fraction))

    def count(start: int) -> None:
        part = slice(start, start + CHUNK)
        mine = tested[part]
        xyz, quat = (values[mine].astype(np.float64) for values in (gaussians.mean_m, gaussians.quat_wxyz))
        scale = np.maximum(gaussians.scale_m[mine].astype(np.float64), THINNEST_M)
        axes = np.ascontiguousarray(np.swapaxes(geometry.matrix_from_quat(quat), 1, 2))
        canonical, extent = axes / scale[:, :, None], axes * (np.sqrt(MEETS) * scale)[:, :, None]
        for job in jobs:
            _count(xyz, canonical, extent, *job, counts[part])

    for _ in in_order(count, range(0, len(tested), CHUNK)):
        pass
    every = np.zeros((4, len(gaussians)), np.int32)
    every[:, tested] = counts.T
    return BeamCounts(*every)


@inner
def _angle(y, x):
    """Angle of the direction (x, y) within 2e-8 rad, by Abramowitz and Stegun 4.4.49; a fifth of ``arctan2``'s time."""
    wide, high = abs(x), abs(y)
    t = min(wide, high) / max(wide, high, 1e-300)
    q = t * t
    angle = ((0.0028662257 * q - 0.0161657367) * q + 0.0429096138) * q - 0.0752896400
    angle = (((angle * q + 0.1065626393) * q - 0.1420889944) * q + 0.1999355085) * q - 0.3333314528
    angle = t * (angle * q + 1.0)
    if high > wide:
        angle = 0.5 * np.pi - angle
    if x < 0:
        angle = np.pi - angle
    return -angle if y < 0 else angle


@inner
def _turned(turn, x, y, z):
    return (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z,
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z,
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z,
    )


@inner
def _half_width(axes, u, v, w):
    """Half of the width along a unit vector of an ellipsoid with the given half axes (rows)."""
    square = 0.0
    for k in range(3):
        part = axes[k, 0] * u + axes[k, 1] * v + axes[k, 2] * w
        square += part * part
    return np.sqrt(square)


@inner
def _in_axes(canonical, turn, result):
    """Rows of a Gaussian's ``canonical`` matrix in the axes of the LiDAR, into ``result``.

    Returns the number of the thinnest one, and one over the standard deviation along it.

    ``canonical`` times a vector is that vector in standard deviations along the Gaussian's axes.
    """
    thinnest, largest = 0, 0.0
    for k in range(3):
        c, square = canonical[k], 0.0
        for m in range(3):
            part = c[0] * turn[0, m] + c[1] * turn[1, m] + c[2] * turn[2, m]
            result[k, m] = part
            square += part * part
        if square > largest:
            thinnest, largest = k, square
    return thinnest, np.sqrt(largest)


@inner
def _meeting(canonical, ax, ay, az, dx, dy, dz):
    """Where along a beam (dx, dy, dz) it is nearest to a Gaussian, and the squared Mahalanobis distance there.

    ``a`` is the Gaussian's centre as seen from the beam's origin, in its standard deviations.
    """
    u = canonical[0, 0] * dx + canonical[0, 1] * dy + canonical[0, 2] * dz
    v = canonical[1, 0] * dx + canonical[1, 1] * dy + canonical[1, 2] * dz
    w = canonical[2, 0] * dx + canonical[2, 1] * dy + canonical[2, 2] * dz
    ab, bb = ax * u + ay * v + az * w, u * u + v * v + w * w
    return ab / bb, ax * ax + ay * ay + az * az - ab * ab / bb


@kernel
def _count(xyz, canonical, extent, pose, drift, beams, image, reach_m, farthest_m, low, width, fraction, counts):
    """Adds the beams of one sweep to ``counts`` [n,4], in the order of ``BeamCounts``."""
    rows = image.shape[0]
    turn, own = np.ascontiguousarray(pose[:3, :3].T), np.empty((3, 3))
    for i in range(len(xyz)):
        total = counts[i, 0] + counts[i, 1]
        if total >= ENOUGH or (total >= CLEAR and 8 * min(counts[i, 0], counts[i, 1]) <= total):
            continue
        px, py, pz = _turned(pose, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        px, py, pz = px + pose[0, 3], py + pose[1, 3], pz + pose[2, 3]
        if px * px + py * py + pz * pz > FARTHEST_M * FARTHEST_M:
            continue
        # The sensor moves while it spins; one correction suffices, as it moves little while it turns by the parallax.
        f = fraction[int((_angle(py, px) + np.pi) / STEP_RAD) % COLUMNS] - 0.5
        x, y, z = px - f * drift[0], py - f * drift[1], pz - f * drift[2]
        level, distance = np.sqrt(x * x + y * y), np.sqrt(x * x + y * y + z * z)
        # No scanner looks straight up or down.
        if distance < NEAREST_M or level < 0.1 * distance:
            continue
        azimuth, elevation = (_angle(y, x) + np.pi) / STEP_RAD, _angle(z, level) / STEP_RAD - low
        margin, noise = MARGIN_M + MARGIN_SHARE * distance, NOISE_M + NOISE_SHARE * distance
        # Most Gaussians are hidden from most sweeps: all beams around end before them.
        middle = min(max(int(np.floor(elevation)), 0), rows - 1)
        if farthest_m[middle, int(np.floor(azimuth)) % COLUMNS] < distance - margin:
            continue
        # Seen along the beams a grazing footprint is as small as others, however long.
        up, back = level / distance, -z / (level * distance)
        across = _half_width(extent[i], *_turned(turn, -y / level, x / level, 0.0)) / level
        upward = _half_width(extent[i], *_turned(turn, back * x, back * y, up)) / distance
        across = min(max(across, width) / STEP_RAD, MOST_CELLS)
        upward = min(max(upward, width) / STEP_RAD, MOST_CELLS)
        thinnest, inverse_m = _in_axes(canonical[i], turn, own)
        cx, cy, cz = _turned(own, px, py, pz)
        mx, my, mz = _turned(own, drift[0], drift[1], drift[2])
        for row in range(
            max(int(np.floor(elevation - upward)), 0), min(int(np.floor(elevation + upward)), rows - 1) + 1
        ):
            for cell in range(int(np.floor(azimuth - across)), int(np.floor(azimuth + across)) + 1):
                column = cell % COLUMNS
                if reach_m[row, column] < distance - margin:
                    continue
                b = image[row, column]
                if b < 0:
                    continue
                # The beam and the centre as seen from where the beam was fired.
                f = beams[b, 4] - 0.5
                ox, oy, oz = px - f * drift[0], py - f * drift[1], pz - f * drift[2]
                dx, dy, dz = beams[b, 0], beams[b, 1], beams[b, 2]
                t = ox * dx + oy * dy + oz * dz
                if ox * ox + oy * oy + oz * oz - t * t > (width * distance) ** 2:
                    t, square = _meeting(own, cx - f * mx, cy - f * my, cz - f * mz, dx, dy, dz)
                    if square > MEETS:
                        continue
                behind = beams[b, 3] - t
                if behind > margin:
                    counts[i, 0] += 1
                elif behind > -margin:
                    counts[i, 1] += 1
                # Across the surface noise is as large for all beams; along grazing ones it is longer.
                along = abs(own[thinnest, 0] * dx + own[thinnest, 1] * dy + own[thinnest, 2] * dz)
                facing = max(along / inverse_m, LEAST_FACING)
                if behind > noise / facing:
                    counts[i, 2] += 1
                elif behind > -noise / facing:
                    counts[i, 3] += 1
