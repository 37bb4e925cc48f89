"""How a driver takes speed and turn from poses, and when it believes what a client says of them."""

import math

import numpy as np
import pytest

from nurec_sim import geometry
from nurec_sim.serving.driver.motion import ego_states
from nurec_sim.serving.wire.driving_states import ReportedMotion, ReportedState

HEADING = 0.98  # rad, as on a recorded street


def told(t_s, along_m, motion=None, yaw=HEADING):
    x, y = 35.0 + along_m * math.cos(HEADING), 38.0 + along_m * math.sin(HEADING)
    return ReportedState(round(t_s * 1e6), geometry.pose_from_xyyaw(x, y, yaw), motion)


def dynamic(x, y=0.0, accel=0.0, yaw_rate=0.0):
    return ReportedMotion((x, y), accel, yaw_rate)


def newest(*states):
    return ego_states(states, [len(states) - 1])[0]


def test_a_velocity_in_the_local_frame_is_not_believed():
    local = dynamic(9.5 * math.cos(HEADING), 9.5 * math.sin(HEADING))
    # Poses 1 us apart, as AlpaSim sends them, say nothing: the step is the one of 50 ms.
    found = newest(told(1.0, 0.0, local), told(1.05, 0.475, local), told(1.050001, 0.475, local))
    assert found.speed_mps == pytest.approx(9.5, rel=1e-4)
    assert (found.accel_mps2, found.yaw_rate_radps, found.steering_rad) == pytest.approx((0.0, 0.0, 0.0))


@pytest.mark.parametrize("speed", [0.2, 1.0, 9.0, 30.0])
def test_zeros_are_believed_only_of_a_car_that_stands(speed):
    zeros = dynamic(0.0)
    assert newest(told(1.0, 0.0, zeros), told(1.1, 0.1 * speed, zeros)).speed_mps == pytest.approx(speed)
    assert newest(told(1.0, 0.0, zeros), told(1.1, 0.002, zeros)).speed_mps == 0.0


def test_a_dynamic_state_that_agrees_is_taken_as_it_is():
    # Braking by 6 m/s^2 from 8.6 to 8.0 m/s in 0.1 s: the poses only know the mean.
    found = newest(told(1.0, 0.0), told(1.1, 0.83, dynamic(8.0, 0.005, -6.0, 0.04)))
    assert (found.speed_mps, found.accel_mps2, found.yaw_rate_radps) == (8.0, -6.0, 0.04)
    assert found.steering_rad == pytest.approx(math.atan(0.04 * 2.85 / 8.0))


@pytest.mark.parametrize(
    ("motion", "speed", "yaw_rate"),
    [
        (dynamic(11.4, 0.0, 0.0, 0.0), 11.4, 0.0),  # limits: 10 m/s +- 1.6 m/s, 0 rad/s +- 0.05 rad/s
        (dynamic(11.7), 10.0, 0.0),
        (dynamic(10.0, 1.5), 10.0, 0.0),
        (dynamic(9.9, 1.7), 10.0, 0.0),
        (dynamic(9.9, 0.0, 0.0, 0.049), 9.9, 0.049),
        (dynamic(9.9, 0.0, 0.0, 0.06), 9.9, 0.0),
        (dynamic(0.0, 0.0, 0.0, 0.04), 10.0, 0.0),  # a velocity that is wrong discredits the rest
    ],
)
def test_the_slack(motion, speed, yaw_rate):
    found = newest(told(1.0, 0.0), told(1.1, 1.0, motion))
    assert found.speed_mps == pytest.approx(speed) and found.yaw_rate_radps == pytest.approx(yaw_rate, abs=1e-9)


def test_motion_on_an_arc_is_measured_along_it():
    radius, turn = 20.0, 0.5  # 10 m/s for a second: the chord is 1 % short and 14 degrees off the first heading
    poses = [geometry.pose_from_xyyaw(radius * math.sin(a), radius * (1 - math.cos(a)), a) for a in (0.0, turn)]
    found = newest(ReportedState(1_000_000, poses[0]), ReportedState(2_000_000, poses[1]))
    assert found.speed_mps == pytest.approx(2 * radius * math.sin(turn / 2), rel=1e-9)
    assert found.yaw_rate_radps == pytest.approx(turn)


def test_the_step_is_short_but_not_too_short_and_not_too_long():
    fast = [told(1 + 0.01 * i, 0.05 * i**2) for i in range(10)]  # 100 Hz, ever faster
    assert newest(*fast).speed_mps == pytest.approx((0.05 * 81 - 0.05 * 25) / 0.04)
    assert newest(told(1.0, 0.0), told(1.0099, 0.099)).speed_mps == pytest.approx(10.0)  # all there is
    assert newest(told(1.0, 0.0), told(1.0049, 0.049)).speed_mps == 0.0
    assert newest(told(1.0, 0.0), told(2.1, 11.0)).speed_mps == 0.0


def test_a_single_pose_has_the_size_of_the_velocity_that_is_told():
    assert newest(told(1.0, 0.0, dynamic(3.0, 4.0, 1.0, 0.1))).speed_mps == 5.0
    assert newest(told(1.0, 0.0)).speed_mps == 0.0


def test_states_of_the_past_are_measured_too_the_first_one_forth():
    zeros = dynamic(0.0)
    states = [told(1 + 0.1 * i, 0.9 * i, zeros) for i in range(4)]
    np.testing.assert_allclose([s.speed_mps for s in ego_states(states, range(4))], 9.0)


def test_fields_of_ours_are_never_doubted():
    exact = ReportedMotion((0.3, 0.0), 0.5, 0.1, 0.2, exact=True)
    found = newest(told(1.0, 0.0), told(1.1, 1.0, exact))
    assert (found.speed_mps, found.accel_mps2, found.yaw_rate_radps, found.steering_rad) == (0.3, 0.5, 0.1, 0.2)
