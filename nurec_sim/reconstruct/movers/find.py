"""Actors of a log without boxes, found by their motion in the sweeps of its LiDAR.

    sweeps -> returns that other sweeps contradict -> objects -> paths -> tracks

What stands throughout cannot be told from scenery, and is not found.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from nurec_sim import geometry
from nurec_sim.reconstruct.movers.boxes import BEST_VIEW, Sighting, lengthened, track_of
from nurec_sim.reconstruct.movers.contradicted import main_lidar, off_ground
from nurec_sim.reconstruct.movers.following import Path, follow
from nurec_sim.reconstruct.movers.objects import Blob, blobs_of
from nurec_sim.types import Clip, Track

NAME = "found-"
"""Ids of found tracks begin with this."""
FEWEST_SIGHTINGS = 4


class Evidence(NamedTuple):
    """What an object must show to be taken for one that moves."""

    share: float
    """In how many of the sweeps of its life it is seen, at least."""
    life_s: float
    """How long it is seen, at least."""
    shape_m: float
    """Largest median distance between the returns of two sightings, the motion undone."""
    returns: int
    """How many cells with returns it has in the middle of its sightings, at least."""


OF_MOVING, OF_CROSSED = Evidence(0.5, 0.0, 0.3, 1), Evidence(0.75, 1.0, 0.2, 20)
"""Of what is ``Seen.moving``, and of what is ``Seen.crossed``: foliage and the edges of what the scanner sees are the
latter, too, but not for long, nor as one, nor with many returns."""
KEEPS_SHARE = 0.5
"""``Evidence.shape_m`` as a share of the distance without the motion undone."""
LEAST_MOVED_M, LEAST_MPS = 1.0, 0.5
STRAIGHT = 0.6
"""Least ratio of the distance between the ends of a path to its length: what jitters in place does not move."""
LEAST_HEIGHT_M = 0.4
"""Least extent, where it is seen best, from its lowest to its highest return."""
STEP_M = 1.0
"""Sightings are compared with the next one at which the object has moved this far."""
PART_MARGIN_M = 0.5
END_SWEEPS = 2
"""Objects that are seen until so many sweeps before the end of the log, or from so many after its begin, are there."""


def find_actors(
    clip: Clip, hold_out: Collection[int] = (), progress: Callable[[float], None] = lambda done: None
) -> tuple[Track, ...]:
    """Tracks of what moves, in the order in which they are first seen; ``labelled`` is False.

    Labels follow from size and speed. Where only one side of an object was seen, its size is the least that objects of
    its label have.

    Args:
        clip: the driving log; its boxes are not looked at.
        hold_out: sweeps that must not be read, by index, of every LiDAR.
        progress: called with the fraction done.

    Returns:
        The tracks; none if no LiDAR has two sweeps that may be read.
    """
    chosen = main_lidar(clip, hold_out)
    if chosen is None:
        return ()
    lidar, indices = chosen
    free, crossed = [], []
    for done, seen in enumerate(off_ground(clip, lidar, indices)):
        free.append(blobs_of(seen, seen.moving))
        crossed.append(blobs_of(seen, seen.crossed))
        progress((done + 1) / len(indices))
    times = clip.sweep_times_us(lidar).sum(axis=1) // 2
    step_us = int(np.median(np.diff(times[indices])))
    tracks = _whole(_tracks(free, clip, step_us, OF_MOVING))
    slow = _whole(_tracks(crossed, clip, step_us, OF_CROSSED))
    tracks += [new for new in slow if not any(_inside(new, track) or _inside(track, new) for track in tracks)]
    tracks.sort(key=lambda track: track.path.start_us)
    return tuple(dataclasses.replace(track, id=f"{NAME}{number + 1}") for number, track in enumerate(tracks))


def _tracks(sweeps: Sequence[Sequence[Blob]], clip: Clip, step_us: int, wanted: Evidence) -> list[Track]:
    """Tracks of those objects in the sweeps of a log, ``step_us`` apart, that show what is wanted."""
    tracks = []
    for path in follow(sweeps):
        life_us = path.blobs[-1].t_us - path.blobs[0].t_us
        least = max(FEWEST_SIGHTINGS, wanted.share * (life_us / step_us + 1))
        returns = np.median([len(blob.xyz_m) for blob in path.blobs])
        if len(path.blobs) >= least and life_us >= 1e6 * wanted.life_s and returns >= wanted.returns:
            track = _track(path, clip)
            if _moves(path, track, wanted.shape_m):
                tracks.append(_lasting(track, clip, step_us))
    return tracks


def _whole(tracks: Sequence[Track]) -> list[Track]:
    """Those tracks that do not follow a part of an object that another one follows for longer."""

    def longer(other: Track, track: Track) -> bool:
        return other.path.end_us - other.path.start_us > track.path.end_us - track.path.start_us

    return [track for track in tracks if not any(longer(other, track) and _inside(track, other) for other in tracks)]


def _inside(track: Track, other: Track) -> bool:
    """Whether what a track follows is inside of the box of another one, for more than half of the former's life."""
    times = track.path.t_us[[other.path.covers(int(t)) for t in track.path.t_us]]
    if not len(times):
        return False
    centre = track.path.at(times)[:, None, :3, 3]
    box_from_world = geometry.inverse(other.path.at(times))
    local = np.einsum("tij,tkj->tki", box_from_world[:, :3, :3], centre)[:, 0] + box_from_world[:, :3, 3]
    inside = geometry.points_in_box(local, other.size_m, PART_MARGIN_M)
    return bool(inside.sum() > len(track.path.t_us) / 2)


def _track(path: Path, clip: Clip) -> Track:
    """The track of a path, with poses at its sightings."""
    velocity = path.smoothed()[:, 2:]
    track = _boxed(path, velocity, clip)
    # The middle of what is seen moves otherwise than the object, of which ever more is seen; the near face of its box
    # does not. So its motion gives the velocities, by which the box is found again.
    if len(track.path.t_us) > 2:
        seconds = (track.path.t_us - track.path.start_us) / 1e6
        track = _boxed(path, np.gradient(track.path.position_m[:, :2], seconds, axis=0), clip)
    return track


def _boxed(path: Path, velocity: Float64[np.ndarray, "t 2"], clip: Clip) -> Track:
    sightings = []
    for blob, rate in zip(path.blobs, velocity, strict=True):
        # Returns near the ground were left out, but a box reaches down to it.
        xyz = np.concatenate([blob.xyz_m, blob.ground_m])
        sightings.append(Sighting(blob.t_us, xyz, np.tile([*rate, 0.0], (len(xyz), 1))))
    return track_of("", sightings, clip.ego)


def _moves(path: Path, track: Track, shape_m: float) -> bool:
    """Whether an object gets somewhere and keeps its shape on the way, other than edges that come and go.

    Of a surface that stands every sweep sees another part, which looks like motion; but the returns of two sweeps then
    agree best where they are. ``shape_m`` is the most that they may be apart, the motion undone.
    """
    place = track.path.position_m
    if len(place) < len(path.blobs):  # slow: ``track_of`` gave it one pose
        return False
    moved = float(np.linalg.norm(place[-1] - place[0]))
    length = float(np.linalg.norm(np.diff(place, axis=0), axis=1).sum())
    seconds = (track.path.end_us - track.path.start_us) / 1e6
    height = float(np.quantile([np.ptp(blob.xyz_m[:, 2]) for blob in path.blobs], BEST_VIEW))
    if moved < max(LEAST_MOVED_M, STRAIGHT * length, LEAST_MPS * seconds) or height < LEAST_HEIGHT_M:
        return False
    followed, stood = _apart(path, track)
    return followed <= min(shape_m, KEEPS_SHARE * stood)


def _apart(path: Path, track: Track) -> tuple[float, float]:
    """Median distance between the returns of sightings ``STEP_M`` apart, in the frame of the box and in the world."""
    place, box_from_world = track.path.position_m, geometry.inverse(track.path.world_from_body)
    followed, stood = [], []
    for number, blob in enumerate(path.blobs):
        far = np.flatnonzero(np.linalg.norm(place[number + 1 :] - place[number], axis=1) >= STEP_M)
        if len(far):
            other = number + 1 + int(far[0])
            there = path.blobs[other].xyz_m
            stood.append(_between(blob.xyz_m, there))
            followed.append(
                _between(
                    geometry.transform_points(box_from_world[number], blob.xyz_m),
                    geometry.transform_points(box_from_world[other], there),
                )
            )
    return (float(np.median(followed)), float(np.median(stood))) if followed else (np.inf, 0.0)


def _between(one: Float64[np.ndarray, "n 3"], other: Float64[np.ndarray, "m 3"]) -> float:
    """Median distance from the returns of which there are fewer to the others."""
    few, many = sorted((one, other), key=len)
    return float(np.median(cKDTree(many).query(few)[0]))


def _lasting(track: Track, clip: Clip, step_us: int) -> Track:
    """The track over half a sweep more than its object was seen, both ways, or to the end of the log if that is near.

    At the ends of a log, sweeps are contradicted from one side only, so that an object is found late or lost early.
    """
    (begin, end), near_us = clip.span_us, END_SWEEPS * step_us
    first, last = track.path.start_us - step_us // 2, track.path.end_us + step_us // 2
    life_us = begin if first <= begin + near_us else first, end - 1 if last >= end - near_us else last
    return dataclasses.replace(track, path=lengthened(track.path, life_us), labelled=False)
