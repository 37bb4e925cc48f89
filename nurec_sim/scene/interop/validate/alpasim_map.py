"""AlpaSim's road map loader and off-road rule, reimplemented from its observed behaviour.

The rules, in the order in which they are applied (docs/scene_format.md has them as a table):

1. Reference lines are ``<line>`` and ``<arc>``; anything else raises, and no lane is left.
2. A geometry gives ``max(2, ceil(length / 0.5))`` points from its start to its end.
3. The ``s`` of a point is its number on the road times 0.5 m. Widths, the lane offset and heights are taken there, so
   they drift unless the pieces are multiples of 0.5 m long.
4. Lanes of every type but ``sidewalk`` are lanes.
5. Edges: right, the outer border of the outermost right lane. Left, the *inner* border of the outermost left lane;
   without one, a line 1 cm left of the reference line, but not on the roads of a junction.
6. Edges that come within 0.2 m of a lane's centre line go, and of two nearly parallel ones whose centroids lie within
   2 m the shorter one.
7. A car is on the road if one lane, or the union of all lanes with a centre point (every 2 m) within 6 m of it in
   space, contains its outline. Otherwise it is off the road if its outline comes within 1 mm of the edge that is
   nearest to its middle.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim.errors import ArchiveError

SAMPLE_M = 0.5
STRAIGHT_PER_M = 1e-6
ARTIFICIAL_M = 0.01
CENTRE_GAP_M = 0.20
TWIN_EDGES_M = 2.0
TWIN_EDGES_RAD = math.radians(15.0)  # our value for "nearly parallel"
NEAR_M = 6.0
CENTRE_STEP_M = 2.0
TOUCH_M = 1e-3
CLIP_M = 1.0
"""Lanes farther from the outline than this cannot contain it and are skipped."""
MAX_POINTS = 1_000_000
MAX_PLACE_M = 1e7
GEOMETRIES = ("line", "arc")


@dataclass(frozen=True)
class MapLane:
    """A lane: its centre line and its outline."""

    road: str
    number: int
    kind: str
    centre: Float64[np.ndarray, "k 3"]
    outline: Float64[np.ndarray, "2k 2"]


class AlpasimMap:
    """Lanes and road edges of an OpenDRIVE file.

    Attributes:
        lanes: of all types but sidewalks.
        edges: [k,2] each, those that remain after rule 6.
        edges_made: how many edges there were before.
    """

    def __init__(self, root: ElementTree.Element):
        """Reads the roads.

        Raises:
            ArchiveError: a geometry that the loader does not know, a number that is none, or no lane at all.
        """
        lanes: list[MapLane] = []
        edges: list[np.ndarray] = []
        try:
            for road in root.iter("road"):
                found, borders = _read_road(road)
                lanes += found
                edges += borders
                if sum(len(lane.centre) for lane in lanes) > MAX_POINTS:
                    raise ArchiveError(f"the lanes have more than {MAX_POINTS:,} points")
        except (ValueError, OverflowError) as error:
            raise ArchiveError(str(error)) from error
        if not lanes:
            raise ArchiveError("no road has a lane")
        everything = np.concatenate(
            [lane.centre for lane in lanes] + [np.pad(edge, ((0, 0), (0, 1))) for edge in edges]
        )
        if not (np.abs(everything) < MAX_PLACE_M).all():
            raise ArchiveError(f"a lane reaches beyond {MAX_PLACE_M:,.0f} m")
        self.lanes, self.edges_made = tuple(lanes), len(edges)
        self.edges = tuple(_edges_kept(edges, [lane.centre[:, :2] for lane in lanes]))

    @cached_property
    def polygons(self) -> np.ndarray:
        """Outlines of the lanes as shapely polygons; self-intersections are repaired."""
        import shapely

        polygons = np.array([shapely.Polygon(lane.outline) for lane in self.lanes], dtype=object)
        crossed = ~shapely.is_valid(polygons)
        polygons[crossed] = shapely.make_valid(polygons[crossed])
        shapely.prepare(polygons)
        return polygons

    @cached_property
    def _centres(self) -> tuple[Any, np.ndarray]:
        from scipy.spatial import cKDTree

        points = [_every(lane.centre, CENTRE_STEP_M) for lane in self.lanes]
        owner = np.repeat(np.arange(len(points)), [len(each) for each in points])
        return cKDTree(np.concatenate(points)), owner

    @cached_property
    def _edge_tree(self) -> Any:
        import shapely

        return shapely.STRtree(shapely.linestrings(np.concatenate(self.edges), indices=self._edge_rows))

    @property
    def _edge_rows(self) -> np.ndarray:
        return np.repeat(np.arange(len(self.edges)), [len(edge) for edge in self.edges])

    def on_lane(self, xyz: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether a lane is under each point."""
        import shapely

        found = shapely.STRtree(self.polygons).query(shapely.points(xyz[:, :2]), predicate="intersects")[0]
        return np.isin(np.arange(len(xyz)), found)

    def offroad(self, middle: Float64[np.ndarray, "n 3"], outlines: np.ndarray) -> Bool[np.ndarray, " n"]:
        """Rule 7 for cars with the given middles and outlines (shapely polygons)."""
        tree, owner = self._centres
        off = np.zeros(len(middle), bool)
        for row, (place, outline) in enumerate(zip(middle, outlines, strict=True)):
            near = np.unique(owner[tree.query_ball_point(place, NEAR_M)])
            off[row] = not self._contains(near, outline) and self._touches_edge(place[:2], outline)
        return off

    def _contains(self, near: np.ndarray, outline: Any) -> bool:
        import shapely

        if shapely.contains(self.polygons[near], outline).any():
            return True
        if len(near) < 2:
            return False
        # Clipped first: the union of whole lanes would be slow.
        west, south, east, north = shapely.bounds(outline) + CLIP_M * np.array([-1, -1, 1, 1])
        around = shapely.clip_by_rect(self.polygons[near], west, south, east, north)
        return bool(shapely.contains(shapely.union_all(around), outline))

    def _touches_edge(self, place: Float64[np.ndarray, " 2"], outline: Any) -> bool:
        import shapely

        if not self.edges:
            return False
        nearest = self._edge_tree.geometries[self._edge_tree.nearest(shapely.Point(place))]
        return bool(shapely.distance(nearest, outline) < TOUCH_M)


def _read_road(road: ElementTree.Element) -> tuple[list[MapLane], list[Float64[np.ndarray, "k 2"]]]:
    """Lanes and edges of one road, by rules 1 to 5."""
    name = road.get("id") or "?"
    xy, heading = _reference_line(road, name)
    if len(xy) < 2:
        return [], []
    s = SAMPLE_M * np.arange(len(xy))
    normal = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    z = _cubics([(_value(each, "s"), each) for each in road.iterfind("elevationProfile/elevation")], s)
    offset = _cubics([(_value(each, "s"), each) for each in road.iterfind("lanes/laneOffset")], s)
    lanes, edges = [], []
    for side, sign in (("left", 1), ("right", -1)):
        rows: dict[int, tuple[str, list[tuple[float, ElementTree.Element]]]] = {}
        for section in road.iterfind("lanes/laneSection"):
            for lane in section.iterfind(f"{side}/lane"):
                number = int(_value(lane, "id"))
                widths = rows.setdefault(number, (lane.get("type", ""), []))[1]
                widths += [(_value(section, "s") + _value(w, "sOffset"), w) for w in lane.iterfind("width")]
        inner = outer = xy + offset[:, None] * normal
        distance = offset
        for number in sorted(rows, key=abs):
            kind, widths = rows[number]
            distance = distance + sign * _cubics(widths, s)
            inner, outer = outer, xy + distance[:, None] * normal
            if kind != "sidewalk":
                centre = np.column_stack([(inner + outer) / 2, z])[::-sign]
                lanes.append(MapLane(name, number, kind, centre, np.concatenate([inner, outer[::-1]])))
        if rows:
            edges.append(outer if side == "right" else inner)
        elif side == "left" and road.get("junction", "-1") == "-1":
            edges.append(xy + ARTIFICIAL_M * normal)
    return lanes, edges


def _reference_line(road: ElementTree.Element, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Points and headings, by rules 1 and 2."""
    places, headings, count = [np.zeros((0, 2))], [np.zeros(0)], 0
    for piece in road.iterfind("planView/geometry"):
        shape = next(iter(piece), None)
        if shape is None or shape.tag not in GEOMETRIES:
            kind = "none" if shape is None else f"<{shape.tag:.40}>"
            raise ArchiveError(f"road {name:.40} has the geometry {kind}, only {' and '.join(GEOMETRIES)} are read")
        length, yaw = _value(piece, "length"), _value(piece, "hdg")
        if not 0 <= length <= SAMPLE_M * MAX_POINTS or count > MAX_POINTS:
            raise ArchiveError(f"road {name:.40} has a geometry of {length:g} m, or more than {MAX_POINTS:,} points")
        t = np.linspace(0.0, length, max(2, math.ceil(length / SAMPLE_M)))
        count += len(t)
        curvature = _value(shape, "curvature") if shape.tag == "arc" else 0.0
        curvature = curvature if abs(curvature) >= STRAIGHT_PER_M else 0.0
        # The chord to a point of an arc has the mean of both headings.
        half = curvature * t / 2
        chord = t * np.sinc(half / np.pi)
        start = np.array([_value(piece, "x"), _value(piece, "y")])
        places.append(start + np.stack([chord * np.cos(yaw + half), chord * np.sin(yaw + half)], axis=1))
        headings.append(yaw + 2 * half)
    return np.concatenate(places), np.concatenate(headings)


def _cubics(pieces: list[tuple[float, ElementTree.Element]], s: Float64[np.ndarray, " n"]) -> np.ndarray:
    """Piecewise cubics in s; 0 without any."""
    if not pieces:
        return np.zeros_like(s)
    pieces = sorted(pieces, key=lambda piece: piece[0])
    starts = np.array([start for start, _ in pieces])
    table = np.array([[_value(piece, name) for name in "abcd"] for _, piece in pieces])
    index = np.clip(np.searchsorted(starts, s + 1e-9, side="right") - 1, 0, len(pieces) - 1)
    a, b, c, d = table[index].T
    ds = s - starts[index]
    return a + ds * (b + ds * (c + ds * d))


def _edges_kept(edges: list[np.ndarray], centres: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Rule 6."""
    import shapely

    if not edges:
        return
    lines = np.array([shapely.LineString(edge) for edge in edges], dtype=object)
    lanes = np.array([shapely.LineString(centre) for centre in centres], dtype=object)
    near = shapely.STRtree(lanes).query(lines, predicate="dwithin", distance=CENTRE_GAP_M)[0]
    left = np.setdiff1d(np.arange(len(lines)), near)
    lines = lines[left]
    middle, length = shapely.centroid(lines), shapely.length(lines)
    way = np.array([edges[index][-1] - edges[index][0] for index in left]).reshape(-1, 2)
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
    gone = set()
    for one, other in shapely.STRtree(middle).query(middle, predicate="dwithin", distance=TWIN_EDGES_M).T:
        if one < other and abs(way[one] @ way[other]) >= math.cos(TWIN_EDGES_RAD):
            gone.add(int(one if length[one] < length[other] else other))
    yield from (edges[index] for row, index in enumerate(left) if row not in gone)


def _every(line: Float64[np.ndarray, "k 3"], step_m: float) -> Float64[np.ndarray, "n 3"]:
    """Points of a line at most ``step_m`` apart."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0.0, along[-1], max(2, math.ceil(along[-1] / step_m) + 1))
    return np.stack([np.interp(at, along, line[:, axis]) for axis in range(3)], axis=1)


def _value(element: ElementTree.Element, name: str) -> float:
    text = element.get(name)
    if text is None or not math.isfinite(float(text)):
        raise ValueError(f"<{element.tag:.40}> needs a finite number as {name!r}, got {text!r:.40}")
    return float(text)
