"""Sweeps gathered into one thinned cloud per rigid body: the static world, and each actor in its own box frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim import geometry
from nurec_sim.compute.cores import in_order
from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.free_space import SweepBeams, chosen_sweeps, sweep_beams
from nurec_sim.reconstruct.lift.cloud import Cloud, Voxels, unthinned, voxel_sums
from nurec_sim.reconstruct.lift.settings import PointSettings
from nurec_sim.types import MOVABLE_LABELS, Clip, Track, Trajectory

FOOT_M = 0.3
"""Points this close to the bottom of a box may be road; the ground decides."""
NEAREST_M, BODY_MARGIN_M = 0.5, 0.3
"""Returns from nearer, or this near to the ego car's box, are of the car."""


LONE_LABEL_US = 50_000
"""A track that is labelled once is there so long before and after: its sweep, and images beside it, show it as well."""


@dataclass(frozen=True)
class Actor:
    """A labelled object, ``clip.tracks[index]``; a static one has one pose, and exists over the whole clip.

    With ``window_us`` it is the object from the first of these times until before the second.
    """

    index: int
    track: Track
    standing: bool
    path: Trajectory
    window_us: tuple[int, int] | None = None

    def present(self, t_us: Int64[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Whether the actor is known to be where its path says."""
        if self.standing:
            return np.ones(np.shape(t_us), bool)
        around_us = LONE_LABEL_US if len(self.path.t_us) == 1 else 0
        known = (t_us >= self.path.start_us - around_us) & (t_us <= self.path.end_us + around_us)
        return known if self.window_us is None else known & (t_us >= self.window_us[0]) & (t_us < self.window_us[1])


def actors_of(clip: Clip, settings: PointSettings) -> list[Actor]:
    """The movable tracks of a clip, each classified as static or moving."""
    actors = []
    for index, track in enumerate(clip.tracks):
        if track.label not in MOVABLE_LABELS:
            continue
        standing = len(track.path.t_us) > 1 and not _moves(track.path.position_m, settings.standing_m)
        path = track.path
        if standing:
            middle = int(np.argmin(np.linalg.norm(path.position_m - np.median(path.position_m, axis=0), axis=1)))
            path = Trajectory(path.t_us[middle : middle + 1], path.world_from_body[middle : middle + 1])
        actors.append(Actor(index, track, standing, path))
    return actors


FAR_M, LARGEST_BACK = 1.0, 0.5
"""What is labelled so far from its middle moves. Less far, what moves goes back by this share of its way at most, where
labels that jitter go to and fro."""


def _moves(place_m: Float64[np.ndarray, "k 3"], standing_m: float) -> bool:
    """Whether a labelled object moves: labels of what stands jitter, those of far objects by decimetres.

    A car that stops or starts within the log moves by little, and for a short time: most labels are at one place.

    Args:
        place_m: its labelled places, in order of time.
        standing_m: what moves less than this stands.
    """
    apart = np.linalg.norm(place_m - np.median(place_m, axis=0), axis=1).max()
    if not standing_m <= apart < FAR_M:
        return bool(apart >= FAR_M)
    third = max(len(place_m) // 3, 1)
    if np.linalg.norm(np.median(place_m[-third:], axis=0) - np.median(place_m[:third], axis=0)) >= standing_m:
        return True
    way = place_m[-1] - place_m[0]
    length = np.linalg.norm(way)
    along = place_m @ (way / max(length, 1e-9))
    back = (np.maximum.accumulate(along) - along).max()
    return bool(length >= standing_m and back < LARGEST_BACK * length)


PATH_PART = 16
"""Places of the path that are tested together."""


def _path_parts(path_m: Float64[np.ndarray, "k 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The path in parts of consecutive places [p,PATH_PART,3], and their bounding spheres: [p,3] and [p] metres."""
    count = -(-len(path_m) // PATH_PART)
    parts = np.asarray(path_m, np.float64)[np.minimum(np.arange(count * PATH_PART), len(path_m) - 1)]
    parts = parts.reshape(count, PATH_PART, 3)
    centre = parts.mean(axis=1)
    return parts, centre, np.linalg.norm(parts - centre[:, None], axis=2).max(axis=1)


@kernel
def _distance_m(xyz, parts, centre, radius):
    """Distance [n] of points [n,3] from the nearest place of the path (``_path_parts``)."""
    result = np.empty(len(xyz))
    nearest = 0
    for i in range(len(xyz)):
        best, best_m = np.inf, np.inf
        # That of the point before comes first: beams fired one after the other end near each other.
        for n in range(-1, len(parts)):
            k = nearest if n < 0 else n
            a, b, c = xyz[i, 0] - centre[k, 0], xyz[i, 1] - centre[k, 1], xyz[i, 2] - centre[k, 2]
            reach = best_m + radius[k]
            if a * a + b * b + c * c >= reach * reach:
                continue
            for j in range(PATH_PART):
                a, b, c = xyz[i, 0] - parts[k, j, 0], xyz[i, 1] - parts[k, j, 1], xyz[i, 2] - parts[k, j, 2]
                square = a * a + b * b + c * c
                if square < best:
                    best, nearest = square, k
            best_m = np.sqrt(best)
        result[i] = best_m
    return result


@kernel
def _between(xyz, low, high):
    """Indices of the points [n,3] in a box along the axes."""
    found = np.empty(len(xyz), np.int64)
    count = 0
    for i in range(len(xyz)):
        if low[0] <= xyz[i, 0] <= high[0] and low[1] <= xyz[i, 1] <= high[1] and low[2] <= xyz[i, 2] <= high[2]:
            found[count] = i
            count += 1
    return found[:count]


@kernel
def _usable(xyz, xyz_world, farthest_m, rig_from_world, centre, half):
    """Indices of the returns [n,3] of a sweep that are neither too near or far nor of the ego car, a box in the rig."""
    found = np.empty(len(xyz), np.int64)
    count = 0
    for i in range(len(xyz)):
        distance = np.sqrt(xyz[i, 0] * xyz[i, 0] + xyz[i, 1] * xyz[i, 1] + xyz[i, 2] * xyz[i, 2])
        # False where a coordinate is not a number.
        if not NEAREST_M < distance < farthest_m:
            continue
        x, y, z = xyz_world[i, 0], xyz_world[i, 1], xyz_world[i, 2]
        inside = True
        for k in range(3):
            m = rig_from_world[k]
            inside &= abs(m[0] * x + m[1] * y + m[2] * z + m[3] - centre[k]) <= half[k]
        found[count] = i
        count += not inside
    return found[:count]


@dataclass(frozen=True)
class Gathered:
    """What the sweeps gave: the static cloud, one cloud per actor (box frame), and the undecided feet of boxes.

    Actors have the numbers of their places in the list. ``feet`` holds, per actor, the points near its box's bottom in
    the box frame, and their world positions.
    ``beams`` are those of the sweeps, at most ``free_space.MOST_SWEEPS`` of them.
    """

    static: Cloud
    actors: dict[int, Cloud]
    feet: dict[int, tuple[Cloud, Float64[np.ndarray, "n 3"]]]
    beams: list[SweepBeams]
    sweep_count: int
    point_count: int
    intensity_known: bool


def voxel_edge_m(
    xyz_m: Float64[np.ndarray, "n 3"], path_m: Float64[np.ndarray, "k 3"], settings: PointSettings
) -> Float64[np.ndarray, " n"]:
    """Edge of the voxel that a point falls into: larger far from the driven path, in powers of two."""
    distance = _distance_m(np.asarray(xyz_m, np.float64), *_path_parts(path_m))
    edge = np.clip(settings.voxel_per_distance * distance, settings.min_voxel_m, settings.max_voxel_m)
    return settings.min_voxel_m * 2.0 ** np.floor(np.log2(edge / settings.min_voxel_m) + 1e-9)


def gather(
    clip: Clip,
    actors: Sequence[Actor],
    hold_out: set[int],
    settings: PointSettings,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Gathered:
    """Read all sweeps but the held-out ones, remove the ego car, split off the boxes, and thin the rest.

    Args:
        clip: the driving log.
        actors: movable tracks, whose points go to clouds of their own.
        hold_out: sweeps that must not be read, by index, of every LiDAR.
        settings: ranges, box margin and voxel sizes.
        progress: called with the fraction of the sweeps that is done.
    """
    static, clouds = Voxels(), {number: Voxels() for number in range(len(actors))}
    feet: dict[int, list[Cloud]] = {number: [] for number in range(len(actors))}
    feet_world: dict[int, list[np.ndarray]] = {number: [] for number in range(len(actors))}
    beams, sweeps, points, known = [], 0, 0, False
    carving = set(chosen_sweeps(clip, hold_out))
    every = [(lidar, i) for lidar in clip.rig.lidars for i in range(len(clip.sweep_times_us(lidar)))]
    jobs = [(lidar, i, (lidar, i) in carving) for lidar, i in every if i not in hold_out]
    for done, parts in enumerate(in_order(lambda job: _split(clip, actors, settings, *job), jobs)):
        progress(done / len(jobs))
        sweeps, points, known = sweeps + 1, points + parts.count, known or parts.intensity_known
        if parts.beams is not None:
            beams.append(parts.beams)
        static.add(*parts.static)
        for index, (sums, foot, foot_world) in parts.actors.items():
            clouds[index].add(*sums)
            feet[index].append(foot)
            feet_world[index].append(foot_world)
    return Gathered(
        static.cloud(),
        {index: voxels.cloud() for index, voxels in clouds.items()},
        {i: (Cloud.concatenate(feet[i]), np.concatenate(feet_world[i])) for i in feet if feet[i]},
        beams,
        sweeps,
        points,
        known,
    )


@dataclass(frozen=True)
class _SweepParts:
    """One sweep: voxel sums of the static world; per actor its voxel sums and its feet, in the box and the world."""

    static: tuple[np.ndarray, np.ndarray]
    actors: dict[int, tuple[tuple[np.ndarray, np.ndarray], Cloud, np.ndarray]]
    beams: SweepBeams | None
    count: int
    intensity_known: bool


def _split(
    clip: Clip, actors: Sequence[Actor], settings: PointSettings, lidar: str, index: int, carving: bool
) -> _SweepParts:
    sweep = clip.sweep(lidar, index)
    xyz, body = sweep.xyz_world_m, clip.rig.body
    half_m = np.asarray(body.size_m) / 2 + BODY_MARGIN_M
    rig_from_world = geometry.inverse(clip.ego.at(sweep.t_us))
    keep = _usable(sweep.xyz_m, xyz, settings.max_range_m, rig_from_world, np.asarray(body.center_m, float), half_m)
    xyz, t_us = xyz[keep], sweep.point_t_us[keep]
    intensity = np.full(len(xyz), np.nan) if sweep.intensity is None else sweep.intensity[keep].astype(np.float64)
    eye = np.broadcast_to(sweep.world_from_lidar[:3, 3], xyz.shape)
    free, parts = np.ones(len(xyz), bool), {}
    for number, actor in enumerate(actors):
        # A quick answer for most of the many windows of people.
        if actor.window_us and (actor.window_us[1] <= sweep.start_us or sweep.end_us < actor.window_us[0]):
            continue
        inside, box_xyz, box_eye, foot = returns_in_box(actor, xyz, eye, t_us, free, settings.box_margin_m)
        if not len(inside):
            continue
        # Every point belongs to one actor at most: to the first whose box holds it.
        free[inside] = False
        edge = np.full(len(inside), settings.min_voxel_m)
        up = ~foot
        parts[number] = (
            voxel_sums(box_xyz[up], box_eye[up], edge[up], intensity[inside][up]),
            unthinned(box_xyz[foot], box_eye[foot], edge[foot], intensity[inside][foot]),
            xyz[inside][foot],
        )
    outside = xyz[free]
    edge = voxel_edge_m(outside, clip.ego.position_m, settings)
    return _SweepParts(
        voxel_sums(outside, eye[: len(outside)], edge, intensity[free]),
        parts,
        sweep_beams(clip, lidar, sweep) if carving else None,
        len(xyz),
        bool(np.isfinite(intensity).any()),
    )


def returns_in_box(
    actor: Actor, xyz: np.ndarray, eye: np.ndarray, t_us: np.ndarray, free: np.ndarray, margin_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Indices of the points in an actor's box at their own times; the points and eyes in the box; which are feet."""
    size = np.asarray(actor.track.size_m)
    # A cheap world-aligned test first: poses at the points' own times are only evaluated near the path.
    radius = np.linalg.norm(size) / 2 + margin_m
    low, high = actor.path.position_m.min(axis=0) - radius, actor.path.position_m.max(axis=0) + radius
    near = _between(xyz, low, high)
    near = near[free[near] & actor.present(t_us[near])]
    if not len(near):
        return near, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool)
    if len(actor.path.t_us) == 1:
        # One pose for all points, as each would get.
        box_from_world = np.broadcast_to(geometry.inverse(actor.path.at(int(t_us[near[0]]))), (len(near), 4, 4))
    else:
        box_from_world = geometry.inverse(actor.path.at(t_us[near]))
    box = np.einsum("nij,nj->ni", box_from_world[:, :3, :3], xyz[near]) + box_from_world[:, :3, 3]
    hit = geometry.points_in_box(box, actor.track.size_m, margin_m)
    near, box, box_from_world = near[hit], box[hit], box_from_world[hit]
    box_eye = np.einsum("nij,nj->ni", box_from_world[:, :3, :3], eye[near]) + box_from_world[:, :3, 3]
    return near, box, box_eye, box[:, 2] < -size[2] / 2 + FOOT_M
