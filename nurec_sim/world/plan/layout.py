"""Generates a town from a seed: roads, houses, furniture, light, and traffic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nurec_sim.world.plan import traffic
from nurec_sim.world.plan.appearance import town_style, town_terrain, town_weather
from nurec_sim.world.plan.density import DENSITIES, TURNS, Traffic, Turn
from nurec_sim.world.plan.furniture import town_props
from nurec_sim.world.plan.junctions import Mouth
from nurec_sim.world.plan.lots import town_houses
from nurec_sim.world.plan.network import TownNetwork
from nurec_sim.world.plan.road import RoadLanes
from nurec_sim.world.plan.splits import SPLITS, STREAM_OF_SPLIT, TEMPLATES, Split
from nurec_sim.world.plan.templates import road_graph
from nurec_sim.world.plan.town import Crossing, Kerb, StopLine, TownPlan

START_US = 1_000_000
STEP_US = 50_000
"""Time step of the poses of a plan."""
MOST_SECONDS = 30.0


def town_plan(
    seed: int, split: Split = "train", template: str | None = None, seconds: float = 12.0,
    traffic_density: Traffic = "usual", turn: Turn | None = None,
) -> TownPlan:  # fmt: skip
    """The town of a seed with ``seconds`` of traffic; takes about a second, a few with ``turn``.

    Args:
        seed: same seed, same split, same plan to the byte.
        split: ``train`` towns use only shared assets of ``splits``; ``test`` towns always have held-out materials,
            every other one a held-out template, and never repeat a training town.
        template: one of ``splits.TEMPLATES``; by seed if not given.
        seconds: length of the drive, 1..30.
        traffic_density: ``usual``, or ``dense``: the same town with more vehicles, parked cars and pedestrians.
        turn: the way that the ego goes through its first junction: ``left``, ``right`` or ``straight``; by seed if not
            given.

    Raises:
        ValueError: a negative seed, an unknown split, template, density or turn, a template that the split holds out,
            seconds out of range, or no drive in the town turns so.
    """
    for what, given, known in (("traffic density", traffic_density, DENSITIES), ("turn", turn, (None, *TURNS))):
        if given not in known:
            raise ValueError(f"no {what} {given!r}; have {', '.join(each for each in known if each)}")
    plan = still_town(seed, split, template, seconds)
    density = DENSITIES[traffic_density]
    ego, actors = traffic.drive(TownNetwork(plan), seed, split, plan.span_us, density, turn)
    return replace(plan, ego=ego, actors=actors)


def still_town(seed: int, split: Split = "train", template: str | None = None, seconds: float = 12.0) -> TownPlan:
    """The same town without traffic; raises as ``town_plan`` does.

    Args:
        seed: seed of the town, at least 0.
        split: ``train`` or ``test``.
        template: one of ``splits.TEMPLATES``; by seed if not given.
        seconds: length of the drive, 1..30.
    """
    if seed < 0 or not 1.0 <= seconds <= MOST_SECONDS:
        raise ValueError(
            f"a town needs a seed >= 0 and 1..{MOST_SECONDS:g} seconds, got seed {seed}, {seconds} seconds"
        )
    if split not in SPLITS:
        raise ValueError(f"no split {split!r}; have {', '.join(SPLITS)}")
    allowed = TEMPLATES.shared if split == "train" else TEMPLATES.all
    if template is not None and template not in allowed:
        raise ValueError(f"no template {template!r} in split {split!r}; have {', '.join(allowed)}")

    # One independent stream per group of properties: more samples in one group leave all others unchanged.
    def stream(number: int) -> np.random.Generator:
        return np.random.default_rng([STREAM_OF_SPLIT[split], seed, number])

    choose = stream(0)
    if template is None:
        held_out = split == "test" and choose.random() < 0.5
        names = TEMPLATES.held_out if held_out else TEMPLATES.shared
        template = str(names[int(choose.integers(len(names)))])
    roads = road_graph(template, stream(1))
    style = town_style(stream(2), split)
    walk = float(choose.uniform(1.8, 2.6) if style.district == "suburb" else choose.uniform(2.4, 4.0))
    plan = TownPlan(
        seed=seed,
        split=split,
        template=template,
        span_us=(START_US, START_US + round(seconds * 1e6 / STEP_US) * STEP_US),
        style=style,
        weather=town_weather(stream(3), split),
        terrain=town_terrain(stream(4)),
        kerb=Kerb(height_m=round(float(choose.uniform(0.1, 0.15)), 3), sidewalk_width_m=round(walk, 2)),
        roads=roads.roads,
        junctions=roads.junctions,
        crossings=(),
        stop_lines=(),
        buildings=(),
        props=(),
    )
    # Each stage needs the areas of the previous one: paint needs roads, houses need paved areas, props need houses.
    crossings, stop_lines = _crossings(stream(5), TownNetwork(plan))
    plan = replace(plan, crossings=crossings, stop_lines=stop_lines)
    network = TownNetwork(plan)
    houses = town_houses(stream(6), network, style)
    props = town_props(stream(7), network, houses, style)
    return replace(plan, buildings=houses, props=props)


def _crossings(rng: np.random.Generator, network: TownNetwork) -> tuple[tuple[Crossing, ...], tuple[StopLine, ...]]:
    """Crossings at most junction mouths and some mid-block; stop lines where drivers may wait."""
    crossings: list[Crossing] = []
    stops: list[StopLine] = []
    for junction in network.plan.junctions:
        for mouth in network.junction_mouths[junction.id]:
            # Stop lines lie behind a crossing if there is one.
            from_mouth = 0.4
            if junction.kind != "fork" and mouth.line.length_m > 30.0 and rng.random() < 0.7:
                depth = round(float(rng.uniform(2.6, 3.6)), 2)
                crossings.append(_crossing_at(mouth, 0.7, depth, zebra=bool(rng.random() < 0.75)))
                from_mouth = 0.7 + depth + 1.0
            if mouth.arm.rule != "priority" and mouth.lanes(inbound=True):
                station = from_mouth if mouth.outward else mouth.line.length_m - from_mouth
                stops.append(StopLine(mouth.arm.road, station, not mouth.outward))
    for line in network.roads.values():
        if not network.plan.junctions and line.length_m > 120.0 and rng.random() < 0.7:
            crossings.append(_mid_block(rng, line))
    return tuple(crossings), tuple(stops)


def _crossing_at(mouth: Mouth, from_mouth_m: float, depth_m: float, zebra: bool) -> Crossing:
    station = from_mouth_m if mouth.outward else mouth.line.length_m - from_mouth_m - depth_m
    return Crossing(mouth.arm.road, station, depth_m, zebra)


def _mid_block(rng: np.random.Generator, line: RoadLanes) -> Crossing:
    """A zebra crossing somewhere in the middle, clear of narrow parts."""
    narrow, station = line.plan.narrowing, float(rng.uniform(0.35, 0.65)) * line.length_m
    if narrow is not None:
        station = (narrow.start_m + narrow.end_m) / 2 - 1.5
    return Crossing(line.plan.id, round(station, 2), 3.0, True)
