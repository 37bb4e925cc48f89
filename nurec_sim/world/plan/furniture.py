"""Street furniture and plants beside the road, and cones on it."""

from __future__ import annotations

import numpy as np
import shapely

from nurec_sim.geometry import box_corners_xy, pose_from_xyyaw
from nurec_sim.world.plan.junctions import Mouth
from nurec_sim.world.plan.network import TownNetwork
from nurec_sim.world.plan.road import RoadLanes
from nurec_sim.world.plan.town import SIGNS, Building, Prop, PropKind, Style

VARIANTS = 4
"""Number of variants of a prop kind."""
ROOM_M = {"tree": 1.0, "bus_stop": 2.2, "billboard": 3.0, "hedge": 0.5, "fence": 0.2}
"""Clearance around a prop's centre; 0.35 m for other kinds."""


def town_props(
    rng: np.random.Generator, network: TownNetwork, houses: tuple[Building, ...], style: Style
) -> tuple[Prop, ...]:
    """All props; only cones are on the road, and none intersects a house.

    Args:
        rng: random generator.
        network: roads, areas and the plan with crossings and stop lines.
        houses: of the town, which props keep clear of.
        style: district (urban or suburban density).
    """
    return _Furniture(rng, network, houses, style).build()


class _Furniture:
    def __init__(
        self, rng: np.random.Generator, network: TownNetwork, houses: tuple[Building, ...], style: Style
    ) -> None:
        self.rng, self.network, self.style = rng, network, style
        footprints = [
            shapely.Polygon(box_corners_xy(pose_from_xyyaw(h.x_m, h.y_m, h.yaw_rad), h.width_m, h.depth_m))
            for h in houses
        ]
        self.houses = shapely.union_all(footprints)
        self.road = network.surface.union(network.kerb)
        self.paved = network.paved
        crossings = []
        for crossing in network.plan.crossings:
            line, end = network.roads[crossing.road], crossing.station_m + crossing.depth_m
            # Kept free up to 3 m behind both kerbs, so that people can reach the crossing.
            edges = [float(line.edge_m(side, end)) + side * 3.0 for side in (-1, 1)]
            crossings.append(line.band(crossing.station_m - 0.3, end + 0.3, *edges))
        self.crossings = shapely.union_all(crossings)
        for area in (self.houses, self.road, self.paved, self.crossings):
            shapely.prepare(area)
        self.props: list[Prop] = []
        self.taken: list[np.ndarray] = []

    def build(self) -> tuple[Prop, ...]:
        for arms in self.network.junction_mouths.values():
            for mouth in arms:
                self._at_mouth(mouth)
        for line in self.network.roads.values():
            self._signs(line)
            self._along(line)
        self._islands()
        self._green()
        return tuple(self.props)

    # ----------------------------------------------------------------------------------------------------- placing

    def _stand(self, kind: PropKind, xy: np.ndarray, yaw: float, *, variant: int | None = None, scale: float = 1.0,
               length: float = 0.0, off_paving: bool = False) -> bool:  # fmt: skip
        """Adds a prop if there is space; returns whether it was added."""
        point = shapely.Point(xy)
        room = ROOM_M.get(kind, 0.35)
        # Trees stand in narrow strips: their trunk must clear the road, their crown only the houses.
        reach = point.buffer(0.25 if kind == "tree" else min(room, 0.35), quad_segs=2)
        if self.road.intersects(reach) or self.houses.intersects(point.buffer(room, quad_segs=2)):
            return False
        if self.crossings.intersects(reach) or (off_paving and self.paved.intersects(point.buffer(room))):
            return False
        if self.taken and np.min(np.linalg.norm(np.array(self.taken)[:, :2] - xy, axis=1)) < room + 0.6:
            return False
        self.taken.append(np.asarray(xy))
        chosen = int(self.rng.integers(VARIANTS)) if variant is None else variant
        self.props.append(Prop(kind, round(float(xy[0]), 3), round(float(xy[1]), 3), round(float(yaw), 4), chosen,
                               round(scale, 3), round(length, 3)))  # fmt: skip
        return True

    def _beside(self, line: RoadLanes, station: float, side: int, beyond: float) -> tuple[np.ndarray, float]:
        """A position ``beyond`` the kerb of a side, and the heading of the traffic there."""
        offset = float(line.edge_m(side, station)) + side * (self.network.plan.kerb.width_m + beyond)
        xy, yaw = line.at(station, offset)
        with_stations = side < 0 or line.plan.lanes_backward == 0
        return xy, float(yaw) + (0.0 if with_stations and line.plan.lanes_forward else np.pi)

    # --------------------------------------------------------------------------------------------------- junctions

    def _at_mouth(self, mouth: Mouth) -> None:
        """Lights or a sign at the right side of incoming traffic."""
        rule, side = mouth.arm.rule, 1 if mouth.outward else -1
        if not mouth.lanes(inbound=True):
            return
        stops = [s.station_m for s in self.network.plan.stop_lines if s.road == mouth.arm.road
                 and s.forward != mouth.outward]  # fmt: skip
        station = stops[0] if stops else mouth.station_m
        # Signs are needed: if something is in the way, they move away from the kerb.
        for beyond in (0.45, 0.8, 1.2):
            xy, heading = self._beside(mouth.line, station, side, beyond)
            if rule in ("red", "green"):
                done = self._stand("traffic_light", xy, heading, variant=("red", "green").index(rule))
            else:
                done = self._stand("sign", xy, heading, variant=SIGNS.index(rule))
            if done:
                break

    def _signs(self, line: RoadLanes) -> None:
        """Speed limits, and warnings before crossings and narrow parts."""
        narrow = line.plan.narrowing
        for side in (-1, 1):
            if not line.count(side):
                continue
            ahead = 1.0 if side < 0 else -1.0
            places = [(float(self.rng.uniform(20, line.length_m - 10)), "speed")] if line.length_m > 40 else []
            if narrow is not None:
                entry = narrow.start_m - narrow.taper_m if side < 0 else narrow.end_m + narrow.taper_m
                places.append((entry - ahead * 6.0, "narrow"))
            for crossing in self.network.plan.crossings:
                if crossing.road == line.plan.id and crossing.zebra:
                    near = crossing.station_m if side < 0 else crossing.station_m + crossing.depth_m
                    places.append((near - ahead * 1.0, "crossing"))
            if line.plan.lanes_forward and self.rng.random() < 0.4:
                places.append((float(self.rng.uniform(10, max(line.length_m - 10, 11))), "no_parking"))
            for station, picture in places:
                if 0 < station < line.length_m:
                    xy, heading = self._beside(line, station, side, 0.5)
                    self._stand("sign", xy, heading, variant=SIGNS.index(picture))
        if narrow is not None:
            self._cones(line)

    def _cones(self, line: RoadLanes) -> None:
        """Cones along the tapers, on the road beside the lanes."""
        narrow = line.plan.narrowing
        assert narrow is not None
        for side in (-1, 1):
            for start in (narrow.start_m - narrow.taper_m, narrow.end_m):
                for station in np.linspace(start, start + narrow.taper_m, 5):
                    offset = float(line.edge_m(side, station)) - side * 0.3
                    # Cones stand on parking strips only, never in a lane.
                    if abs(offset) < abs(float(line.lane_edge_m(side, station))) + 0.1:
                        continue  # no strip beside the lane here
                    xy, yaw = line.at(station, offset)
                    # Directly, without the test for free ground, since cones are on the road.
                    self.props.append(Prop("cone", round(float(xy[0]), 3), round(float(xy[1]), 3),
                                           round(float(yaw), 4), on_road=True))  # fmt: skip

    # ------------------------------------------------------------------------------------------------ along the road

    def _along(self, line: RoadLanes) -> None:
        urban = self.style.district != "suburb"
        walk = self.network.plan.kerb.sidewalk_width_m
        tree_step = float(self.rng.choice([9.0, 13.0, 20.0]))
        self._row(line, "lamp", 27.0, 0.5)
        if self.rng.random() < 0.8:
            self._row(line, "tree", tree_step, 0.75, (0.75, 1.15))
        self._row(line, "bus_stop", 130.0, walk - 0.9)
        self._row(line, "bin", 38.0 if urban else 70.0, 0.5)
        self._row(line, "bench", 60.0, walk - 0.5)
        self._row(line, "hydrant", 85.0, 0.45)
        self._row(line, "billboard", 110.0, walk + 1.8)
        if urban and self.rng.random() < 0.3:
            self._row(line, "bollard", 3.0, 0.35, limit=24)
        for side in (-1, 1):
            self._boundary(line, side)
        self._row(line, "bush", 9.0, walk + 1.2, (0.7, 1.2))

    def _row(self, line: RoadLanes, kind: PropKind, step: float, beyond: float, scale: tuple[float, float] = (1.0, 1.0),
             limit: int = 1000) -> None:  # fmt: skip
        for side in (-1, 1):
            station, count = float(self.rng.uniform(0.1, 1.0)) * step, 0
            while station < line.length_m - 1.0 and count < limit:
                xy, heading = self._beside(line, station, side, beyond)
                self._stand(kind, xy, heading, scale=float(self.rng.uniform(*scale)))
                station += step * float(self.rng.uniform(0.8, 1.25))
                count += 1

    def _boundary(self, line: RoadLanes, side: int) -> None:
        """Hedges and fences behind the sidewalk, with gaps for doors."""
        kind: PropKind = "hedge" if self.rng.random() < 0.6 else "fence"
        share = 0.75 if self.style.district == "suburb" else 0.25
        beyond = self.network.plan.kerb.sidewalk_width_m + 0.55
        for station in np.arange(6.0, line.length_m - 6.0, 6.0):
            if self.rng.random() > share:
                continue
            ends = [self._beside(line, s, side, beyond)[0] for s in (station - 2.6, station + 2.6)]
            strip = shapely.LineString(ends).buffer(0.4, cap_style="flat")
            if self.houses.intersects(strip) or self.paved.intersects(strip):
                continue
            across = ends[1] - ends[0]
            yaw = float(np.arctan2(across[1], across[0])) - np.pi / 2
            self._stand(kind, (ends[0] + ends[1]) / 2, yaw, length=float(np.hypot(*across)))

    # ----------------------------------------------------------------------------------------------------- elsewhere

    def _islands(self) -> None:
        """Bushes and a tree or two on the islands of roundabouts."""
        for junction in self.network.plan.junctions:
            if junction.kind != "roundabout":
                continue
            centre = np.array([junction.x_m, junction.y_m])
            room = junction.ring_radius_m - junction.ring_width_m / 2 - self.network.plan.kerb.sidewalk_width_m - 1.5
            for k in range(7):
                angle = 2 * np.pi * k / 7 + float(self.rng.uniform(-0.2, 0.2))
                xy = centre + max(room, 0.5) * float(self.rng.uniform(0.3, 1.0)) * np.array(
                    [np.cos(angle), np.sin(angle)]
                )
                self._stand("tree" if k == 0 else "bush", xy, angle, scale=float(self.rng.uniform(0.7, 1.1)))

    def _green(self) -> None:
        """Trees and bushes on the open ground around."""
        low_x, low_y, high_x, high_y = self.network.surface.bounds
        for xy in self.rng.uniform([low_x - 50, low_y - 50], [high_x + 50, high_y + 50], (110, 2)):
            kind: PropKind = "tree" if self.rng.random() < 0.75 else "bush"
            if shapely.distance(self.paved, shapely.Point(xy)) > 3.0:
                self._stand(kind, xy, float(self.rng.uniform(-np.pi, np.pi)), scale=float(self.rng.uniform(0.9, 1.5)))
