"""The kinematic bicycle against closed forms, and its limits."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nurec_sim.sim.vehicle import VehicleLimits, VehicleState, actuate, advance, step

LIMITS = VehicleLimits()


@settings(max_examples=60, deadline=None)
@given(
    steering=st.floats(-0.6, 0.6),
    accel=st.floats(-1.0, 4.0),
    speed=st.floats(3.0, 20.0),
    yaw=st.floats(-3.0, 3.0),
)
def test_hundred_steps_equal_one_arc(steering, accel, speed, yaw):
    state = VehicleState(1.0, -2.0, yaw, speed, accel, steering)
    for _ in range(100):
        state = advance(state, 0.01, LIMITS)
    distance = speed * 1.0 + accel / 2
    curvature = math.tan(steering) / LIMITS.wheelbase_m
    heading = yaw + curvature * distance
    if abs(curvature) > 1e-9:
        x = 1.0 + (math.sin(heading) - math.sin(yaw)) / curvature
        y = -2.0 - (math.cos(heading) - math.cos(yaw)) / curvature
    else:
        x, y = 1.0 + distance * math.cos(yaw), -2.0 + distance * math.sin(yaw)
    # The closed form itself loses digits as the curvature vanishes.
    assert np.allclose([state.x_m, state.y_m], [x, y], atol=1e-8 + 1e-14 / max(abs(curvature), 1e-9))
    assert math.isclose(state.yaw_rad, heading, abs_tol=1e-10)
    assert math.isclose(state.speed_mps, speed + accel, abs_tol=1e-10)


def test_braking_car_stops_where_the_closed_form_says_and_never_reverses():
    state = VehicleState(0.0, 0.0, 0.0, 10.0, -8.0, 0.0)
    for _ in range(200):
        state = advance(state, 0.01, LIMITS)
        assert state.speed_mps >= 0
    assert state.speed_mps == 0.0
    assert math.isclose(state.x_m, 10.0**2 / 16, abs_tol=1e-9)


def test_actuators_lag_and_limits():
    state = VehicleState(0.0, 0.0, 0.0, 10.0)
    soft = state
    for _ in range(10):
        soft = actuate(soft, 0.01, 1.0, 0.01, LIMITS)
    assert math.isclose(soft.accel_mps2, 1 - math.exp(-1.0), rel_tol=1e-9)
    assert math.isclose(soft.steering_rad, 0.01 * (1 - math.exp(-1.0)), rel_tol=1e-9)
    hard, steerings = state, []
    for _ in range(300):
        hard = actuate(hard, 2.0, 50.0, 0.01, LIMITS)
        steerings.append(hard.steering_rad)
    assert np.diff(steerings).max() <= 0.6 * 0.01 + 1e-12
    assert hard.steering_rad <= 0.6 and hard.accel_mps2 <= 4.0
    for _ in range(300):
        hard = actuate(hard, -2.0, -50.0, 0.01, LIMITS)
    assert hard.steering_rad >= -0.6 and hard.accel_mps2 >= -8.0
    assert hard.accel_mps2 == pytest.approx(-8.0, abs=1e-6)


def test_standing_car_stays_and_starts_again():
    state = VehicleState(3.0, 4.0, 0.5, 0.0)
    for _ in range(50):
        state = step(state, 0.3, -3.0, LIMITS)
    assert (state.x_m, state.y_m, state.yaw_rad, state.speed_mps, state.accel_mps2) == (3.0, 4.0, 0.5, 0.0, 0.0)
    for _ in range(100):
        state = step(state, 0.0, 2.0, LIMITS)
    assert state.speed_mps == pytest.approx(2.0 * (1 - 0.1), abs=0.02)
