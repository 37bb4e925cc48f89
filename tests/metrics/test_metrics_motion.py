"""Progress, comfort, feasibility and plans on hand-made motions with known answers."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from metrics_worlds import STEP_US, T0_US, failed_rollout, rollout, standing, straight_poses

from nurec_sim import geometry
from nurec_sim.metrics import METRICS, score_rollout
from nurec_sim.metrics.comfort import infeasible_steps
from nurec_sim.types import Plan


def scores(run):
    return {series.name: series for series in score_rollout(run, None)}


def circle(count, radius_m, speed_mps):
    angle = np.arange(count) * 0.1 * speed_mps / radius_m
    xy = np.column_stack([np.sin(angle), 1 - np.cos(angle)]) * radius_m
    return np.stack([geometry.pose_from_xyyaw(*p, a) for p, a in zip(xy, angle, strict=True)])


def test_half_the_speed_makes_half_the_progress():
    found = scores(rollout(straight_poses(41, 5.0), recorded=straight_poses(41, 10.0)))
    assert found["progress"].value() == pytest.approx(0.5)
    assert found["progress_rel"].value() == pytest.approx(0.5)
    assert found["dist_to_gt_trajectory"].value() == pytest.approx(0.0, abs=1e-9)
    assert found["dist_to_gt_location"].value() == pytest.approx(20.0)
    assert found["dist_traveled_m"].value() == pytest.approx(20.0)
    assert found["gt_dist_traveled_m"].value() == pytest.approx(40.0)


def test_distance_counts_from_take_over():
    found = scores(rollout(straight_poses(41), warm_up=11))
    assert found["dist_traveled_m"].value() == pytest.approx(29.0)
    assert not found["progress"].valid[:11].any()


def test_offset_is_the_distance_to_the_path():
    found = scores(rollout(straight_poses(30, y=2.5), recorded=straight_poses(40)))
    assert found["dist_to_gt_trajectory"].value() == pytest.approx(2.5)


def test_a_route_that_meets_itself_is_not_jumped_along():
    loop = np.concatenate([circle(130, 20.0, 10.0)])  # more than one round of 126 m
    found = scores(rollout(loop))
    assert np.all(np.diff(found["progress"].values) > 0)
    assert found["progress"].value() == pytest.approx(1.0, abs=0.01)


def test_past_the_end_of_the_log_there_is_no_recorded_place():
    found = scores(rollout(straight_poses(30), recorded=straight_poses(20)))
    assert found["dist_to_gt_location"].valid.tolist() == [True] * 20 + [False] * 10


def test_braking_is_the_deceleration_of_states_and_never_negative():
    states = tuple(
        dataclasses.replace(state, accel_mps2=accel)
        for state, accel in zip(rollout(straight_poses(4)).states, (1.0, 0.0, -3.5, -0.5), strict=True)
    )
    found = scores(rollout(straight_poses(4), states=states))["braking_mps2"]
    assert found.values.tolist() == [0.0, 0.0, 3.5, 0.5] and found.value() == 3.5


def test_a_standing_recording_has_no_progress():
    found = scores(rollout(standing(20, 1, 1, z=0.0)))
    assert not found["progress"].valid.any() and found["dist_to_gt_trajectory"].value() == 0


def test_steady_driving_is_comfortable_and_feasible():
    found = scores(rollout(circle(60, 50.0, 10.0)))
    assert found["comfort"].value() == 1 and found["kinematic_infeasible"].value() == 0
    assert found["lat_accel_mps2"].value() == pytest.approx(2.0, abs=0.05)
    assert found["yaw_rate_radps"].value() == pytest.approx(0.2, abs=0.005)
    assert found["lon_accel_mps2"].value() == pytest.approx(0.0, abs=0.05)


def test_hard_braking_is_uncomfortable_by_its_size():
    speed = np.maximum(12 - 0.6 * np.arange(20), 0)  # 6 m/s2
    x = np.concatenate([[0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.1)])
    found = scores(rollout(np.stack([geometry.pose_from_xyyaw(p, 0, 0) for p in x])))
    assert found["comfort"].value() == 0
    assert found["lon_accel_mps2"].value() == pytest.approx(6.0, abs=0.2)


def test_too_few_or_uneven_states_have_no_comfort():
    few = scores(rollout(straight_poses(7)))
    assert not few["comfort"].valid.any() and not few["jerk_mps3"].valid.any()
    run = rollout(straight_poses(20))
    late = dataclasses.replace(run.states[-1], t_us=run.states[-1].t_us + 50_000)
    assert not scores(dataclasses.replace(run, states=(*run.states[:-1], late)))["comfort"].valid.any()


def test_a_jump_and_a_spin_are_infeasible():
    jump = straight_poses(20)
    jump[10:, 0, 3] += 3.0
    assert scores(rollout(jump))["kinematic_infeasible"].value() == 1
    assert scores(rollout(circle(20, 2.0, 3.0)))["kinematic_infeasible"].value() == 1


@settings(max_examples=40, deadline=None)
@given(st.floats(4.0, 200.0), st.floats(0.0, 25.0))
def test_steady_circles_wider_than_the_tightest_turn_are_feasible(radius, speed):
    poses = circle(12, radius, speed)
    assert not infeasible_steps(STEP_US * np.arange(12), poses[:, :2, 3], geometry.yaw_of(poses)).any()


def test_plans_that_come_true_have_no_error_and_do_not_move():
    found = scores(rollout(straight_poses(40)))
    assert found["plan_deviation"].value() == pytest.approx(0, abs=1e-9)
    assert found["tracking_error_m"].value() == pytest.approx(0, abs=1e-9)
    assert found["plan_infeasible"].value() == 0
    assert not found["plan_deviation"].valid[0], "the first plan has none before it"


def test_plans_that_jump_deviate_by_the_weighted_jump():
    run = rollout(straight_poses(40))
    times = [(made, plan) for made, plan in run.plans]
    made, plan = times[1]
    aside = plan.pose + np.array([0.0, 1.5, 0.0])
    times[1] = (made, Plan(plan.t_us, aside))
    found = scores(dataclasses.replace(run, plans=tuple(times)))
    assert found["plan_deviation"].values[1] == pytest.approx(1.5)
    assert found["tracking_error_m"].values[1] == pytest.approx(1.5)
    short = Plan(plan.t_us[:4], plan.pose[:4])
    found = scores(dataclasses.replace(run, plans=(run.plans[0], (made, short))))
    assert not found["plan_deviation"].valid.any(), "fewer than 5 shared times"


def test_every_metric_is_there_for_every_rollout_even_one_without_states():
    for run in (rollout(straight_poses(20)), rollout(straight_poses(1)), failed_rollout()):
        series = score_rollout(run, None)
        assert [one.name for one in series] == list(METRICS)
        for one in series:
            assert len(one.t_us) == len(one.values) == len(one.valid) > 0
            assert np.isfinite(one.values[one.valid]).all() and np.isnan(one.values[~one.valid]).all()
    assert not any(one.valid.any() for one in series if one.name != "eval_relevant")
    assert series[0].t_us[0] == T0_US


def moving(accel_mps2, speed_mps, yaw_rad):
    """A rollout with given signals, one value per 0.1 s; places don't matter to comfort."""
    count = len(accel_mps2)
    run = rollout(np.stack([geometry.pose_from_xyyaw(0.1 * i, 0, yaw_rad[i]) for i in range(count)]))
    states = [
        dataclasses.replace(state, accel_mps2=float(a), speed_mps=float(v))
        for state, a, v in zip(run.states, accel_mps2, speed_mps, strict=True)
    ]
    return dataclasses.replace(run, states=tuple(states))


def test_jerk_is_the_rate_of_the_length_of_the_acceleration():
    """3 m/s2 ahead and 5 t to the side: the length sqrt(9 + 25 t^2) grows by 25 t / length, 4 m/s3 at t = 0.8 s.

    A window of eight states has its middle half a step late, so the turn begins half a step late too.
    """
    t = 0.1 * np.arange(21)
    found = scores(moving(np.full(21, 3.0), np.full(21, 10.0), 0.25 * (t - 0.05) ** 2))
    assert found["lat_accel_mps2"].values[8] == pytest.approx(4.0, rel=1e-6)
    assert found["jerk_mps3"].values[8] == pytest.approx(4.0, rel=0.02)


def test_accelerations_are_smoothed_by_a_parabola_over_eight_states():
    """A single 2 m/s2: the least-squares parabola through 8 places +-0.5 ... +-3.5 gives a neighbour of its middle
    (388.5 - 42 / 4) / 1344 of it, from the sums 8, 42 and 388.5 of x^0, x^2 and x^4."""
    accel = np.zeros(21)
    accel[10] = 2.0
    found = scores(moving(accel, np.full(21, 10.0), np.zeros(21)))
    assert np.nanmax(found["lon_accel_mps2"].values) == pytest.approx(2.0 * 378 / 1344)
