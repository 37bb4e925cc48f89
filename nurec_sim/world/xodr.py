"""The town's roads as OpenDRIVE 1.6 (``map.xodr``), exactly: with the lines, arcs and spirals of the plan.

Map coordinates are the world's. Heights and cross slopes follow the terrain by cubic pieces of about ``PIECE_M``. Every
junction path is a connecting road whose one lane lies in the middle of its reference line.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from nurec_sim.scene.opendrive.writer import GEO_REFERENCE
from nurec_sim.world.plan.network import TownNetwork
from nurec_sim.world.plan.road import RoadLanes, RoadLine
from nurec_sim.world.plan.terrain import Terrain
from nurec_sim.world.plan.town import Arm, Connection, Crossing, Junction, TownPlan

PIECE_M = 8.0
_MARK_OF_LINE = {"none": "none", "dashed": "broken", "solid": "solid", "double": "solid solid"}
Cubic = tuple[float, float, float, float, float]
"""Start along the road and the coefficients a, b, c, d of a cubic from there on."""


def opendrive_town(plan: TownPlan) -> bytes:
    """``map.xodr`` of a town, in UTF-8; the same plan gives the same bytes."""
    return _Writer(plan).write()


class _Writer:
    def __init__(self, plan: TownPlan):
        self.plan, self.network = plan, TownNetwork(plan)
        # OpenDRIVE ids are numbers as text; junction paths are roads too and are numbered after the real ones.
        self.road_number = {road.id: str(k) for k, road in enumerate(plan.roads)}
        self.junction_number = {junction.id: str(1000 + k) for k, junction in enumerate(plan.junctions)}
        paths = [path.id for junction in plan.junctions for path in junction.connections]
        self.path_number = {name: str(len(self.road_number) + k) for k, name in enumerate(paths)}
        self.arm_at: dict[tuple[str, str], str] = {(arm.road, arm.end): j.id for j in plan.junctions for arm in j.arms}

    def write(self) -> bytes:
        root = Element("OpenDRIVE")
        west, south, east, north = (_text(value) for value in self.network.surface.bounds)
        title = {"revMajor": "1", "revMinor": "6", "name": f"town {self.plan.split} {self.plan.seed}",
                 "vendor": "nurec_sim", "north": north, "south": south, "east": east, "west": west}  # fmt: skip
        SubElement(SubElement(root, "header", title), "geoReference").text = GEO_REFERENCE
        for name, line in self.network.roads.items():
            self._road(root, name, line)
        for junction in self.plan.junctions:
            for path in junction.connections:
                self._path(root, junction, path)
        for junction in self.plan.junctions:
            self._junction(root, junction)
        ElementTree.indent(root)
        xml = ElementTree.tostring(root, encoding="unicode")
        # ElementTree cannot write CDATA, which the standard requires around the projection string.
        xml = xml.replace(GEO_REFERENCE, f"<![CDATA[{GEO_REFERENCE}]]>")
        return f'<?xml version="1.0" encoding="UTF-8"?>\n{xml}\n'.encode()

    # --------------------------------------------------------------------------------------------------------- roads

    def _road(self, root: Element, name: str, line: RoadLanes) -> None:
        # Junction -1: a road outside of junctions.
        number = {"name": name, "length": _text(line.length_m), "id": self.road_number[name], "junction": "-1"}
        road = SubElement(root, "road", number)
        link = SubElement(road, "link")
        for end, tag in (("start", "predecessor"), ("end", "successor")):
            junction = self.arm_at.get((name, end))
            if junction is not None:
                SubElement(link, tag, elementType="junction", elementId=self.junction_number[junction])
        self._shape(road, line, line.plan.speed_limit_mps)
        lanes = SubElement(road, "lanes")
        section = SubElement(lanes, "laneSection", s="0")
        if line.plan.lanes_backward or line.plan.left_strip_m:
            self._side(SubElement(section, "left"), line, 1)
        centre = SubElement(SubElement(section, "center"), "lane", id="0", type="none", level="false")
        both = line.plan.lanes_forward and line.plan.lanes_backward
        colour = "yellow" if self.plan.style.yellow_lines else "white"
        # The line between driving directions; on one-way roads the reference line is an edge.
        _mark(centre, _MARK_OF_LINE[line.plan.centre_line] if both else "solid", colour)
        self._side(SubElement(section, "right"), line, -1)
        crossings = [crossing for crossing in self.plan.crossings if crossing.road == name]
        if crossings:
            objects = SubElement(road, "objects")
            for index, crossing in enumerate(crossings):
                _crosswalk(objects, f"{self.road_number[name]}{index:02d}", line, crossing)

    def _side(self, parent: Element, line: RoadLanes, side: int) -> None:
        """Driving lanes, parking strip, kerb and sidewalk of a side, from left to right as OpenDRIVE requires."""
        kerb, count = self.plan.kerb, line.count(side)
        narrow = line.plan.narrowing
        lane_width = (line.plan.lane_width_m, narrow.lane_width_m if narrow else None)
        strip = line.plan.right_strip_m if side < 0 else line.plan.left_strip_m
        narrow_strip = None if narrow is None else narrow.right_strip_m if side < 0 else narrow.left_strip_m
        kinds: list[tuple[str, float, float | None]] = [("driving", *lane_width)] * count
        if strip or narrow_strip:
            kinds.append(("parking", strip, narrow_strip))
        kinds += [("curb", kerb.width_m, None), ("sidewalk", kerb.sidewalk_width_m, None)]
        # Lanes count outwards from the reference line, and the file lists them by descending id.
        numbered = [(side * (k + 1), *kind) for k, kind in enumerate(kinds)]
        for number, kind, usual, narrowed in sorted(numbered, reverse=True):
            lane = SubElement(parent, "lane", id=str(number), type=kind, level="false")
            for cubic in _widths(line, usual, narrowed):
                _cubic(lane, "width", "sOffset", cubic)
            inner = abs(number) < count
            edge = abs(number) == count and (strip or line.plan.edge_lines)
            _mark(lane, "broken" if inner else "solid" if edge else "none", "white")
            if kind in ("curb", "sidewalk"):
                # Relative to the road surface, at both edges.
                SubElement(lane, "height", sOffset="0", inner=_text(kerb.height_m), outer=_text(kerb.height_m))

    # ----------------------------------------------------------------------------------------------------- junctions

    def _path(self, root: Element, junction: Junction, path: Connection) -> None:
        line, source = RoadLine(path), path.from_lane.rpartition(":")[0]
        number = {"name": path.id, "length": _text(line.length_m), "id": self.path_number[path.id],
                  "junction": self.junction_number[junction.id]}  # fmt: skip
        road = SubElement(root, "road", number)
        link, lane_ends = SubElement(road, "link"), dict[str, str]()
        for tag, lane in (("predecessor", path.from_lane), ("successor", path.to_lane)):
            name, _, lane_ends[tag] = lane.rpartition(":")
            SubElement(link, tag, elementType="road", elementId=self.road_number[name],
                       contactPoint=_arm(junction, name).end)  # fmt: skip
        plan = self.network.roads[source].plan
        self._shape(road, line, plan.speed_limit_mps)
        lanes = SubElement(road, "lanes")
        # Lanes lie beside the reference line; half a width of offset centres the only one on it.
        SubElement(lanes, "laneOffset", s="0", a=_text(plan.lane_width_m / 2), b="0", c="0", d="0")
        section = SubElement(lanes, "laneSection", s="0")
        _mark(SubElement(SubElement(section, "center"), "lane", id="0", type="none", level="false"), "none", "white")
        only = SubElement(SubElement(section, "right"), "lane", id="-1", type="driving", level="false")
        lane_link = SubElement(only, "link")
        for tag, end in lane_ends.items():
            SubElement(lane_link, tag, id=end)
        _cubic(only, "width", "sOffset", (0.0, plan.lane_width_m, 0.0, 0.0, 0.0))
        _mark(only, "none", "white")

    def _junction(self, root: Element, junction: Junction) -> None:
        element = SubElement(root, "junction", name=junction.id, id=self.junction_number[junction.id])
        for k, path in enumerate(junction.connections):
            source, _, lane = path.from_lane.rpartition(":")
            connection = SubElement(element, "connection", id=str(k), incomingRoad=self.road_number[source],
                                    connectingRoad=self.path_number[path.id], contactPoint="start")  # fmt: skip
            SubElement(connection, "laneLink", {"from": lane, "to": "-1"})

    # --------------------------------------------------------------------------------------------------------- shape

    def _shape(self, road: Element, line: RoadLine, limit_mps: float) -> None:
        """Type, reference line, elevation and cross slope."""
        kind = SubElement(road, "type", s="0", type="town")
        SubElement(kind, "speed", max=_text(limit_mps), unit="m/s")
        view = SubElement(road, "planView")
        for k, piece in enumerate(line.curve.pieces):
            (x, y), yaw = line.start_of(k)
            geometry = SubElement(view, "geometry", s=_text(line.piece_station_m[k]), x=_text(x), y=_text(y),
                                  hdg=_text(yaw), length=_text(piece.length_m))  # fmt: skip
            first, last = piece.start_curvature_per_m, piece.end_curvature_per_m
            if first == last == 0.0:
                SubElement(geometry, "line")
            elif first == last:
                SubElement(geometry, "arc", curvature=_text(first))
            else:
                SubElement(geometry, "spiral", curvStart=_text(first), curvEnd=_text(last))
        heights, tilts = _ground_profile(line, self.plan.terrain)
        elevation, lateral = SubElement(road, "elevationProfile"), SubElement(road, "lateralProfile")
        for cubic in heights:
            _cubic(elevation, "elevation", "s", cubic)
        for cubic in tilts:
            _cubic(lateral, "superelevation", "s", cubic)


def _ground_profile(line: RoadLine, terrain: Terrain) -> tuple[list[Cubic], list[Cubic]]:
    """Height (cubic pieces with the terrain's own slopes) and cross slope (rad, linear pieces) along a line."""
    knots = np.linspace(0.0, line.length_m, max(2, int(np.ceil(line.length_m / PIECE_M)) + 1))
    xy, yaw = line.at(knots)
    height, gradient = terrain.height_m(xy), terrain.gradient(xy)
    ahead = gradient[:, 0] * np.cos(yaw) + gradient[:, 1] * np.sin(yaw)
    # Superelevation is positive where the right side is lower.
    tilt = np.arctan(gradient[:, 1] * np.cos(yaw) - gradient[:, 0] * np.sin(yaw))
    length, rise = np.diff(knots), np.diff(height)
    # Cubic Hermite: meets heights and slopes of the terrain at both knots.
    c = (3 * rise / length - 2 * ahead[:-1] - ahead[1:]) / length
    d = (ahead[:-1] + ahead[1:] - 2 * rise / length) / length**2
    zero = np.zeros_like(c)
    heights = np.stack([knots[:-1], height[:-1], ahead[:-1], c, d], axis=1)
    tilts = np.stack([knots[:-1], tilt[:-1], np.diff(tilt) / length, zero, zero], axis=1)
    return _rows(heights), _rows(tilts)


def _rows(table: np.ndarray) -> list[Cubic]:
    return [(float(s), float(a), float(b), float(c), float(d)) for s, a, b, c, d in table]


def _widths(line: RoadLanes, usual: float, narrowed: float | None) -> Iterator[Cubic]:
    """A lane's width along the road: constant, or eased to another one by two cubics."""
    yield (0.0, usual, 0.0, 0.0, 0.0)
    narrow = line.plan.narrowing
    if narrow is None or narrowed is None or narrowed == usual:
        return
    change, taper = narrowed - usual, narrow.taper_m
    # The smoothstep of RoadLanes as a polynomial in metres: w + 3 (dw / t^2) s^2 - 2 (dw / t^3) s^3.
    ease = (3 * change / taper**2, -2 * change / taper**3)
    yield (narrow.start_m - taper, usual, 0.0, *ease)
    yield (narrow.start_m, narrowed, 0.0, 0.0, 0.0)
    yield (narrow.end_m, narrowed, 0.0, -ease[0], -ease[1])
    yield (narrow.end_m + taper, usual, 0.0, 0.0, 0.0)


def _arm(junction: Junction, road: str) -> Arm:
    return next(arm for arm in junction.arms if arm.road == road)


def _crosswalk(parent: Element, number: str, line: RoadLanes, crossing: Crossing) -> None:
    """A crosswalk from kerb to kerb."""
    start, end = crossing.station_m, crossing.station_m + crossing.depth_m
    middle = (start + end) / 2
    right, left = (float(line.edge_m(side, middle)) for side in (-1, 1))
    walk = SubElement(parent, "object", type="crosswalk", id=number, name="zebra" if crossing.zebra else "crossing",
                      s=_text(middle), t=_text((left + right) / 2), zOffset="0", orientation="none",
                      length=_text(crossing.depth_m), width=_text(left - right), hdg="0")  # fmt: skip
    outline = SubElement(walk, "outline")
    for s, t in ((start, right), (end, right), (end, left), (start, left)):
        SubElement(outline, "cornerRoad", s=_text(s), t=_text(t), dz="0", height="0")


def _cubic(parent: Element, tag: str, start: str, cubic: Cubic) -> None:
    SubElement(parent, tag, dict(zip((start, "a", "b", "c", "d"), (_text(value) for value in cubic), strict=True)))


def _mark(lane: Element, kind: str, colour: str) -> None:
    SubElement(lane, "roadMark", sOffset="0", type=kind, material="standard", color=colour, width="0.12")


def _text(value: float) -> str:
    """A number with twelve digits after the point: curvatures need them."""
    return f"{float(value):.12f}"
