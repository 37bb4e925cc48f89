"""Road layouts by name. Roads end some 100 to 180 m from the origin."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nurec_sim.world.plan.junctions import crossing, reaches, roundabout
from nurec_sim.world.plan.road import RoadLine
from nurec_sim.world.plan.town import Arm, Junction, Narrowing, Road, RoadPiece, Rule

HALF_TOWN_M = 130.0
EASE_M = 12.0
"""Length of the clothoids before and after an arc (shorter before short arcs)."""


@dataclass(frozen=True)
class RoadGraph:
    """Roads and the junctions between them."""

    roads: tuple[Road, ...]
    junctions: tuple[Junction, ...]


Pieces = tuple[RoadPiece, ...]


def road_graph(template: str, rng: np.random.Generator) -> RoadGraph:
    """The roads of a template.

    Raises:
        KeyError: no such template.
    """
    return _TEMPLATES[template](rng)


def bend(turn_rad: float, radius_m: float) -> Pieces:
    """A curve (left positive) of clothoid, arc and clothoid."""
    ease = min(EASE_M, 0.4 * abs(turn_rad) * radius_m)
    curvature = float(np.sign(turn_rad) / radius_m)
    # Each clothoid turns half as much as an arc of its length, so both together replace one length of arc.
    arc = abs(turn_rad) * radius_m - ease
    return (
        RoadPiece(ease, 0.0, curvature),
        RoadPiece(float(arc), curvature, curvature),
        RoadPiece(ease, curvature, 0.0),
    )


# -------------------------------------------------------------------------------------------------------- one road


def _usual(rng: np.random.Generator, lanes: Sequence[int] = (1, 1, 1, 2)) -> dict[str, Any]:
    """A cross-section: lanes, widths, parking, speed limit and lines."""
    count = int(rng.choice(lanes))
    parking = [(0.0, 0.0), (2.2, 2.2), (2.2, 2.2), (2.2, 0.0), (0.0, 2.2)][int(rng.integers(5))]
    limit_kmh = int(rng.choice([30, 50, 50] if count == 1 else [50, 50, 60]))
    return {
        "lanes_forward": count,
        "lanes_backward": count,
        "lane_width_m": round(float(rng.uniform(3.1, 3.7)), 2),
        "left_strip_m": parking[0],
        "right_strip_m": parking[1],
        "speed_limit_mps": round(limit_kmh / 3.6, 3),
        "centre_line": str(rng.choice(["dashed", "dashed", "solid"] if count == 1 else ["double", "solid"])),
        "edge_lines": bool(rng.random() < 0.6),
    }


def _single(rng: np.random.Generator, pieces: Pieces, **changes: Any) -> RoadGraph:
    """One road whose middle lies near the origin, in any direction."""
    road = Road("main", 0.0, 0.0, 0.0, pieces, **{**_usual(rng), **changes})
    # Laid out from the origin first; then turned, and moved so that its middle lies at the origin.
    middle, _ = RoadLine(road).at(road.length_m / 2)
    yaw = float(rng.uniform(-np.pi, np.pi))
    turned = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ -middle
    return RoadGraph((replace(road, x_m=float(turned[0]), y_m=float(turned[1]), yaw_rad=yaw),), ())


def _straight(rng: np.random.Generator) -> RoadGraph:
    return _single(rng, (RoadPiece(2 * HALF_TOWN_M),))


def _curve(rng: np.random.Generator) -> RoadGraph:
    # Log-uniform: tight bends are as likely as wide ones. The bound on the turn limits the length of the arc.
    radius = float(np.exp(rng.uniform(np.log(25.0), np.log(200.0))))
    turn = float(rng.choice([-1, 1]) * min(rng.uniform(0.7, 1.6), 150.0 / radius))
    entry = float(rng.uniform(85.0, 105.0))
    return _single(rng, (RoadPiece(entry), *bend(turn, radius), RoadPiece(120.0)))


def _s_curve(rng: np.random.Generator) -> RoadGraph:
    sign = float(rng.choice([-1, 1]))
    first, second = (float(v) for v in rng.uniform(32.0, 110.0, 2))
    turns = [min(float(rng.uniform(0.6, 1.1)), 85.0 / radius) for radius in (first, second)]
    return _single(
        rng,
        (
            RoadPiece(float(rng.uniform(75.0, 90.0))),
            *bend(sign * turns[0], first),
            RoadPiece(float(rng.uniform(8.0, 30.0))),
            *bend(-sign * turns[1], second),
            RoadPiece(100.0),
        ),
    )


def _narrowing(rng: np.random.Generator) -> RoadGraph:
    lane, narrow = round(float(rng.uniform(3.3, 3.6)), 2), round(float(rng.uniform(2.75, 3.0)), 2)
    start = float(rng.uniform(110.0, 130.0))
    gone = [(0.0, 0.0), (2.2, 0.0), (0.0, 2.2)][int(rng.integers(3))]
    narrowing = Narrowing(start, start + float(rng.uniform(25, 60)), float(rng.uniform(8, 16)), narrow, *gone)
    turn, radius = float(rng.choice([-1, 1]) * rng.uniform(0.15, 0.6)), float(rng.uniform(90, 200))
    pieces = (RoadPiece(60.0), *bend(turn, radius), RoadPiece(230.0 - abs(turn) * radius))
    return _single(rng, pieces, lanes_forward=1, lanes_backward=1, lane_width_m=lane, left_strip_m=2.2,
                   right_strip_m=2.2, speed_limit_mps=8.333, centre_line="dashed", narrowing=narrowing)  # fmt: skip


# ------------------------------------------------------------------------------------------------------- junctions


@dataclass(frozen=True)
class _Spoke:
    """Specification of an arm: direction, cross-section, rule and the pieces beyond its straight mouth."""

    name: str
    angle_rad: float
    section: dict[str, Any]
    rule: Rule
    tail: Pieces

    @property
    def widths_m(self) -> tuple[float, float]:
        """To the left and to the right of the centre line, seen from the junction."""
        section = self.section
        lane = section["lane_width_m"]
        return (section["lanes_backward"] * lane + section["left_strip_m"],
                section["lanes_forward"] * lane + section["right_strip_m"])  # fmt: skip

    def road(self, centre: np.ndarray, reach_m: float) -> Road:
        """The road from its mouth outwards."""
        x, y = centre + reach_m * np.array([np.cos(self.angle_rad), np.sin(self.angle_rad)])
        return Road(self.name, float(x), float(y), self.angle_rad, self.tail, **self.section)


def _tail(rng: np.random.Generator, length_m: float = 112.0) -> Pieces:
    """A straight mouth, then straight on or a gentle curve."""
    if rng.random() < 0.4:
        return (RoadPiece(length_m),)
    turn, radius = float(rng.choice([-1, 1]) * rng.uniform(0.15, 0.5)), float(rng.uniform(90.0, 180.0))
    return (RoadPiece(26.0), *bend(turn, radius), RoadPiece(max(length_m - 26.0 - abs(turn) * radius, 20.0)))


def _rules(rng: np.random.Generator, main: int, side: int) -> list[Rule]:
    """Lights, stop signs or yield signs; the main road comes first."""
    kinds: tuple[tuple[Rule, Rule], ...] = (("green", "red"), ("priority", "stop"), ("priority", "yield"))
    first, second = kinds[int(rng.integers(3))]
    return [first] * main + [second] * side


def _spokes(rng: np.random.Generator, angles: Sequence[float], main: dict[str, Any], side: dict[str, Any],
            names: Sequence[str]) -> list[_Spoke]:  # fmt: skip
    """Arms at the given angles; the first two are the main road."""
    rules = _rules(rng, 2, len(angles) - 2)
    return [
        _Spoke(name, angle, _turned(main) if i == 1 else main if i == 0 else side, rule, _tail(rng))
        for i, (name, angle, rule) in enumerate(zip(names, angles, rules, strict=True))
    ]


def _turned(section: dict[str, Any]) -> dict[str, Any]:
    """The same cross-section seen along the other direction."""
    return {**section, "lanes_forward": section["lanes_backward"], "lanes_backward": section["lanes_forward"],
            "left_strip_m": section["right_strip_m"], "right_strip_m": section["left_strip_m"]}  # fmt: skip


def _reaches(spokes: Sequence[_Spoke], corner_m: float, at_least: Sequence[float] | None = None) -> list[float]:
    # `reaches` expects counter-clockwise order.
    order = np.argsort([spoke.angle_rad % (2 * np.pi) for spoke in spokes])
    sorted_reaches = reaches([(spokes[i].angle_rad, *spokes[i].widths_m) for i in order], corner_m)
    found = [0.0] * len(spokes)
    for place, index in enumerate(order):
        found[index] = max(sorted_reaches[place], at_least[index] if at_least else 0.0)
    return found


def _meet(junction: str, centre: np.ndarray, spokes: Sequence[_Spoke], corner_m: float) -> RoadGraph:
    found = _reaches(spokes, corner_m)
    roads = tuple(spoke.road(centre, reach) for spoke, reach in zip(spokes, found, strict=True))
    arms = [Arm(spoke.name, "start", spoke.rule) for spoke in spokes]
    by_id = {road.id: road for road in roads}
    return RoadGraph(roads, (crossing(junction, "crossing", centre, arms, by_id, corner_m),))


def _main_and_side(rng: np.random.Generator) -> tuple[dict[str, Any], dict[str, Any]]:
    main = _usual(rng)
    side = {**_usual(rng, (1,)), "lane_width_m": main["lane_width_m"]}
    return main, side


def _t_junction(rng: np.random.Generator) -> RoadGraph:
    turn = float(rng.uniform(-np.pi, np.pi))
    stem = turn + float(rng.choice([-1, 1]) * (np.pi / 2 + rng.normal(0, 0.12)))
    main, side = _main_and_side(rng)
    spokes = _spokes(rng, [turn + np.pi, turn, stem], main, side, ["west", "east", "stem"])
    return _meet("junction", np.zeros(2), spokes, float(rng.uniform(5, 9)))


def _x_junction(rng: np.random.Generator) -> RoadGraph:
    turn = float(rng.uniform(-np.pi, np.pi))
    skew = float(rng.normal(0, 0.12))
    main, side = _main_and_side(rng)
    angles = [turn + np.pi, turn, turn + np.pi / 2 + skew, turn - np.pi / 2 + skew + float(rng.normal(0, 0.05))]
    spokes = _spokes(rng, angles, main, side, ["west", "east", "north", "south"])
    return _meet("junction", np.zeros(2), spokes, float(rng.uniform(5, 9)))


def _double_junction(rng: np.random.Generator) -> RoadGraph:
    turn, apart = float(rng.uniform(-np.pi, np.pi)), float(rng.uniform(75.0, 100.0))
    ahead = np.array([np.cos(turn), np.sin(turn)])
    centres = [-ahead * apart / 2, ahead * apart / 2]
    main, side = _main_and_side(rng)
    corner = float(rng.uniform(5, 8))
    first_side = float(rng.choice([-1, 1]))
    roads: list[Road] = []
    spokes_at: list[list[_Spoke]] = []
    for i in (0, 1):
        outer = turn + (np.pi if i == 0 else 0.0)
        sides = [first_side if i == 0 else -first_side] if rng.random() < 0.6 else [-1.0, 1.0]
        angles = [outer, outer + np.pi, *(turn + s * (np.pi / 2 + float(rng.normal(0, 0.06))) for s in sides)]
        names = ["west" if i == 0 else "east", "link", *(f"{'left' if s > 0 else 'right'}_{i}" for s in sides)]
        spokes = _spokes(rng, angles, main if i else _turned(main), side, names)
        # The side roads stay straight or diverge, so that they never intersect.
        spokes_at.append([replace(s, tail=(RoadPiece(100.0),)) if k > 1 else s for k, s in enumerate(spokes)])
    junctions = []
    reach = [_reaches(spokes, corner) for spokes in spokes_at]
    # The road between the two junctions, from mouth to mouth.
    link_m = apart - reach[0][1] - reach[1][1]
    start = centres[0] + ahead * reach[0][1]
    roads.append(Road("link", float(start[0]), float(start[1]), turn, (RoadPiece(link_m),), **spokes_at[0][1].section))
    for i, centre in enumerate(centres):
        spokes = spokes_at[i]
        roads += [spoke.road(centre, reach[i][k]) for k, spoke in enumerate(spokes) if k != 1]
        arms = [Arm(spoke.name, "end" if k == 1 and i == 1 else "start", spoke.rule) for k, spoke in enumerate(spokes)]
        by_id = {road.id: road for road in roads}
        junctions.append(crossing(f"junction_{i}", "crossing", centre, arms, by_id, corner))
    return RoadGraph(tuple(roads), tuple(junctions))


def _slip_road(rng: np.random.Generator) -> RoadGraph:
    """A ramp that leaves the main road to the right, or joins it from the right."""
    turn, joins = float(rng.uniform(-np.pi, np.pi)), bool(rng.random() < 0.4)
    main = {**_usual(rng, (1, 2)), "left_strip_m": 0.0, "right_strip_m": 0.0, "speed_limit_mps": 16.667}
    angle = float(rng.uniform(0.24, 0.36))
    ramp = {**main, "lanes_forward": 0 if joins else 1, "lanes_backward": 1 if joins else 0, "centre_line": "none",
            "edge_lines": True, "speed_limit_mps": 11.111}  # fmt: skip
    radius = float(rng.uniform(60, 120))
    # The main road runs from west to east; a ramp that joins comes from the west.
    away = turn + np.pi + angle if joins else turn - angle
    curl = float(rng.uniform(0.4, 0.9)) * (1 if joins else -1)
    tail = (RoadPiece(8.0), *bend(curl, radius), RoadPiece(45.0))
    spokes = [
        _Spoke("west", turn + np.pi, _turned(main), "priority", (RoadPiece(120.0),)),
        _Spoke("east", turn, main, "priority", (RoadPiece(120.0),)),
        _Spoke("ramp", away, ramp, "yield" if joins else "priority", tail),
    ]
    corner = 1.5
    found = _reaches(spokes, corner)
    centre = -np.array([np.cos(turn), np.sin(turn)]) * 15.0
    roads = tuple(spoke.road(centre, reach) for spoke, reach in zip(spokes, found, strict=True))
    arms = [Arm(spoke.name, "start", spoke.rule) for spoke in spokes]
    fork = crossing("fork", "fork", centre, arms, {road.id: road for road in roads}, corner)
    return RoadGraph(roads, (fork,))


def _roundabout(rng: np.random.Generator) -> RoadGraph:
    turn, count = float(rng.uniform(-np.pi, np.pi)), int(rng.choice([3, 4, 4]))
    section = _usual(rng, (1,))
    ring, width, flare = float(rng.uniform(12.5, 18.0)), float(rng.uniform(5.5, 6.5)), float(rng.uniform(10.0, 14.0))
    spread = [2 * np.pi * k / count + float(rng.normal(0, 0.05)) for k in range(count)]
    spokes = [
        _Spoke(name, turn + angle, section, "yield", _tail(rng, 100.0))
        for name, angle in zip(("east", "north", "west", "south"), spread, strict=False)
    ]
    corner = float(rng.uniform(7.0, 10.0))
    # Room for the flares between mouth and ring.
    reach = ring + flare + 2.0
    centre = np.zeros(2)
    roads = tuple(spoke.road(centre, reach) for spoke in spokes)
    arms = [Arm(spoke.name, "start", "yield") for spoke in spokes]
    by_id = {road.id: road for road in roads}
    return RoadGraph(roads, (roundabout("roundabout", centre, arms, by_id, corner, ring, width, flare),))


_TEMPLATES: dict[str, Callable[[np.random.Generator], RoadGraph]] = {
    "straight": _straight,
    "curve": _curve,
    "s_curve": _s_curve,
    "t_junction": _t_junction,
    "x_junction": _x_junction,
    "double_junction": _double_junction,
    "narrowing": _narrowing,
    "slip_road": _slip_road,
    "roundabout": _roundabout,
}
