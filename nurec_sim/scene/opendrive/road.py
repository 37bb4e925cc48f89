"""A road of the map: a reference line and one lane of constant width to its right."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool

from nurec_sim.scene.opendrive.curves import Piece, sampled

LANE_WIDTH_M = 3.5
MAX_WIDTH_M = 4.0
CLEAR_M = 0.3
"""Clearance to the border of everything except the strips along it."""
OVERLAP_M = 0.05
SEAL_M = 0.02
FIT_M = 0.03
"""Tolerance by which fitted curves may leave the area."""
STATION_M = 1.0
MIN_ROAD_M = 1.0
SHARPEST = 0.8
"""Maximum product of curvature and the width on the inside of a bend; at 1 the inner border would be a point."""


@dataclass(frozen=True)
class LaidRoad:
    """A reference line and the lane on its right, with its type and width; seals are separate lanes."""

    reference: list[Piece]
    lane: str
    width_m: float
    sealed: tuple[bool, bool]
    """Whether it is sealed on the left and on the right."""

    @cached_property
    def polygon(self) -> Any:
        """The area of the lane as a shapely polygon."""
        import shapely

        xy, yaw = sampled(self.reference)
        normal = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
        return shapely.Polygon(np.concatenate([xy, (xy - self.width_m * normal)[::-1]]))

    @property
    def length_m(self) -> float:
        """Length of the reference line."""
        return sum(piece.length_m for piece in self.reference)


def gentle(chain: list[Piece], left_m: float, right_m: float) -> Iterator[list[Piece]]:
    """Splits a chain at bends that are too sharp for the width on their inside, and drops those bends."""
    # A parallel curve at a distance d on the inside has the radius 1/k - d, which must stay positive.
    fits = np.array([-SHARPEST <= piece.curvature_per_m * right_m and piece.curvature_per_m * left_m <= SHARPEST
                     for piece in chain], bool)  # fmt: skip
    for start, stop in runs(fits, 1):
        if sum(piece.length_m for piece in chain[start:stop]) >= MIN_ROAD_M / 2:
            yield chain[start:stop]


def runs(mask: Bool[np.ndarray, " n"], shortest: int = 3) -> Iterator[tuple[int, int]]:
    """Start and stop of the runs of at least ``shortest`` consecutive True values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - start >= shortest:
            yield int(start), int(stop)
