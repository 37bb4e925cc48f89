"""Knots of moving Gaussians in an archive: each triple of times once, positions only of those that change place.

Gaussians of one exposure or of one rigid actor share their knot times, and knots of rigid and static ones are all at
``mean_m``. So an archive of the current version has

- ``dynamic_knot_t_us`` int64 ``[k, 3]``, the distinct triples in ascending order, and ``dynamic_window`` ``[n]``, the
  index of each Gaussian's triple;
- ``dynamic_moves`` bool ``[n]`` and ``dynamic_knot_m`` float32 ``[m, 3, 3]``, the knots of the m Gaussians for which it
  is true.

Version 1 has ``dynamic_knot_t_us`` ``[n, 3]`` and ``dynamic_knot_m`` ``[n, 3, 3]`` of all Gaussians instead.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32, Int64

from nurec_sim.errors import ArchiveError
from nurec_sim.types import DynamicGaussians

TIMES, WINDOW, MOVES, KNOTS, OWNERS = (
    f"nurec_sim/dynamic_{name}.npy" for name in ("knot_t_us", "window", "moves", "knot_m", "track")
)
KINDS = {TIMES: "i", WINDOW: "iu", MOVES: "b", KNOTS: "f", OWNERS: "i"}
"""Members and the kinds of their dtypes, as for ``array_from_npy``."""
OF_VERSION_1 = (TIMES, KNOTS, OWNERS)


def knot_arrays(dynamic: DynamicGaussians) -> dict[str, np.ndarray]:
    """The arrays of an archive by member."""
    times, window = np.unique(dynamic.knot_t_us, axis=0, return_inverse=True)
    moves = (dynamic.knot_m != dynamic.gaussians.mean_m[:, None]).any(axis=(1, 2))
    return {
        TIMES: times,
        WINDOW: _narrow(window.reshape(-1), len(times)),
        MOVES: moves,
        KNOTS: dynamic.knot_m[moves],
        OWNERS: _narrow(dynamic.track, int(dynamic.track.max(initial=0)) + 1),
    }


def knots_of(
    arrays: Mapping[str, np.ndarray], mean_m: Float32[np.ndarray, "n 3"], where: str
) -> tuple[Int64[np.ndarray, "n 3"], Float32[np.ndarray, "n 3 3"], np.ndarray]:
    """``knot_t_us``, ``knot_m`` and ``track`` of the moving Gaussians with these means.

    Args:
        arrays: by member, of the current version, or of version 1.
        mean_m: of all moving Gaussians.
        where: name of the archive in error texts.

    Raises:
        ArchiveError: the arrays do not fit each other.
    """
    times, knot_m, owners = arrays[TIMES], arrays[KNOTS], arrays[OWNERS].astype(np.int32)
    if WINDOW not in arrays:
        return times, knot_m, owners
    n, window, moves = len(mean_m), arrays[WINDOW].astype(np.int64), arrays[MOVES]
    if window.shape != (n,) or ((window < 0) | (window >= len(times))).any():
        raise ArchiveError(
            f"{where}: {WINDOW} must name one of {len(times)} triples of times for each of {n} Gaussians"
        )
    if moves.shape != (n,) or knot_m.shape != (int(moves.sum()), 3, 3):
        raise ArchiveError(f"{where}: {KNOTS} must have the knots of those of {n} Gaussians that {MOVES} marks")
    everywhere = np.repeat(mean_m[:, None], 3, axis=1)
    everywhere[moves] = knot_m
    return times[window], everywhere, owners


def _narrow(index: np.ndarray, count: int) -> np.ndarray:
    """Indices below ``count``, or -1, in two bytes each if they fit."""
    return index.astype(np.int16 if count <= np.iinfo(np.int16).max else np.int32)
