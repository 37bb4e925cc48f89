"""Centre lines of lines, arcs and clothoids, evaluated exactly, with lanes and parking strips.

Road coordinates are (station, offset): metres along the centre line and metres to its left.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import shapely
from jaxtyping import Float64

from nurec_sim.world.plan.town import Road, RoadPiece

STEP_M = 1.0
# Eight nodes integrate polynomials up to degree 15 exactly, far beyond what the gentle clothoids of a road need.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


class Curve(Protocol):
    """A start pose and the pieces from there on: a road, or a path through a junction."""

    @property
    def x_m(self) -> float: ...  # noqa: D102
    @property
    def y_m(self) -> float: ...  # noqa: D102
    @property
    def yaw_rad(self) -> float: ...  # noqa: D102
    @property
    def pieces(self) -> tuple[RoadPiece, ...]: ...  # noqa: D102


class RoadLine:
    """An evaluated curve; exact to 1e-9 m at any station."""

    def __init__(self, curve: Curve):
        self.curve = curve
        self.piece_station_m = np.cumsum([0.0, *(piece.length_m for piece in curve.pieces)])
        self.length_m = float(self.piece_station_m[-1])
        self._starts = [(np.array([curve.x_m, curve.y_m], np.float64), float(curve.yaw_rad))]
        for piece in curve.pieces:
            xy, yaw = _along(piece, *self._starts[-1], np.array([piece.length_m]))
            self._starts.append((xy[0], float(yaw[0])))

    @property
    def end(self) -> tuple[Float64[np.ndarray, " 2"], float]:
        """Position and heading of the end."""
        return self._starts[-1]

    def start_of(self, piece: int) -> tuple[Float64[np.ndarray, " 2"], float]:
        """Position and heading where a piece begins."""
        return self._starts[piece]

    def at(
        self, station_m: float | Float64[np.ndarray, "*n"], offset_m: float | Float64[np.ndarray, "*n"] = 0.0
    ) -> tuple[Float64[np.ndarray, "*n 2"], Float64[np.ndarray, "*n"]]:
        """Position and heading on the curve; stations are clamped to its range."""
        station = np.clip(np.asarray(station_m, np.float64), 0.0, self.length_m)
        # A station on a boundary belongs to the next piece; the end of the road belongs to the last one.
        piece_of = np.clip(
            np.searchsorted(self.piece_station_m, station, side="right") - 1, 0, len(self.curve.pieces) - 1
        )
        xy, yaw = np.zeros((*station.shape, 2)), np.zeros(station.shape)
        for index, piece in enumerate(self.curve.pieces):
            here = piece_of == index
            if here.any():
                xy[here], yaw[here] = _along(piece, *self._starts[index], station[here] - self.piece_station_m[index])
        # The left normal of a heading (cos, sin) is (-sin, cos).
        offset = np.asarray(offset_m, np.float64)[..., None]
        return xy + offset * np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1), yaw

    def stations(self, start_m: float = 0.0, end_m: float | None = None) -> Float64[np.ndarray, " k"]:
        """Stations at most 1 m apart, at which polygons and polylines have vertices."""
        end_m = self.length_m if end_m is None else end_m
        return np.linspace(start_m, end_m, max(2, int(np.ceil((end_m - start_m) / STEP_M)) + 1))

    def band(
        self, start_m: float, end_m: float, right_m: float | np.ndarray, left_m: float | np.ndarray
    ) -> shapely.Polygon:
        """The area between two lateral offsets, as a polygon with a vertex on each side at every station.

        Args:
            start_m: first station, in metres along the centre line.
            end_m: last station.
            right_m: offset of the right edge (m, left positive): one number, or one per ``stations(start_m, end_m)``.
            left_m: offset of the left edge, likewise.
        """
        stations = self.stations(start_m, end_m)
        right, _ = self.at(stations, right_m)
        left, _ = self.at(stations, left_m)
        return shapely.Polygon(np.concatenate([right, left[::-1]]))


class RoadLanes(RoadLine):
    """A road's centre line with its cross-section; ``side`` is -1 for the right and 1 for the left."""

    def __init__(self, plan: Road):
        super().__init__(plan)
        self.plan = plan

    @property
    def numbers(self) -> tuple[int, ...]:
        """Lane numbers, from the outermost on the right to the outermost on the left."""
        return (*range(-self.plan.lanes_forward, 0), *range(1, self.plan.lanes_backward + 1))

    def count(self, side: int) -> int:
        """How many lanes lie on a side of the centre line."""
        return self.plan.lanes_forward if side < 0 else self.plan.lanes_backward

    def lane_width_m(self, station_m: float | Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
        """Width of every lane."""
        narrow = self.plan.narrowing
        return self._eased(station_m, self.plan.lane_width_m, narrow.lane_width_m if narrow else None)

    def strip_width_m(self, side: int, station_m: float | Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
        """Width of the parking strip of a side."""
        narrow, plan = self.plan.narrowing, self.plan
        usual = plan.right_strip_m if side < 0 else plan.left_strip_m
        return self._eased(
            station_m, usual, None if narrow is None else narrow.right_strip_m if side < 0 else narrow.left_strip_m
        )

    def lane_edge_m(self, side: int, station_m: float | Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
        """Offset of the outer edge of a side's lanes."""
        return side * self.count(side) * self.lane_width_m(station_m)

    def edge_m(self, side: int, station_m: float | Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
        """Offset of the foot of the kerb."""
        return self.lane_edge_m(side, station_m) + side * self.strip_width_m(side, station_m)

    def lane_offset_m(self, number: int, station_m: float | Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
        """Offset of a lane's centre line."""
        return np.sign(number) * (abs(number) - 0.5) * self.lane_width_m(station_m)

    def surface(self, start_m: float, end_m: float) -> shapely.Polygon:
        """The area between the kerbs."""
        stations = self.stations(start_m, end_m)
        return self.band(start_m, end_m, self.edge_m(-1, stations), self.edge_m(1, stations))

    def _eased(self, station_m: float | np.ndarray, usual: float, narrow_value: float | None) -> np.ndarray:
        """A width that changes along the narrowing by a cubic, as in OpenDRIVE."""
        station = np.asarray(station_m, np.float64)
        narrow = self.plan.narrowing
        if narrow is None or narrow_value is None:
            return np.full(station.shape, usual)
        # 1 at both ends of the narrow part and beyond 1 within it; falls to 0 over the length of a taper outside.
        inside = np.minimum(station - narrow.start_m, narrow.end_m - station) / narrow.taper_m + 1
        share = np.clip(inside, 0.0, 1.0)
        # The smoothstep 3 s^2 - 2 s^3 has zero slope at both ends, and OpenDRIVE can express it exactly.
        return usual + (narrow_value - usual) * share**2 * (3 - 2 * share)


def _along(
    piece: RoadPiece, start: np.ndarray, yaw_rad: float, distance_m: np.ndarray
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
    """Position and heading along a piece: closed form for arcs, Gauss-Legendre for clothoids."""
    first = piece.start_curvature_per_m
    change = (piece.end_curvature_per_m - first) / piece.length_m
    # Curvature k0 + k' s integrates to the heading yaw0 + k0 s + k' s^2 / 2.
    yaw = yaw_rad + (first + change * distance_m / 2) * distance_m
    if change == 0.0:  # the chord of an arc
        # A chord is s sin(a) / a long for half the turned angle a, and points along the mean heading. np.sinc(x) is
        # sin(pi x) / (pi x), so that straight lines need no special case.
        half = (yaw - yaw_rad) / 2
        chord = distance_m * np.sinc(half / np.pi)
        middle = yaw_rad + half
        return start + np.stack([chord * np.cos(middle), chord * np.sin(middle)], axis=-1), yaw
    # Fresnel integrals: position is the integral of (cos, sin) of the heading, per distance from the start.
    inner = distance_m[:, None] * (_NODES + 1) / 2
    heading = yaw_rad + (first + change * inner / 2) * inner
    scale = distance_m / 2
    xy = np.stack([(np.cos(heading) @ _WEIGHTS) * scale, (np.sin(heading) @ _WEIGHTS) * scale], axis=-1)
    return start + xy, yaw
