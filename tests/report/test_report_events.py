"""Reasons of events on drives by hand, and which rollout deserves the first look."""

import dataclasses

import numpy as np
import pytest
from metrics_worlds import rollout, standing, straight_poses
from test_report import street_report

from nurec_sim import geometry
from nurec_sim.metrics import find_contacts
from nurec_sim.report.events import farthest_apart, first_offroad_us, grouped, happenings, verdict
from nurec_sim.report.reasons import beside_path_m, contact_reason, offroad_reason
from nurec_sim.types import Plan


def arc(count: int, radius_m: float = 20.0, speed: float = 10.0) -> np.ndarray:
    """A left turn at 10 Hz after 10 m straight ahead."""
    poses = []
    for along in speed * 0.1 * np.arange(count):
        angle = max(0.0, along - 10) / radius_m
        x, y = min(along, 10) + radius_m * np.sin(angle), radius_m * (1 - np.cos(angle))
        poses.append(geometry.pose_from_xyyaw(x, y, angle))
    return np.stack(poses)


def test_a_plan_that_misses_the_turn_is_the_reason():
    """Plans of ``rollout`` are straight; the recording turns left by 15 m / 20 m in the 25 m after the first one."""
    run = rollout(straight_poses(30), recorded=arc(60))
    assert offroad_reason(run, int(run.t_us[5])) == "the recorded path turns left by 43°, the plan stayed straight"
    assert beside_path_m(run, int(run.t_us[20])) < -2, "on the right of the recorded path"


def test_a_plan_that_turns_where_the_recording_does_not_is_the_reason():
    steps = np.arange(1, 51)
    heading = np.minimum(0.02 * steps, 0.3)
    turn = Plan(2_000_000 + 100_000 * steps, np.column_stack([1.0 * steps, 0 * steps, heading]))
    run = dataclasses.replace(rollout(straight_poses(30)), plans=((2_000_000, turn),))
    assert offroad_reason(run, int(run.t_us[12])) == "the plan turned left by 17° where the recorded path goes straight"


def test_a_car_beside_or_on_the_path_is_told_apart():
    aside = rollout(straight_poses(30, y=-1.2), recorded=straight_poses(60))
    assert offroad_reason(aside, int(aside.t_us[12])) == "the car had drifted 1.2 m to the right of the recorded path"
    on = rollout(straight_poses(30), recorded=straight_poses(60))
    assert "doubt the road's labels" in offroad_reason(on, int(on.t_us[12]))


def test_reasons_of_contacts():
    ahead = rollout(straight_poses(30), {"parked": standing(30, 20.0, 0.0)})
    (front,) = find_contacts(ahead)
    assert contact_reason(ahead, front) == "the plan did not brake (+0.0 m/s²) at 10.0 m/s"
    chased = rollout(straight_poses(30, speed_mps=2.0), {"late": straight_poses(30, 12.0, x0=-12, z=0.75)},
                     recorded=straight_poses(30, speed_mps=12.0))  # fmt: skip
    rear = find_contacts(chased)[0]
    assert rear.side == "rear"
    assert contact_reason(chased, rear) == (
        "the actor repeats its recording and ran into the back: the car drove 2.0 m/s, the recorded one 12.0 m/s at "
        "that time"
    )  # fmt: skip


@pytest.fixture(scope="module")
def entries():
    return {entry.rollout.policy: entry for entry in street_report().rollouts}


def test_events_have_times_texts_and_reasons(entries):
    (event,) = happenings(entries["drifter"])
    assert event.text == "off-road" and event.t_us == first_offroad_us(entries["drifter"])
    assert "beside the recorded path, so what sensors showed there was extrapolated" in event.reason
    assert verdict(entries["drifter"]) == ("off-road",) and verdict(entries["<b>broken</b>"]) == ("failed",)


def test_different_verdicts_come_first_then_distance_then_the_worst(entries):
    """The broken one is worst, but is the same in both; the drifter ends differently."""

    def twin(entry, **changes):
        return dataclasses.replace(entry, rollout=dataclasses.replace(entry.rollout, reconstruction="dense", **changes))

    good, drifter, broken = entries["route_follower"], entries["drifter"], entries["<b>broken</b>"]
    calm = dataclasses.replace(good, rollout=dataclasses.replace(good.rollout, policy="drifter"), contacts=())
    both = [good, twin(good), broken, twin(broken), drifter, twin(calm)]
    groups = grouped(both, ("lift", "dense"))
    assert [group[0].rollout.policy for group in groups] == ["drifter", "<b>broken</b>", "route_follower"]
    assert [entry.rollout.reconstruction for entry in groups[0]] == ["lift", "dense"]
    apart, at_s = farthest_apart(groups[0])
    assert apart == pytest.approx(10.2, abs=0.3) and at_s == pytest.approx(7.9)
    assert farthest_apart(groups[2]) == (0.0, 0.0)
    assert [len(group) for group in grouped(both, ())] == [1] * 6
