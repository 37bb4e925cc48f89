"""The ground and the road in it, grown from points of a street with kerbs."""

import numpy as np
import pytest
from clouds import cloud_of
from reconstruct_street import KERB_M, STEP_M, Street

from nurec_sim import geometry
from nurec_sim.reconstruct.lift import bodies, road
from nurec_sim.reconstruct.lift.ground import find_ground
from nurec_sim.reconstruct.lift.points import gather
from nurec_sim.reconstruct.lift.settings import (
    GroundSettings,
    PointSettings,
)


def ground_points(kerb_m, seed=0, noise_m=0.01):
    random = np.random.default_rng(seed)
    xy = random.uniform([-5, -9], [25, 9], (60_000, 2))
    z = np.where(np.abs(xy[:, 1]) < KERB_M, 0.0, kerb_m) + random.normal(0, noise_m, len(xy))
    return np.column_stack([xy, z])


def drive():
    return np.stack([geometry.pose_from_xyyaw(x, 0, 0) for x in np.arange(0, 20, 1.0)])


@pytest.mark.parametrize(("slope", "kerb_m"), [(0.0, 0.15), (0.04, 0.12), (-0.03, 0.10)])
def test_road_grows_to_the_kerb_on_any_slope(slope, kerb_m):
    points, poses = ground_points(kerb_m), drive()
    points[:, 2] += slope * points[:, 0]
    poses[:, 2, 3] = slope * poses[:, 0, 3]
    ground = find_ground(points, poses, GroundSettings())
    x, y = np.meshgrid(np.arange(0, 20, 0.2), np.arange(-7, 7.01, 0.1))
    at = np.column_stack([x.ravel(), y.ravel(), slope * x.ravel() + np.where(np.abs(y.ravel()) < KERB_M, 0, kerb_m)])
    road = ground.is_road(at)
    side = np.abs(at[:, 1])
    assert road[side < KERB_M - 0.25].mean() > 0.99
    assert road[side > KERB_M + 0.25].mean() < 0.01


def test_pavement_level_with_the_road_cannot_be_told_apart():
    ground = find_ground(ground_points(0.0), drive(), GroundSettings())
    assert ground.is_road(np.array([[10.0, 6.0, 0.0]]))[0]


@pytest.mark.parametrize(
    ("rise_m", "returns", "under_m"), [(-0.1, 2000, -0.1), (0.08, 2000, 0.08), (0.025, 2000, 0.0), (-0.1, 20, 0.0)]
)
def test_under_the_car_the_ground_is_as_high_as_beside_it_and_not_as_the_origin_of_the_rig(rise_m, returns, under_m):
    """The car stands, and the LiDAR sees the road from 2.5 m on; few returns, or less than 3 cm, leave the path."""
    points = ground_points(STEP_M, noise_m=0.0) + (0, 0, rise_m)
    away = np.abs(points[:, :2] - [1, 0]).max(axis=1)
    near = np.flatnonzero((away > 2.5) & (away < 4.5))[:returns]
    points = np.concatenate([points[near], points[away > 5.5]])
    poses = np.stack([geometry.pose_from_xyyaw(x, 0, 0) for x in (0.0, 0.01)])
    ground = find_ground(points, poses, GroundSettings())
    assert ground.above(np.array([[0.5, 0.0, 0.0]]))[0] == pytest.approx(-under_m, abs=0.005)


@pytest.mark.parametrize(
    ("sweeps", "least_m", "most_m"), [(1, 0.0, 0.005), (2, 0.005, 0.008), (7, 0.015, 0.02), (None, 0.015, 0.02)]
)
def test_the_road_of_few_sweeps_is_even_across_the_rings_of_beams(sweeps, least_m, most_m):
    """Rings half a metre apart lie 2 cm too high and too low by turns. Waves of 4 m, a crown and the kerb stay."""

    def true_m(x, y):
        return 0.03 * np.cos(2 * np.pi * x / 4) + np.where(np.abs(y) < KERB_M, 0.1 * (1 - (y / KERB_M) ** 2), 0.0)

    points = ground_points(STEP_M, noise_m=0.0)
    ring = np.floor(np.linalg.norm(points[:, :2], axis=1) / 0.5)
    points[:, 2] += true_m(*points[:, :2].T) + np.where(ring % 2, 0.02, -0.02)
    ground = find_ground(points, drive(), GroundSettings(), sweeps=sweeps)
    x, y = (part.ravel() for part in np.meshgrid(np.arange(2, 18, 0.1), np.arange(0.3 - KERB_M, KERB_M - 0.2, 0.1)))
    error = ground.above(np.column_stack([x, y, true_m(x, y)]))
    assert least_m < np.sqrt(np.mean(error**2)) < most_m and np.abs(error.mean()) < 0.004
    assert ground.above(np.array([[11.0, KERB_M + 0.3, STEP_M]]))[0] == pytest.approx(0, abs=0.025)


def test_a_log_of_one_sweep_has_an_even_road(monkeypatch):
    street, asked = Street(frames=1), []
    monkeypatch.setattr(bodies, "find_ground", lambda *given: asked.append(given))
    bodies.ground_of(street, gather(street, [], set(), PointSettings()), GroundSettings())
    assert [given[4] for given in asked] == [1]


@pytest.mark.parametrize(("size_m", "road"), [((1.3, 1.3), True), ((4.0, 1.5), False)])
def test_islands_of_two_square_metres_are_not_road(size_m, road):
    """Raised by 12 cm in the middle of a lane: smaller than that it is no island, but uneven asphalt."""
    points = ground_points(STEP_M)
    raised = (np.abs(points[:, :2] - [10, 2]) < np.array(size_m) / 2).all(axis=1)
    points[raised, 2] += 0.12
    assert find_ground(points, drive(), GroundSettings()).is_road(np.array([[10.0, 2.0, 0.12]]))[0] == road


def test_what_lies_under_a_standing_car_is_road():
    """Nobody sees the asphalt below it, but for a few returns from its underbody."""
    points = ground_points(STEP_M)
    car = (np.abs(points[:, :2] - [10, 2]) < (2.2, 0.9)).all(axis=1)
    returns = np.column_stack([np.random.default_rng(2).uniform([9.5, 1.9], [10.5, 2.1], (60, 2)), np.full(60, 0.15)])
    ground = find_ground(np.concatenate([points[~car], returns]), drive(), GroundSettings())
    x, y = np.meshgrid(np.arange(8, 12, 0.1), np.arange(1.1, 3.0, 0.1))
    row, column, _ = ground.cells(np.column_stack([x.ravel(), y.ravel(), 0 * y.ravel()]))
    assert ground.road[row, column].all()


@pytest.mark.parametrize("bend_m", [np.inf, 60.0])
def test_the_kerb_goes_on_behind_a_parked_car(bend_m):
    """The car hides 4.4 m of the kerb, 1.6 m of the road before it and 0.4 m of the pavement; so too in a bend."""
    points, poses = ground_points(STEP_M), drive()
    hidden = (np.abs(points[:, :2] - [10, KERB_M - 0.6]) < (2.2, 1.0)).all(axis=1)
    x, y = np.meshgrid(np.arange(8.0, 12.0, 0.1), np.arange(KERB_M - 1.5, KERB_M + 0.9, 0.1))
    at = np.column_stack([x.ravel(), y.ravel(), 0 * y.ravel()])
    for xyz in (points, at):
        xyz[:, 1] += xyz[:, 0] ** 2 / 2 / bend_m
    poses[:, 1, 3] = poses[:, 0, 3] ** 2 / 2 / bend_m
    yaw = np.arctan(poses[:, 0, 3] / bend_m)
    poses[:, :2, :2] = np.stack([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]).transpose(2, 0, 1)
    ground = find_ground(points[~hidden], poses, GroundSettings())
    row, column, _ = ground.cells(at)
    road, beyond = ground.road[row, column], y.ravel() - KERB_M
    assert road[beyond < -0.15].mean() > 0.99 and road[beyond > 0.15].mean() < 0.01


def test_returns_from_under_a_parked_car_tell_heights_but_do_not_fence_off_the_road():
    """A ring of returns from wheels and sills, 8 cm up; within it some from the road, 3 cm lower than around it."""
    points = ground_points(STEP_M)
    car = (np.abs(points[:, :2] - [10, 2.3]) < (2.2, 0.9)).all(axis=1)
    inner = (np.abs(points[:, :2] - [10, 2.3]) < (1.8, 0.6)).all(axis=1)
    under = points[car] - np.where(inner[car], 0.03, -0.08)[:, None] * (0, 0, 1)
    ground = find_ground(points[~car], drive(), GroundSettings(), under)
    x, y = np.meshgrid(np.arange(7.9, 12.1, 0.1), np.arange(1.5, 3.1, 0.1))
    row, column, _ = ground.cells(np.column_stack([x.ravel(), y.ravel(), 0 * y.ravel()]))
    assert ground.road[row, column].all()
    middle = (np.abs(x - 10) < 1.3).ravel() & (np.abs(y - 2.3) < 0.3).ravel()
    assert ground.height_m[row, column][middle].mean() == pytest.approx(-0.03, abs=0.005)
    assert ground.height_m[row, column].max() < 0.02, "no wheels"


def test_places_beside_the_drive_are_those_of_the_projection_onto_its_line():
    """On a circle of 60 m radius and before its start; half a metre from a sample, 14 m aside, 14/60 of that off."""
    angle = np.arange(0.0, 1.0, 1 / 60)
    poses = np.stack([geometry.pose_from_xyyaw(60 * np.sin(a), 60 * (1 - np.cos(a)), a) for a in angle])
    xy = np.random.default_rng(3).uniform([-20, -10], [40, 20], (500, 2))
    line = np.concatenate([[[-road.BEYOND_M, 0.0]], poses[:, :2, 3]])
    along, left = geometry.project_to_polyline(xy, line)
    got = road._along_and_across(xy, poses)
    near = np.abs(left) < 14
    assert near.sum() > 300
    assert got[near, 0] == pytest.approx(along[near], abs=0.5 * 14 / 60 + 0.02)
    assert got[near, 1] == pytest.approx(left[near], abs=0.02)


def test_a_car_may_go_back_on_its_own_track():
    there, points = drive()[:11], ground_points(STEP_M)
    hidden = np.linalg.norm(points[:, :2] - [8, 3], axis=1) < 0.5
    ground = find_ground(points[~hidden], np.concatenate([there, there[-2::-1]]), GroundSettings())
    assert ground.is_road(np.array([[8.0, 3.0, 0.0]]))[0]


def test_ground_holes_are_filled_flat():
    points = ground_points(STEP_M)
    hole = np.linalg.norm(points[:, :2] - [8, 0], axis=1) < 2.0
    ground = find_ground(points[~hole], drive(), GroundSettings())
    sheet = ground.sheet(cloud_of(points[~hole]))
    inside = np.linalg.norm(sheet.xyz_m[:, :2] - [8, 0], axis=1) < 2.0
    assert inside.sum() > 1000
    assert np.abs(sheet.xyz_m[inside, 2]).max() < 0.05


def test_ground_that_few_beams_reach_is_filled_from_its_neighbours():
    """Beyond 10 m the scanner sees rings 2.5 m apart, 4 % of the cells; half of that on a slope of 3 %: 4 cm."""
    points, poses = ground_points(0.0), drive()[:10]
    points[:, 2] += 0.03 * points[:, 0]
    poses[:, 2, 3] = 0.03 * poses[:, 0, 3]
    ring = points[:, 0] % 2.5 < 0.1
    ground = find_ground(points[(points[:, 0] < 10) | ring], poses, GroundSettings())
    far = np.column_stack([np.arange(11.0, 19.0, 0.1), np.full(80, 4.0), 0.03 * np.arange(11.0, 19.0, 0.1)])
    assert np.abs(ground.above(far)).max() < 0.045


def test_tops_of_things_are_not_ground():
    points = ground_points(STEP_M)
    top = np.column_stack([np.random.default_rng(1).uniform([10, 1], [14, 3], (4000, 2)), np.full(4000, 1.4)])
    under = (points[:, 0] > 10) & (points[:, 0] < 14) & (points[:, 1] > 1) & (points[:, 1] < 3)
    ground = find_ground(np.concatenate([points[~under], top]), drive(), GroundSettings())
    row, column, _ = ground.cells(np.array([[12.0, 2.0, 0]]))
    assert abs(ground.height_m[row, column][0]) < 0.1
