"""Pairs of neighbouring LiDAR points on two different surfaces (edges), and pairs on the same one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from nurec_sim.logs.checks.sampling import Points

NEAREST_M, FURTHEST_M = 2.5, 80.0
MOST_POINTS = 30_000
NEIGHBOURS = 4
CLOSEST_RAD, WIDEST_RAD = np.radians(0.15), np.radians(2.0)
ELEVATION_WEIGHTS = (3.0, 0.5)
"""Beams are denser along rows than across them; one search along and one across rows finds both kinds of pairs."""
JUMP_M, JUMP_SHARE = 1.0, 0.2
LEVEL_M = 0.15
SMOOTH_SHARE = 0.05
OTHER_INTENSITY, SAME_INTENSITY = 0.35, 0.1
BLOCK_RAD = np.radians((6.0, 4.0))


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of points, by index.

    Attributes:
        first, second: indices of the two points of each pair.
        border: whether there is an edge between them: the range jumps, or the intensity changes.
        block: number of their patch of directions; pairs of one patch are correlated.
    """

    first: Int64[np.ndarray, " n"]
    second: Int64[np.ndarray, " n"]
    border: Bool[np.ndarray, " n"]
    block: Int64[np.ndarray, " n"]


def find_pairs(points: Points, intensity: np.ndarray | None, origin: Float64[np.ndarray, " 3"]) -> Pairs:
    """Neighbouring points in the LiDAR's view.

    Two points are on different surfaces if their ranges differ by more than 1 m and 20 %, or if their ranges agree and
    their intensity ranks do not (paint, signs, kerbs). Ground at a grazing angle has range jumps between points of
    equal height: such pairs are ambiguous and skipped, as are pairs between the thresholds.

    Args:
        points: [n,3] in the rig frame.
        intensity: [n] or None.
        origin: origin of the rays, in the rig frame.
    """
    ray = points - origin
    distance = np.linalg.norm(ray, axis=1)
    used = np.flatnonzero((distance > NEAREST_M) & (distance < FURTHEST_M))
    if len(used) > MOST_POINTS:
        used = np.sort(np.random.default_rng(0).choice(used, MOST_POINTS, replace=False))
    ray, distance = ray[used], distance[used]
    azimuth, elevation = np.arctan2(ray[:, 1], ray[:, 0]), np.arcsin(ray[:, 2] / distance)
    i, j = _neighbours(azimuth, elevation)
    jump, nearer = np.abs(distance[i] - distance[j]), np.minimum(distance[i], distance[j])
    level = np.abs(ray[i, 2] - ray[j, 2]) < LEVEL_M
    border = (jump > np.maximum(JUMP_M, JUMP_SHARE * nearer)) & ~level
    same = jump < SMOOTH_SHARE * nearer
    if intensity is not None:
        # Ranks instead of values: intensity scales differ between devices and are rarely calibrated.
        rank = np.argsort(np.argsort(intensity[used], kind="stable")) / max(len(used), 1)
        change = np.abs(rank[i] - rank[j])
        border |= same & (change > OTHER_INTENSITY)
        same &= change < SAME_INTENSITY
    kept = np.flatnonzero(border | same)
    i, j = i[kept], j[kept]
    columns, rows = (np.floor(angle[i] / size).astype(np.int64) for angle, size in
                     zip((azimuth, elevation), BLOCK_RAD, strict=True))  # fmt: skip
    return Pairs(used[i], used[j], border[kept], columns * 1000 + rows)


def _neighbours(azimuth: np.ndarray, elevation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of both ends of all neighbouring pairs, each pair once."""
    count, found = len(azimuth), [np.zeros(0, np.int64)]
    for weight in ELEVATION_WEIGHTS if count > NEIGHBOURS else ():
        # A large weight makes points of other rows far, so that neighbours are found along a row; a small one across
        # rows.
        places = np.column_stack([azimuth, weight * elevation])
        apart, other = cKDTree(places).query(places, k=NEIGHBOURS + 1, distance_upper_bound=WIDEST_RAD)
        near = np.isfinite(apart[:, 1:]) & (apart[:, 1:] > CLOSEST_RAD)
        one = np.broadcast_to(np.arange(count)[:, None], near.shape)[near]
        two = other[:, 1:][near]
        # An unordered pair as one integer, for np.unique.
        found.append(np.minimum(one, two).astype(np.int64) * count + np.maximum(one, two))
    pairs = np.unique(np.concatenate(found))
    return pairs // max(count, 1), pairs % max(count, 1)
