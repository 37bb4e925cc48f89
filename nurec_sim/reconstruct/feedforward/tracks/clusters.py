"""Dynamic Gaussians that no labelled track explains, grouped into tracks by where they are and how they move.

Frames of different cameras and chunks are exposed at different times. So every Gaussian is placed, by its own motion,
at the two instants of a common clock that lie around its middle knot. At each instant Gaussians close to each other and
alike in velocity are one *blob*; a blob and one of the next instant are the same object if each shares more Gaussians
with the other than with any other blob. Such chains of blobs, which may miss an instant or two, become tracks
(``boxes``), the largest first, and each takes along what moves with it inside its box.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64, Num
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from nurec_sim.reconstruct.feedforward.tracks.labelled import owners_of_points, poses_at
from nurec_sim.reconstruct.lift.points import Actor
from nurec_sim.reconstruct.movers.boxes import Sighting, lengthened, track_of
from nurec_sim.types import DynamicGaussians, Track, Trajectory

REACH_M = 120.0
"""Gaussians farther from the ego car are too coarse to separate into objects."""
CELL_M = 0.5
"""Gaussians of one instant are first averaged over cells of this edge."""
LINK_M = 0.8
"""Cells whose means are this close belong together."""
METRES_PER_MPS = 0.5
"""How far apart a difference in velocity of 1 m/s puts two Gaussians, as if it were a distance."""
MIN_GAUSSIANS = 20
"""Fewer at one instant are noise."""
MIN_INSTANTS = 2
"""What was seen around one instant only is no track."""
ALIKE_MPS = 1.0
"""A Gaussian in an object's box belongs to it if its velocity differs by less than this."""
MOMENT_US = 100_000
"""The velocity of a path is taken over this long before and after."""
MOST_MISSED = 2
"""Maximum number of instants for which an object may be hidden within a chain..."""
BRIDGE_M = 2.0
"""...if it is then this close to where it was heading, as alike in velocity as ``METRES_PER_MPS`` counts."""
LARGEST_M = 20.0
"""Wider blobs are no single object, but a queue or a misread wall."""


@dataclass(frozen=True)
class _Clock:
    """Instants ``start_us + k * step_us``; the step is the usual time between two frames of a camera."""

    start_us: int
    step_us: int


@dataclass(frozen=True)
class _Placed:
    """Each Gaussian at the instants ``first`` and ``first + 1`` of the clock, around its middle knot."""

    first: Int64[np.ndarray, " n"]
    position_m: Float64[np.ndarray, "2 n 3"]
    velocity_mps: Float64[np.ndarray, "n 3"]
    nearer: Int64[np.ndarray, " n"]


def group_into_tracks(
    dynamic: DynamicGaussians, ego: Trajectory, first_index: int = 0, taken: Collection[str] = ()
) -> tuple[tuple[Track, ...], Int32[np.ndarray, " n"]]:
    """Tracks of the moving objects among the Gaussians that have none, over a whole clip.

    Args:
        dynamic: the merged dynamic layer; those with ``track == -1`` are grouped.
        ego: the recording car, from which every object was seen from one side only.
        first_index: index that the first new track will have among the scene's.
        taken: ids that new tracks must not get.

    Returns:
        The new tracks, and ``dynamic.track`` with -1 replaced where a Gaussian belongs to one of them. Gaussians that
        are far away, alone, seen in one frame only or part of something very large keep their -1.
    """
    track = dynamic.track.astype(np.int32).copy()
    rows = np.flatnonzero((track < 0) & _near(dynamic, ego))
    if not len(rows):
        return (), track
    times, knots = dynamic.knot_t_us[rows], dynamic.knot_m[rows].astype(np.float64)
    clock = _Clock(int(times[:, 1].min()), max(int(np.median((times[:, 2] - times[:, 0]) // 2)), 1))
    placed = _placed(times, knots, clock)
    blobs = _blobs(placed)
    if not len(blobs.instant):
        return (), track
    chain = _chains(blobs, clock.step_us)
    of_gaussian = np.where(blobs.of_gaussian >= 0, chain[blobs.of_gaussian], -1)

    names = (name for number in range(1, len(taken) + len(chain) + 1) if (name := f"moving-{number}") not in taken)
    tracks: list[Track] = []
    owner = np.full(len(rows), -1, np.int32)
    for number, mine in _largest_first(_nearer_first(of_gaussian, placed.nearer)):
        mine = mine[owner[mine] < 0]
        sightings = _sightings(placed, of_gaussian, mine, number, clock)
        if len(sightings) < MIN_INSTANTS:
            continue
        found = _living(track_of(next(names), sightings, ego), times[mine])
        free = np.flatnonzero(owner < 0)
        along = _goes_along(found, knots[free, 1], times[free, 1], placed.velocity_mps[free])
        mine = np.union1d(mine, free[along])
        owner[mine] = len(tracks)
        tracks.append(_living(found, times[mine]))
    track[rows] = np.where(owner >= 0, first_index + owner, -1)
    return tuple(tracks), track


def _living(track: Track, times: Int64[np.ndarray, "n 3"]) -> Track:
    """The track with a path over the lives of its Gaussians."""
    life_us = int(times[:, 0].min()), int(times[:, 2].max())
    return dataclasses.replace(track, path=lengthened(track.path, life_us))


def _goes_along(
    track: Track, xyz_m: Float64[np.ndarray, "n 3"], t_us: Int64[np.ndarray, " n"], velocity: Float64[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Which points lie in a track's padded box and move with it: sides of an object too sparse to be linked to it."""
    inside = owners_of_points([Actor(0, track, False, track.path)], xyz_m, t_us, np.ones(len(xyz_m), bool)) == 0
    rows = np.flatnonzero(inside)
    before = np.maximum(t_us[rows] - MOMENT_US, track.path.start_us)
    after = np.minimum(t_us[rows] + MOMENT_US, track.path.end_us)
    moved = (poses_at(track.path, after) - poses_at(track.path, before))[:, :3, 3]
    relative = velocity[rows] - moved / ((after - before) / 1e6)[:, None]
    inside[rows] = np.linalg.norm(relative[:, :2], axis=1) < ALIKE_MPS
    return inside


def _near(dynamic: DynamicGaussians, ego: Trajectory) -> Bool[np.ndarray, " n"]:
    """Which Gaussians are within reach of the ego car at their own time."""
    instants, index = np.unique(dynamic.knot_t_us[:, 1], return_inverse=True)
    offset = dynamic.knot_m[:, 1] - ego.at(instants)[:, :3, 3][index]
    return np.einsum("ni,ni->n", offset, offset) < REACH_M**2


def _placed(times: Int64[np.ndarray, "n 3"], knots: Float64[np.ndarray, "n 3 3"], clock: _Clock) -> _Placed:
    first = (times[:, 1] - clock.start_us) // clock.step_us
    since_us = times[:, 1] - clock.start_us - first * clock.step_us
    steps_s = np.diff(times, axis=1) / 1e6
    before = (knots[:, 1] - knots[:, 0]) / steps_s[:, :1]
    after = (knots[:, 2] - knots[:, 1]) / steps_s[:, 1:]
    earlier = knots[:, 1] - before * (since_us / 1e6)[:, None]
    later = knots[:, 1] + after * ((clock.step_us - since_us) / 1e6)[:, None]
    return _Placed(
        first, np.stack([earlier, later]), (before + after) / 2, (2 * since_us > clock.step_us).astype(np.int64)
    )


# ---------------------------------------------------------------------------------------------------------- blobs


@dataclass(frozen=True)
class _Blobs:
    """``of_gaussian`` is the blob of each Gaussian at its two instants, -1 for none; ``like`` as in ``_likeness``."""

    of_gaussian: Int64[np.ndarray, "2 n"]
    instant: Int64[np.ndarray, " blobs"]
    like: Float64[np.ndarray, "blobs 4"]


def _likeness(
    position_m: Float64[np.ndarray, "k 3"], velocity: Float64[np.ndarray, "k 3"]
) -> Float64[np.ndarray, "k 4"]:
    """Place and velocity over ground, in a space where what belongs together is close together."""
    return np.column_stack([position_m[:, :2], velocity[:, :2] * METRES_PER_MPS])


def _blobs(placed: _Placed) -> _Blobs:
    """Gaussians of one instant linked with those that are close and alike, by way of their cells."""
    instant = np.concatenate([placed.first, placed.first + 1])
    like = _likeness(placed.position_m.reshape(-1, 3), np.tile(placed.velocity_mps, (2, 1)))
    cell, count, mean = _averaged(instant, like)
    cell_instant = np.zeros(len(count), np.int64)
    cell_instant[cell] = instant
    # Instants lie too far apart on a fifth axis to be linked.
    pairs = cKDTree(np.column_stack([mean, cell_instant * (10 * LINK_M)])).query_pairs(LINK_M, output_type="ndarray")
    number, blob_of_cell = _components(pairs, len(count))
    size = np.bincount(blob_of_cell, count, number)
    low, high = np.full((number, 2), np.inf), np.full((number, 2), -np.inf)
    np.minimum.at(low, blob_of_cell, mean[:, :2])
    np.maximum.at(high, blob_of_cell, mean[:, :2])
    good = (size >= MIN_GAUSSIANS) & (np.linalg.norm(high - low, axis=1) <= LARGEST_M)
    new = np.where(good, np.cumsum(good) - 1, -1)
    instant_of_blob = np.zeros(number, np.int64)
    instant_of_blob[blob_of_cell] = cell_instant
    middle = np.column_stack([np.bincount(blob_of_cell, count * column, number) for column in mean.T]) / size[:, None]
    return _Blobs(new[blob_of_cell[cell]].reshape(2, -1), instant_of_blob[good], middle[good])


def _averaged(
    instant: Int64[np.ndarray, " m"], like: Float64[np.ndarray, "m 4"]
) -> tuple[Int64[np.ndarray, " m"], Int64[np.ndarray, " cells"], Float64[np.ndarray, "cells 4"]]:
    """The cell of each row, and the number and the mean of the rows in each cell."""
    key = instant - instant.min()
    for column in like.T:
        place = np.floor(column / CELL_M).astype(np.int64)
        place -= place.min()
        # Numbering the keys anew after each column keeps them small, whatever the values are.
        key = np.unique(key * (place.max() + 1) + place, return_inverse=True)[1]
    count = np.bincount(key)
    mean = np.column_stack([np.bincount(key, column) for column in like.T]) / count[:, None]
    return key, count, mean


def _components(pairs: Int64[np.ndarray, "k 2"], nodes: int) -> tuple[int, Int32[np.ndarray, " nodes"]]:
    links = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), (nodes, nodes))
    return connected_components(links, directed=False)


# --------------------------------------------------------------------------------------------------------- chains


def _chains(blobs: _Blobs, step_us: int) -> Int64[np.ndarray, " blobs"]:
    """The chain of each blob: it and a blob of the next instant are linked if each shares most with the other."""
    number = len(blobs.instant)
    # A Gaussian lies in a blob of each of its two instants: it votes for them being one object.
    both = blobs.of_gaussian[:, (blobs.of_gaussian >= 0).all(axis=0)]
    pair, shared = np.unique(both[0] * number + both[1], return_counts=True)
    earlier, later = np.divmod(pair, number)
    mutual = _largest(earlier, shared) & _largest(later, shared)
    links = np.column_stack([earlier[mutual], later[mutual]])
    for missed in range(1, MOST_MISSED + 1):
        links = np.concatenate([links, _bridges(blobs, links, missed, step_us)])
    return _components(links, number)[1].astype(np.int64)


def _bridges(
    blobs: _Blobs, links: Int64[np.ndarray, "k 2"], missed: int, step_us: int
) -> Int64[np.ndarray, "bridges 2"]:
    """Links over instants at which an object was hidden: from ends of chains to beginnings where they were heading."""
    everything = np.arange(len(blobs.instant))
    ends, beginnings = np.setdiff1d(everything, links[:, 0]), np.setdiff1d(everything, links[:, 1])
    # Constant velocity over the hidden instants; velocities are stored times METRES_PER_MPS.
    expected = blobs.like[ends].copy()
    expected[:, :2] += expected[:, 2:] / METRES_PER_MPS * ((missed + 1) * step_us / 1e6)
    apart = 10 * BRIDGE_M
    tree = cKDTree(np.column_stack([blobs.like[beginnings], blobs.instant[beginnings] * apart]))
    distance, nearest = tree.query(
        np.column_stack([expected, (blobs.instant[ends] + missed + 1) * apart]), distance_upper_bound=BRIDGE_M
    )
    met = np.isfinite(distance)
    ends, distance, nearest = ends[met], distance[met], nearest[met]
    best = _largest(nearest, -distance)
    return np.column_stack([ends[best], beginnings[nearest[best]]])


def _largest(group: Int64[np.ndarray, " k"], value: Num[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
    """Which entry of each group is the largest; the first of equals."""
    order = np.lexsort((np.arange(len(group)), -value, group))
    first = np.ones(len(group), bool)
    first[1:] = group[order][1:] != group[order][:-1]
    result = np.zeros(len(group), bool)
    result[order] = first
    return result


def _nearer_first(of_gaussian: Int64[np.ndarray, "2 n"], nearer: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Each Gaussian's chain at the instant nearer to its middle knot, else at the other one."""
    columns = np.arange(len(nearer))
    near, far = of_gaussian[nearer, columns], of_gaussian[1 - nearer, columns]
    return np.where(near >= 0, near, far)


def _largest_first(chain: Int64[np.ndarray, " n"]) -> Iterator[tuple[int, Int64[np.ndarray, " k"]]]:
    """Each chain and its Gaussians."""
    order = np.argsort(chain, kind="stable")
    bounds = np.searchsorted(chain[order], np.arange(chain.max() + 2))
    for number in np.argsort(-np.diff(bounds), kind="stable"):
        yield int(number), order[bounds[number] : bounds[number + 1]]


def _sightings(placed: _Placed, of_gaussian: np.ndarray, mine: np.ndarray, chain: int, clock: _Clock) -> list[Sighting]:
    """A chain's Gaussians at the instants that are nearest to their own times, where their motion matters least."""
    mine = mine[of_gaussian[placed.nearer[mine], mine] == chain]
    instants, index, count = np.unique(
        placed.first[mine] + placed.nearer[mine], return_inverse=True, return_counts=True
    )
    order = np.argsort(index, kind="stable")
    ends = np.cumsum(count)
    parts = [mine[order[end - size : end]] for end, size in zip(ends, count, strict=True)]
    return [
        Sighting(
            clock.start_us + int(instant) * clock.step_us,
            placed.position_m[placed.nearer[part], part],
            placed.velocity_mps[part],
        )
        for instant, part in zip(instants, parts, strict=True)
        if len(part) >= MIN_GAUSSIANS // 2
    ]
