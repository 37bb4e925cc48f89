"""Upright boxes over time in bird's-eye view, and their collisions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64


@dataclass(frozen=True, eq=False)
class Boxes:
    """Centres, headings, half lengths and half widths of n boxes at t instants."""

    middle_m: Float64[np.ndarray, "t n 2"]
    yaw_rad: Float64[np.ndarray, "t n"]
    half_m: Float64[np.ndarray, "n 2"]

    def since(self, step: int) -> Boxes:
        """The same without the first ``step`` instants."""
        return Boxes(self.middle_m[step:], self.yaw_rad[step:], self.half_m)


def standing(places: Sequence[tuple[float, float, float]], half_m: np.ndarray, instants: int) -> Boxes:
    """Static boxes at (x, y, yaw)."""
    table = np.array(places, np.float64).reshape(-1, 3)
    shape = (instants, len(table))
    middle, yaw = np.broadcast_to(table[:, :2], (*shape, 2)), np.broadcast_to(table[:, 2], shape)
    return Boxes(middle, yaw, np.asarray(half_m, np.float64).reshape(-1, 2))


def together(groups: Sequence[Boxes]) -> Boxes:
    """Concatenation of boxes."""
    middle = np.concatenate([group.middle_m for group in groups], axis=1)
    yaw = np.concatenate([group.yaw_rad for group in groups], axis=1)
    return Boxes(middle, yaw, np.concatenate([group.half_m for group in groups]))


def touching(boxes: Boxes, margin_m: float = 0.0) -> list[tuple[int, int]]:
    """Pairs of boxes that come closer than ``margin_m`` at any of their times, by separating axes.

    Pairs of static boxes are skipped. The margin is slightly larger at corners.
    """
    radius = np.linalg.norm(boxes.half_m, axis=1) + margin_m
    moves = np.ptp(boxes.middle_m, axis=0).max(axis=1) > 1e-6
    rows, columns = np.triu_indices(len(radius), 1)
    some = moves[rows] | moves[columns]
    rows, columns = rows[some], columns[some]
    # Circumscribed circles first: few pairs and times are left for the exact test.
    away = np.linalg.norm(boxes.middle_m[:, rows] - boxes.middle_m[:, columns], axis=2)
    at, pair = np.nonzero(away < radius[rows] + radius[columns])
    first, second = rows[pair], columns[pair]
    between = boxes.middle_m[at, second] - boxes.middle_m[at, first]
    half_a, half_b = boxes.half_m[first] + margin_m / 2, boxes.half_m[second] + margin_m / 2
    yaw_a, yaw_b = boxes.yaw_rad[at, first], boxes.yaw_rad[at, second]
    c, s = np.abs(np.cos(yaw_b - yaw_a)), np.abs(np.sin(yaw_b - yaw_a))
    # Separating axes of two rectangles: they are apart if their projections are, on any of the four side directions.
    apart = np.zeros(len(at), bool)
    for yaw, mine, other in ((yaw_a, half_a, half_b), (yaw_b, half_b, half_a)):
        along = np.abs(between[:, 0] * np.cos(yaw) + between[:, 1] * np.sin(yaw))
        across = np.abs(between[:, 1] * np.cos(yaw) - between[:, 0] * np.sin(yaw))
        apart |= along > mine[:, 0] + other[:, 0] * c + other[:, 1] * s
        apart |= across > mine[:, 1] + other[:, 0] * s + other[:, 1] * c
    return sorted(set(zip(first[~apart].tolist(), second[~apart].tolist(), strict=True)))
