"""The traffic of a town: the ego, other vehicles, parked cars and pedestrians.

All vehicles are simulated together from ``WARM_UP_S`` before the log starts, so that its first frame is in a steady
state. Colliding actors are removed and the simulation is repeated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Bool, Float64, Int64

from nurec_sim.world.plan import departures, drivers, fleet, pedestrians
from nurec_sim.world.plan import swept_boxes as boxes
from nurec_sim.world.plan.density import DENSITIES, Density, Turn
from nurec_sim.world.plan.departures import Vehicle
from nurec_sim.world.plan.drivers import STEP_S
from nurec_sim.world.plan.network import TownNetwork
from nurec_sim.world.plan.pedestrians import Walker
from nurec_sim.world.plan.routes import SPACING_M, Route
from nurec_sim.world.plan.rules import Rules
from nurec_sim.world.plan.splits import STREAM_OF_SPLIT, Split
from nurec_sim.world.plan.swept_boxes import Boxes
from nurec_sim.world.plan.town import EGO_MIDDLE_M, Actor, ActorKind

WARM_UP_S = 3.0
AHEAD_M = 130.0
"""Length of the ego's route around which other actors are generated."""
KEPT_EVERY = 2
"""Subsampling of actor paths; the ego keeps every step."""
ATTEMPTS, TURNING_ATTEMPTS, AGAIN = 3, 12, 5
APART_M = 0.08
LIVELY_SHARE, LIVELY_M = 0.6, 40.0
"""A drive is lively if for this fraction of time ``Density.lively`` actors move within this distance ahead of the ego.
"""

EgoPath = tuple[tuple[int, float, float, float], ...]


def drive(
    network: TownNetwork, seed: int, split: Split, span_us: tuple[int, int], density: Density | None = None,
    turn: Turn | None = None,
) -> tuple[EgoPath, tuple[Actor, ...]]:  # fmt: skip
    """All trajectories in a town, deterministic for its arguments.

    Of up to ``ATTEMPTS`` random scenes the first lively one is taken, else the liveliest; with ``turn``, of up to
    ``TURNING_ATTEMPTS`` and only of those in which the ego turns.

    Args:
        network: the town's lanes and areas.
        seed: seed of the town.
        split: ``train`` or ``test``: selects vehicle families and the random stream.
        span_us: first and last time of the trajectories.
        density: how much traffic; usual if not given.
        turn: the way that the ego goes through the first junction within the span; any if not given.

    Returns:
        The ego as (t_us, x, y, yaw) every 50 ms over the whole span, and all other actors; no two boxes ever touch.

    Raises:
        ValueError: in no scene the ego turned.
    """
    rules, density = Rules(network), density or DENSITIES["usual"]
    best: tuple[float, _Scene] | None = None
    for attempt in range(ATTEMPTS if turn is None else TURNING_ATTEMPTS):
        rng = np.random.default_rng([STREAM_OF_SPLIT[split], seed, 0x7A, attempt])
        scene = _scene(rng, rules, split, span_us, density, turn)
        if scene is None:
            continue
        lively = liveliness(scene.boxes, scene.movers, density.lively)
        if best is None or lively > best[0]:
            best = lively, scene
        if lively >= LIVELY_SHARE:
            break
    if best is None:
        seconds = (span_us[1] - span_us[0]) / 1e6
        raise ValueError(
            f"no drive of {seconds:g} s in town {seed} of split {split!r} ({network.plan.template}) goes {turn} at its "
            "first junction; another seed, a longer drive or a template with junctions may"
        )
    return best[1].ego_path(), best[1].actors()


@dataclass(frozen=True, eq=False)
class _Scene:
    """Boxes of all actors (ego, vehicles, pedestrians, parked cars) at ``t_us``, and which are kept."""

    t_us: Int64[np.ndarray, " t"]
    boxes: Boxes
    vehicles: Sequence[Vehicle]
    walkers: Sequence[Walker]
    parked: Sequence[Actor]
    stays: Bool[np.ndarray, " n"]

    @property
    def movers(self) -> Bool[np.ndarray, " n"]:
        """Kept actors other than the ego and parked cars."""
        index = np.arange(len(self.stays))
        return self.stays & (index > 0) & (index <= len(self.vehicles) + len(self.walkers))

    def ego_path(self) -> EgoPath:
        """The rear axle of the ego."""
        yaw = self.boxes.yaw_rad[:, 0]
        xy = self.boxes.middle_m[:, 0] - EGO_MIDDLE_M * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        rows = np.column_stack([xy, yaw]).round(6).tolist()
        return tuple((int(t), *row) for t, row in zip(self.t_us, rows, strict=True))

    def actors(self) -> tuple[Actor, ...]:
        """All others, named."""
        found = []
        for index, vehicle in enumerate(self.vehicles, start=1):
            if self.stays[index]:
                size = vehicle.driver.size_m
                above = np.full(len(self.t_us), size[2] / 2)
                found.append(self._moving(index, vehicle.name, vehicle.kind, size, vehicle.colour, above))
        for index, walker in enumerate(self.walkers, start=1 + len(self.vehicles)):
            if self.stays[index]:
                # Feet were sampled from the warm-up on; the scene starts after it.
                above = walker.foot_m[-len(self.t_us) :] + walker.size_m[2] / 2
                name = f"pedestrian_{index - 1 - len(self.vehicles)}"
                found.append(self._moving(index, name, "pedestrian", walker.size_m, walker.colour, above))
        stays = self.stays[1 + len(self.vehicles) + len(self.walkers) :]
        return (*found, *(actor for actor, keep in zip(self.parked, stays, strict=True) if keep))

    def _moving(
        self,
        index: int,
        name: str,
        kind: ActorKind,
        size_m: tuple[float, float, float],
        colour: tuple[float, float, float],
        above_m: Float64[np.ndarray, " t"],
    ) -> Actor:
        rows = np.column_stack([self.boxes.middle_m[:, index], above_m, self.boxes.yaw_rad[:, index]]).round(4)
        last = len(rows) - 1
        # Vehicles that wait for the whole drive count as static and repeat one pose.
        moves = bool(np.ptp(rows[:, :2], axis=0).max() > 0.02)
        steps = sorted({*range(0, last, KEPT_EVERY), last}) if moves else [0, last]
        path = tuple((int(self.t_us[i]), *rows[i if moves else 0].tolist()) for i in steps)
        return Actor(name, kind, size_m, colour, moves, path)


def _scene(
    rng: np.random.Generator, rules: Rules, split: Split, span_us: tuple[int, int], density: Density, turn: Turn | None
) -> _Scene | None:
    """One attempt: simulates and removes colliding actors until none is left; None if the ego does not ``turn``."""
    seconds = (span_us[1] - span_us[0]) * 1e-6
    steps, warm = round(seconds / STEP_S), round(WARM_UP_S / STEP_S)
    # Time 0 is the start of the log; the warm-up is negative.
    t_s = (np.arange(warm + steps + 1) - warm) * STEP_S
    ego = departures.ego_driver(rng, rules, seconds + WARM_UP_S, turn)
    ahead = ego.route.at(np.linspace(ego.station_m, min(ego.station_m + AHEAD_M, ego.route.length_m), 27))
    way = shapely.LineString(ahead)
    parked = fleet.parked_cars(rng, rules.network, split, span_us, way, density)
    walkers = pedestrians.people(rng, rules.network, ahead, t_s, density)
    vehicles = departures.other_vehicles(rng, rules, split, ego, way, density)
    # Without the removed actors the others drive differently, so the simulation starts again. After the last round, the
    # remaining colliding actors are only left out.
    for again in range(AGAIN):
        # Vehicles react to each other and to people on crossings; people and parked cars react to nobody.
        everyone = [ego, *(vehicle.driver for vehicle in vehicles)]
        crossers = [walker for walker in walkers if walker.crossing is not None]
        passes = rules.passes(everyone, crossers, WARM_UP_S)
        motion = drivers.simulate(everyone, warm + steps, rules.meetings, pedestrians.boxes_of(crossers, t_s), passes)
        places = [(actor.path[0][1], actor.path[0][2], actor.path[0][4]) for actor in parked]
        half = np.array([actor.size_m[:2] for actor in parked]).reshape(-1, 2) / 2
        groups = [motion, pedestrians.boxes_of(walkers, t_s), boxes.standing(places, half, len(t_s))]
        everything = boxes.together(groups).since(warm)
        if turn is not None and _first_turn(ego.route, everything.middle_m[:, 0], rules) != turn:
            return None
        driving, walking = len(everyone), len(everyone) + len(walkers)
        stays = ~_superfluous(everything, driving, walking)
        if stays.all() or again == AGAIN - 1:
            break
        vehicles = [each for each, stay in zip(vehicles, stays[1:driving], strict=True) if stay]
        walkers = [each for each, stay in zip(walkers, stays[driving:walking], strict=True) if stay]
        parked = [each for each, stay in zip(parked, stays[walking:], strict=True) if stay]
    t_us = span_us[0] + np.rint(np.arange(steps + 1) * STEP_S * 1e6).astype(np.int64)
    return _Scene(t_us, everything, vehicles, walkers, parked, stays)


def _first_turn(route: Route, driven_m: Float64[np.ndarray, "t 2"], rules: Rules) -> str:
    """The way through the first junction between the ends of a drive along a route; empty if there is none."""
    first, last = (SPACING_M * np.linalg.norm(route.xy_m - place, axis=1).argmin() for place in driven_m[[0, -1]])
    for leg in route.legs:
        if leg.in_junction and first <= leg.start_m and leg.end_m <= last:
            return rules.lanes[leg.lane].turn
    return ""


def _superfluous(everything: Boxes, driving: int, walking: int) -> Bool[np.ndarray, " n"]:
    """Actors to remove to avoid collisions: pedestrians first, then parked cars, then the one placed last.

    Args:
        everything: vehicles [0, driving), the ego first, people [driving, walking), parked cars.
        driving: see ``everything``.
        walking: see ``everything``.
    """
    order = np.arange(len(everything.half_m))
    # A higher order is removed first.
    order[driving:walking] += len(order)
    out = np.zeros(len(order), bool)
    for i, j in boxes.touching(everything, APART_M):
        if not out[i] and not out[j]:
            out[i if order[i] > order[j] else j] = True
    return out


def liveliness(everything: Boxes, who: Bool[np.ndarray, " n"], count: int = 2) -> float:
    """Fraction of time in which ``count`` of ``who`` move close ahead of box 0, the ego."""
    # Every half second is enough, and a displacement of 15 cm over it is a moving actor.
    each = round(0.5 / STEP_S)
    middle, yaw = everything.middle_m[::each], everything.yaw_rad[::each, :1]
    away = middle[:-1, who] - middle[:-1, :1]
    c, s = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    ahead, aside = away[..., 0] * c + away[..., 1] * s, np.abs(away[..., 1] * c - away[..., 0] * s)
    moves = np.linalg.norm(np.diff(middle[:, who], axis=0), axis=2) > 0.15
    # A sector of about 50 degrees to either side of straight ahead.
    seen = (ahead > 0) & (ahead < LIVELY_M) & (aside < 1.2 * ahead) & moves
    return float((seen.sum(axis=1) >= count).mean())
