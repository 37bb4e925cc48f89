"""Messages of the egodriver interface: what goes in comes out, seen from above, also on a slope."""

import math

import numpy as np
import pytest
from driving_calls import NOW_US, ego_state, like_alpasim
from hypothesis import given, settings
from hypothesis import strategies as st

from nurec_sim import geometry
from nurec_sim.errors import RequestError
from nurec_sim.serving.driver.motion import ego_states
from nurec_sim.serving.wire import driving, driving_paths, driving_states, egodriver
from nurec_sim.serving.wire.driving_states import read_states
from nurec_sim.types import ActorState, EgoState, Needs, Plan

PROPERTY = settings(max_examples=60, deadline=None)
ANGLES = st.floats(-math.pi, math.pi, exclude_max=True)
TILTS = st.floats(-0.3, 0.3)
METRES = st.floats(-80, 80)
PADDING = {"x": math.nan, "y": math.nan, "z": math.nan}
"""What AlpaSim fills routes up with."""


def turned(roll, pitch, yaw):
    around_x = np.array([[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]])
    around_y = np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]])
    return geometry.rotation_from_yaw(yaw) @ around_y @ around_x


@st.composite
def egos(draw, t_us=NOW_US):
    rotation = turned(draw(TILTS), draw(TILTS), draw(ANGLES))
    place = np.array([draw(METRES), draw(METRES), draw(st.floats(-5, 5))])
    return EgoState(t_us, geometry.pose(rotation, place), 7.5, -0.25, 0.125, 0.0625)


POSES2 = st.lists(st.tuples(METRES, METRES, ANGLES), min_size=1, max_size=6).map(np.array)


def angle_between(a, b):
    return np.abs(geometry.wrap_angle(np.asarray(a) - b)).max()


def written_plan(ego, xyyaw):
    """A plan of a pose every 0.1 s, and the reply that holds it."""
    plan = Plan(NOW_US + 100_000 * np.arange(1, len(xyyaw) + 1), xyyaw)
    message = egodriver.DriveResponse()
    driving_paths.write_plan(ego, plan, message)
    return plan, message


@PROPERTY
@given(egos(), POSES2)
def test_plans_travel_exactly_and_nearly_without_our_additions(ego, xyyaw):
    plan, message = written_plan(ego, xyyaw)
    found = driving_paths.read_plan(ego, message)
    assert found.t_us.tolist() == plan.t_us.tolist() and np.array_equal(found.pose, plan.pose)
    rounded = driving_paths.read_plan(ego, like_alpasim(message))
    np.testing.assert_allclose(rounded.pose[:, :2], xyyaw[:, :2], atol=1e-4)
    assert angle_between(rounded.pose[:, 2], xyyaw[:, 2]) < 1e-5


@PROPERTY
@given(egos(), POSES2)
def test_plans_lie_on_the_plane_of_the_car_and_start_at_it(ego, xyyaw):
    _, message = written_plan(ego, xyyaw)
    poses = np.array([np.array(p.pose.exact).reshape(4, 4) for p in message.trajectory.poses])
    np.testing.assert_allclose(poses[0], ego.world_from_rig, atol=1e-9)
    inside = geometry.transform_points(geometry.inverse(ego.world_from_rig), poses[:, :3, 3])
    np.testing.assert_allclose(inside[:, 2], 0.0, atol=1e-9)
    # From above, heading and place in the world are those of the car, moved by the plan.
    c, s = math.cos(geometry.yaw_of(ego.world_from_rig)), math.sin(geometry.yaw_of(ego.world_from_rig))
    x, y, yaw = xyyaw.T
    there = ego.world_from_rig[:2, 3] + np.column_stack([c * x - s * y, s * x + c * y])
    np.testing.assert_allclose(poses[1:, :2, 3], there, atol=1e-9)
    assert angle_between(geometry.yaw_of(poses[1:]), geometry.yaw_of(ego.world_from_rig) + yaw) < 1e-9


@PROPERTY
@given(egos(), POSES2)
def test_routes_and_recorded_futures_travel_exactly_and_nearly_without_our_additions(ego, xyyaw):
    route, recorded = egodriver.Route(), egodriver.GroundTruth()
    driving_paths.write_route(ego, xyyaw[:, :2], np.arange(len(xyyaw)) / 3, route)
    times = NOW_US + 100_000 * np.arange(1, len(xyyaw) + 1)
    driving_paths.write_recorded(ego, times, xyyaw, recorded)
    found = driving_paths.read_route(route)
    assert np.array_equal(found.seen_from_above(ego), xyyaw[:, :2])
    assert np.array_equal(found.speed_mps, np.arange(len(xyyaw)) / 3)
    future = driving_paths.read_recorded(recorded)
    assert np.array_equal(future.seen_from_above(ego), xyyaw) and np.array_equal(future.pose_t_us, times)
    bare = driving_paths.read_route(like_alpasim(route))
    assert bare.speed_mps is None and bare.exact_xy is None
    np.testing.assert_allclose(bare.seen_from_above(ego), xyyaw[:, :2], atol=1e-4)
    future = driving_paths.read_recorded(like_alpasim(recorded))
    np.testing.assert_allclose(future.seen_from_above(ego)[:, :2], xyyaw[:, :2], atol=1e-4)
    assert angle_between(future.seen_from_above(ego)[:, 2], xyyaw[:, 2]) < 1e-5


@PROPERTY
@given(egos(), egos(t_us=NOW_US + 300_000), POSES2)
def test_paths_of_another_time_are_moved_to_now(then, now, xyyaw):
    found = driving_paths.moved(xyyaw, then, now)
    for before, after in zip(xyyaw, found, strict=True):
        there = driving_paths.level_frame(then.world_from_rig) @ geometry.pose_from_xyyaw(*before)
        same = driving_paths.level_frame(now.world_from_rig) @ geometry.pose_from_xyyaw(*after)
        np.testing.assert_allclose(there[:2], same[:2], atol=1e-9)
    assert driving_paths.moved(xyyaw, now, now) is xyyaw


@PROPERTY
@given(st.lists(egos(), min_size=1, max_size=3))
def test_states_travel_exactly(states):
    states = [EgoState(NOW_US + i, s.world_from_rig, s.speed_mps, s.accel_mps2) for i, s in enumerate(states)]
    message = egodriver.RolloutEgoTrajectory()
    driving_states.write_states(states, message)
    told = read_states(message)
    for one, two in zip(states, ego_states(told, range(len(told))), strict=True):
        assert np.array_equal(one.world_from_rig, two.world_from_rig)
        assert (one.t_us, one.speed_mps, one.accel_mps2) == (two.t_us, two.speed_mps, two.accel_mps2)
        assert (one.yaw_rate_radps, one.steering_rad) == (two.yaw_rate_radps, two.steering_rad)


@pytest.mark.parametrize("given", [20, 3, 1, 0])
def test_padding_at_the_end_of_a_route_is_cut(given):
    route = egodriver.Route(timestamp_us=NOW_US)
    for i in range(given):
        route.waypoints.add(x=4.0 * i, y=1.0)
    for _ in range(20 - given):
        route.waypoints.add(**PADDING)
    seen = driving_paths.read_route(route).seen_from_above(ego_state())
    assert seen.tolist() == [[4.0 * i, 1.0] for i in range(given)]


def test_states_without_our_additions_keep_their_motion_in_float32():
    message = egodriver.RolloutEgoTrajectory()
    driving_states.write_states([ego_state(speed=5.1)], message)
    (found,) = read_states(like_alpasim(message))
    assert found.motion.velocity_mps == (np.float32(5.1), 0.0) and not found.motion.exact
    assert (found.motion.accel_mps2, found.motion.yaw_rate_radps) == (np.float32(0.3), np.float32(0.1))
    message.dynamic_states[0].ClearField("linear_velocity")
    assert read_states(message)[0].motion is None


def test_fewer_dynamic_states_belong_to_the_last_poses():
    message = egodriver.RolloutEgoTrajectory()
    driving_states.write_states([ego_state(NOW_US - 100_000, speed=3.0), ego_state(NOW_US, speed=4.0)], message)
    like_alpasim(message)
    del message.dynamic_states[0]
    first, second = read_states(message)
    assert first.motion is None and second.motion.velocity_mps == (4.0, 0.0)


def test_actors_and_descriptions_travel_exactly():
    pose = geometry.pose(turned(0.02, 0.1, 1.0), np.array([12.3, -4.5, 0.7]))
    actor = ActorState("a", "automobile", (4.4, 1.8, 1.6), pose, np.array([3.3, -0.1]))
    message = egodriver.RolloutActors(timestamp_us=NOW_US)
    driving.write_actors([actor], message)
    (found,) = driving.read_actors(egodriver.RolloutActors.FromString(message.SerializeToString()))
    assert (found.id, found.label, found.size_m) == (actor.id, actor.label, actor.size_m)
    assert np.array_equal(found.rig_from_box, pose) and np.array_equal(found.velocity_mps, actor.velocity_mps)
    needs, described = Needs(("front", "left"), ("any",), 123, True), egodriver.PolicyDescription()
    driving.write_policy("it", needs, described)
    assert driving.read_policy(described) == ("it", needs)


def test_a_car_on_its_side_is_refused():
    ego = EgoState(NOW_US, geometry.pose(turned(1.5, 0.0, 0.0), np.zeros(3)), 1.0)
    route = egodriver.Route()
    route.waypoints.add(x=1.0)
    with pytest.raises(RequestError, match="the ego must stand upright; the cosine of its tilt is 0.0707"):
        driving_paths.read_route(route).seen_from_above(ego)


@pytest.mark.parametrize(
    ("read", "kind", "values", "text"),
    [
        (driving_paths.read_route, "Route", {"timestamp_us": 2**63}, "route.timestamp_us must be microseconds"),
        (driving_paths.read_route, "Route", {"waypoints": [{"x": math.inf}]}, r"waypoints\[0\] must lie within"),
        (driving_paths.read_route, "Route", {"waypoints": [PADDING, {"x": 1.0}]}, "only at the end of a route"),
        (driving_paths.read_route, "Route", {"waypoints": [{"x": 1.0, "z": math.nan}]}, r"waypoints\[0\] must lie"),
        (driving_paths.read_route, "Route", {"waypoints": [{"x": 1.0, "y": math.nan}]}, r"waypoints\[0\] must lie"),
        (driving_paths.read_route, "Route", {"waypoints": [PADDING], "exact_xy": [1.0, 2.0]}, "for each of 0 poses"),
        (driving_paths.read_route, "Route", {"exact_xy": [1.0]}, "route.exact_xy must have 2 values"),
        (read_states, "RolloutEgoTrajectory", {"dynamic_states": [{}]}, "dynamic_states must be at most one"),
        (read_states, "RolloutEgoTrajectory", {"trajectory": {"poses": [{}]}}, "must have a unit quaternion"),
        (
            driving.read_encoded_image,
            "RolloutCameraImage",
            {"camera_image": {"frame_start_us": 5}},
            "must not end before",
        ),
        (driving.read_actors, "RolloutActors", {"actors": [{"rig_from_box": {"quat": {"w": 1}}}]}, "needs 3 size_m"),
    ],
)
def test_what_makes_no_sense_is_named(read, kind, values, text):
    with pytest.raises(RequestError, match=text):
        read(getattr(egodriver, kind)(**values))
