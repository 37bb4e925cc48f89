"""Points of the network and the boxes of the log: which point belongs to which track, and how it moves with it.

Times stay int64 microseconds until differences of them are taken. No function here loops over points: there is one
vectorised call per track, over those points of one image that can reach its box.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

from nurec_sim import geometry
from nurec_sim.reconstruct.lift.actors import standing_knots_us
from nurec_sim.reconstruct.lift.points import LONE_LABEL_US, Actor, actors_of
from nurec_sim.reconstruct.lift.settings import PointSettings
from nurec_sim.types import Clip, Trajectory

PADDING_M = 0.5
"""Boxes grow by this on every side for movable points: 1 m on each whole dimension, as in the released model."""

Vectors = Float64[np.ndarray, "n 3"]
Times = Int64[np.ndarray, " n"]


def scene_actors(clip: Clip) -> list[Actor]:
    """The movable tracks of a clip; ``Actor.index`` is the place in ``clip.tracks``.

    A static one (moves less than 0.3 m) has one pose and exists over the whole clip. The path of one that moves
    is extended by one step at both ends, by the twist of the step beside it: labels come at 2 to 10 Hz, and the
    object does not vanish between the last one and the next frame.
    """
    actors = actors_of(clip, PointSettings())
    return [a if a.standing else dataclasses.replace(a, path=_longer(a.path, clip.span_us)) for a in actors]


def owners_of_points(
    actors: Sequence[Actor], xyz_m: Vectors, t_us: Times, movable: Bool[np.ndarray, " n"]
) -> Int32[np.ndarray, " n"]:
    """The actor in whose box each point lies at the point's own time.

    Movable points count within the padded box, others only within the box itself, so that the ground around a car does
    not move along with it. Of several boxes the one wins in which the point lies deepest, as a share of the way from
    border to middle: a person beside a car stays a person. (The release takes every class within the padding, and
    the last box.)

    Args:
        actors: from ``scene_actors``.
        xyz_m: points in the world, without those that can be no part of an actor (the road).
        t_us: when each was seen.
        movable: whether the network calls them movable.

    Returns:
        Place in ``actors`` per point, -1 for none.
    """
    owner, outward = np.full(len(xyz_m), -1, np.int32), np.ones(len(xyz_m))
    x, y, z = np.ascontiguousarray(xyz_m.T)
    for number, actor in enumerate(actors):
        low, high = _reach(actor, t_us)
        near = np.flatnonzero((x > low[0]) & (x < high[0]))
        near = near[(y[near] > low[1]) & (y[near] < high[1]) & (z[near] > low[2]) & (z[near] < high[2])]
        # Int64 times throughout: float32 epoch times would associate hardly any point (the release's defect).
        near = near[actor.present(t_us[near])]
        if not len(near):
            continue
        box_from_world = geometry.inverse(poses_at(actor.path, t_us[near]))
        offset = np.abs(_turned(box_from_world, xyz_m[near]) + box_from_world[:, :3, 3])
        half = np.asarray(actor.track.size_m) / 2
        share = np.max(offset / (half + PADDING_M), axis=1)
        inside = (share < 1) & (movable[near] | np.all(offset < half, axis=1)) & (share < outward[near])
        owner[near[inside]], outward[near[inside]] = number, share[inside]
    return owner


def owners_of_rays(
    actors: Sequence[Actor], origin_m: Vectors, direction: Vectors, t_us: Times
) -> Int32[np.ndarray, " n"]:
    """The actor whose padded box a ray meets, if it meets exactly one: for movable points whose depth is off.

    Args:
        actors: from ``scene_actors``.
        origin_m: where rays start in the world; a box around it does not count.
        direction: unit vectors in the world.
        t_us: when each ray was exposed.

    Returns:
        Place in ``actors`` per ray, -1 for no box or several.
    """
    owner, hits = np.full(len(origin_m), -1, np.int32), np.zeros(len(origin_m), np.int32)
    for number, actor in enumerate(actors):
        half = np.asarray(actor.track.size_m) / 2 + PADDING_M
        low, high = _reach(actor, t_us)
        to_middle = (low + high) / 2 - origin_m
        along = np.einsum("ni,ni->n", to_middle, direction)
        # Sphere test first: squared distance of the ray from the middle of the swept box.
        aside = np.einsum("ni,ni->n", to_middle, to_middle) - np.square(along)
        radius = np.linalg.norm(high - low) / 2
        near = np.flatnonzero((along > -radius) & (aside < radius**2) & actor.present(t_us))
        if not len(near):
            continue
        box_from_world = geometry.inverse(poses_at(actor.path, t_us[near]))
        start = _turned(box_from_world, origin_m[near]) + box_from_world[:, :3, 3]
        step = _turned(box_from_world, direction[near])
        enter, leave = geometry.box_crossings(start, step, -half, half)
        met = near[(enter < leave) & (enter > 0)]
        owner[met] = number
        hits[met] += 1
    return np.where(hits == 1, owner, -1).astype(np.int32)


def knots_along(
    actor: Actor, xyz_m: Vectors, t_us: Times, target_t_us: tuple[int, int], span_us: tuple[int, int]
) -> tuple[Int64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3 3"]]:
    """Knots of points that move with an actor: ``world_from_box(t_k) @ box_from_world(t_2) @ position``.

    Args:
        actor: from ``scene_actors``.
        xyz_m: points in the world.
        t_us: when each was seen, the time of its middle knot.
        target_t_us: times of the outer knots; they are moved to the ends of the path where they lie beyond them.
        span_us: the clip's. Points of a static actor live over all of it.

    Returns:
        Times and positions of the knots.
    """
    if actor.standing:
        return np.tile(standing_knots_us(span_us), (len(xyz_m), 1)), np.repeat(xyz_m[:, None], 3, axis=1)
    before = max(target_t_us[0], actor.path.start_us)
    after = min(target_t_us[1], actor.path.end_us)
    box_from_world = geometry.inverse(poses_at(actor.path, t_us))
    in_box = _turned(box_from_world, xyz_m) + box_from_world[:, :3, 3]
    outer = [geometry.transform_points(actor.path.at(t), in_box) for t in (before, after)]
    times = np.stack([np.minimum(before, t_us - 1), t_us, np.maximum(after, t_us + 1)], axis=1)
    return times, np.stack([outer[0], xyz_m, outer[1]], axis=1)


def poses_at(path: Trajectory, t_us: Times) -> Float64[np.ndarray, "n 4 4"]:
    """``path.at`` for many points of few instants: the lines of an image share theirs."""
    instants, index = np.unique(t_us, return_inverse=True)
    return path.at(instants)[index]


def _turned(a_from_b: Float64[np.ndarray, "n 4 4"], vectors: Vectors) -> Vectors:
    return np.einsum("nij,nj->ni", a_from_b[:, :3, :3], vectors)


def _reach(actor: Actor, t_us: Times) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """Corners of a world-aligned box around the padded boxes between the first and the last time."""
    if not len(t_us):
        return np.zeros(3), np.zeros(3)
    first, last = int(t_us.min()), int(t_us.max())
    path = actor.path
    between = path.t_us[(path.t_us > first) & (path.t_us < last)]
    middle = path.at(np.array([first, *between, last]))[:, :3, 3]
    radius = np.linalg.norm(np.asarray(actor.track.size_m) / 2 + PADDING_M)
    return middle.min(axis=0) - radius, middle.max(axis=0) + radius


def _longer(path: Trajectory, span_us: tuple[int, int]) -> Trajectory:
    """The path with one more pose at both ends, by the twist of the step beside it, within the clip's span."""
    times, poses = path.t_us, path.world_from_body
    if len(times) == 1:
        around = times[0] + np.array([-LONE_LABEL_US, 0, LONE_LABEL_US])
        return Trajectory(around, np.repeat(poses, 3, axis=0))
    # T_0 T_1^-1 is the last step backwards in the world: applying it once more continues the same twist.
    before = poses[0] @ geometry.inverse(poses[1]) @ poses[0]
    after = poses[-1] @ geometry.inverse(poses[-2]) @ poses[-1]
    longer = Trajectory(
        np.concatenate([[2 * times[0] - times[1]], times, [2 * times[-1] - times[-2]]]),
        np.concatenate([before[None], poses, after[None]]),
    )
    first, last = max(longer.start_us, min(span_us[0], times[0])), min(longer.end_us, max(span_us[1], times[-1]))
    within = np.unique([first, *times, last])
    return Trajectory(within, longer.at(within))
