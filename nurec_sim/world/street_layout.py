"""From a seed to a street: road shape, houses, trees, and the traffic of a 12 second drive."""

from __future__ import annotations

import numpy as np
import shapely

from nurec_sim.geometry import box_corners_xy, pose_from_xyyaw
from nurec_sim.world import traffic
from nurec_sim.world.plan import Actor, Building, Prop, RoadPiece, StreetPlan, StreetRoad
from nurec_sim.world.road import RoadLine

START_US = 1_000_000
BEHIND_M = 45.0
"""Road behind the ego's first pose."""
FACADES, TREES = 8, 4


def street_plan(seed: int, seconds: float = 12.0) -> StreetPlan:
    """The street of ``seed``: a straight entry, a clear curve, a straight exit, and ``seconds`` of traffic on it.

    The recorded ego keeps its lane and its distance to a slower lead car. Who drives straight on leaves the road in
    the curve; who follows the route without slowing down runs into the lead car.

    Raises:
        ValueError: seed is negative, or seconds is not within 1..20.
    """
    if seed < 0 or not 1.0 <= seconds <= 20.0:
        raise ValueError(f"a street needs a seed >= 0 and 1..20 seconds, got seed {seed} and {seconds} seconds")
    rng = np.random.default_rng([seed, 0x52])
    road = _road(rng)
    line = RoadLine(road)
    span_us = (START_US, START_US + round(seconds * 1e6 / traffic.STEP_US) * traffic.STEP_US)
    ego, actors = _traffic(np.random.default_rng([seed, 0x7A]), line, span_us)
    buildings, props = _surroundings(np.random.default_rng([seed, 0xB1]), line)
    sun = float(line.yaw_rad[0] + rng.choice([-1, 1]) * rng.uniform(0.6, 2.2))
    return StreetPlan(
        seed=seed, span_us=span_us, road=road, buildings=buildings, props=props, actors=actors, ego=ego,
        sun_azimuth_rad=sun, sun_elevation_rad=float(rng.uniform(0.7, 0.95)), cloud_cover=float(rng.uniform(0.3, 0.5)),
    )  # fmt: skip


def _road(rng: np.random.Generator) -> StreetRoad:
    bend = float(rng.choice([-1, 1]) / rng.uniform(31.0, 36.0))
    pieces = (
        RoadPiece(BEHIND_M + float(rng.uniform(30.0, 36.0))),
        RoadPiece(10.0, 0.0, bend),
        RoadPiece(float(rng.uniform(28.0, 34.0)), bend, bend),
        RoadPiece(10.0, bend, 0.0),
        RoadPiece(130.0),
    )
    yaw = float(rng.uniform(-np.pi, np.pi))
    x, y = (float(v) for v in rng.uniform(-20, 20, 2))
    return StreetRoad(x, y, yaw, pieces, zebra_station_m=BEHIND_M + float(rng.uniform(14.0, 18.0)))


def _traffic(
    rng: np.random.Generator, line: RoadLine, span_us: tuple[int, int]
) -> tuple[tuple[tuple[int, float, float, float], ...], tuple[Actor, ...]]:
    t_us = np.arange(span_us[0], span_us[1] + 1, traffic.STEP_US)
    seconds = (t_us - t_us[0]) * 1e-6
    kinds = list(traffic.CAR_SIZES_M)
    lead_kind = str(rng.choice(["sedan", "wagon", "suv"]))
    speed = float(rng.uniform(9.2, 9.8))
    first_gap = float(rng.uniform(17.0, 20.0))
    ego_m, lead_m = traffic.drive_ego_and_lead(
        line, len(t_us) - 1, BEHIND_M, BEHIND_M + traffic.EGO_FRONT_M + first_gap, speed,
        traffic.CAR_SIZES_M[lead_kind][0],
    )  # fmt: skip
    colour = int(rng.integers(len(traffic.STREET_COLOURS)))
    actors = [traffic.car("lead", lead_kind, 3, line, t_us, lead_m, backwards=False)]
    for i, start in enumerate((62.0, 104.0, 165.0)):
        stations = BEHIND_M + start + rng.uniform(-4, 4) - rng.uniform(7.4, 8.4) * seconds
        kind = ["hatch", "van", "sedan"][i]
        actors.append(traffic.car(f"oncoming_{i}", kind, colour + 1 + i, line, t_us, stations, backwards=True))
    curve_start = line.road.pieces[0].length_m
    curve_end = curve_start + sum(piece.length_m for piece in line.road.pieces[1:4])
    spots = [*np.arange(14.0, curve_start - 8, 7.0), *np.arange(curve_end + 8, curve_end + 70, 7.0)]
    count = 0
    for side in (-1, 1):
        for station in spots:
            near_zebra = abs(station - (line.road.zebra_station_m or -100.0)) < 6.5
            if rng.random() < 0.58 and not near_zebra:
                slack = (float(rng.uniform(0.0, 0.1)), float(rng.normal(0, 0.012)))
                kind = kinds[int(rng.integers(len(kinds)))]
                where = float(station + rng.uniform(-0.5, 0.5))
                actors.append(traffic.parked_car(
                    f"parked_{count}", kind, int(rng.integers(100)), line, span_us, where, side, slack))  # fmt: skip
                count += 1
    walk = line.road.half_width_m + line.road.sidewalk_width_m * 0.62
    for i, (start, side, pace) in enumerate([(24.0, -1, 1.3), (58.0, 1, -1.2), (78.0, -1, -1.4), (100.0, 1, 1.1)]):
        stations = BEHIND_M + start + rng.uniform(-4, 4) + pace * rng.uniform(0.9, 1.1) * seconds
        actors.append(traffic.pedestrian(f"pedestrian_{i}", colour + 4 + i, line, t_us, stations, side * walk))
    xy, yaw = line.at(ego_m, -line.road.lane_width_m / 2)
    ego = tuple((int(t), float(x), float(y), float(a)) for t, (x, y), a in zip(t_us, xy, yaw, strict=True))
    return ego, tuple(actors)


def _surroundings(rng: np.random.Generator, line: RoadLine) -> tuple[tuple[Building, ...], tuple[Prop, ...]]:
    road = line.road
    edge = road.half_width_m + road.kerb_width_m + road.sidewalk_width_m
    kept = shapely.Polygon(line.ring(-edge - 0.8, edge + 0.8)).buffer(0)
    taken = [kept]
    buildings: list[Building] = []

    def place(xy: np.ndarray, yaw: float, width: float, depth: float, floors: int) -> bool:
        footprint = shapely.Polygon(box_corners_xy(pose_from_xyyaw(xy[0], xy[1], yaw), width, depth))
        if any(footprint.intersects(other) for other in taken):
            return False
        taken.append(footprint.buffer(0.4))
        red, green, blue = (float(v) for v in rng.uniform(0.85, 1.0, 3))
        buildings.append(Building(
            float(xy[0]), float(xy[1]), float(yaw), width, depth, floors, float(rng.uniform(2.9, 3.4)),
            int(rng.integers(FACADES)), bool(floors > 2 and rng.random() < 0.45),
            bool(floors <= 3 and rng.random() < 0.65), (red, green, blue)))  # fmt: skip
        return True

    for side in (-1, 1):
        station = float(rng.uniform(-10, 0))
        while station < line.length_m + 5:
            width, depth = float(rng.uniform(10, 20)), float(rng.uniform(9, 13))
            setback = float(rng.uniform(1.2, 5.0))
            xy, yaw = line.at(min(max(station + width / 2, 0.0), line.length_m), side * (edge + setback + depth / 2))
            facing = float(yaw) + (np.pi if side > 0 else 0.0)
            built = rng.random() < 0.88 and place(xy, facing, width, depth, int(rng.integers(2, 6)))
            station += width + float(rng.uniform(1.0, 7.0)) if built else 3.0
    for end, away in ((0.0, -16.0), (line.length_m, 16.0)):  # close the view at both ends of the street
        xy, yaw = line.at(end)
        place(xy + away * np.array([np.cos(yaw), np.sin(yaw)]), float(yaw + np.pi / 2), 26.0, 12.0, 5)
    centre = line.xy_m.mean(axis=0)
    for angle in rng.uniform(0, 2 * np.pi, 26):
        xy = centre + rng.uniform(110, 240) * np.array([np.cos(angle), np.sin(angle)])
        place(xy, float(rng.uniform(0, np.pi)), float(rng.uniform(14, 30)), float(rng.uniform(14, 24)),
              int(rng.integers(4, 15)))  # fmt: skip
    return tuple(buildings), _props(rng, line, taken[1:])


def _props(rng: np.random.Generator, line: RoadLine, houses: list[shapely.Polygon]) -> tuple[Prop, ...]:
    road = line.road
    kerb = road.half_width_m + road.kerb_width_m
    keep_off = shapely.Polygon(line.ring(-kerb - 0.3, kerb + 0.3)).buffer(0)
    solid = shapely.union_all([*houses, keep_off])
    props: list[Prop] = []

    def along(kind: str, first: float, step: float, beyond: float, scale: tuple[float, float], clear: float) -> None:
        for side in (-1, 1):
            station = first + float(rng.uniform(0, step))
            while station < line.length_m:
                xy, yaw = line.at(station, side * (kerb + beyond))
                facing = float(yaw) + (np.pi if side > 0 else 0.0)
                if solid.distance(shapely.Point(xy)) > clear:
                    props.append(Prop(kind, float(xy[0]), float(xy[1]), facing, int(rng.integers(TREES)),
                                      float(rng.uniform(*scale))))  # fmt: skip
                station += step * float(rng.uniform(0.75, 1.25))

    along("tree", 2.0, 13.0, 0.75, (0.75, 1.15), 0.0)
    along("lamp", 9.0, 27.0, 0.55, (1.0, 1.0), 0.0)
    along("sign", 16.0, 55.0, 0.5, (1.0, 1.0), 0.0)
    along("bush", 4.0, 6.0, road.sidewalk_width_m + 1.1, (0.7, 1.2), 0.8)
    grass = shapely.union_all([solid, shapely.Polygon(line.ring(-kerb - 4, kerb + 4)).buffer(0)])
    low, high = line.xy_m.min(axis=0) - 60, line.xy_m.max(axis=0) + 60
    for xy in rng.uniform(low, high, (90, 2)):
        if grass.distance(shapely.Point(xy)) > 3.0:
            props.append(Prop("tree", float(xy[0]), float(xy[1]), float(rng.uniform(0, 6.28)),
                              int(rng.integers(TREES)), float(rng.uniform(0.9, 1.5))))  # fmt: skip
    return tuple(props)
