"""Named situations: who touches whom, on which side, and what does not count."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from metrics_worlds import CAR_M, STEP_US, T0_US, rig, rollout, standing, straight_poses

from nurec_sim import geometry
from nurec_sim.metrics import find_contacts, score_rollout
from nurec_sim.metrics.boxes import BoxPath, body_boxes, heights_overlap, outline_gap, rectangle_distance

EGO_NOSE_M = 1.4 + 4.9 / 2


def scores(run, **options):
    return {series.name: series for series in score_rollout(run, None, **options)}


def sides(run, profile="strict"):
    return [(contact.actor, contact.side) for contact in find_contacts(run, profile)]


def test_parked_car_ahead_is_a_front_contact_at_fault():
    found = scores(run := rollout(straight_poses(40), {"parked": standing(40, 20.0, 0.3)}))
    assert sides(run) == [("parked", "front")]
    assert (
        found["collision_front"].value() == found["collision_any"].value() == found["collision_at_fault"].value() == 1
    )
    assert found["collision_lateral"].value() == found["collision_rear"].value() == 0
    contact = find_contacts(run)[0]
    # Both boxes lose 1 % of their length at each end before they are tested.
    gap_closes_m = 20.0 - CAR_M[0] / 2 * 0.98 - (1.4 + 4.9 / 2 * 0.98)
    assert contact.t_us == T0_US + STEP_US * int(np.ceil(gap_closes_m / 1.0))
    assert contact.rule == "front_or_lateral" and contact.at_fault
    assert contact.delta_v_mps == pytest.approx(5.0)  # 10 m/s against a standing car of equal mass
    assert found["collision_delta_v_mps"].value() == pytest.approx(5.0)


def test_rear_end_by_a_replayed_car_is_not_at_fault_even_when_it_drives_on_through():
    ego = straight_poses(60, speed_mps=2.0)
    faster = straight_poses(60, speed_mps=12.0, x0=-20.0, z=0.75)
    found = scores(run := rollout(ego, {"behind": faster}))
    assert sides(run) == [("behind", "rear")]
    assert found["collision_rear"].value() == 1 and found["collision_at_fault"].value() == 0
    assert found["collision_front"].value() == found["collision_lateral"].value() == 0
    # AlpaSim classifies every frame anew, so the same car also touches the front as it leaves.
    assert scores(run, profile="alpasim")["collision_front"].value() == 1


def test_side_swipe_is_lateral():
    along = straight_poses(30, y=4.0, x0=1.4, z=0.75)
    along[:, 1, 3] -= np.linspace(0, 3.0, 30)
    found = scores(run := rollout(straight_poses(30), {"bike": along}, sizes={"bike": (2.0, 0.8, 1.6)}))
    assert sides(run) == [("bike", "lateral")]
    assert found["collision_lateral"].value() == 1 and found["collision_at_fault"].value() == 1
    # AlpaSim looks at the whole overlap of a frame, which for a car as long as the ego meets the front bumper too.
    car = rollout(straight_poses(30), {"car": along})
    assert sides(car) == [("car", "lateral")] and sides(car, "alpasim") == [("car", "front")]


def test_two_contacts_at_once_keep_both_classes_unless_alpasim_is_wanted():
    ego = straight_poses(30)
    actors = {
        "ahead": standing(30, 1.4 + 20.0 + 4.6, 0.0),
        "behind": straight_poses(30, x0=1.4 - 4.75, speed_mps=10.0, z=0.75),
    }
    actors["behind"][15:, 0, 3] += 1.0
    actors["ahead"][:, 0, 3] = actors["behind"][15, 0, 3] + 9.0
    run = rollout(ego, actors)
    strict, alpasim = scores(run), scores(run, profile="alpasim")
    both = (strict["collision_front"].values == 1) & (strict["collision_rear"].values == 1)
    assert both.any()
    at = int(np.argmax(both))
    assert alpasim["collision_front"].values[at] == 0 and alpasim["collision_rear"].values[at] == 1, "the last one wins"
    assert alpasim["collision_any"].values[at] == 1


def test_bridge_above_is_no_obstacle():
    found = scores(rollout(straight_poses(40), {"train": standing(40, 20.0, 0.0, z=6.0)}))
    assert found["collision_any"].value() == 0
    assert not found["min_distance_to_obstacle_m"].valid.any()


def test_actor_that_appears_inside_the_ego_waits_until_it_was_apart_once():
    poses = standing(60, 21.4, 0.0)
    poses[:20] = np.nan  # appears when the ego stands over it
    run = rollout(straight_poses(60), {"ghost": poses})
    assert scores(run)["collision_any"].value() == 0
    assert scores(run, profile="alpasim")["collision_any"].value() == 1
    poses = poses.copy()
    poses[28:, 0, 3] = 50.0  # left behind, then again in front
    assert sides(rollout(straight_poses(60), {"ghost": poses})) == [("ghost", "front")]


def test_contact_brought_along_from_the_log_does_not_count():
    overlapping = straight_poses(30, x0=3.0, z=0.75)
    overlapping[:5, 0, 3] += 8.0
    assert scores(rollout(straight_poses(30), {"near": overlapping}, warm_up=8))["collision_any"].value() == 0
    assert scores(rollout(straight_poses(30), {"near": overlapping}))["collision_any"].value() == 1


def test_contact_during_warm_up_is_not_counted():
    poses = standing(40, 6.0, 0.0)
    poses[6:] = np.nan
    found = scores(rollout(straight_poses(40), {"early": poses, "far": standing(40, 90.0, 30.0)}, warm_up=10))
    assert found["collision_any"].value() == 0 and not found["collision_any"].valid[:10].any()
    assert found["eval_relevant"].values.tolist() == [0.0] * 10 + [1.0] * 30


def test_without_actors_nothing_is_claimed():
    found = scores(rollout(straight_poses(30)))
    for name in ("collision_any", "collision_front", "min_distance_to_obstacle_m", "ttc_s"):
        assert not found[name].valid.any() and np.isnan(found[name].value()), name
    assert scores(rollout(straight_poses(30)), actors_known=True)["collision_any"].value() == 0


def test_one_pose_actors_zero_area_boxes_and_yaw_wrap():
    once = np.full((40, 4, 4), np.nan)
    once[20] = geometry.pose_from_xyyaw(22.0, 0.0, np.pi - 1e-9, 0.75)
    point = standing(40, 25.0, 0.0, yaw=-np.pi)
    run = rollout(straight_poses(40), {"once": once, "point": point}, sizes={"point": (0.0, 0.0, 1.0)})
    assert ("point", "front") in sides(run)
    assert "once" not in dict(sides(run)), "it appeared inside the ego"
    # At 10 Hz the point is first seen 0.8 m behind the bumper; AlpaSim takes that frame for what it is.
    assert ("point", "front") not in sides(run, "alpasim")


def test_unknown_profile_and_misfitting_actors_are_refused():
    with pytest.raises(ValueError, match=r"unknown metric profile 'lenient'; have \['strict', 'alpasim'\]"):
        score_rollout(rollout(straight_poses(3)), None, profile="lenient")
    with pytest.raises(ValueError, match="actor 'short' has poses of shape .* the rollout has 9 states"):
        score_rollout(rollout(straight_poses(9), {"short": standing(4, 0, 0)}), None)


def test_gap_and_time_to_contact_count_down():
    found = scores(rollout(straight_poses(15), {"parked": standing(15, 40.0, 0.0)}))
    gap, ttc = found["min_distance_to_obstacle_m"], found["ttc_s"]
    assert gap.values[0] == pytest.approx(40.0 - 1.4 - 0.98 * (4.9 + CAR_M[0]) / 2)
    assert np.diff(gap.values) == pytest.approx(-np.ones(14))
    assert ttc.values[0] == 3.0 and ttc.values[-1] == pytest.approx(np.ceil(gap.values[-1]) / 10, abs=0.101)


def test_ego_body_is_off_the_rig_origin():
    body = body_boxes(straight_poses(1), rig().body)
    assert geometry.box_corners_xy(body.world_from_box, 4.9, 1.9)[0, :, 0].max() == pytest.approx(EGO_NOSE_M)


places = st.tuples(st.floats(-8, 8), st.floats(-8, 8), st.floats(-4, 4))
sizes = st.tuples(st.floats(0.5, 6), st.floats(0.3, 3))


@settings(max_examples=60, deadline=None)
@given(places, sizes, places, sizes)
def test_rectangle_distance_is_shapelys(place_a, size_a, place_b, size_b):
    a, b = geometry.pose_from_xyyaw(*place_a), geometry.pose_from_xyyaw(*place_b)
    polygons = [shapely.Polygon(geometry.box_corners_xy(p, *s)) for p, s in ((a, size_a), (b, size_b))]
    ours = rectangle_distance(a, size_a, b, size_b)
    assert ours == pytest.approx(shapely.distance(*polygons), abs=1e-9)
    assert ours == pytest.approx(rectangle_distance(b, size_b, a, size_a), abs=1e-12)


@settings(max_examples=30, deadline=None)
@given(places, places)
def test_outline_gap_is_that_of_eroded_and_dilated_polygons(place_a, place_b):
    boxes, polygons = [], []
    for place, size in ((place_a, (4.9, 1.9, 1.5)), (place_b, (0.8, 0.6, 1.7))):
        box = BoxPath(geometry.pose_from_xyyaw(*place)[None], size)
        shrunk = shapely.Polygon(geometry.box_corners_xy(box.world_from_box[0], *box.length_width_m))
        radius = 0.5 * min(box.length_width_m) / 2
        polygons.append(shrunk.buffer(-radius, join_style="mitre").buffer(radius, quad_segs=64))
        boxes.append(box)
    assert outline_gap(*boxes)[0] == pytest.approx(shapely.distance(*polygons), abs=1e-3)


def test_boxes_meet_in_height_up_to_half_of_both_heights():
    """A 1.5 m and a 2.5 m box: centres 2 m apart just touch."""
    lower = BoxPath(standing(2, 0.0, 0.0, z=0.75), (4.0, 2.0, 1.5))
    above = standing(2, 0.0, 0.0)
    above[:, 2, 3] = 0.75 + np.array([1.95, 2.05])
    assert heights_overlap(lower, BoxPath(above, (4.0, 2.0, 2.5))).tolist() == [True, False]
