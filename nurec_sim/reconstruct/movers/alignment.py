"""Tracks of moving objects, corrected so that the returns of all sweeps on an object make one surface.

Boxes that people draw, and those that are found by motion, are off by centimetres to decimetres, another way in every
sweep; an object that is gathered along them is smeared.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim import geometry
from nurec_sim.compute.cores import in_order
from nurec_sim.logs.selection import with_tracks
from nurec_sim.reconstruct.lift.points import Actor, actors_of, returns_in_box
from nurec_sim.reconstruct.lift.settings import PointSettings
from nurec_sim.reconstruct.movers.registration import Returns, corrections, disagreement, moved
from nurec_sim.types import Clip, Track, Trajectory

MARGIN_M = 0.3
"""Returns this far outside of a box may belong to its object."""
MOVED_M = 0.5
"""A track that moves less than this is left as it is."""
MOST_POINTS = 2000
FEWEST_POINTS = 8
"""Of one object: in all sweeps together at most, and in a sweep that is corrected at least."""
TOGETHER_US, BESIDE_US, FAR_US = 20_000, 60_000, 1_000_000
"""Sweeps of several LiDARs within the first time are corrected together. A label within the second one of a sweep needs
no correction of its own; one that is farther than the third from all sweeps that show its object stays as it is."""
LABELLED_SIGMA, FOUND_SIGMA = (0.15, 0.15, 0.05, np.radians(2.0)), (0.4, 0.4, 0.1, np.radians(4.0))
"""Standard deviations of boxes that were labelled and found: along, across and up in metres, turn in radians."""
LARGEST, BETTER = 4.0, 0.9
"""A track stays as it was if a correction is more standard deviations than the first, or if returns disagree by more
than the second times what they did before."""
EXACT = (0.03, 0.03, 0.05, np.radians(0.5))
"""It also stays if its corrections are no larger than this (root of their mean square, units as above): few returns do
not tell more, and tracks of simulated logs are exact. Height is told worst: of a car that is followed some ten beams a
sweep show the rear and nothing else, 3 cm were made up, and its number plate was smeared."""
EXTENT = (0.01, 0.99)
"""Quantiles of the returns that count as the ends of an object."""


def with_aligned_actors(clip: Clip, hold_out: Collection[int] = ()) -> tuple[Clip, int]:
    """A log whose tracks of moving objects are corrected where its sweeps show them, and how many are.

    Args:
        clip: the driving log.
        hold_out: sweeps that must not be read, by index, of every LiDAR.
    """
    actors = [
        actor
        for actor in actors_of(clip, PointSettings())
        if not actor.standing and np.ptp(actor.path.position_m, axis=0).max() >= MOVED_M
    ]
    seen = _gathered(clip, actors, hold_out)
    known = [actor for actor in actors if len(seen[actor.index]) > 1]
    tracks, changed = list(clip.tracks), 0
    for actor, track in zip(known, in_order(lambda a: _corrected(a.track, seen[a.index]), known), strict=True):
        if track is not None:
            tracks[actor.index] = track
            changed += 1
    return (with_tracks(clip, tracks) if changed else clip), changed


Part = tuple[int, Float64[np.ndarray, "n 6"]]
"""The mean time of the returns of one sweep on an object, and in the frame of its box where they are and the unit rays
to them."""


def _gathered(clip: Clip, actors: Sequence[Actor], hold_out: Collection[int]) -> dict[int, list[Part]]:
    """What the sweeps show of each actor, in the order of time."""
    spans = [(actor.path.start_us, actor.path.end_us) for actor in actors]
    jobs = []
    for lidar in clip.rig.lidars:
        for index, (start_us, end_us) in enumerate(clip.sweep_times_us(lidar).tolist()):
            if index not in hold_out and any(first <= end_us and start_us <= last for first, last in spans):
                jobs.append((lidar, index))
    seen: dict[int, list[Part]] = {actor.index: [] for actor in actors}
    for found in in_order(lambda job: _parts(clip, actors, *job), jobs):
        for index, part in found.items():
            seen[index].append(part)
    return {index: sorted(parts, key=lambda part: part[0]) for index, parts in seen.items()}


def _parts(clip: Clip, actors: Sequence[Actor], lidar: str, index: int) -> dict[int, Part]:
    """What one sweep shows of each actor, without returns near its foot, which may be road."""
    sweep = clip.sweep(lidar, index)
    xyz, t_us = sweep.xyz_world_m, sweep.point_t_us
    eye = np.broadcast_to(sweep.world_from_lidar[:3, 3], xyz.shape)
    free, found = np.isfinite(xyz).all(axis=1), {}
    for actor in actors:
        inside, box_m, eye_m, foot = returns_in_box(actor, xyz, eye, t_us, free, MARGIN_M)
        free[inside] = False
        if len(inside) - foot.sum() >= FEWEST_POINTS:
            times = t_us[inside][~foot]
            rays = (box_m - eye_m) / np.linalg.norm(box_m - eye_m, axis=1, keepdims=True)
            mean_us = int(times[0]) + round(float((times - times[0]).mean()))
            found[actor.index] = mean_us, np.concatenate([box_m, rays], axis=1)[~foot]
    return found


def _corrected(track: Track, parts: Sequence[Part]) -> Track | None:
    """The track on which returns agree best; None if they cannot agree near it, or hardly better."""
    returns, far = _returns(track.path.t_us, parts)
    sigma = np.array(LABELLED_SIGMA if track.labelled else FOUND_SIGMA)
    poses = track.path.at(returns.t_us)
    values = corrections(returns, poses, sigma)
    before, after = disagreement(returns, np.zeros_like(values)), disagreement(returns, values)
    exact = track.labelled and (np.sqrt((values**2).mean(axis=0)) <= EXACT).all()
    if exact or (np.abs(values) > LARGEST * sigma).any() or after >= BETTER * before:
        return None
    change = np.array([geometry.pose_from_xyyaw(x, y, yaw, z) for x, y, z, yaw in values])
    times = np.union1d(returns.t_us, track.path.t_us[far])
    all_poses = track.path.at(times)
    all_poses[np.searchsorted(times, returns.t_us)] = poses @ geometry.inverse(change)
    path, size = Trajectory(times, all_poses), np.array(track.size_m)
    if track.labelled or track.label == "person":
        return dataclasses.replace(track, path=path)
    # A found box followed what each sweep showed; one that keeps its place on the vehicle must hold all of it. A person
    # has no length that could be seen in part, and what is around swinging arms and legs is free.
    low, high = np.quantile(moved(returns, values), EXTENT, axis=0)
    low, high = np.minimum(low, -size / 2), np.maximum(high, size / 2)
    low[2] = -size[2] / 2
    length, width, height = (high - low).tolist()
    path = Trajectory(times, all_poses @ geometry.pose(np.eye(3), (low + high) / 2))
    return dataclasses.replace(track, size_m=(length, width, height), path=path)


def _returns(label_us: Int64[np.ndarray, " l"], parts: Sequence[Part]) -> tuple[Returns, Bool[np.ndarray, " l"]]:
    """Returns on an object, thinned, with the times that need a correction; and which labels are far from all of it."""
    most = max(MOST_POINTS // len(parts), FEWEST_POINTS)
    sweep_us: list[int] = []
    points, sweep = [], []
    for at_us, seen in parts:
        if not sweep_us or at_us - sweep_us[-1] > TOGETHER_US:
            sweep_us.append(at_us)
        # In the order of firing every n-th return leaves all parts of the object.
        chosen = seen[:: -(-len(seen) // most)]
        points.append(chosen)
        sweep.append(np.full(len(chosen), len(sweep_us) - 1))
    seen_us = np.array(sweep_us, np.int64)
    distance_us = np.abs(label_us[:, None] - seen_us).min(axis=1)
    far = distance_us >= FAR_US
    own = distance_us > BESIDE_US
    # The ends stay: the object is there as long as it was labelled.
    own[[0, -1]] = True
    t_us = np.union1d(seen_us, label_us[own & ~far])
    place = np.searchsorted(t_us, seen_us)[np.concatenate(sweep)]
    xyz, ray = np.split(np.concatenate(points), 2, axis=1)
    return Returns(t_us, xyz, place, ray), far
