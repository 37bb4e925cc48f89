"""Precision and recall of detected objects, and consistency of two sets of detections.

A detection and an object of one kind belong together if their centres, seen from above, are within 2 m; the surest
detections choose first, each the nearest object that is left (as nuScenes does). Objects that are not to be found take
detections without counting, after the visible ones had their choice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

MATCH_M = 2.0
RANGES_M = ((0.0, 30.0), (30.0, 60.0))
"""Bins of the distance from the camera, seen from above."""


@dataclass(frozen=True, eq=False)
class Places:
    """Kinds and places of objects, seen from above."""

    kind: Int64[np.ndarray, " n"]
    xy_m: Float64[np.ndarray, "n 2"]


def match(
    found: Places, there: Places, visible: Bool[np.ndarray, " m"] | None = None
) -> tuple[Int64[np.ndarray, " n"], Bool[np.ndarray, " m"]]:
    """Assigns detections to objects.

    Args:
        found: detections, the surest first.
        there: objects.
        visible: those that should be found; all if None.

    Returns:
        For each detection the index of its object, -1 for none, and -2 if it is at an object that is not to be found;
        and which objects were found.
    """
    seen = np.ones(len(there.kind), bool) if visible is None else np.asarray(visible, bool)
    owner, taken = np.full(len(found.kind), -1, np.int64), np.zeros(len(there.kind), bool)
    for k, (kind, place) in enumerate(zip(found.kind, found.xy_m, strict=True)):
        away = np.linalg.norm(there.xy_m - place, axis=1)
        near = (there.kind == kind) & (away <= MATCH_M)
        free = np.flatnonzero(near & seen & ~taken)
        if len(free):
            owner[k] = free[np.argmin(away[free])]
            taken[owner[k]] = True
        elif (near & ~seen).any():
            owner[k] = -2
    return owner, taken


def range_bin(xy_m: Float64[np.ndarray, "n 2"]) -> Int64[np.ndarray, " n"]:
    """Index into ``RANGES_M`` of places relative to the camera, -1 beyond."""
    away = np.linalg.norm(xy_m, axis=1)
    bins = np.full(len(away), -1, np.int64)
    for k, (low, high) in enumerate(RANGES_M):
        bins[(away >= low) & (away < high)] = k
    return bins


def count(
    found: Places, there: Places, visible: Bool[np.ndarray, " m"], kinds: Sequence[str]
) -> dict[str, dict[str, int]]:
    """Counts of one image: by ``kind range``, ``found`` and ``right`` detections, ``there`` and ``seen`` objects.

    Detections are binned by their own distance, objects by theirs; places are relative to the camera.
    """
    owner, taken = match(found, there, visible)
    its, their = range_bin(found.xy_m), range_bin(there.xy_m)
    counts = {}
    for kind, name in enumerate(kinds):
        for k, (low, high) in enumerate(RANGES_M):
            mine, objects = (found.kind == kind) & (its == k), (there.kind == kind) & (their == k) & visible
            counts[f"{name} {low:g}-{high:g} m"] = {
                "found": int((mine & (owner != -2)).sum()),
                "right": int((mine & (owner >= 0)).sum()),
                "there": int(objects.sum()),
                "seen": int((objects & taken).sum()),
            }
    return counts


def agreement(one: Places, other: Places, kinds: Sequence[str]) -> dict[str, dict[str, int]]:
    """Detections of one image and how many of them are in another image of the same view too, by ``kind range``."""
    owner, _ = match(one, other)
    bins = range_bin(one.xy_m)
    return {
        f"{name} {low:g}-{high:g} m": {
            "found": int(((one.kind == kind) & (bins == k)).sum()),
            "again": int(((one.kind == kind) & (bins == k) & (owner >= 0)).sum()),
        }
        for kind, name in enumerate(kinds)
        for k, (low, high) in enumerate(RANGES_M)
    }


def added(counts: Sequence[Mapping[str, Mapping[str, int]]]) -> dict[str, dict[str, int]]:
    """Sums of counts over images."""
    sums: dict[str, dict[str, int]] = {}
    for each in counts:
        for name, row in each.items():
            into = sums.setdefault(name, dict.fromkeys(row, 0))
            for key, value in row.items():
                into[key] += value
    return sums


def share(part: int, whole: int) -> float | None:
    """A ratio of counts; None of nothing."""
    return part / whole if whole else None
