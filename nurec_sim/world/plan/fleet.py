"""Vehicle kinds, sizes and colours, and parked cars."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely

from nurec_sim.world.plan.density import Density
from nurec_sim.world.plan.network import TownNetwork
from nurec_sim.world.plan.splits import VEHICLES, Split
from nurec_sim.world.plan.town import Actor, ActorKind

SIZE_OF_KIND_M: dict[str, tuple[float, float, float]] = {
    "hatch": (4.05, 1.76, 1.48),
    "sedan": (4.70, 1.83, 1.44),
    "wagon": (4.75, 1.84, 1.49),
    "suv": (4.65, 1.90, 1.70),
    "van": (5.20, 2.00, 2.15),
    "pickup": (5.30, 1.92, 1.82),
    "sports": (4.40, 1.86, 1.26),
    "minivan": (4.85, 1.93, 1.78),
    "truck": (8.20, 2.40, 3.30),
    "bus": (11.40, 2.50, 3.10),
    "cyclist": (1.80, 0.62, 1.76),
}
SHARE_OF_KIND = {"truck": 0.4, "bus": 0.25, "sports": 0.4}
"""Relative frequency of a kind; default 1."""
LONG_KINDS = ("truck", "bus")
HELD_OUT_SHARE = 0.5
COLOURS = (
    (0.86, 0.86, 0.87), (0.10, 0.10, 0.11), (0.55, 0.56, 0.58), (0.62, 0.07, 0.07), (0.09, 0.20, 0.48),
    (0.20, 0.34, 0.24), (0.76, 0.70, 0.58), (0.85, 0.55, 0.10), (0.14, 0.45, 0.60), (0.30, 0.31, 0.34),
    (0.93, 0.93, 0.92), (0.70, 0.71, 0.73), (0.05, 0.08, 0.16), (0.44, 0.12, 0.16), (0.36, 0.30, 0.24),
)  # fmt: skip
PARKED_NEAR_M, MOST_PARKED = 60.0, 26
CLEAR_M = 5.0


def pick_kind(rng: np.random.Generator, split: Split, parked: bool = False) -> ActorKind:
    """A random vehicle kind; half of those in test towns are held out from training."""
    kinds = VEHICLES.held_out if split == "test" and rng.random() < HELD_OUT_SHARE else VEHICLES.shared
    usual = [kind for kind in kinds if not (parked and kind in LONG_KINDS)]
    share = np.array([SHARE_OF_KIND.get(kind, 1.0) for kind in usual])
    return str(usual[int(rng.choice(len(usual), p=share / share.sum()))])  # type: ignore[return-value]


def pick_size(rng: np.random.Generator, kind: str) -> tuple[float, float, float]:
    """A random size of that kind, rounded to millimetres."""
    # 2.5 % of variation, at most 5 %; widths stay within the legal 2.55 m.
    length, width, height = np.array(SIZE_OF_KIND_M[kind]) * (1 + np.clip(rng.normal(0, 0.025, 3), -0.05, 0.05))
    return round(float(length), 3), round(float(min(width, 2.55)), 3), round(float(height), 3)


def pick_colour(rng: np.random.Generator) -> tuple[float, float, float]:
    """A random colour of cars and clothes."""
    return COLOURS[int(rng.integers(len(COLOURS)))]


def parked_cars(
    rng: np.random.Generator, network: TownNetwork, split: Split, span_us: tuple[int, int], way: shapely.LineString,
    density: Density,
) -> list[Actor]:  # fmt: skip
    """Cars in the parking strips around the ego's route, nearest first, with small pose noise.

    Args:
        rng: random generator.
        network: roads with their parking strips.
        split: ``train`` or ``test``: selects the vehicle families.
        span_us: first and last time of their (constant) poses.
        way: the ego's route ahead (m); cars are kept within ``PARKED_NEAR_M`` of it.
        density: how many.
    """
    found: list[tuple[float, Actor]] = []
    for name, road in network.roads.items():
        kept_free = _kept_free(network, name)
        for side in (-1, 1):
            full, station = float(rng.uniform(*density.parked)), float(rng.uniform(2.0, 8.0))
            while station < road.length_m - 7.0:
                kind = pick_kind(rng, split, parked=True)
                size = pick_size(rng, kind)
                room = float(rng.uniform(0.9, 2.6))
                # On the inside of a bend a metre of the strip spans more than a metre of stations.
                strip = road.at(np.array([station, station + 1.0]), road.edge_m(side, station))[0]
                per_m = max(1.0, 1.0 / float(np.linalg.norm(strip[1] - strip[0])))
                ends, station = (station, station + size[0] * per_m), station + (size[0] + room) * per_m
                out, turn, taken = abs(float(rng.normal(0, 0.04))), float(rng.normal(0, 0.012)), rng.random() < full
                narrow = float(road.strip_width_m(side, np.array(ends)).min()) < size[1] + 0.1
                if not taken or narrow or any(ends[0] < high and low < ends[1] for low, high in kept_free):
                    continue
                middle = (ends[0] + ends[1]) / 2
                # The narrowest point along the car counts, in road coordinates signed by side.
                edge = side * float((side * road.edge_m(side, np.array([*ends, middle]))).min())
                # Wheels are about 10 cm from the kerb.
                xy, yaw = road.at(middle, edge - side * (size[1] / 2 + 0.1 + out))
                away = float(shapely.distance(way, shapely.Point(xy)))
                against = road.count(-1) == 0 or (side > 0 and road.count(1) > 0)
                heading = float(yaw) + (np.pi if against else 0.0) + turn
                place = (round(float(xy[0]), 4), round(float(xy[1]), 4), size[2] / 2, round(heading, 5))
                if away < PARKED_NEAR_M:
                    path = ((span_us[0], *place), (span_us[1], *place))
                    found.append((away, Actor("", kind, size, pick_colour(rng), False, path)))
    found.sort(key=lambda pair: pair[0])
    return [replace(actor, id=f"parked_{index}") for index, (_, actor) in enumerate(found[:MOST_PARKED])]


def _kept_free(network: TownNetwork, road: str) -> list[tuple[float, float]]:
    """No-parking sections of a road: before junctions, at crossings and at stop lines."""
    length = network.roads[road].length_m
    spans = [
        (-CLEAR_M, CLEAR_M) if mouth.outward else (length - CLEAR_M, length + CLEAR_M)
        for mouths in network.junction_mouths.values()
        for mouth in mouths
        if mouth.arm.road == road
    ]
    plan = network.plan
    spans += [(c.station_m - CLEAR_M, c.station_m + c.depth_m + CLEAR_M) for c in plan.crossings if c.road == road]
    return spans + [(s.station_m - 1.0, s.station_m + 1.0) for s in plan.stop_lines if s.road == road]
