"""Moving returns of one sweep grouped into objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from nurec_sim.reconstruct.movers.contradicted import Seen

LINK_M = 0.8
"""Moving returns this close to each other, seen from above, belong to one object."""
BESIDE_M = 0.4
"""Other returns this close to a moving one are asked whether they move as well..."""
LEAST_SHARE = 0.5
"""...and this share of all of them must: edges of what stands are seen past, too."""
FEWEST = 5
LARGEST_M = 20.0
LOWEST_TOP_M, HIGHEST_FOOT_M = 0.6, 1.2
"""Above the ground: the top of an object is higher than the first, its lowest return lower than the second."""


@dataclass(frozen=True, eq=False)
class Blob:
    """An object in one sweep.

    Attributes:
        t_us: when it was measured: the mean time of its returns.
        xyz_m: its returns in the world.
        ground_m: the same moved down to the ground.
        middle_m: middle of their extent, seen from above.
    """

    t_us: int
    xyz_m: Float64[np.ndarray, "n 3"]
    ground_m: Float64[np.ndarray, "n 3"]
    middle_m: Float64[np.ndarray, " 2"]


def blobs_of(seen: Seen, moves: Bool[np.ndarray, " n"]) -> list[Blob]:
    """The moving objects among the returns of a sweep.

    Args:
        seen: the returns.
        moves: which of them move: ``seen.moving`` or ``seen.crossed``.
    """
    moving = np.flatnonzero(moves)
    if not len(moving):
        return []
    tree = cKDTree(seen.xyz_m[moving, :2])
    pairs = tree.query_pairs(LINK_M, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), (len(moving), len(moving)))
    count, group = connected_components(links, directed=False)
    distance, nearest = cKDTree(seen.xyz_m[moving]).query(seen.xyz_m, distance_upper_bound=BESIDE_M)
    near = np.flatnonzero(np.isfinite(distance))
    of_near = group[nearest[near]]
    around = np.bincount(of_near, minlength=count)
    sure = np.bincount(group, minlength=count)
    found = []
    for number in np.flatnonzero((sure >= FEWEST) & (sure >= LEAST_SHARE * around)):
        rows = moving[group == number]
        xyz, height = seen.xyz_m[rows], seen.height_m[rows]
        low, high = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
        size_m = float(np.linalg.norm(high - low))
        if size_m <= LARGEST_M and height.max() >= LOWEST_TOP_M and height.min() <= HIGHEST_FOOT_M:
            on_ground = np.column_stack([xyz[:, :2], xyz[:, 2] - height])
            found.append(Blob(_mean(seen.fired_us[rows]), xyz, on_ground, (low + high) / 2))
    return found


def _mean(t_us: Int64[np.ndarray, " n"]) -> int:
    first = int(t_us[0])
    return first + round(float((t_us - first).mean()))
