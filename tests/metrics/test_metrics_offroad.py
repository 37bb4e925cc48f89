"""Off-road from Gaussians: the S-curve of the specification, kerbs, unknown ground, bridges and the true map."""

import dataclasses

import numpy as np
import pytest
from metrics_worlds import (
    LENGTH_M,
    ROAD_HALF_M,
    T0_US,
    curve_points,
    curve_yaw,
    gaussians,
    rig,
    rollout,
    s_curve_gaussians,
    s_curve_map,
    s_curve_path,
    standing,
)

from nurec_sim import geometry
from nurec_sim.errors import ReconstructError
from nurec_sim.metrics import build_offroad_grid, judge_footprints, road_agreement, score_rollout
from nurec_sim.metrics.ground import fit_ground
from nurec_sim.metrics.offroad import RoadState, corners_outside_m, debounced
from nurec_sim.metrics.offroad_agreement import boundary_bias_m
from nurec_sim.metrics.offroad_grid import Cell, OffroadGrid, driven_path
from nurec_sim.scene.opendrive.road_area import drivable_area
from nurec_sim.types import Label, RoadMap, Trajectory

BODY = rig().body
EGO = s_curve_path()


def shifted(left_m: float, count: int = 60) -> np.ndarray:
    """Rig poses beside the centre line of the S-curve."""
    x = np.linspace(20, 90, count)
    xy, yaw = curve_points(x, np.full(count, left_m)), curve_yaw(x)
    return np.stack([geometry.pose_from_xyyaw(*p, a) for p, a in zip(xy, yaw, strict=True)])


@pytest.fixture(scope="module")
def grid() -> OffroadGrid:
    return build_offroad_grid(s_curve_gaussians(), EGO, BODY)


def scored(poses, grid, road_map=None, **changes):
    run = rollout(poses, recorded=EGO.world_from_body, **changes)
    return {series.name: series for series in score_rollout(run, grid, road_map)}


@pytest.mark.parametrize(
    ("change", "least", "unknown"),
    [
        ({}, 0.985, 0.02),
        ({"parked": 10}, 0.985, 0.05),
        ({"confusion": 0.05}, 0.985, 0.02),
        ({"boundary_jitter_m": 0.3}, 0.98, 0.05),
        ({"density": 15.0}, 0.97, 0.05),
        ({"grade": 0.08}, 0.985, 0.02),
    ],
    ids=["default", "ten parked cars", "5 % wrong labels", "ragged edge", "sparse", "uphill"],
)
def test_the_grid_agrees_with_the_true_polygon(change, least, unknown):
    ego = s_curve_path(change.get("grade", 0.0))
    wrong = known = 0
    for seed in range(2):
        grid = build_offroad_grid(s_curve_gaussians(seed, **change), ego, BODY)
        found = road_agreement(grid, s_curve_map(), ego, BODY, placements=300, seed=seed)
        wrong += found.false_alarms + found.misses
        known += found.known
        assert found.misses <= 1, found
    assert 1 - wrong / known >= least
    assert 1 - known / 600 <= unknown


def test_the_grid_is_the_same_every_time(grid):
    again = build_offroad_grid(s_curve_gaussians(), EGO, BODY)
    assert np.array_equal(again.state, grid.state) and np.array_equal(again.beyond_known_m, grid.beyond_known_m)
    assert grid.overruled_frac < 0.01


def test_car_on_the_kerb_is_off_and_in_the_lane_it_is_not(grid):
    inside, kerb = scored(shifted(1.5), grid), scored(shifted(ROAD_HALF_M - 0.95 + 0.6), grid)
    assert inside["offroad"].value() == 0 and inside["offroad_max_excursion_m"].value() < 0.1
    assert kerb["offroad"].value() == 1
    assert kerb["offroad_max_excursion_m"].value() == pytest.approx(0.6, abs=0.2)
    assert 0 < kerb["offroad_area_frac"].value() < 0.5
    assert inside["offroad_unknown_frac"].value() == 0


def test_a_bridge_above_does_not_make_the_verge_road(grid):
    under_the_deck = geometry.pose_from_xyyaw(60.0, 12.0, 0.0)
    assert judge_footprints(grid, under_the_deck[None], BODY).verdict[0] != RoadState.ON


def test_unseen_ground_is_unknown_never_off_and_never_on(grid):
    hidden = s_curve_gaussians()
    xy = hidden.mean_m[:, :2]
    seen = ~((xy[:, 0] > 40) & (xy[:, 0] < 80) & (xy[:, 1] > np.interp(xy[:, 0], [0, 120], [0, 0]) + 1.2))
    patchy = build_offroad_grid(hidden[seen], EGO, BODY)
    found = scored(shifted(2.5), patchy)
    assert 0.1 < found["offroad_unknown_frac"].value() < 0.9
    lost = found["offroad_unknown_frac"].values == 1
    assert not found["offroad"].valid[lost].any()
    assert found["offroad"].value() == 0, "what is known says nothing of what is not"
    far = geometry.pose_from_xyyaw(60.0, 500.0, 0.0)
    assert judge_footprints(grid, far[None], BODY).verdict[0] == RoadState.UNKNOWN


def test_without_a_grid_offroad_is_invalid_not_zero():
    found = scored(shifted(8.0), None)
    assert not found["offroad"].valid.any() and np.isnan(found["offroad"].value())


def test_a_grid_that_misfits_the_start_of_the_recording_is_not_used(grid):
    elsewhere = dataclasses.replace(grid, origin_m=(grid.origin_m[0], grid.origin_m[1] + 9.0))
    found = scored(shifted(0.0), elsewhere)
    assert not found["offroad"].valid.any() and not found["offroad_unknown_frac"].valid.any()


def test_true_offroad_is_the_polygons(grid):
    assert scored(shifted(0.0), grid, s_curve_map())["offroad_true"].value() == 0
    assert scored(shifted(4.0), grid, s_curve_map())["offroad_true"].value() == 1
    assert not scored(shifted(4.0), grid)["offroad_true"].valid.any()
    hole = np.array([[50.0, -2], [54, -2], [54, 2], [50, 2]])
    square = np.array([[0.0, -50], [120, -50], [120, 50], [0, 50]])
    area = drivable_area(RoadMap(drivable=((square, hole),)))
    poses = np.stack([geometry.pose_from_xyyaw(x, 0.0, 0.0) for x in (20.0, 50.0)])
    assert (corners_outside_m(area, poses, BODY) > 0).tolist() == [False, True]


def test_offroad_needs_two_states_in_a_row():
    on, off, unknown = RoadState.ON, RoadState.OFF, RoadState.UNKNOWN
    values, valid = debounced(np.array([off, on, off, off, unknown, off, off]))
    assert values.tolist() == [0, 0, 0, 1, 0, 0, 1]
    assert valid.tolist() == [True, True, True, True, False, False, True]


def test_no_road_label_is_an_error_that_says_so():
    flat = gaussians(np.random.default_rng(0).uniform(0, 100, (500, 3)) * [1, 0.1, 0], np.full(500, Label.OTHER))
    with pytest.raises(ReconstructError, match="no Gaussian near the recorded path is labelled road .500 Gaussians"):
        build_offroad_grid(flat, EGO, BODY)


def test_faint_gaussians_and_movable_ones_are_no_evidence(grid):
    base = s_curve_gaussians()
    draw = np.random.default_rng(1)
    x, y = draw.uniform(0, LENGTH_M, 40_000), draw.uniform(-8, 8, 40_000)
    ghosts = gaussians(np.column_stack([x, y, np.full(40_000, 0.05)]), np.full(40_000, Label.ROAD), 0.04)
    parked = gaussians(np.column_stack([x, y, np.full(40_000, 0.3)]), np.full(40_000, Label.MOVABLE), 0.9)
    again = build_offroad_grid(type(base).concatenate([base, ghosts, parked]), EGO, BODY)
    assert np.mean(again.state == grid.state) > 0.999


def test_distances_grow_from_the_edge_and_are_zero_inside(grid):
    side = np.linspace(0, 6, 61)
    possible, known, inside = grid.look_up(curve_points(np.full(61, 60.0), side))
    assert inside.all() and (known >= possible - 1e-6).all()
    assert known[side < ROAD_HALF_M - 0.3].max() == 0
    beyond = side > ROAD_HALF_M + 0.5
    assert known[beyond] == pytest.approx(side[beyond] - ROAD_HALF_M, abs=0.25)


def test_ground_follows_the_driven_deck_not_the_bridge():
    road = s_curve_gaussians(grade=0.05)
    path = driven_path(s_curve_path(0.05), BODY)
    low, high = (-10.0, -25.0), (130.0, 25.0)
    ground = fit_ground(road.mean_m[road.label == Label.ROAD].astype(float), path, low, high)
    x = np.linspace(10, 110, 50)
    on_road = ground.at(curve_points(x, np.zeros(50)))
    assert on_road == pytest.approx(0.05 * x, abs=0.06)
    beside = ground.at(np.column_stack([x, np.full(50, 18.0)]))
    assert np.abs(beside - 0.05 * x).max() < 1.0, "extrapolated by the plane of the road"


def test_agreement_needs_a_map_and_a_path(grid):
    with pytest.raises(ValueError, match="no road map with a drivable area"):
        road_agreement(grid, RoadMap(), EGO, BODY)
    still = dataclasses.replace(EGO, t_us=EGO.t_us[:2], world_from_body=standing(2, 0, 0))
    with pytest.raises(ValueError, match="0.00 m long; at least 1 m"):
        road_agreement(grid, s_curve_map(), still, BODY)


@pytest.mark.parametrize(("left_m", "right_m", "bias"), [(3.3, 3.3, -0.2), (4.0, 3.8, 0.4), (3.7, 3.5, 0.1)])
def test_the_boundarys_bias_is_the_median_distance_of_the_grids_edge_from_the_true_one(left_m, right_m, bias):
    """A true road 7 m wide along x: of as many errors to the left as to the right the median is their mean.

    With two thirds of the left edge unknown, three of four errors are those of the right edge.
    """
    x = np.linspace(0, 30, 61)
    ego = Trajectory(
        (np.arange(61) * 100_000).astype(np.int64),
        np.stack([geometry.pose_from_xyyaw(at, 0.0, 0.0) for at in x]),
    )
    y = (np.arange(200) + 0.5) * 0.1 - 10
    columns = np.arange(400) * 0.1 - 5
    state = np.where((y < left_m) & (y > -right_m), Cell.ROAD, Cell.NONROAD)[:, None].repeat(400, axis=1)
    ring = np.array([[-50.0, -3.5], [80, -3.5], [80, 3.5], [-50, 3.5]])
    whole = OffroadGrid.from_state((-5.0, -10.0), 0.1, state, 0.1, 0.0)
    assert boundary_bias_m(whole, RoadMap(drivable=((ring,),)), ego) == pytest.approx(bias, abs=0.021)
    state[(y > 2)[:, None] & (columns > 10)] = Cell.UNKNOWN
    hidden = OffroadGrid.from_state((-5.0, -10.0), 0.1, state, 0.1, 0.0)
    assert boundary_bias_m(hidden, RoadMap(drivable=((ring,),)), ego) == pytest.approx(right_m - 3.5, abs=0.021)
    state[y > -5] = Cell.UNKNOWN
    nothing = OffroadGrid.from_state((-5.0, -10.0), 0.1, state, 0.1, 0.0)
    assert np.isnan(boundary_bias_m(nothing, RoadMap(drivable=((ring,),)), ego))


def test_a_parked_cars_shadow_in_the_road_is_filled_but_one_at_the_kerb_is_not_road(grid):
    rows, columns = grid.state.shape
    middle = curve_points(np.array([60.0]), np.array([2.3]))[0]  # of the second parked car
    column, row = ((middle - np.array(grid.origin_m)) / grid.cell_m).astype(int)
    assert 0 <= row < rows and 0 <= column < columns and grid.state[row, column] == Cell.ROAD
    assert T0_US > 1_000_000


@pytest.mark.parametrize(("beyond_m", "off"), [(0.25, False), (0.35, True)])
def test_a_body_is_off_road_from_30_cm_beyond_the_border(beyond_m, off):
    """Road to the left up to y = 3 m; a straight ego whose left side lies so far beyond it."""
    y = 3.0 - BODY.size_m[1] / 2 + beyond_m
    poses = np.stack([geometry.pose_from_xyyaw(x, y, 0.0) for x in np.linspace(10.0, 20.0, 20)])
    recorded = np.stack([geometry.pose_from_xyyaw(x, 0.0, 0.0) for x in np.linspace(10.0, 20.0, 20)])
    border = np.array([[-20.0, -10], [60, -10], [60, 3], [-20, 3]])
    found = {s.name: s for s in score_rollout(rollout(poses, recorded=recorded), None, RoadMap(drivable=((border,),)))}
    assert found["offroad_true"].value() == off
    rows, columns = np.indices((400, 800))  # cells of 0.1 m from (-20, -20)
    state = np.where(-20 + (rows + 0.5) * 0.1 < 3.0, Cell.ROAD, Cell.NONROAD)
    grid = OffroadGrid.from_state((-20.0, -20.0), 0.1, state, 0.1, 0.0)
    assert (judge_footprints(grid, poses, BODY).verdict == (RoadState.OFF if off else RoadState.ON)).all()
