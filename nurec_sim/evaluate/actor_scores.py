"""Actors that were found by their motion, compared with the boxes of the log.

Counted are instants of objects: at each box time of the log, the labelled movable objects near the car that move, and
the found ones. An object and a found one belong together if their centres are close, each to one other at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment

from nurec_sim.types import MOVABLE_LABELS, Clip, GaussianScene, Track

NEAR_M = 40.0
"""Distance from the car up to which objects count."""
MATCH_M = 2.0
"""Largest distance between the centres of a box and a found object, seen from above."""
MOVES_MPS = 1.0
PEOPLE = ("person", "rider", "animal")
MOMENT_US = 250_000
"""Speeds are over this long before and after, or up to the end of a track."""
STEP_US = 100_000


def score_actors(clip: Clip, scene: GaussianScene) -> dict[str, Any] | None:
    """How well the found actors of a scene agree with the boxes of its log.

    Args:
        clip: the log.
        scene: a scene of it.

    Returns:
        ``recall`` of labelled vehicles that move at more than 1 m/s, ``recall_people`` that do, ``precision`` (share of
        found instants at a labelled movable object, moving or not), medians ``centre_m`` and ``speed_mps`` of the
        errors of moving vehicles that were found, ``instants`` labelled and ``found``; None where there is nothing to
        divide by. None altogether if the log has no boxes or the scene no found actors.
    """
    found = [track for track in scene.tracks if not track.labelled and track.actor]
    labelled = [track for track in clip.tracks if track.label in MOVABLE_LABELS and len(track.path.t_us) > 1]
    if not found or not labelled:
        return None
    first, last = (end(track.path.t_us[k] for track in labelled) for end, k in ((min, 0), (max, -1)))
    start, end = max(int(first), clip.ego.start_us), min(int(last), clip.ego.end_us)
    counts = {"vehicles": [0, 0], "people": [0, 0], "found": [0, 0]}
    centre, speed = [], []
    for t_us in range(start, end + 1, STEP_US):
        there, seen = _near(labelled, clip, t_us), _near(found, clip, t_us)
        pairs = _pairs([place for _, place in there], [place for _, place in seen])
        counts["found"][0] += len(pairs)
        counts["found"][1] += len(seen)
        for number, (track, place) in enumerate(there):
            true_mps = _velocity(track, t_us)
            if np.linalg.norm(true_mps) < MOVES_MPS:
                continue
            people = track.label in PEOPLE
            counts["people" if people else "vehicles"][0] += number in pairs
            counts["people" if people else "vehicles"][1] += 1
            if number in pairs and not people:
                other, its_place = seen[pairs[number]]
                centre.append(float(np.linalg.norm(its_place - place)))
                speed.append(float(np.linalg.norm(_velocity(other, t_us) - true_mps)))
    share = {name: hit / total if total else None for name, (hit, total) in counts.items()}
    return {
        "recall": share["vehicles"],
        "recall_people": share["people"],
        "precision": share["found"],
        "centre_m": float(np.median(centre)) if centre else None,
        "speed_mps": float(np.median(speed)) if speed else None,
        "instants": {
            "moving vehicles": counts["vehicles"][1],
            "moving people": counts["people"][1],
            "found actors": counts["found"][1],
        },
    }


def _near(tracks: Sequence[Track], clip: Clip, t_us: int) -> list[tuple[Track, Float64[np.ndarray, " 2"]]]:
    """The tracks that are near the car at a time, and where."""
    ego = clip.ego.at(t_us)[:2, 3]
    places = [(track, track.path.at(t_us)[:2, 3]) for track in tracks if track.path.covers(t_us)]
    return [(track, place) for track, place in places if np.linalg.norm(place - ego) < NEAR_M]


def _pairs(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> dict[int, int]:
    if not one or not other:
        return {}
    distance = np.linalg.norm(np.array(one)[:, None] - np.array(other), axis=2)
    # What is too far away costs more than all pairs together, so that it never takes a partner from another.
    rows, columns = linear_sum_assignment(np.where(distance <= MATCH_M, distance, 1e3))
    return {int(r): int(c) for r, c in zip(rows, columns, strict=True) if distance[r, c] <= MATCH_M}


def _velocity(track: Track, t_us: int) -> Float64[np.ndarray, " 2"]:
    """Over ground, metres per second."""
    before, after = max(t_us - MOMENT_US, track.path.start_us), min(t_us + MOMENT_US, track.path.end_us)
    moved = track.path.at(after)[:2, 3] - track.path.at(before)[:2, 3]
    return moved / max((after - before) / 1e6, 1e-6)
