"""Fits tangent-continuous chains of lines and arcs to polylines, for readers that support no other geometry.

Vertices are placed on the polyline at chords of 1, 4 or 16 times ``CHORD_M``, the longest that stays within
``CHORD_TOLERANCE_M``; every corner between two chords is rounded by the arc tangent to both. Lengths of the pieces are
then multiples of half a chord, and none is a single one: readers that count 0.5 m per sample keep the right distance
along the road (within 1 %).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

CHORD_M = 0.999
"""Slightly less than a metre, so that rounding never adds a sample to a piece."""
CHORDS = (16, 4, 1)
CHORD_TOLERANCE_M = 0.02
_STRAIGHT_RAD = 1e-6


@dataclass(frozen=True)
class Piece:
    """A line (curvature 0) or an arc with a start point and heading; positive curvature turns left."""

    xy: tuple[float, float]
    heading_rad: float
    length_m: float
    curvature_per_m: float

    def at(self, distance_m: Float64[np.ndarray, " n"]) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
        """Points and headings at distances along the piece."""
        # A chord of an arc has the mean of both headings and the length s sin(k s / 2) / (k s / 2); 0 / 0 is 1 in sinc.
        half = self.curvature_per_m * distance_m / 2
        chord, yaw = distance_m * np.sinc(half / np.pi), self.heading_rad + half
        return np.array(self.xy) + np.stack([chord * np.cos(yaw), chord * np.sin(yaw)], axis=1), yaw + half

    def aside(self, left_m: float) -> Piece:
        """The parallel piece offset to the left; the radius of a left turn must be larger than the offset."""
        x, y = self.xy
        # The radius changes from R to R - d at the same angle, so lengths scale with 1 - d / R.
        scale = 1 - self.curvature_per_m * left_m
        moved = (x - left_m * float(np.sin(self.heading_rad)), y + left_m * float(np.cos(self.heading_rad)))
        return Piece(moved, self.heading_rad, self.length_m * scale, self.curvature_per_m / scale)


def resampled(line: Float64[np.ndarray, "n d"], step_m: float) -> Float64[np.ndarray, "k d"]:
    """Resamples a line at horizontal steps of at most ``step_m``, including both ends; repeated points are dropped."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1))])
    kept = np.concatenate([[True], np.diff(along) > 1e-9])
    at = np.linspace(0.0, along[-1], max(1, int(np.ceil(along[-1] / step_m))) + 1)
    return np.stack([np.interp(at, along[kept], line[kept, axis]) for axis in range(line.shape[1])], axis=1)


def fitted(line: Float64[np.ndarray, "n 2"]) -> list[Piece]:
    """Lines and arcs along a polyline of at least two points; corners of 90 degrees are rounded by 0.2 m."""
    vertices = _vertices(np.asarray(line, np.float64)[:, :2])
    step = np.diff(vertices, axis=0)
    length = np.hypot(*step.T)
    yaw = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    turn = np.diff(yaw)
    turn[np.abs(turn) < _STRAIGHT_RAD] = 0.0
    reach = np.minimum(length[:-1], length[1:]) / 2  # distance from a corner to the start of its arc
    reach[turn == 0.0] = 0.0
    before, after = np.concatenate([[0.0], reach]), np.concatenate([reach, [0.0]])
    pieces: list[Piece] = []
    for k in range(len(step)):
        u = step[k] / length[k]
        straight = float(length[k] - before[k] - after[k])
        if straight > 1e-6:
            start = vertices[k] + before[k] * u
            if pieces and pieces[-1].curvature_per_m == 0.0:
                last = pieces[-1]
                pieces[-1] = Piece(last.xy, last.heading_rad, last.length_m + straight, 0.0)
            else:
                pieces.append(Piece((float(start[0]), float(start[1])), float(yaw[k]), straight, 0.0))
        if k < len(turn) and turn[k] != 0.0:
            start = vertices[k + 1] - reach[k] * u
            # An arc tangent to both chords at a distance t from their corner has the radius t / tan(turn / 2).
            curvature = float(np.tan(turn[k] / 2) / reach[k])
            arc_m = float(turn[k] / curvature)
            pieces.append(Piece((float(start[0]), float(start[1])), float(yaw[k]), arc_m, curvature))
    return pieces


def sampled(pieces: list[Piece], step_m: float = 0.5) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
    """Points and headings along a chain, including both ends of every piece."""
    parts = [
        piece.at(np.linspace(0.0, piece.length_m, max(2, int(np.ceil(piece.length_m / step_m))))) for piece in pieces
    ]
    xy, yaw = zip(*parts, strict=True)
    return np.concatenate(xy), np.concatenate(yaw)


def _vertices(line: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "k 2"]:
    """Points on a polyline whose distances are multiples of ``CHORD_M``, except the last one."""
    keep = np.concatenate([[True], np.hypot(*np.diff(line, axis=0).T) > 1e-6])
    line = line[keep]
    found, row, here = [line[0]], 0, line[0]
    while True:
        for multiple in CHORDS:
            ahead = _ahead(line, row, here, multiple * CHORD_M)
            if ahead is None:
                continue
            there, next_row = ahead
            between = line[row + 1 : next_row + 1] - here
            u = (there - here) / (multiple * CHORD_M)
            # Distance from the chord of the vertices that it skips.
            off = np.abs(between[:, 0] * u[1] - between[:, 1] * u[0])
            if multiple == 1 or off.max(initial=0.0) <= CHORD_TOLERANCE_M:
                break
        else:
            break
        here, row = there, next_row
        found.append(here)
    rest = float(np.hypot(*(line[-1] - here)))
    if len(found) == 1 or rest > 0.3 * CHORD_M:
        found.append(line[-1])
    return np.array(found)


def _ahead(line: np.ndarray, row: int, here: np.ndarray, chord_m: float) -> tuple[np.ndarray, int] | None:
    """First point of the polyline after ``here`` (on segment ``row``) at distance ``chord_m``, and its segment."""
    stop = row + 1
    while stop < len(line):
        # In blocks: vertices may be much denser than chords, and a full search each time would be quadratic.
        block = line[stop : stop + 64] - here
        far = np.flatnonzero(block[:, 0] ** 2 + block[:, 1] ** 2 >= chord_m**2)
        if len(far):
            stop += int(far[0])
            break
        stop += 64
    if stop >= len(line):
        return None
    start = here if stop == row + 1 else line[stop - 1]
    way, away = line[stop] - start, start - here
    # Intersection of a segment with a circle around ``here``: the larger root is where it leaves the circle.
    a, b, c = float(way @ way), float(way @ away), float(away @ away) - chord_m**2
    t = (-b + np.sqrt(max(b * b - a * c, 0.0))) / a
    return start + t * way, stop - 1
