"""Actors as rigid parts of their boxes: one set of Gaussians each, moved by the path of its track."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64

from nurec_sim.reconstruct.lift.points import LONE_LABEL_US, Actor
from nurec_sim.types import Clip, DynamicGaussians, Gaussians, Track, Trajectory

OUTSIDE = 1.2
"""Knots of what stands over a whole span lie this much farther from its middle than its ends: the fade at the ends is
exp(-(1 / 1.2)**10) = 0.85."""


def tracks_of(clip: Clip, actors: Sequence[Actor]) -> tuple[Track, ...]:
    """The clip's tracks as the scene shows them: a static one stays at one place, over the whole clip.

    Logs label objects only while a sensor sees them; a parked car that the ego has passed is still there to be hit.
    """
    tracks = list(clip.tracks)
    for actor in actors:
        path, pose = actor.path, actor.path.world_from_body[0]
        if actor.standing:
            path = Trajectory(np.array(clip.span_us), np.stack([pose, pose]))
        elif len(path.t_us) == 1:
            path = Trajectory(path.t_us[0] + np.array([-LONE_LABEL_US, LONE_LABEL_US]), np.stack([pose, pose]))
        else:
            continue
        tracks[actor.index] = dataclasses.replace(actor.track, path=path)
    return tuple(tracks)


def in_box(actor: Actor, gaussians_box: Gaussians) -> DynamicGaussians:
    """Gaussians in the frame of an actor's box as parts of its track."""
    track = np.full(len(gaussians_box), actor.index, np.int32)
    return DynamicGaussians.rigid(gaussians_box, track, actor.path.start_us)


def standing_knots_us(span_us: tuple[int, int]) -> Int64[np.ndarray, " 3"]:
    """Knot times of Gaussians that are static over a whole span and should not fade within it."""
    half, middle = int((span_us[1] - span_us[0]) / 2 * OUTSIDE) + 1, (span_us[0] + span_us[1]) // 2
    return np.array([middle - half, middle, middle + half])
