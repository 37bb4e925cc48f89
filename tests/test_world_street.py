import dataclasses

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.world import RoadLine, RoadPiece, StreetPlan, street_plan
from nurec_sim.world.plan import StreetRoad as Road

BODY_CENTRE_M, BODY_SIZE_M = 1.4, (4.9, 1.9)


def footprint(world_from_rig):
    return box(geometry.pose(world_from_rig[:3, :3], world_from_rig[:3, 3] + BODY_CENTRE_M * world_from_rig[:3, 0]),
               *BODY_SIZE_M)  # fmt: skip


def box(world_from_box, length_m, width_m):
    return shapely.Polygon(geometry.box_corners_xy(world_from_box, length_m, width_m))


def touched(plan, footprints, t_us):
    """Ids of the actors that the ego's footprints touch, one time each."""
    hits = []
    for track in plan.tracks():
        poses = track.path.at(t_us)
        near = np.linalg.norm(poses[:, :2, 3] - np.array([f.centroid.coords[0] for f in footprints]), axis=1) < 9
        hits += [track.id for i in np.flatnonzero(near) if footprints[i].intersects(box(poses[i], *track.size_m[:2]))]
    return set(hits)


@pytest.fixture(scope="module")
def plan():
    return street_plan(7)


def test_same_seed_same_plan_to_the_byte(plan):
    assert street_plan(7).to_json() == plan.to_json()
    assert street_plan(8).to_json() != plan.to_json()


def test_plan_survives_json(plan):
    assert StreetPlan.from_json(plan.to_json()) == plan


def test_broken_plans_are_refused_with_the_field(plan):
    with pytest.raises(
        ClipError, match=r"not a street plan: road\.lane_widht_m: Unexpected keyword.*fields seed, span_us"
    ):
        StreetPlan.from_json(plan.to_json().replace('"lane_width_m"', '"lane_widht_m"'))
    with pytest.raises(ClipError, match=r"not a street plan: road\.pieces\.0\.length_m: .*number"):
        StreetPlan.from_json(plan.to_json().replace('"length_m": ', '"length_m": "long", "was": ', 1))
    with pytest.raises(ClipError, match="not a street plan: the text itself: Invalid JSON"):
        StreetPlan.from_json(plan.to_json()[:-30])


@pytest.mark.parametrize("seed, seconds", [(-1, 12.0), (1, 0.5), (1, 21.0)])
def test_impossible_streets_are_refused(seed, seconds):
    with pytest.raises(ValueError, match="a street needs a seed >= 0 and 1..20 seconds, got seed"):
        street_plan(seed, seconds)


@pytest.mark.parametrize("seed", range(5))
def test_recorded_drive_touches_nothing_and_stays_on_the_road(seed):
    plan = street_plan(seed)
    ego = plan.ego_trajectory()
    footprints = [footprint(pose) for pose in ego.world_from_body]
    road = shapely.Polygon(RoadLine(plan.road).road_map().drivable[0][0])
    assert all(road.contains(f) for f in footprints)
    assert touched(plan, footprints, ego.t_us) == set()
    lead = next(track for track in plan.tracks() if track.id == "lead")
    gap = [f.distance(box(pose, *lead.size_m[:2])) for f, pose in zip(footprints, lead.path.at(ego.t_us), strict=True)]
    assert min(gap) > 6.0


@pytest.mark.parametrize("seed", range(5))
def test_straight_driver_leaves_the_road_or_crashes_and_a_blind_follower_hits_the_lead(seed):
    plan = street_plan(seed)
    ego, line = plan.ego_trajectory(), RoadLine(plan.road)
    road = shapely.Polygon(line.road_map().drivable[0][0])
    start, seconds = ego.world_from_body[0], (ego.t_us - ego.t_us[0]) * 1e-6
    speed = np.linalg.norm(ego.position_m[1] - ego.position_m[0]) / seconds[1]
    in_time = seconds <= 7.0
    straight = [footprint(start @ geometry.pose_from_xyyaw(speed * s, 0.0, 0.0)) for s in seconds[in_time]]
    left_road = any(not road.contains(f) for f in straight)
    assert left_road or touched(plan, straight, ego.t_us[in_time])
    station, offset = geometry.project_to_polyline(start[None, :2, 3], line.xy_m)
    xy, yaw = line.at(station[0] + speed * seconds, offset[0])
    blind = [footprint(geometry.pose_from_xyyaw(*place, angle)) for place, angle in zip(xy, yaw, strict=True)]
    assert "lead" in touched(plan, blind, ego.t_us)


def test_actors_never_touch_each_other(plan):
    tracks = plan.tracks()
    for t_us in range(plan.span_us[0], plan.span_us[1] + 1, 500_000):
        boxes = [box(track.path.at(t_us), *track.size_m[:2]) for track in tracks]
        tree = shapely.STRtree(boxes)
        pairs = tree.query(boxes, predicate="intersects")
        assert (pairs[0] == pairs[1]).all(), [(tracks[a].id, tracks[b].id) for a, b in pairs.T if a < b]


def test_cast_of_the_street(plan):
    tracks = {track.id: track for track in plan.tracks()}
    assert {"lead", "oncoming_0", "pedestrian_0"} <= set(tracks)
    assert sum(name.startswith("parked") for name in tracks) >= 6
    assert all(track.controllable == (not name.startswith("parked")) for name, track in tracks.items())
    assert tracks["pedestrian_0"].label == "person" and tracks["lead"].label == "automobile"
    assert all(
        track.path.start_us <= plan.span_us[0] and track.path.end_us >= plan.span_us[1] for track in tracks.values()
    )


pieces = st.builds(
    RoadPiece,
    length_m=st.floats(5, 60),
    start_curvature_per_m=st.floats(-0.04, 0.04),
    end_curvature_per_m=st.floats(-0.04, 0.04),
)
roads = st.builds(
    Road,
    x_m=st.floats(-50, 50),
    y_m=st.floats(-50, 50),
    yaw_rad=st.floats(-3, 3),
    pieces=st.lists(pieces, min_size=1, max_size=4).map(tuple),
)


@settings(max_examples=40, deadline=None)
@given(road=roads, share=st.floats(0.05, 0.95), offset=st.floats(-5.0, 5.0))
def test_places_on_the_road_are_found_again(road, share, offset):
    line = RoadLine(road)
    assert np.isclose(geometry.arc_length(line.xy_m)[-1], line.length_m, rtol=1e-4)
    turn = sum(p.length_m * (p.start_curvature_per_m + p.end_curvature_per_m) / 2 for p in road.pieces)
    assert np.isclose(line.yaw_rad[-1] - line.yaw_rad[0], turn, atol=0.04)
    xy, yaw = line.at(share * line.length_m, offset)
    centre, _ = line.at(share * line.length_m)
    assert np.isclose(np.linalg.norm(xy - centre), abs(offset))
    assert np.isclose((xy - centre) @ [np.cos(yaw), np.sin(yaw)], 0.0, atol=1e-9)


def test_circle_of_constant_curvature():
    line = RoadLine(Road(0.0, 0.0, 0.0, (RoadPiece(np.pi * 15, 1 / 30, 1 / 30),)))
    xy, yaw = line.at(line.length_m)
    np.testing.assert_allclose(xy, [30.0, 30.0], atol=1e-3)
    np.testing.assert_allclose(yaw, np.pi / 2, atol=1e-9)


def test_road_map_is_the_road_between_the_kerbs(plan):
    line = RoadLine(plan.road)
    road_map = line.road_map()
    polygon = shapely.Polygon(road_map.drivable[0][0])
    assert polygon.is_valid and polygon.exterior.is_ccw
    assert np.isclose(polygon.area, 2 * plan.road.half_width_m * line.length_m, rtol=2e-3)
    forward, backward = road_map.lanes
    recorded = plan.ego_trajectory().position_m
    _, offset = geometry.project_to_polyline(recorded[:, :2], forward[:, :2])
    assert np.abs(offset).max() < 0.02
    heading = geometry.yaw_of(plan.ego_trajectory().world_from_body[0])
    assert (forward[1] - forward[0])[:2] @ [np.cos(heading), np.sin(heading)] > 0
    assert (backward[1] - backward[0])[:2] @ [np.cos(heading), np.sin(heading)] < 0


def test_plans_are_frozen(plan):
    with pytest.raises(dataclasses.FrozenInstanceError):
        plan.seed = 3
