"""Knots of moving Gaussians in an archive: each triple of times once, positions only of those that change place.

Gaussians of one exposure or of one rigid actor share their knot times, and knots of rigid and static ones are all at
``mean_m``. So an archive of the current version has

- ``dynamic_knot_t_us`` int64 ``[k, 3]``, the distinct triples in ascending order, and the column ``window`` ``[n]``,
  the index of each Gaussian's triple;
- the column ``moves`` ``[n]`` and ``dynamic_knot_m`` float32 ``[m, 3, 3]``, the knots of the m Gaussians for which it
  is true;
- the columns ``track`` and, if any is, ``in_box`` ``[n]``.

Columns are arrays of integers of the USD layer of actors, which packs them (``usd.actors``). In version 2 they were
members like ``dynamic_window``. Version 1 has ``dynamic_knot_t_us`` ``[n, 3]`` and ``dynamic_knot_m`` ``[n, 3, 3]`` of
all Gaussians instead of ``window`` and ``moves``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64

from nurec_sim.errors import ArchiveError
from nurec_sim.types import DynamicGaussians


class DynamicKnots(NamedTuple):
    """The fields of ``DynamicGaussians`` besides ``gaussians``, in their order."""

    knot_t_us: Int64[np.ndarray, "n 3"]
    knot_m: Float32[np.ndarray, "n 3 3"]
    track: Int32[np.ndarray, " n"]
    in_box: Bool[np.ndarray, " n"] | None


TIMES, KNOTS = "nurec_sim/dynamic_knot_t_us.npy", "nurec_sim/dynamic_knot_m.npy"
KINDS = {TIMES: "i", KNOTS: "f"}
"""Members and the kinds of their dtypes, as for ``array_from_npy``."""
WINDOW, MOVES, TRACK, IN_BOX = "window", "moves", "track", "in_box"
COLUMN_KINDS = {WINDOW: "iu", MOVES: "b", TRACK: "i", IN_BOX: "b"}
"""Those of members of earlier versions."""


def member_of(column: str) -> str:
    """The member of a column in archives of versions 1 and 2."""
    return f"nurec_sim/dynamic_{column}.npy"


def columns_of(version: int, in_box: bool) -> tuple[str, ...]:
    """The columns of an archive of a version, whose Gaussians may lie in boxes."""
    own = (WINDOW, MOVES, TRACK) if version > 1 else (TRACK,)
    return (*own, IN_BOX) if in_box else own


def knot_arrays(dynamic: DynamicGaussians) -> tuple[dict[str, np.ndarray], dict[str, Int32[np.ndarray, " n"]]]:
    """The arrays of an archive by member, and its columns."""
    times, window = np.unique(dynamic.knot_t_us, axis=0, return_inverse=True)
    moves = (dynamic.knot_m != dynamic.gaussians.mean_m[:, None]).any(axis=(1, 2))
    columns = {WINDOW: window.reshape(-1), MOVES: moves, TRACK: dynamic.track}
    if dynamic.in_box is not None:
        columns[IN_BOX] = dynamic.in_box
    arrays = {TIMES: times, KNOTS: dynamic.knot_m[moves]}
    return arrays, {name: np.ascontiguousarray(column, np.int32) for name, column in columns.items()}


def knots_of(
    arrays: Mapping[str, np.ndarray], columns: Mapping[str, np.ndarray], mean_m: Float32[np.ndarray, "n 3"], where: str
) -> DynamicKnots:
    """Knots and owners of the moving Gaussians with these means.

    Args:
        arrays: by member (``KINDS``).
        columns: those of the archive's version (``columns_of``).
        mean_m: of all moving Gaussians.
        where: name of the archive in error texts.

    Raises:
        ArchiveError: the arrays do not fit each other.
    """
    times, knot_m, n = arrays[TIMES], arrays[KNOTS], len(mean_m)
    if wrong := {name: column.shape for name, column in columns.items() if column.shape != (n,)}:
        raise ArchiveError(f"{where}: {n} moving Gaussians, but other shapes in {wrong}")
    track = columns[TRACK].astype(np.int32)
    in_box = columns[IN_BOX].astype(bool) if IN_BOX in columns else None
    if WINDOW not in columns:
        return DynamicKnots(times, knot_m, track, in_box)
    window, moves = columns[WINDOW].astype(np.int64), columns[MOVES].astype(bool)
    if ((window < 0) | (window >= len(times))).any():
        raise ArchiveError(
            f"{where}: {WINDOW} must name one of {len(times)} triples of times for each of {n} Gaussians"
        )
    if knot_m.shape != (int(moves.sum()), 3, 3):
        raise ArchiveError(f"{where}: {KNOTS} must have the knots of those of {n} Gaussians that {MOVES} marks")
    everywhere = np.repeat(mean_m[:, None], 3, axis=1)
    everywhere[moves] = knot_m
    return DynamicKnots(times[window], everywhere, track, in_box)
