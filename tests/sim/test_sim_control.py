"""What the controllers command, tick by tick, against values worked out by hand."""

import math

import numpy as np
import pytest

from nurec_sim.errors import PlanError
from nurec_sim.sim.control import PlannedPath, perfect, pursuit_pi
from nurec_sim.sim.plans import check_plan
from nurec_sim.sim.vehicle import VehicleLimits, VehicleState
from nurec_sim.types import Plan

NOW_US = 3_000_000
LIMITS = VehicleLimits()
LAG = 1 - math.exp(-0.1)
"""Share of a command that a lag of 0.1 s lets through within a tick of 10 ms."""


def path(pose, speed_mps=0.0, step_us=1_000_000):
    """A plan from the origin with poses (x, y, yaw) one step apart."""
    pose = np.asarray(pose, float)
    plan = Plan(NOW_US + step_us * np.arange(1, len(pose) + 1), pose)
    return PlannedPath(plan, VehicleState(0.0, 0.0, 0.0, speed_mps), NOW_US)


def along(*x):
    return path([(value, 0.0, 0.0) for value in x])


@pytest.mark.parametrize(("speed_mps", "lookahead_m"), [(4.0, 3.0), (10.0, 5.0), (30.0, 12.0)])
def test_steering_aims_at_the_plan_half_a_second_ahead_within_3_to_12_m(speed_mps, lookahead_m):
    """A plan that leads away at an angle: the arc to its point at distance d has the curvature 2 sin(angle) / d."""
    angle = 0.02
    slanted = path([(d * math.cos(angle), d * math.sin(angle), angle) for d in (10.0, 20.0, 30.0)])
    after = pursuit_pi(slanted, VehicleState(0.0, 0.0, 0.0, speed_mps), 0, 0.0, LIMITS)
    assert after.steering_rad == pytest.approx(LAG * math.atan(LIMITS.wheelbase_m * 2 * math.sin(angle) / lookahead_m))


def test_who_is_slower_than_the_plan_and_behind_it_makes_up_for_both():
    """10 m/s wanted; at 9.6 m/s and 0.2 m behind that is 2.5 * 0.4 + 2 * 0.2 = 1.4 m/s2."""
    after = pursuit_pi(along(10, 20, 30, 40), VehicleState(19.8, 0.0, 0.0, 9.6), 2_000_000, 19.8, LIMITS)
    assert after.accel_mps2 == pytest.approx(1.4 * LAG)


def test_a_plan_that_gains_speed_is_followed_before_it_is_behind():
    """Speeds 2 and 4 m/s at the middles of the second and the third second: 2 m/s2."""
    after = pursuit_pi(along(1, 3, 7), VehicleState(2.0, 0.0, 0.0, 3.0), 2_000_000, 3.0, LIMITS)
    assert after.accel_mps2 == pytest.approx(2.0 * LAG)


def test_the_brake_stays_on_at_a_standstill():
    """A car that creeps although its plan stands would be asked for -2.5 * 0.1 m/s2 alone."""
    after = pursuit_pi(along(0, 0, 0), VehicleState(0.0, 0.0, 0.0, 0.1), 1_000_000, 0.0, LIMITS)
    assert after.accel_mps2 == pytest.approx(-2.0 * LAG)
    behind = pursuit_pi(along(0, 0, 0), VehicleState(-1.0, 0.0, 0.0, 0.1), 1_000_000, -1.0, LIMITS)
    assert behind.accel_mps2 == pytest.approx((2.0 * 1.0 - 2.5 * 0.1) * LAG)


def test_the_perfect_car_has_the_place_speed_and_acceleration_of_its_plan():
    """Speeds 2 and 4 m/s at the middles of the second and the third second, so 3 m/s and 2 m/s2 after two."""
    after = perfect(along(1, 3, 7), VehicleState(2.98, 0.0, 0.0, 2.98), 1_990_000, 0.0, LIMITS)
    assert (after.x_m, after.speed_mps, after.accel_mps2) == pytest.approx((3.0, 3.0, 2.0))
    assert after.steering_rad == 0.0


def test_the_perfect_car_steers_as_its_turn_needs():
    """0.2 rad/s at 5 m/s: tan(steering) / wheelbase is the curvature 0.04 / m."""
    turning = path([(5.0, 0.0, 0.2), (10.0, 0.0, 0.4), (15.0, 0.0, 0.6)])
    after = perfect(turning, VehicleState(7.45, 0.0, 0.298, 5.0), 1_490_000, 0.0, LIMITS)
    assert after.yaw_rad == pytest.approx(0.3)
    assert after.steering_rad == pytest.approx(math.atan(0.04 * LIMITS.wheelbase_m))


def test_stations_grow_by_steps_ahead_only():
    """The third pose lies half a metre behind the second, and the way goes on from there."""
    found = along(1.0, 2.0, 1.5, 3.0)
    assert [found.station_at(t_s) for t_s in (1.0, 2.0, 3.0, 4.0)] == pytest.approx([1.0, 2.0, 2.0, 3.5])
    assert [found.speed_at(t_s) for t_s in (1.5, 2.5, 3.5)] == pytest.approx([1.0, 0.0, 1.5])


def test_a_car_ahead_of_its_schedule_has_its_first_pose_behind_it():
    assert [along(-0.5, 1.0).station_at(t_s) for t_s in (0.5, 1.0, 2.0)] == pytest.approx([-0.25, -0.5, 1.0])


def test_a_plan_goes_straight_on_beyond_its_end():
    found = path([(3.0, 0.0, 0.0), (5.0, 0.0, 0.5)])
    assert found.point_at(4.0) == pytest.approx((4.0, 0.0))
    assert found.point_at(7.0) == pytest.approx((5 + 2 * math.cos(0.5), 2 * math.sin(0.5)))


def test_a_plan_reaches_two_and_a_half_seconds_ahead_or_is_refused():
    poses = np.zeros((2, 3))
    assert len(check_plan(Plan(NOW_US + np.array([1_000_000, 2_500_000]), poses), NOW_US).t_us) == 2
    with pytest.raises(PlanError, match=r"the plan ends 2\.490 s ahead; it must reach at least 2\.5 s"):
        check_plan(Plan(NOW_US + np.array([1_000_000, 2_490_000]), poses), NOW_US)
