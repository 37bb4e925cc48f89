"""Start states and routes of the ego, its lead car and nearby vehicles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from nurec_sim.world.plan import fleet
from nurec_sim.world.plan.density import Density, Turn
from nurec_sim.world.plan.drivers import Driver
from nurec_sim.world.plan.routes import END_M, SPACING_M, Route, lay_route, random_lanes
from nurec_sim.world.plan.rules import Rules
from nurec_sim.world.plan.splits import Split
from nurec_sim.world.plan.town import EGO_MIDDLE_M, ActorKind

EGO_SIZE_M = (4.9, 1.9, 1.5)
EGO_EAGERNESS = (0.5, 1.3)
"""The ego's desired speed relative to the limit."""
FASTEST_EGO_MPS = 16.0
EGO_TRIES, TURNING_TRIES = 8, 40
"""Random routes that the ego chooses from; more when it has to turn."""
SEEN_M = 90.0
"""Vehicles further from the ego's route are not simulated."""
LEAVING_M = 60.0
"""Nor are vehicles about to leave the town."""
CYCLISTS = 0.13
FREE_M = 2.5
FLOWING_RANK = 3
"""Rank that rarely has to wait at a junction; the ego prefers such routes slightly."""


@dataclass(frozen=True, eq=False)
class Vehicle:
    """A driver with its vehicle's appearance."""

    name: str
    kind: ActorKind
    colour: tuple[float, float, float]
    driver: Driver


def ego_driver(rng: np.random.Generator, rules: Rules, seconds: float, turn: Turn | None = None) -> Driver:
    """The ego: through a junction if there is one, usually not into a red light.

    Args:
        rng: random generator.
        rules: lanes and right of way of the town.
        seconds: length of its drive.
        turn: its way through the first junction, if one of the random routes has it.
    """
    eagerness = float(rng.uniform(*EGO_EAGERNESS))
    firsts = [lane for lane in rules.lanes.values() if not lane.in_junction]
    best: tuple[float, Route, float] | None = None
    for _ in range(EGO_TRIES if turn is None else TURNING_TRIES):
        first = firsts[int(rng.integers(len(firsts)))]
        # Expected distance: the desired speed, less some for bends and waiting.
        distance = 0.85 * min(FASTEST_EGO_MPS, first.speed_limit_mps * eagerness) * seconds
        way = random_lanes(rng, rules.lanes, first.id, 2 * distance)
        route = lay_route(rules.lanes, way, speed_factor=min(eagerness, FASTEST_EGO_MPS / first.speed_limit_mps))
        # Starting at a station of at most `free`, the ego does not reach the end of the town.
        free = route.length_m - END_M - distance
        inside = [leg for leg in route.legs if leg.in_junction]
        # One point for a route that is long enough, one for a route through a junction.
        score = min(free, 10.0) / 10.0 + (1.0 if inside else 0.0)
        first_rank = min((rules.rank[leg.lane] for leg in inside[:1]), default=0)
        # A drive that ends at a red light shows little; only some are kept.
        if first_rank < 0 and rng.random() < 0.8:
            score -= 1.5
        if first_rank >= FLOWING_RANK:
            score += float(rng.uniform(0.0, 1.0))
        if turn is not None and (not inside or rules.lanes[inside[0].lane].turn != turn):
            score -= 10.0
        start = float(rng.uniform(8.0, max(free, 10.0)))
        if inside:
            # Reaches the junction after 10 to 60 % of the expected distance.
            start = max(min(free, inside[0].start_m - float(rng.uniform(0.1, 0.6)) * distance), 10.0)
        if best is None or score > best[0]:
            best = score, route, start
    assert best is not None
    _, route, start = best
    return rules.driver(route, start, _allowed(route, start), EGO_SIZE_M, EGO_MIDDLE_M)


def other_vehicles(
    rng: np.random.Generator, rules: Rules, split: Split, ego: Driver, way: shapely.LineString, density: Density
) -> list[Vehicle]:
    """Usually a lead car, and vehicles on the lanes around ``way``, nearest first.

    Args:
        rng: random generator.
        rules: lanes, right of way and stop positions of the town.
        split: ``train`` or ``test``: selects the vehicle families.
        ego: the ego at its start; nothing is placed on it.
        way: the ego's route ahead (m); vehicles start within ``SEEN_M`` of it.
        density: how many.
    """
    places = _lead(rng, rules, ego, density.lead) + _places(rng, rules, way, density.spacing_m)
    wanted = int(rng.integers(density.vehicles[0], density.vehicles[1] + 1))
    taken = [(ego.route.at(np.array(ego.station_m)), EGO_SIZE_M[0])]
    found: list[Vehicle] = []
    for away, route, station in places:
        if len(found) == wanted:
            break
        # Only the lead car has a negative order.
        leads = away < 0
        kind: ActorKind = "cyclist" if not leads and rng.random() < CYCLISTS else fleet.pick_kind(rng, split)
        if kind in fleet.LONG_KINDS and any(rules.lanes[leg.lane].turn not in ("", "straight") for leg in route.legs):
            kind = "van"  # long vehicles do not turn at junctions, since they would need both lanes
        size, lanes = fleet.pick_size(rng, kind), [leg.lane for leg in route.legs]
        if kind == "cyclist":
            # Routes scale the lane's limit, so the pace of 3 to 6.5 m/s becomes a factor of it.
            pace = float(rng.uniform(3.0, 6.5)) / rules.lanes[lanes[0]].speed_limit_mps
            route = lay_route(rules.lanes, lanes, _cycling_m(rules, lanes), pace)
        place = route.at(np.array(station))
        # Skips vehicles that stick out of the start of their route, or start too close to another one.
        if station < size[0] / 2 + 1.0 or any(
            np.linalg.norm(place - other) < (size[0] + length) / 2 + FREE_M for other, length in taken
        ):
            continue
        taken.append((place, size[0]))
        name = "lead" if leads else f"{'cyclist' if kind == 'cyclist' else 'vehicle'}_{len(found)}"
        driver = rules.driver(route, station, 0.8 * _allowed(route, station), size)
        found.append(Vehicle(name, kind, fleet.pick_colour(rng), driver))
    return found


Place = tuple[float, Route, float]
"""How late it is considered, its route, and its station on it."""


def _lead(rng: np.random.Generator, rules: Rules, ego: Driver, chance: float) -> list[Place]:
    """Start of a slower lead car ahead of the ego, most of the time."""
    # The gap grows with speed by half a second of driving.
    station = ego.station_m + EGO_SIZE_M[0] + float(rng.uniform(7.0, 28.0)) + 0.5 * ego.speed_mps
    slower = float(rng.uniform(0.7, 1.1))
    if rng.random() > chance or station > ego.route.length_m - LEAVING_M:
        return []
    return [(-1.0, lay_route(rules.lanes, [leg.lane for leg in ego.route.legs], speed_factor=slower), station)]


def _places(
    rng: np.random.Generator, rules: Rules, way: shapely.LineString, spacing_m: tuple[float, float]
) -> list[Place]:
    """Start positions on all lanes of roads, roughly nearest first."""
    places: list[Place] = []
    for lane in rules.lanes.values():
        if lane.in_junction:
            continue
        spacing = float(rng.uniform(*spacing_m))
        station = float(rng.uniform(4.0, spacing))
        while station < lane.length_m - 4.0:
            # Vehicles stop at the end of their route, so it reaches 200 m beyond the start.
            lanes = random_lanes(rng, rules.lanes, lane.id, station + 200.0)
            route = lay_route(rules.lanes, lanes, speed_factor=float(rng.uniform(0.6, 1.05)))
            away = float(shapely.distance(way, shapely.Point(route.at(np.array(station)))))
            if away < SEEN_M and station < route.length_m - LEAVING_M:
                # Jitter mixes near and far places, so that not only the nearest ones are taken.
                places.append((away + float(rng.uniform(0, 25.0)), route, station))
            station += 8.0 + float(rng.exponential(spacing))
    return sorted(places, key=lambda place: place[0])


def _allowed(route: Route, station_m: float) -> float:
    return float(route.allowed_mps[round(station_m / SPACING_M)])


def _cycling_m(rules: Rules, lanes: Sequence[str]) -> float:
    """Lateral offset of cyclists from the lane centre: half a metre from its edge at the narrowest point."""
    roads = [rules.network.roads.get(rules.lanes[name].road) for name in lanes]
    narrow = [road.plan.narrowing.lane_width_m for road in roads if road is not None and road.plan.narrowing]
    return 0.5 * min([*narrow, *(rules.lanes[name].width_m for name in lanes)]) - 0.55
