"""Traffic rules at junctions and crossings: right of way and stop positions."""

from __future__ import annotations

from collections.abc import Sequence

from nurec_sim.world.plan import drivers, pedestrians
from nurec_sim.world.plan.drivers import Driver, Pass
from nurec_sim.world.plan.network import TownNetwork
from nurec_sim.world.plan.routes import Conflict, Route, conflicts

RANK_OF_RULE = {"priority": 4, "green": 4, "stop": 2, "yield": 2, "red": -2}
"""Right-of-way ranks; a negative rank never enters."""
LEFT_TURN_RANK = -1
BEFORE_CROSSING_M = 0.6
STEP_OUT_S = 2.0
"""Drivers start waiting this long before a pedestrian steps on the road."""


class Rules:
    """Rules shared by all drivers of a network.

    Attributes:
        lanes: by id.
        meetings: conflict zones of junction lanes.
        rank: right of way per junction lane.
        stop_short_m: distance of the stop line before each of them.
        must_halt: lanes with a stop sign.
    """

    def __init__(self, network: TownNetwork):
        self.network = network
        self.lanes = {lane.id: lane for lane in network.lanes}
        self.meetings: dict[tuple[str, str], Conflict] = conflicts(self.lanes)
        self.rank: dict[str, int] = {}
        self.stop_short_m: dict[str, float] = {}
        halts = set()
        line_of = {(line.road, line.forward): line.station_m for line in network.plan.stop_lines}
        for junction in network.plan.junctions:
            rule_of = {(arm.road, arm.end): arm.rule for arm in junction.arms}
            for path in junction.connections:
                road, _, number = path.from_lane.rpartition(":")
                # Negative lanes run with the stations of their road and reach the junction at its end.
                forward = int(number) < 0
                rule = rule_of[road, "end" if forward else "start"]
                self.rank[path.id] = RANK_OF_RULE[rule] + (LEFT_TURN_RANK if path.turn == "left" else 0)
                line = line_of.get((road, forward))
                if line is not None:
                    self.stop_short_m[path.id] = network.roads[road].length_m - line if forward else line
                if rule == "stop":
                    halts.add(path.id)
        self.must_halt = frozenset(halts)

    def driver(
        self,
        route: Route,
        station_m: float,
        speed_mps: float,
        size_m: tuple[float, float, float],
        axle_m: float | None = None,
    ) -> Driver:
        """A driver who follows these rules.

        Args:
            route: lanes to drive.
            station_m: initial station of the vehicle's centre on the route.
            speed_mps: initial speed.
            size_m: length, width and height.
            axle_m: distance from the rear axle to the centre; if None, a usual fraction of the length.
        """
        axle = drivers.AXLE_BEHIND_MIDDLE * size_m[0] if axle_m is None else axle_m
        return Driver(route, station_m, speed_mps, size_m, self.rank, self.stop_short_m, self.must_halt, axle)

    def passes(self, everyone: Sequence[Driver], walkers: Sequence[pedestrians.Walker], delay_s: float) -> list[Pass]:
        """Stops of drivers for pedestrians; the drivers' clock starts ``delay_s`` before the pedestrians'."""
        found = []
        for index, driver in enumerate(everyone):
            for leg in driver.route.legs:
                road, _, number = leg.lane.rpartition(":")
                for walker in walkers:
                    crossing = walker.crossing
                    if leg.in_junction or crossing is None or crossing.road != road:
                        continue
                    forward = int(number) < 0
                    end = crossing.station_m + crossing.depth_m
                    # Distance from the start of the lane, in its own driving direction, to the near edge of the
                    # crossing.
                    before = crossing.station_m if forward else self.network.roads[road].length_m - end
                    since, until = walker.on_road_s[0 if forward else 1]
                    stop = leg.start_m + before - BEFORE_CROSSING_M
                    found.append(Pass(index, stop, delay_s + since - STEP_OUT_S, delay_s + until))
        return found
