"""Rigid actors stored once, in the frames of their boxes, instead of once per image.

Every image shows one side of a vehicle for its own moment, so that the Gaussians of a log would grow with its length.
Here they are moved into the box frame. Seen from the box's centre, each direction (a cell on the faces of the box) is
then shown by one view alone, the one with the finest Gaussians there: wrong depths shift what other views saw along
such directions, and would put second surfaces before or behind it.

Parts of static actors on which the images of a chunk agree are one view of that chunk; what the images disagree on
stays momentary (``tracks.standing``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim import geometry
from nurec_sim.reconstruct.feedforward.tracks.labelled import PADDING_M, poses_at
from nurec_sim.reconstruct.lift.points import Actor
from nurec_sim.types import DynamicGaussians, Gaussians

DEFORMABLE_LABELS = ("person", "rider", "animal")
"""Actors whose shape changes as they move; they keep their windows of three knots."""
CELL_M = 0.25
"""Edge of a cell on the faces of a box."""
SCALE_RING = 0.25
"""Views are equally fine in a cell if the logarithms of their Gaussians' mean scale are in one interval of this."""
LEAST_COVER = 0.3
"""A view shows a cell only if its Gaussians there cover this share of what those of the best covering view do."""


def rigid_once(
    dynamic: DynamicGaussians, chunk: Int64[np.ndarray, " n"], actors: Sequence[Actor], span_us: tuple[int, int]
) -> DynamicGaussians:
    """The dynamic layer with each rigid actor stored once.

    Args:
        dynamic: the merged layer; ``track`` is the index of an actor's track, -1 for none.
        chunk: number of the chunk that each Gaussian comes from.
        actors: from ``scene_actors``.
        span_us: the clip's.

    Returns:
        The other Gaussians as they were, then the parts of rigid actors, ``in_box``.
    """
    ends, middle = dynamic.knot_t_us[:, [0, 2]], dynamic.knot_t_us[:, 1]
    lasting = (ends[:, 0] <= span_us[0]) & (ends[:, 1] >= span_us[1])
    # Images of a chunk differ in the times of their neighbours, the outer knots.
    key = np.column_stack([chunk, np.where(lasting[:, None], 0, ends)])
    view = np.unique(key, axis=0, return_inverse=True)[1].reshape(-1)
    loose, parts = np.ones(len(dynamic), bool), []
    for actor in actors:
        path = actor.track.path
        # A rigid part is there only while the path is; what was seen before or after keeps its moment.
        there = lasting if actor.standing else (middle >= path.start_us) & (middle <= path.end_us)
        mine = np.flatnonzero((dynamic.track == actor.index) & there)
        if actor.track.label in DEFORMABLE_LABELS or not len(mine):
            continue
        loose[mine] = False
        parts.append(_once(actor, dynamic.gaussians[mine], middle[mine], view[mine]))
    rest = DynamicGaussians(
        dynamic.gaussians[loose], dynamic.knot_t_us[loose], dynamic.knot_m[loose], dynamic.track[loose]
    )
    return DynamicGaussians.concatenate([rest, *parts]) if parts else dynamic


def _once(
    actor: Actor, gaussians: Gaussians, t_us: Int64[np.ndarray, " n"], view: Int64[np.ndarray, " n"]
) -> DynamicGaussians:
    """One actor's Gaussians in its box, each direction from one view."""
    half_m = np.asarray(actor.track.size_m) / 2
    if actor.standing:
        poses = np.broadcast_to(actor.path.world_from_body[0], (len(t_us), 4, 4))
    else:
        poses = poses_at(actor.path, t_us)
    inside = _in_box(gaussians, geometry.inverse(poses))
    if not actor.standing:
        # Rays with a wrong depth leave points far from the box that they meet; these would go along beside it for ever.
        near = (np.abs(inside.mean_m) < half_m + PADDING_M).all(axis=1)
        inside, view = inside[near], view[near]
    kept = inside[_shown(inside, view, half_m)]
    return DynamicGaussians.rigid(kept, np.full(len(kept), actor.index), actor.path.start_us)


def _in_box(gaussians: Gaussians, box_from_world: Float64[np.ndarray, "n 4 4"]) -> Gaussians:
    """Gaussians in the frame of the box at the moment of each."""
    turn = box_from_world[:, :3, :3]
    quat = geometry.quat_multiply(geometry.quat_from_matrix(turn), gaussians.quat_wxyz)
    return dataclasses.replace(
        gaussians,
        mean_m=(np.einsum("nij,nj->ni", turn, gaussians.mean_m) + box_from_world[:, :3, 3]).astype(np.float32),
        quat_wxyz=geometry.quat_normalize(np.where(quat[:, :1] < 0, -quat, quat)).astype(np.float32),
        normal=np.einsum("nij,nj->ni", turn, gaussians.normal).astype(np.float32),
    )


def _shown(
    gaussians: Gaussians, view: Int64[np.ndarray, " n"], half_m: Float64[np.ndarray, " 3"]
) -> Bool[np.ndarray, " n"]:
    """Which Gaussians come from the view that shows their direction from the centre."""
    if not len(gaussians):
        return np.zeros(0, bool)
    cell = np.unique(_cells(gaussians.mean_m, half_m), axis=0, return_inverse=True)[1].reshape(-1)
    size = np.bincount(view)
    pairs, of_pair, count = np.unique(cell * len(size) + view, return_inverse=True, return_counts=True)
    its_cell, its_view = np.divmod(pairs, len(size))
    area = np.sort(gaussians.scale_m.astype(np.float64), axis=1)[:, 1:].prod(axis=1)
    cover = np.bincount(of_pair, area)
    most = np.zeros(cell.max() + 1)
    np.maximum.at(most, its_cell, cover)
    log_scale = np.bincount(of_pair, np.log(np.maximum(area, 1e-12)) / 2) / count
    # First whether it covers the cell, then how fine it is, then whether it shows much of the actor, so that
    # neighbouring cells come from one image.
    ring = np.floor(log_scale / SCALE_RING)
    order = np.lexsort((its_view, -size[its_view], ring, cover < LEAST_COVER * most[its_cell], its_cell))
    first = np.append(True, np.diff(its_cell[order]) > 0)
    shows = np.zeros(len(pairs), bool)
    shows[order[first]] = True
    return shows[of_pair]


def _cells(xyz_m: np.ndarray, half_m: Float64[np.ndarray, " 3"]) -> Int64[np.ndarray, "n 4"]:
    """Face of the box that a ray from its centre meets, and the cell there."""
    share = xyz_m / half_m
    axis = np.abs(share).argmax(axis=1)
    rows = np.arange(len(share))
    most = share[rows, axis]
    met = np.floor(share / np.maximum(np.abs(most), 1e-9)[:, None] * half_m / CELL_M).astype(np.int64)
    met[rows, axis] = 0
    return np.column_stack([2 * axis + (most < 0), met])
