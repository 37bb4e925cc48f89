"""Drivers on hand-made roads: each rule alone."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from nurec_sim import geometry
from nurec_sim.world.plan.drivers import STEP_S, Driver, Pass, follow, simulate
from nurec_sim.world.plan.network import Lane
from nurec_sim.world.plan.routes import END_M, SPACING_M, Conflict, Leg, Route, conflicts, lay_route, random_lanes
from nurec_sim.world.plan.swept_boxes import Boxes, standing, together, touching

CAR = (4.5, 1.8, 1.5)
NOBODY = standing([], np.zeros((0, 2)), 1000)


def line(x0, y0, x1, y1):
    length = float(np.hypot(x1 - x0, y1 - y0))
    share = (np.arange(int(length / SPACING_M) + 1) * SPACING_M / length)[:, None]
    return np.array([x0, y0]) + share * np.array([x1 - x0, y1 - y0])


def route(xy, speed=10.0, legs=()):
    return Route(xy, np.full(len(xy), speed), tuple(legs))


def driver(way, station=0.0, speed=0.0, rank=None, halt=(), short=None):
    return Driver(way, station, speed, CAR, rank or {}, short or {}, frozenset(halt), 1.3)


def speeds(motion, index=0):
    return np.linalg.norm(np.diff(motion.middle_m[:, index], axis=0), axis=1) / STEP_S


def test_a_free_driver_reaches_the_wanted_speed_and_keeps_it():
    motion = simulate([driver(route(line(0, 0, 400, 0)))], 500, {}, NOBODY, [])
    assert speeds(motion)[0] < 0.2 and 9.5 < speeds(motion)[-1] <= 10.01
    assert np.diff(speeds(motion)).max() / STEP_S < 1.7


def test_who_follows_keeps_away_and_stops_behind_who_stands():
    way = route(line(0, 0, 300, 0), 14.0)
    stands = driver(route(line(0, 0, 300, 0), 0.0), 150.0)
    motion = simulate([driver(way, 10.0, 14.0), stands], 500, {}, NOBODY, [])
    gap = motion.middle_m[:, 1, 0] - motion.middle_m[:, 0, 0] - CAR[0]
    assert 1.0 < gap.min() and 1.0 < gap[-1] < 4.0 and speeds(motion)[-1] < 0.3


def test_oncoming_cars_in_their_own_lane_do_not_matter():
    motion = simulate(
        [driver(route(line(0, 0, 300, 0)), 10.0, 10.0), driver(route(line(300, 3.2, 0, 3.2)), 150.0, 10.0)],
        300, {}, NOBODY, [],
    )  # fmt: skip
    assert speeds(motion).min() > 9.5


def crossing(rank_of_second=0, halt=(), first_station=20.0, second_station=20.0):
    """Two roads that cross at (60, 0); junction paths are 20 m long."""
    east = route(line(0, 0, 150, 0), 10.0, [Leg("east", 50.0, 70.0, True)])
    north = route(line(60, -60, 60, 90), 10.0, [Leg("north", 50.0, 70.0, True)])
    meet = {
        ("east", "north"): Conflict((7.0, 13.0), (7.0, 13.0)),
        ("north", "east"): Conflict((7.0, 13.0), (7.0, 13.0)),
    }
    drivers = [
        driver(east, first_station, 8.0, {"east": 0}, halt),
        driver(north, second_station, 8.0, {"north": rank_of_second}),
    ]
    return simulate(drivers, 400, meet, NOBODY, [])


@pytest.mark.parametrize("rank, first_over", [(2, 1), (-1, 0)])
def test_rank_decides_who_goes_first(rank, first_over):
    motion = crossing(rank)
    assert touching(motion) == []
    over = [int(np.argmax(motion.middle_m[:, 0, 0] > 60)), int(np.argmax(motion.middle_m[:, 1, 1] > 0))]
    if rank < 0:  # a red light stays red
        assert over[0] > 0 and over[1] == 0 and speeds(motion, 1)[-1] < 0.1
        assert -60 + 50 - 3.5 < motion.middle_m[-1, 1, 1] + CAR[0] / 2 < -60 + 50
    else:
        assert 0 < over[first_over] < over[1 - first_over]


def test_equal_ranks_go_one_after_the_other_and_nobody_waits_forever():
    for shift in np.linspace(0, 12, 7):
        motion = crossing(second_station=20.0 - shift)
        assert touching(motion) == []
        assert motion.middle_m[-1, 0, 0] > 75 and motion.middle_m[-1, 1, 1] > 15


def test_a_stop_sign_stops_even_who_is_alone():
    motion = crossing(halt=("east",), second_station=0.0)
    slow = speeds(motion) < 0.4
    assert slow.any() and motion.middle_m[-1, 0, 0] > 75
    assert 44 < motion.middle_m[np.argmax(slow), 0, 0] + CAR[0] / 2 < 50


@pytest.mark.parametrize(("before_m", "stops"), [(5.0, False), (25.0, True)])
def test_a_red_light_stops_who_can_still_stop(before_m, stops):
    """From 10 m/s the hardest braking, 6 m/s2, takes 8.3 m: who is nearer drives on as if it were green."""
    way = route(line(0, 0, 150, 0), 10.0, [Leg("east", 50.0, 70.0, True)])
    one = driver(way, 50.0 - before_m - CAR[0] / 2, 10.0, {"east": -1})
    found = speeds(simulate([one], 200, {}, NOBODY, []))
    assert found[-1] < 0.1 if stops else found.min() > 9.9


def test_who_has_its_tail_in_the_crossing_has_not_passed():
    """One stands half a metre beyond the crossing with its front, so the other waits where its junction begins."""
    stands = driver(route(line(60, -60, 60, 90), 0.0, [Leg("north", 50.0, 70.0, True)]), 63.5 - CAR[0] / 2)
    comes = driver(route(line(0, 0, 150, 0), 10.0, [Leg("east", 50.0, 70.0, True)]), 20.0, 8.0)
    meet = Conflict((7.0, 13.0), (7.0, 13.0))
    motion = simulate([comes, stands], 300, {("east", "north"): meet, ("north", "east"): meet}, NOBODY, [])
    assert 46 < motion.middle_m[-1, 0, 0] + CAR[0] / 2 < 50 and speeds(motion)[-1] < 0.1


def test_drivers_wait_for_people_who_cross():
    one = driver(route(line(0, 0, 200, 0)), 5.0, 10.0)
    assert simulate([one], 120, {}, NOBODY, []).middle_m[-1, 0, 0] > 60
    motion = simulate([one], 300, {}, NOBODY, [Pass(0, 50.0, 0.0, 9.0)])
    nine = round(9.0 / STEP_S)
    assert 46 < motion.middle_m[nine, 0, 0] + CAR[0] / 2 < 50 and motion.middle_m[-1, 0, 0] > 70


def test_somebody_in_the_way_is_seen_even_without_a_crossing():
    person = standing([(40.0, 0.3, 0.0)], np.array([[0.45, 0.3]]), 1000)
    motion = simulate([driver(route(line(0, 0, 200, 0)), 5.0, 10.0)], 300, {}, person, [])
    assert (
        touching(together([motion, Boxes(*(part[:301] for part in (person.middle_m, person.yaw_rad)), person.half_m)]))
        == []
    )
    assert speeds(motion)[-1] < 0.1


def test_rear_axles_do_not_slip_on_a_bend():
    angle = np.linspace(0, np.pi / 2, 2 * int(12 * np.pi / 2) + 1)
    bend = 12.0 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    way = np.concatenate([line(-40, 0, 0, 0)[:-1], bend, line(12, 12, 12, 80)[1:]])
    motion = simulate([driver(route(way, 6.0), 5.0, 6.0)], 250, {}, NOBODY, [])
    heading = np.stack([np.cos(motion.yaw_rad[:, 0]), np.sin(motion.yaw_rad[:, 0])], axis=1)
    rear = motion.middle_m[:, 0] - 1.3 * heading
    step, middle = np.diff(rear, axis=0), (heading[1:] + heading[:-1]) / 2
    assert np.abs(step[:, 0] * middle[:, 1] - step[:, 1] * middle[:, 0]).max() < 0.005
    assert np.isclose(motion.yaw_rad[-1, 0], np.pi / 2, atol=0.02)


def test_follow_is_the_published_model():
    speed, gap, lead = 8.0, 20.0, 6.0
    desired = 2.0 + speed * 1.2 + speed * (speed - lead) / (2 * np.sqrt(1.6 * 2.0))
    expected = 1.6 * (1 - (8.0 / 12.0) ** 4 - (desired / gap) ** 2)
    found = follow(np.array([speed]), np.array([12.0]), np.array([gap]), lead)
    assert np.isclose(found[0], expected)


# ------------------------------------------------------------------------------------------------------------- routes


def lane(name, points, successors=(), inside=False, limit=14.0):
    points = np.asarray(points, float)
    xyz = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    return Lane(name, "road", xyz, 3.5, limit, tuple(successors), inside)


def test_routes_slow_down_before_bends_and_their_end():
    angle = np.linspace(0, np.pi / 2, 20)
    bend = np.array([80.0, 0.0]) + 10.0 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    lanes = {
        "in": lane("in", np.stack([np.arange(81.0), np.zeros(81)], axis=1), ["turn"]),
        "turn": lane("turn", bend, ["out"], True),
        "out": lane("out", np.stack([np.full(81, 90.0), 10.0 + np.arange(81.0)], axis=1)),
    }
    way = random_lanes(np.random.default_rng(1), lanes, "in", 1000.0)
    assert way == ("in", "turn", "out")
    found = lay_route(lanes, way)
    np.testing.assert_allclose(np.linalg.norm(np.diff(found.xy_m, axis=0), axis=1), SPACING_M, atol=0.01)
    speed = found.allowed_mps
    assert speed[10] == 14.0 and (speed[-int(END_M / SPACING_M) :] == 0).all()
    at_bend = speed[int(82 / SPACING_M) : int(94 / SPACING_M)]
    np.testing.assert_allclose(at_bend, np.sqrt(2.2 * 10), rtol=0.08)
    assert np.diff(speed**2).min() / (2 * SPACING_M) > -1.61
    right = lay_route(lanes, ("in",), right_m=1.0)
    np.testing.assert_allclose(right.xy_m[:, 1], -1.0, atol=1e-9)


def test_lanes_conflict_where_they_cross_or_merge_but_not_where_they_part():
    lanes = {
        name: lane(name, points, successors, inside)
        for name, points, successors, inside in [
            ("a", [(-20, 0), (-10, 0)], ["straight", "left"], False),
            ("b", [(0, -20), (0, -10)], ["across", "right"], False),
            ("straight", [(x, 0) for x in range(-10, 11)], ["c"], True),
            ("left", [(-10, 0), (-5, 1), (-1, 5), (0, 10)], ["d"], True),
            ("across", [(0, y) for y in range(-10, 11)], ["d"], True),
            ("right", [(0, -10), (1, -5), (5, -1), (10, 0)], ["c"], True),
            ("c", [(10, 0), (20, 0)], [], False),
            ("d", [(0, 10), (0, 20)], [], False),
        ]
    }
    found = conflicts(lanes)
    assert ("straight", "left") not in found and ("across", "right") not in found
    assert found["straight", "across"].first == (8.0, 12.0) and found["straight", "across"].second == (8.0, 12.0)
    merge = found["straight", "right"]
    assert merge.first[1] == 20.0 and merge.second[1] == merge.second[0] + 1.0


# -------------------------------------------------------------------------------------------------------------- boxes


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_boxes_touch_where_polygons_do(seed):
    rng = np.random.default_rng(seed)
    count = 6
    middle, yaw = rng.uniform(-6, 6, (3, count, 2)), rng.uniform(-9, 9, (3, count))
    half = rng.uniform(0.3, 3.0, (count, 2))
    polygons = [
        [shapely.Polygon(geometry.box_corners_xy(geometry.pose_from_xyyaw(*middle[t, i], yaw[t, i]), *(2 * half[i])))
         for i in range(count)] for t in range(3)
    ]  # fmt: skip
    expected = {
        (i, j) for i in range(count) for j in range(i + 1, count)
        if any(polygons[t][i].intersects(polygons[t][j]) for t in range(3))
    }  # fmt: skip
    assert set(touching(Boxes(middle, yaw, half))) == expected
