"""The road's centre line and everything laid out along it: lanes, edges, ribbons and the exact drivable polygon.

Places on the road are (station, offset): metres along the centre line and metres to its left.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from nurec_sim.types import RoadMap
from nurec_sim.world.plan import Road

FINE_STEP_M = 0.25
MESH_STEP_M = 1.0


class RoadLine:
    """A road's centre line, integrated from its pieces (curvature, then heading, then position)."""

    def __init__(self, road: Road):
        self.road = road
        ends = np.cumsum([0.0, *(piece.length_m for piece in road.pieces)])
        self.length_m = float(ends[-1])
        count = int(np.ceil(self.length_m / FINE_STEP_M))
        self.station_m = np.linspace(0.0, self.length_m, count + 1)
        step = self.length_m / count
        middle = self.station_m[:-1] + step / 2
        piece = np.clip(np.searchsorted(ends, middle, side="right") - 1, 0, len(road.pieces) - 1)
        start = np.array([p.start_curvature_per_m for p in road.pieces])[piece]
        change = np.array([(p.end_curvature_per_m - p.start_curvature_per_m) / p.length_m for p in road.pieces])[piece]
        self.curvature_per_m = start + change * (middle - ends[piece])
        self.yaw_rad = road.yaw_rad + np.concatenate([[0.0], np.cumsum(self.curvature_per_m * step)])
        heading = (self.yaw_rad[:-1] + self.yaw_rad[1:]) / 2
        self.xy_m = np.array([road.x_m, road.y_m]) + np.concatenate(
            [np.zeros((1, 2)), np.cumsum(step * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)]
        )

    def at(
        self, station_m: float | Float64[np.ndarray, "*n"], offset_m: float | Float64[np.ndarray, "*n"] = 0.0
    ) -> tuple[Float64[np.ndarray, "*n 2"], Float64[np.ndarray, "*n"]]:
        """Position and heading of places on the road; stations before the start or past the end are held there."""
        yaw = np.asarray(np.interp(station_m, self.station_m, self.yaw_rad))
        x = np.interp(station_m, self.station_m, self.xy_m[:, 0])
        y = np.interp(station_m, self.station_m, self.xy_m[:, 1])
        return np.stack([x - offset_m * np.sin(yaw), y + offset_m * np.cos(yaw)], axis=-1), yaw

    def curvature_at(self, station_m: float) -> float:
        """Curvature of the centre line, left positive."""
        middle = (self.station_m[:-1] + self.station_m[1:]) / 2
        return float(np.interp(station_m, middle, self.curvature_per_m))

    def stations(self, start_m: float = 0.0, end_m: float | None = None) -> Float64[np.ndarray, " k"]:
        """The stations at which meshes and polygons have vertices, at most 1 m apart."""
        end_m = self.length_m if end_m is None else end_m
        return np.linspace(start_m, end_m, max(2, int(np.ceil((end_m - start_m) / MESH_STEP_M)) + 1))

    def line(self, offset_m: float) -> Float64[np.ndarray, "k 2"]:
        """A line parallel to the centre line."""
        return self.at(self.stations(), offset_m)[0]

    def ring(self, right_m: float, left_m: float) -> Float64[np.ndarray, "k 2"]:
        """The closed counter-clockwise outline of everything between two offsets (last point = first)."""
        outline = np.concatenate([self.line(right_m), self.line(left_m)[::-1]])
        return np.concatenate([outline, outline[:1]])

    def road_map(self) -> RoadMap:
        """The exact drivable polygon and both lane centre lines in driving direction."""
        half, lane = self.road.half_width_m, self.road.lane_width_m / 2
        lanes = (self.line(-lane), self.line(lane)[::-1])
        return RoadMap(
            drivable=((self.ring(-half, half),),),
            lanes=tuple(np.concatenate([line, np.zeros((len(line), 1))], axis=1) for line in lanes),
        )
