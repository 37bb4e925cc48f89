"""Pedestrians: walking along sidewalks, using crossings, or standing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float64
from scipy.spatial.distance import cdist

from nurec_sim import geometry
from nurec_sim.world.plan.density import Density
from nurec_sim.world.plan.fleet import pick_colour
from nurec_sim.world.plan.network import TownNetwork
from nurec_sim.world.plan.swept_boxes import Boxes, standing
from nurec_sim.world.plan.town import Crossing, Kerb

SIZE_M = (0.9, 0.62, 1.74)
PACE_MPS = (0.9, 1.7)
NEAR_M = 45.0
"""Pedestrians are placed within this distance of the ego's path."""
BEHIND_TREES_M, BEFORE_BENCHES_M = 1.3, 1.1
"""Lamps and trees are within this distance of the kerb, benches and bus stops within this one of the far edge."""
ROOM_M = {"bus_stop": 1.3, "bench": 0.9, "billboard": 1.5}
USUAL_ROOM_M = 0.45
"""Clearance of pedestrians from the centre of props, by kind."""


@dataclass(frozen=True, eq=False)
class Walker:
    """A pedestrian's path: positions, headings and heights of the feet above the road.

    ``on_road_s``: time intervals in which the right and the left side of the road at ``crossing`` are occupied.
    """

    xy_m: Float64[np.ndarray, "t 2"]
    yaw_rad: Float64[np.ndarray, " t"]
    foot_m: Float64[np.ndarray, " t"]
    size_m: tuple[float, float, float]
    colour: tuple[float, float, float]
    crossing: Crossing | None = None
    on_road_s: tuple[tuple[float, float], ...] = ()


def people(
    rng: np.random.Generator, network: TownNetwork, ego_xy: Float64[np.ndarray, "k 2"], t_s: Float64[np.ndarray, " t"],
    density: Density,
) -> list[Walker]:  # fmt: skip
    """Pedestrians around the ego's path.

    Args:
        rng: random generator.
        network: sidewalks, roads and crossings.
        ego_xy: the ego's path.
        t_s: sample times of the paths.
        density: how many.
    """
    way = shapely.LineString(ego_xy)
    found = _on_crossings(rng, network, way, t_s, density.crossers)
    count = int(rng.integers(density.walkers[0], density.walkers[1] + 1))
    return found + _on_sidewalks(rng, network, way, t_s, count)


def boxes_of(walkers: Sequence[Walker], t_s: Float64[np.ndarray, " t"]) -> Boxes:
    """Boxes of pedestrians at their sample times."""
    if not walkers:
        return standing([], np.zeros((0, 2)), len(t_s))
    half = np.array([[walker.size_m[0] / 2, walker.size_m[1] / 2] for walker in walkers])
    xy, yaw = np.stack([w.xy_m for w in walkers], axis=1), np.stack([w.yaw_rad for w in walkers], axis=1)
    return Boxes(xy, yaw, half)


def _size(rng: np.random.Generator) -> tuple[float, float, float]:
    scale = float(np.clip(rng.normal(1.0, 0.06), 0.75, 1.12))
    return (round(SIZE_M[0] * scale, 3), SIZE_M[1], round(SIZE_M[2] * scale, 3))


# ------------------------------------------------------------------------------------------------ along the sidewalk


def _on_sidewalks(
    rng: np.random.Generator, network: TownNetwork, way: shapely.LineString, t_s: np.ndarray, count: int
) -> list[Walker]:
    kerb = network.plan.kerb
    near, far = _walking_m(kerb)
    # Walking directions keep different distances from the kerb, so that people do not meet head-on.
    rings = {direction: _rings(network.surface.buffer(kerb.width_m + m)) for direction, m in ((1, near), (-1, far))}
    walkable = network.sidewalk.buffer(0.05)
    shapely.prepare(walkable)
    found: list[Walker] = []
    # Some places are unsuitable; a few tries each are enough.
    for _ in range(4 * count):
        if len(found) == count:
            break
        direction = int(rng.choice([-1, 1]))
        ring = rings[direction][int(rng.integers(len(rings[direction])))]
        length = geometry.arc_length(ring)
        start = float(rng.uniform(0, length[-1]))
        pace = 0.0 if rng.random() < 0.15 else float(rng.uniform(*PACE_MPS))
        station = start + direction * pace * t_s
        at = _lookup(length, ring)
        xy = at(station % length[-1])
        if shapely.distance(way, shapely.Point(xy[0])) > NEAR_M or _runs_into_something(xy, network):
            continue
        if not shapely.contains_xy(walkable, *xy[:: max(1, len(xy) // 12)].T).all():
            continue
        # Headings from a secant of 1.2 m turn smoothly at the corners of the ring.
        step = at((station + 0.6) % length[-1]) - at((station - 0.6) % length[-1])
        yaw = np.unwrap(np.arctan2(step[:, 1], step[:, 0])) + (np.pi if direction < 0 else 0.0)
        # Standing people face in any direction.
        if pace == 0.0:
            yaw = yaw + float(rng.uniform(-np.pi, np.pi))
        found.append(Walker(xy, yaw, np.full(len(t_s), kerb.height_m), _size(rng), pick_colour(rng)))
    return found


def _walking_m(kerb: Kerb) -> tuple[float, float]:
    """Distances from the kerb for walking in each direction; equal on narrow sidewalks."""
    near = min(BEHIND_TREES_M, kerb.sidewalk_width_m - 0.45)
    return near, max(near, kerb.sidewalk_width_m - BEFORE_BENCHES_M)


def _rings(area: shapely.Geometry) -> list[Float64[np.ndarray, "k 2"]]:
    """Outer outlines of an area, closed and counter-clockwise, without islands."""
    return [np.array(shapely.orient_polygons(polygon).exterior.coords) for polygon in shapely.get_parts(area)]


def _runs_into_something(xy: Float64[np.ndarray, "t 2"], network: TownNetwork) -> bool:
    """Whether a path collides with a prop."""
    props = network.plan.props
    places = np.array([(prop.x_m, prop.y_m) for prop in props]).reshape(-1, 2)
    room = np.array([ROOM_M.get(prop.kind, USUAL_ROOM_M) for prop in props])
    return bool((cdist(places, xy[::4]).min(axis=1) < room).any())


# ----------------------------------------------------------------------------------------------------- over the road


def _on_crossings(
    rng: np.random.Generator, network: TownNetwork, way: shapely.LineString, t_s: np.ndarray,
    chances: tuple[float, float, float],
) -> list[Walker]:  # fmt: skip
    found = []
    for crossing in network.plan.crossings:
        road = network.roads[crossing.road]
        middle, _ = road.at(crossing.station_m + crossing.depth_m / 2)
        if shapely.distance(way, shapely.Point(middle)) > NEAR_M:
            continue
        # Two people cross side by side, not through each other.
        for share in (0.3, 0.7)[: int(rng.choice(3, p=chances))]:
            station = crossing.station_m + share * crossing.depth_m
            walker = _crosser(rng, network, crossing, station, t_s)
            if not _runs_into_something(walker.xy_m, network):
                found.append(walker)
    return found


def _crosser(
    rng: np.random.Generator, network: TownNetwork, crossing: Crossing, station_m: float, t_s: np.ndarray
) -> Walker:
    """Along the sidewalk to the crossing, across it, and along the other sidewalk."""
    road, kerb = network.roads[crossing.road], network.plan.kerb
    side = int(rng.choice([-1, 1]))
    beyond = kerb.width_m + _walking_m(kerb)[0]
    near, far = (float(road.edge_m(s, station_m)) + s * beyond for s in (side, -side))
    inward = 1.0 if station_m < road.length_m / 2 else -1.0  # away from the junction that the crossing belongs to
    before, after = (station_m + inward * float(rng.uniform(2.0, 12.0)) for _ in range(2))
    # In road coordinates (station, offset), so that the path follows bends.
    corners = np.array([(before, near), (station_m, near), (station_m, far), (after, far)])
    places = _rounded(corners)
    xy = road.at(places[:, 0], places[:, 1])[0]
    length = geometry.arc_length(xy)
    pace, start_s = float(rng.uniform(1.0, 1.6)), float(rng.uniform(-8.0, 0.6 * t_s[-1]))
    walked = np.clip(pace * (t_s - start_s), 0.0, length[-1] - 0.01)
    at = _lookup(length, xy)
    ahead, behind = at(np.minimum(walked + 0.4, length[-1])), at(np.maximum(walked - 0.4, 0.0))
    offset = _lookup(length, places[:, 1:])(walked)[:, 0]
    edges = sorted(float(road.edge_m(s, station_m)) for s in (-1, 1))
    outside = np.maximum(offset - edges[1], edges[0] - offset)
    both_ways = road.count(-1) > 0 and road.count(1) > 0
    # On a one-way road its traffic waits for the whole width.
    sides = ((edges[0], 0.0), (0.0, edges[1])) if both_ways else ((edges[0], edges[1]),) * 2
    busy = []
    for low, high in sides:  # a side is occupied from one step before entering until one step after leaving
        inside = length[(places[:, 1] > low - 0.7) & (places[:, 1] < high + 0.7)]
        busy.append((start_s + float(inside[0]) / pace, start_s + float(inside[-1]) / pace))
    yaw = np.unwrap(np.arctan2(*(ahead - behind).T[::-1]))
    # Feet step up the kerb over 25 cm.
    foot = kerb.height_m * np.clip(outside / 0.25 + 0.5, 0.0, 1.0)
    return Walker(at(walked), yaw, foot, _size(rng), pick_colour(rng), crossing, tuple(busy))


def _rounded(corners: np.ndarray) -> np.ndarray:
    """The path with corners smoothed (Chaikin), finely sampled."""
    points = corners
    for _ in range(3):
        low, high = 0.8 * points[:-1] + 0.2 * points[1:], 0.2 * points[:-1] + 0.8 * points[1:]
        points = np.concatenate([points[:1], np.stack([low, high], axis=1).reshape(-1, 2), points[-1:]])
    length = geometry.arc_length(points)
    return _lookup(length, points)(np.arange(0.0, length[-1], 0.2))


def _lookup(station_m: np.ndarray, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    return lambda s: np.stack([np.interp(s, station_m, column) for column in values.T], axis=-1)
