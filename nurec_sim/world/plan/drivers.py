"""Vehicle simulation: speeds by the intelligent driver model, and right of way.

Free driving and car following: Treiber, Hennecke, Helbing, "Congested traffic states in empirical observations and
microscopic simulations" (2000). The centre of a vehicle follows its route and its rear axle follows without slip (a
tractrix). Arrays have one row per vehicle; the ego is an ordinary vehicle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim.world.plan.routes import SPACING_M, Conflict, Route
from nurec_sim.world.plan.swept_boxes import Boxes

STEP_S = 0.05
ACCEL_MPS2, BRAKE_MPS2, HARD_BRAKE_MPS2 = 1.6, 2.0, 6.0
STAND_GAP_M, HEADWAY_S = 2.0, 1.2
LOOK_AHEAD_M = 60.0 * np.linspace(0.0, 1.0, 48) ** 1.5
"""Look-ahead distances from the front bumper for obstacles, finest nearby."""
ASIDE_M = 0.25  # lateral clearance
STOP_SHORT_M = 0.6
AXLE_BEHIND_MIDDLE = 0.29  # of the length


@dataclass(frozen=True, eq=False)
class Driver:
    """A vehicle with its route.

    Attributes:
        route: its route.
        station_m: initial station of its centre.
        speed_mps: initial speed.
        size_m: length, width, height.
        rank: right of way per junction lane of the route; a negative rank never enters (red light).
        stop_short_m: distance of the stop line before each such lane.
        must_halt: lanes with a stop sign.
        axle_m: distance from the rear axle to the centre.
    """

    route: Route
    station_m: float
    speed_mps: float
    size_m: tuple[float, float, float]
    rank: Mapping[str, int]
    stop_short_m: Mapping[str, float]
    must_halt: frozenset[str]
    axle_m: float


@dataclass(frozen=True)
class Pass:
    """A pedestrian crosses a route: ``driver`` waits at ``stop_m`` from ``from_s`` to ``until_s``."""

    driver: int
    stop_m: float
    from_s: float
    until_s: float


def simulate(
    drivers: Sequence[Driver],
    steps: int,
    meetings: Mapping[tuple[str, str], Conflict],
    walkers: Boxes,
    passes: Sequence[Pass],
) -> Boxes:
    """Stations of all drivers over ``steps`` steps of ``STEP_S``, the start included.

    Args:
        drivers: n drivers.
        steps: number of steps.
        meetings: ``routes.conflicts`` of the network.
        walkers: pedestrians on the road at the same times; drivers brake for them.
        passes: pedestrian crossings to wait for.
    """
    count = len(drivers)
    half = np.array([[driver.size_m[0] / 2, driver.size_m[1] / 2] for driver in drivers])
    axle = np.array([driver.axle_m for driver in drivers])
    # Stations are those of vehicle centres; vehicles start straight, with the rear axle on the route.
    road = _Roads([driver.route for driver in drivers])
    station = np.array([driver.station_m for driver in drivers])
    speed, accel = np.array([driver.speed_mps for driver in drivers]), np.zeros(count)
    yields, stops = _Yields(drivers, meetings), _Stops(drivers, passes)
    middle, yaw = np.zeros((steps + 1, count, 2)), np.zeros((steps + 1, count))
    rear = road.at(station - axle)
    for step in range(steps + 1):
        middle[step] = road.at(station)
        # The tractrix: the rear axle is pulled towards the centre along the line between them.
        heading = middle[step] - rear
        heading /= np.linalg.norm(heading, axis=1, keepdims=True)
        rear = middle[step] - axle[:, None] * heading
        yaw[step] = np.arctan2(heading[:, 1], heading[:, 0])
        front = station + half[:, 0]
        gap, lead_speed = _what_is_ahead(road, front, half, middle[step], yaw[step], speed, walkers, step)
        stop = np.minimum(yields.stops_m(front, speed, half[:, 0]), stops.stops_m(front, speed, step * STEP_S))
        wanted = follow(speed, road.allowed(station), gap, lead_speed)
        # A stop line acts as a standing leader. The model halts STAND_GAP_M behind a leader; the offset moves that to
        # STOP_SHORT_M before the line.
        wanted = np.minimum(wanted, follow(speed, road.allowed(station), stop - front + STAND_GAP_M - STOP_SHORT_M))
        accel = accel + np.clip(wanted - accel, -14.0 * STEP_S, 5.0 * STEP_S)  # jerk limit
        after = np.maximum(speed + accel * STEP_S, 0.0)
        # A standing vehicle keeps no negative acceleration, or the jerk limit would delay its start.
        accel = np.where(after == 0.0, np.maximum(accel, 0.0), accel)
        # Trapezoidal rule: exact for constant acceleration.
        station, speed = station + (speed + after) / 2 * STEP_S, after
    return Boxes(middle, np.unwrap(yaw, axis=0), half)


def follow(
    speed: Float64[np.ndarray, " n"],
    wanted: Float64[np.ndarray, " n"],
    gap_m: Float64[np.ndarray, " n"],
    lead_speed: float | Float64[np.ndarray, " n"] = 0.0,
) -> Float64[np.ndarray, " n"]:
    """Accelerations (m/s^2) by the intelligent driver model, within -``HARD_BRAKE_MPS2`` .. ``ACCEL_MPS2``.

    Args:
        speed: current speeds (m/s) of n vehicles.
        wanted: desired speeds (m/s).
        gap_m: free distance ahead of the front bumper; infinite on a free road.
        lead_speed: speed (m/s) of the obstacle at that distance, along the route.
    """
    # Free term 1 - (v / v0)^4. Above the desired speed its power would brake far too hard, so it is linear there.
    share = np.minimum(speed / np.maximum(wanted, 0.05), 1.0)
    free = np.where(speed < wanted, 1 - share**4, 1.5 * (wanted - speed))
    # Desired gap s* = s0 + max(0, v T + v dv / (2 sqrt(a b))); the interaction term is (s* / s)^2.
    closing = speed * (speed - lead_speed) / (2 * np.sqrt(ACCEL_MPS2 * BRAKE_MPS2))
    desired = STAND_GAP_M + np.maximum(0.0, speed * HEADWAY_S + closing)
    wish = ACCEL_MPS2 * (free - (desired / np.maximum(gap_m, 0.1)) ** 2)
    return np.clip(wish, -HARD_BRAKE_MPS2, ACCEL_MPS2)


class _Roads:
    """All routes in one array, for vectorised look-up."""

    def __init__(self, routes: Sequence[Route]):
        # Shorter routes repeat their last point; `last` is the last real segment, used beyond the end.
        longest = max(len(route.xy_m) for route in routes)
        self.last = np.array([len(route.xy_m) - 2 for route in routes])
        self.xy = np.stack([np.pad(r.xy_m, ((0, longest - len(r.xy_m)), (0, 0)), mode="edge") for r in routes])
        self.speed = np.stack([np.pad(r.allowed_mps, (0, longest - len(r.xy_m)), mode="edge") for r in routes])
        self.rows = np.arange(len(routes))

    def at(self, station_m: Float64[np.ndarray, "n ..."]) -> Float64[np.ndarray, "n ... 2"]:
        """Points of each driver's route, extrapolated straight beyond both ends."""
        shape = (-1,) + (1,) * (station_m.ndim - 1)
        row, place = self.rows.reshape(shape), station_m / SPACING_M
        index = np.clip(place.astype(int), 0, self.last.reshape(shape))
        low = self.xy[row, index]
        return low + (place - index)[..., None] * (self.xy[row, index + 1] - low)

    def allowed(self, station_m: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Allowed speeds on the routes."""
        return self.speed[self.rows, np.clip(np.rint(station_m / SPACING_M).astype(int), 0, self.last)]


def _what_is_ahead(
    road: _Roads, front: np.ndarray, half: np.ndarray, middle: np.ndarray, yaw: np.ndarray, speed: np.ndarray,
    walkers: Boxes, step: int,
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:  # fmt: skip
    """Free distance ahead of each front bumper, and the speed of the obstacle along the route."""
    count = len(front)
    way = road.at(front[:, None] + LOOK_AHEAD_M)
    # Vehicles first, so that box i is vehicle i; people count as standing.
    boxes = np.concatenate([middle, walkers.middle_m[step]])
    box_yaw = np.concatenate([yaw, walkers.yaw_rad[step]])
    box_half = np.concatenate([half, walkers.half_m])
    box_speed = np.concatenate([speed, np.zeros(len(walkers.half_m))])
    away = way[:, :, None] - boxes  # [n, look, box, 2]
    c, s = np.cos(box_yaw), np.sin(box_yaw)
    along, across = away[..., 0] * c + away[..., 1] * s, away[..., 1] * c - away[..., 0] * s
    # Half extent of a rotated box perpendicular to the route; only the width gets a margin.
    aside = half[:, None, None, 1] + ASIDE_M
    hit = (np.abs(along) < box_half[:, 0] + 0.3) & (np.abs(across) < box_half[:, 1] + aside)
    turned = np.abs(np.sin(yaw[:, None] - box_yaw))[:, None]
    hit |= (np.abs(along) < box_half[:, 0] + aside * turned) & (np.abs(across) < box_half[:, 1] + 0.3)
    # No vehicle is its own obstacle.
    hit[np.arange(count), :, np.arange(count)] = False
    blocked = hit.any(axis=2)
    first = np.argmax(blocked, axis=1)
    other = np.argmax(hit[np.arange(count), first], axis=1)
    free = ~blocked.any(axis=1)
    # The obstacle at the nearest blocked point counts, with its speed along this vehicle's heading.
    gap = np.where(free, np.inf, LOOK_AHEAD_M[first])
    return gap, np.where(free, 0.0, box_speed[other] * np.cos(box_yaw[other] - yaw))


class _Yields:
    """Right of way at junctions: one row per pair of drivers with conflicting lanes."""

    def __init__(self, drivers: Sequence[Driver], meetings: Mapping[tuple[str, str], Conflict]):
        # Row: me, other, my stop, their stop, conflict zone on my route [2], on theirs [2], my rank, their rank.
        rows, reds = [], []
        entries = [
            [
                (leg, leg.start_m - driver.stop_short_m.get(leg.lane, 0.0))
                for leg in driver.route.legs
                if leg.in_junction
            ]
            for driver in drivers
        ]
        for i, driver in enumerate(drivers):
            for mine, stop in entries[i]:
                if driver.rank.get(mine.lane, 0) < 0:
                    reds.append((i, stop))
                for j, other in enumerate(drivers):
                    for theirs, their_stop in entries[j] if j != i else ():
                        meeting = meetings.get((mine.lane, theirs.lane))
                        if meeting is not None:
                            rows.append((
                                i, j, stop, their_stop,
                                mine.start_m + meeting.first[0], mine.start_m + meeting.first[1],
                                theirs.start_m + meeting.second[0], theirs.start_m + meeting.second[1],
                                driver.rank.get(mine.lane, 0), other.rank.get(theirs.lane, 0),
                            ))  # fmt: skip
        table = np.array(rows, np.float64).reshape(-1, 10)
        self.me, self.other = table[:, 0].astype(int), table[:, 1].astype(int)
        self.stop, self.their_stop, self.near, self.far, self.their_near, self.their_far = table[:, 2:8].T
        self.my_rank, self.their_rank = table[:, 8], table[:, 9]
        self.red = np.array(reds, np.float64).reshape(-1, 2)
        self.count = len(drivers)
        halts = [
            (i, stop) for i, driver in enumerate(drivers) for leg, stop in entries[i] if leg.lane in driver.must_halt
        ]
        self.halt = np.array(halts, np.float64).reshape(-1, 2)
        self.halted: Bool[np.ndarray, " h"] = np.zeros(len(halts), bool)

    def stops_m(self, front: np.ndarray, speed: np.ndarray, half_length: np.ndarray) -> Float64[np.ndarray, " n"]:
        """Stop position of each front bumper, infinite if none."""
        stops = np.full(self.count, np.inf)
        me, other = self.me, self.other
        # Whoever is past the stop line does not stop any more.
        inside, they_inside = front[me] > self.stop + 0.5, front[other] > self.their_stop + 0.5
        # Their rear bumper has left the conflict zone.
        passed = front[other] - 2 * half_length[other] > self.their_far
        # Stopped vehicles may start at any time, so both speeds are overestimated slightly.
        my_pace, their_pace = speed[me] + 1.5, speed[other] + 1.5
        they_come = np.maximum(self.their_near - front[other], 0.0) / their_pace
        they_leave = (self.their_far + 2 * half_length[other] - front[other]) / np.maximum(speed[other], 0.5)
        i_come = np.maximum(self.near - front[me], 0.0) / my_pace
        # From a stop one accelerates through the zone, hence a mean speed between the present one and a usual one.
        i_leave = (self.far + 2 * half_length[me] - front[me]) / np.maximum(0.5 * speed[me] + 2.5, 3.0)
        # Time intervals in the zone overlap, with a margin of a second after me and 0.8 s before.
        meet = ~passed & (they_come < i_leave + 1.0) & (they_leave > i_come - 0.8)
        # Equal ranks: first come, first served; ties go to the lower index, so that never both wait.
        sooner = np.where(np.isclose(they_come, i_come), other < me, they_come < i_come)
        theirs = they_inside | (self.their_rank > self.my_rank) | ((self.their_rank == self.my_rank) & sooner)
        held = ~inside & meet & theirs & _concerns(self.stop - front[me], speed[me])
        # A driver may yield to several others: the nearest stop counts, hence the unbuffered minimum.
        np.minimum.at(stops, me[held], self.stop[held])
        # Red lights stay closed; a stop sign opens for a driver who has halted at it.
        for table, closed in ((self.red, np.ones(len(self.red), bool)), (self.halt, ~self._halts(front, speed))):
            who = table[:, 0].astype(int)
            held = closed & (front[who] < table[:, 1] + 0.5) & _concerns(table[:, 1] - front[who], speed[who])
            np.minimum.at(stops, who[held], table[held, 1])
        return stops

    def _halts(self, front: np.ndarray, speed: np.ndarray) -> Bool[np.ndarray, " h"]:
        who = self.halt[:, 0].astype(int)
        self.halted |= (np.abs(self.halt[:, 1] - front[who]) < 3.0) & (speed[who] < 0.4)
        return self.halted


class _Stops:
    """Waiting for crossing pedestrians."""

    def __init__(self, drivers: Sequence[Driver], passes: Sequence[Pass]):
        self.count = len(drivers)
        self.me: Int64[np.ndarray, " p"] = np.array([each.driver for each in passes], np.int64)
        self.stop = np.array([each.stop_m for each in passes])
        self.span = np.array([(each.from_s, each.until_s) for each in passes]).reshape(-1, 2)

    def stops_m(self, front: np.ndarray, speed: np.ndarray, now_s: float) -> Float64[np.ndarray, " n"]:
        """Stop position of each front bumper, infinite if none."""
        stops = np.full(self.count, np.inf)
        if len(self.me):
            open_now = (self.span[:, 0] <= now_s) & (now_s < self.span[:, 1]) & (front[self.me] < self.stop + 0.5)
            held = open_now & _concerns(self.stop - front[self.me], speed[self.me])
            np.minimum.at(stops, self.me[held], self.stop[held])
        return stops


def _concerns(distance_m: np.ndarray, speed: np.ndarray) -> Bool[np.ndarray, " r"]:
    """Whether a stop is near enough to brake for, and far enough to be reachable."""
    # 10 m more than braking at 1.5 m/s^2 takes, and at most 1 m less than hard braking takes.
    return (distance_m < speed**2 / 3.0 + 10.0) & (distance_m > speed**2 / (2 * HARD_BRAKE_MPS2) - 1.0)
