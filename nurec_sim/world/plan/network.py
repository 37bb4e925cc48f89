"""The road network of a plan: exact areas, markings and lanes, all derived from the plan."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Float64

from nurec_sim.types import RoadMap
from nurec_sim.world.plan.junctions import Mouth
from nurec_sim.world.plan.markings import Marking, town_markings
from nurec_sim.world.plan.pavement import GRID_M, QUARTER_SEGMENTS, SMOOTH_M, drivable_area, mouths
from nurec_sim.world.plan.road import RoadLanes, RoadLine
from nurec_sim.world.plan.town import TownPlan


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane of a road (``<road>:<number>``) or a path through a junction (``<junction>:<k>``), in driving direction.

    ``polyline`` lies on the ground, with points at most 1 m apart; it ends exactly where its successors start.
    ``width_m`` is the minimum width. ``road`` is the lane's road or the path's junction, ``turn`` is ``straight``,
    ``left`` or ``right`` on paths, and ``ends_at`` is the junction that a lane of a road leads to.
    """

    id: str
    road: str
    polyline: Float64[np.ndarray, "k 3"]
    width_m: float
    speed_limit_mps: float
    successors: tuple[str, ...]
    in_junction: bool
    turn: str = ""
    ends_at: str = ""

    @property
    def length_m(self) -> float:
        """Horizontal length."""
        return float(np.linalg.norm(np.diff(self.polyline[:, :2], axis=0), axis=1).sum())


class TownNetwork:
    """Areas are shapely geometry in metres, seen from above; ``ground.ground_triangles`` cuts them to fit the terrain.

    Attributes:
        roads: by id, the centre line and cross-section of every road.
        junction_mouths: by id, the arms of every junction.
        surface: between the kerbs; holes are islands.
        lanes: of roads first, then the paths through junctions.
    """

    def __init__(self, plan: TownPlan):
        self.plan = plan
        self.roads = {road.id: RoadLanes(road) for road in plan.roads}
        self.junction_mouths: dict[str, list[Mouth]] = {j.id: mouths(j, self.roads) for j in plan.junctions}
        self.surface: shapely.MultiPolygon = drivable_area(self.roads, plan.junctions)
        self.lanes: tuple[Lane, ...] = tuple(self._lanes())

    def height_m(self, xy: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n"]:
        """Height of the road surface; sidewalks and grass lie ``plan.kerb.height_m`` higher."""
        return self.plan.terrain.height_m(xy)

    def road_map(self) -> RoadMap:
        """The surface polygons, with islands as holes, and the centre lines of all lanes and junction paths."""
        rings = tuple(
            tuple(np.array(ring.coords)[:, :2] for ring in (polygon.exterior, *polygon.interiors))
            for polygon in self.surface.geoms
        )
        return RoadMap(drivable=rings, lanes=tuple(lane.polyline for lane in self.lanes))

    # -------------------------------------------------------------------------------------------------------- areas

    @cached_property
    def kerb(self) -> shapely.Geometry:
        """The top of the kerb stones around ``surface``."""
        return self._grown(self.plan.kerb.width_m).difference(self.surface)

    @cached_property
    def sidewalk(self) -> shapely.Geometry:
        """Paving behind the kerbs, on islands too."""
        kerb = self.plan.kerb
        return self._grown(kerb.width_m + kerb.sidewalk_width_m).difference(self._grown(kerb.width_m))

    @cached_property
    def paved(self) -> shapely.Geometry:
        """Road, kerb and sidewalk; grass and lots lie beyond."""
        kerb = self.plan.kerb
        return self._grown(kerb.width_m + kerb.sidewalk_width_m)

    @cached_property
    def markings(self) -> tuple[Marking, ...]:
        """All paint, in pieces no longer than about 20 m."""
        return town_markings(self.plan, self.roads, self.junction_mouths, self.surface)

    def _grown(self, by_m: float) -> shapely.Geometry:
        # The same rounding and grid as the surface, so that neighbouring areas share vertices.
        grown = shapely.buffer(self.surface, by_m, quad_segs=QUARTER_SEGMENTS)
        return shapely.set_precision(grown.simplify(SMOOTH_M), GRID_M)

    # --------------------------------------------------------------------------------------------------------- lanes

    def _lanes(self) -> Iterator[Lane]:
        paths = [(junction, path) for junction in self.plan.junctions for path in junction.connections]
        after: dict[str, list[str]] = {}
        for _, path in paths:
            after.setdefault(path.from_lane, []).append(path.id)
        # Lanes into a junction, by their id.
        ends_at = {
            f"{mouth.arm.road}:{number}": junction
            for junction, arms in self.junction_mouths.items()
            for mouth in arms
            for number in mouth.lanes(inbound=True)
        }
        for name, line in self.roads.items():
            stations = line.stations()
            for number in line.numbers:
                xy, _ = line.at(stations, line.lane_offset_m(number, stations))
                key = f"{name}:{number}"
                yield Lane(
                    id=key,
                    road=name,
                    # Positive lanes drive against the stations.
                    polyline=self._on_ground(xy if number < 0 else xy[::-1]),
                    width_m=float(line.lane_width_m(stations).min()),
                    speed_limit_mps=line.plan.speed_limit_mps,
                    successors=tuple(after.get(key, ())),
                    in_junction=False,
                    ends_at=ends_at.get(key, ""),
                )
        for junction, path in paths:
            curve = RoadLine(path)
            road = self.roads[path.from_lane.rpartition(":")[0]].plan
            yield Lane(
                id=path.id,
                road=junction.id,
                polyline=self._on_ground(curve.at(curve.stations())[0]),
                width_m=road.lane_width_m,
                speed_limit_mps=road.speed_limit_mps,
                successors=(path.to_lane,),
                in_junction=True,
                turn=path.turn,
            )

    def _on_ground(self, xy: Float64[np.ndarray, "k 2"]) -> Float64[np.ndarray, "k 3"]:
        return np.concatenate([xy, self.height_m(xy)[:, None]], axis=1)
