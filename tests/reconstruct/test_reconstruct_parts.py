import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reconstruct_street import KERB_M, STEP_M, Street, camera

from nurec_sim import geometry, sensors
from nurec_sim.reconstruct.lift import bodies, colour, depth, lifting, road, splat
from nurec_sim.reconstruct.lift.cloud import Cloud
from nurec_sim.reconstruct.lift.ground import find_ground
from nurec_sim.reconstruct.lift.matching import census
from nurec_sim.reconstruct.lift.points import actors_of, gather
from nurec_sim.reconstruct.lift.settings import (
    ColourSettings,
    GroundSettings,
    LiftSettings,
    PointSettings,
    ViewSettings,
)
from nurec_sim.reconstruct.lift.sky_cubemap import make_sky
from nurec_sim.reconstruct.lift.surfaces import footprints, surface_of
from nurec_sim.reconstruct.lift.views import choose_frames, read_views, tiles_of
from nurec_sim.types import CameraModel, Fisheye, Pinhole, Shutter


def cloud_of(xyz, eye=(0.0, 0.0, 5.0), spacing=0.1):
    n = len(xyz)
    return Cloud(np.asarray(xyz, float), np.broadcast_to(np.asarray(eye, float), (n, 3)).copy(),
                 np.full(n, spacing, np.float32), np.full(n, np.nan, np.float32))  # fmt: skip


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


@pytest.mark.parametrize(("rise_m", "returns", "under_m"), [(-0.1, 2000, -0.1), (0.08, 2000, 0.08), (-0.1, 20, 0.0)])
def test_under_the_car_the_ground_is_as_high_as_beside_it_and_not_as_the_origin_of_the_rig(rise_m, returns, under_m):
    """The car stands, and the LiDAR sees the road from 2.5 m on; few returns are no reason to doubt the path."""
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


@given(st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_normals_of_a_plane_face_the_sensor(seed):
    random = np.random.default_rng(seed)
    normal = random.normal(size=3)
    normal /= np.linalg.norm(normal)
    basis = np.linalg.svd(normal[None])[2][1:]
    xyz = random.uniform(-2, 2, (400, 2)) @ basis + random.normal(0, 0.02, (400, 1)) * normal
    moved, found, spacing, _ = surface_of(cloud_of(xyz, eye=5 * normal))
    assert np.median(found @ normal) > 0.98
    assert (found @ normal > 0).all()
    assert np.std(moved.xyz_m @ normal) < 0.7 * np.std(xyz @ normal)
    assert (spacing >= 0.1 - 1e-6).all() and (spacing <= 0.3 + 1e-6).all()


def test_census_tells_the_clearly_darker_neighbours_row_by_row():
    """Of the middle of 7 x 7 equal pixels the first neighbour is 2 darker, the last 3, the second 1: too little."""
    gray = np.full((7, 7), 100, np.uint8)
    gray[0, 0], gray[0, 1], gray[6, 6] = 98, 99, 97
    assert int(census(gray)[3, 3]) == (1 << 47) | 1


def test_one_scan_line_faces_the_sensor():
    xyz = np.column_stack([np.linspace(-1, 1, 50), np.full(50, 5.0), np.zeros(50)])
    _, normal, _, _ = surface_of(cloud_of(xyz, eye=(0, 0, 0)))
    assert np.median(-normal[:, 1]) > 0.99


def test_footprints_cover_their_pixels_on_the_surface():
    ray = np.array([[0.8, 0.0, -0.6], [1.0, 0, 0]])
    normal = np.array([[0.0, 0, 1], [-1.0, 0, 0]])
    gaussians = footprints(np.zeros((2, 3)), normal, ray, np.array([0.1, 0.1]), np.zeros((2, 3)), np.zeros(2),
                           np.zeros(2, np.uint8), 0.9)  # fmt: skip
    axes = geometry.matrix_from_quat(gaussians.quat_wxyz)
    stretched = axes[0][:, 0]
    assert abs(stretched[0]) == pytest.approx(1, abs=1e-6)
    assert gaussians.scale_m[0, 0] / gaussians.scale_m[0, 1] == pytest.approx(1 / 0.6, rel=1e-5)
    assert gaussians.scale_m[1, 0] == pytest.approx(gaussians.scale_m[1, 1], rel=1e-5)
    assert (gaussians.scale_m[:, 2] < 0.2 * gaussians.scale_m[:, 1]).all()


def test_every_point_goes_to_one_body():
    clip = Street(boxes={"a": ((4.0, 1.8, 1.5), np.array([12.0, -2.0]))})
    actors = actors_of(clip, PointSettings())
    fine = PointSettings(min_voxel_m=0.001, max_voxel_m=0.001)
    gathered = gather(clip, actors, set(), fine)
    feet = sum(len(box) for box, _ in gathered.feet.values())
    total = len(gathered.static) + sum(map(len, gathered.actors.values())) + feet
    assert 0.97 * gathered.point_count <= total <= gathered.point_count
    box = clip.tracks[0].path.world_from_body[0]
    local = geometry.transform_points(geometry.inverse(box), gathered.static.xyz_m)
    assert not geometry.points_in_box(local, (4.0, 1.8, 1.5), 0.14).any()


def test_returns_of_a_scanner_that_reaches_far_are_kept():
    """A Pandar128 measures up to 200 m; beyond ``max_range_m`` returns are errors."""
    street = Street(frames=1)
    near = street.sweep("top", 0)
    xyz = np.array([[180.0, 3.0, 2.0], [255.0, 3.0, 2.0]])
    far = dataclasses.replace(near, xyz_m=xyz, intensity=None, point_t_us=np.full(2, near.t_us))
    street.sweep = lambda lidar, index: far
    gathered = gather(street, [], set(), PointSettings())
    assert len(gathered.static) == 1
    assert gathered.static.xyz_m[0] == pytest.approx(far.xyz_world_m[0], abs=1e-3)


@pytest.mark.parametrize("lens", ["plain", "distorted", "fisheye"])
def test_views_project_like_their_camera(lens):
    front = camera(width=320, height=160)
    if lens == "distorted":
        front = CameraModel("front", 320, 160, Pinhole(150, 150, 160, 80, radial=(-0.1, 0.02, 0, 0, 0, 0)),
                            front.rig_from_camera)  # fmt: skip
    if lens == "fisheye":
        front = CameraModel("front", 320, 160, Fisheye(100, 100, 160, 80, max_angle_rad=1.6), front.rig_from_camera)
    clip = Street(frames=1, cameras=(front,))
    options = ViewSettings()
    views = read_views(clip, ["front"], {}, options)
    assert len(views) == len(tiles_of(front, options)) and (lens != "fisheye" or len(views) >= 2)
    world_from_camera = clip.world_from_camera("front", 0)[0]
    errors = []
    for view in views:
        tile = view.tile
        assert tile.valid.mean() > 0.5
        v, u = np.nonzero(tile.valid)
        some = slice(None, None, 997)
        points = lifting.points_of(view, np.full(tile.valid.shape, 0.1, np.float32))[v[some], u[some]]
        uv, seen = sensors.project(front, geometry.transform_points(geometry.inverse(world_from_camera), points))
        for x, pixel, ok, row, column in zip(points, uv, seen, v[some], u[some], strict=True):
            a, b, z = splat.project_point(view.packed[None], 0, *x)
            assert (a, b) == pytest.approx((column + 0.5, row + 0.5), abs=1e-3) and z == pytest.approx(10, rel=1e-5)
            recorded = clip.image("front", 0)
            if ok and 1 < pixel[0] < 319 and 1 < pixel[1] < 159:
                near = recorded[int(pixel[1]) - 1 : int(pixel[1]) + 2, int(pixel[0]) - 1 : int(pixel[0]) + 2]
                errors.append(np.abs(near.astype(int) - view.rgb[row, column]).min(axis=(0, 1)).max())
    assert len(errors) > 10 and np.mean(np.array(errors) < 12) > 0.85


def test_rolling_shutter_points_project_back():
    base = camera()
    rolling = CameraModel("front", 192, 96, base.lens, base.rig_from_camera, Shutter.TOP_TO_BOTTOM)

    class Rolling(Street):
        def world_from_camera(self, camera_id, index):
            pair = super().world_from_camera(camera_id, index)
            pair[1, 0, 3] += 0.3
            return pair

    clip = Rolling(frames=1, cameras=(rolling,))
    (view,) = read_views(clip, ["front"], {}, ViewSettings())
    assert np.linalg.norm(view.drift_m) == pytest.approx(0.3)
    points = lifting.points_of(view, np.full((96, 192), 0.2, np.float32))
    uv, seen, _ = sensors.project_rolling(rolling, clip.world_from_camera("front", 0), points[::9, ::17].reshape(-1, 3))
    v, u = np.mgrid[0:96:9, 0:192:17] + 0.5
    assert seen.all()
    assert np.abs(uv - np.column_stack([u.ravel(), v.ravel()])).max() < 0.15


def test_frames_are_thinned_evenly():
    frames = choose_frames(Street(frames=50), ["front"], 1, ViewSettings(max_views=10, max_frames=25))
    assert [frame for _, frame, _ in frames] == list(range(0, 50, 2))
    assert [frame for _, frame, key in frames if key] == list(range(0, 50, 6))


def test_depth_is_found_by_matching_where_nothing_was_measured():
    clip = Street(frames=3)
    views = read_views(clip, ["front"], {}, ViewSettings())
    step, levels = 1 / 3.5 / 47, 48
    empty = np.zeros((96, 192), np.float32)
    around = [(v.packed, v.rgb, census(v.rgb.mean(axis=-1).astype(np.uint8))) for v in views[1:]]
    no_sky = np.full((96, 192), depth.NOT_SKY, np.uint8)
    found = depth.dense_inverse_depth(views[0].packed, views[0].world_from_view, views[0].rgb, empty, no_sky, around,
                                      step * np.arange(levels))  # fmt: skip
    pose = views[0].world_from_view
    rays = lifting.rays_of(views[0]).reshape(-1, 3)
    distance, what = clip.cast(pose[:3, 3], rays @ pose[:3, :3].T, 0)
    true = (1 / distance).reshape(96, 192)
    walls = (what.reshape(96, 192) == 4) & (true > 1 / 25)
    walls[:, :20], walls[:, -20:] = False, False
    assert np.median(np.abs(found - true)[walls]) < step


def test_measured_depth_stays():
    prior = np.full((20, 30), 0.123, np.float32)
    view = read_views(Street(frames=1, cameras=(camera(width=30, height=20),)), ["front"], {}, ViewSettings())[0]
    no_sky = np.full(prior.shape, depth.NOT_SKY, np.uint8)
    found = depth.dense_inverse_depth(
        view.packed, view.world_from_view, view.rgb, prior, no_sky, [], 0.01 * np.arange(32)
    )
    assert np.array_equal(found, prior)


def test_isp_of_cameras_that_share_points():
    random = np.random.default_rng(0)
    true = random.uniform(0.1, 0.9, (2000, 3)).astype(np.float32)
    gain = np.array([[0.9, 0.05, 0, 0.02], [0, 0.8, 0, 0.03], [0, 0, 1.1, -0.02]])
    other = (np.column_stack([true, np.ones(2000)]) @ gain.T).astype(np.float32)
    everything = np.ones(2000, bool)
    nothing = np.zeros(2000, bool)
    isp, unaligned_cameras = colour.solve_isp(
        ["a", "b", "c"], {"a": (true, everything), "b": (other, everything), "c": (true, nothing)}
    )
    assert np.allclose(isp["a"], np.eye(3, 4)) and np.allclose(isp["c"], np.eye(3, 4))
    assert np.abs(isp["b"] - gain).max() < 0.06
    assert unaligned_cameras == ["c"]
    assert np.abs(colour.to_canonical(other * 255, isp["b"]) - true * 255).mean() < 4


def test_sky_without_any_view_is_grey():
    sky = make_sky([], [], [], 8)
    assert sky.shape == (6, 8, 8, 3) and (sky == sky[0, 0, 0]).all()


@pytest.mark.parametrize(
    ("path_m", "duration_s", "lengths"),
    [
        (20.0, 5.0, 1.0),  # a short log has all limits as they are
        (125.0, 5.0, 2.5),  # the longer of path and duration counts
        (0.0, 15.0, 3.0),
        (5000.0, 600.0, 8.0),  # no more than this
    ],
)
def test_limits_follow_the_length_of_the_log(path_m, duration_s, lengths):
    given = LiftSettings(views=ViewSettings(max_views=40, max_frames=240, budget=900_000, pixels=10**6, width_px=640))
    longer = given.for_log(path_m, duration_s, [(640, 400, 10)])
    views = longer.views
    assert (views.max_views, views.max_frames) == (40 * lengths, 240 * lengths)
    assert (views.budget, views.pixels) == (900_000 * lengths, 10**6 * lengths)
    assert (longer.colours.images, longer.colours.pixels) == (60 * lengths, 50 * 10**6 * lengths)
    assert views.width_px == 640 and longer.points == given.points


@pytest.mark.parametrize(
    ("make", "changed", "message"),
    [
        (ViewSettings, {"budget": -5}, "budget must be 1 or more, got -5"),
        (ViewSettings, {"levels": 1}, "levels must be 2 or more, got 1"),
        (ViewSettings, {"neighbours": -1}, "neighbours must be 0 or more, got -1"),
        (ViewSettings, {"min_depth_m": 200.0}, "below max_depth_m, got 200.0 and 150.0"),
        (ColourSettings, {"rounds": -1}, "rounds must be 0 or more, got -1"),
        (ColourSettings, {"images": 0}, "images must be 1 or more, got 0"),
        (ColourSettings, {"pixels": 0}, "pixels must be 1 or more, got 0"),
        (ColourSettings, {"trust": -0.1}, "trust must be 0 or more, got -0.1"),
        (ColourSettings, {"gain_pull": float("nan")}, "gain_pull must be 0 or more, got nan"),
        (LiftSettings, {"duration_s": 0.0}, "duration_s must be positive and finite, got 0.0"),
        (LiftSettings, {"most_lengths": 0.5}, "most_lengths must be 1 or more, got 0.5"),
        (LiftSettings, {"most_detail": 0.0}, "most_detail must be 1 or more, got 0.0"),
    ],
)
def test_impossible_settings_are_named(make, changed, message):
    with pytest.raises(ValueError, match=message):
        make(**changed)


@pytest.mark.parametrize(
    ("width_px", "reduction"),
    [(640, 1), (960, 1), (961, 2), (1242, 2), (1600, 2), (1920, 3), (1936, 3), (3848, 6), (100, 1)],
)
def test_images_are_reduced_by_the_whole_number_that_comes_nearest(width_px, reduction):
    """To 640 pixels; of two as near the smaller, which keeps more: 1600 becomes 800 and not 533."""
    assert ViewSettings().reduction_of(width_px) == reduction


@pytest.mark.parametrize(
    ("path_m", "images", "limits"),
    [
        (20.0, [(1242, 375, 51)], 1.0),  # 621 x 187 a camera
        (20.0, [(700, 500, 100)], 1.0),  # just what one length is for
        (20.0, [(700, 500, 100)] * 3, 3**0.5),
        (20.0, [(1400, 1000, 100)] * 3, 3**0.5),  # worked on at 700 x 500
        (20.0, [(1600, 900, 100)] * 6, 2.0),  # 800 x 450 and six of them: 2.48, but no more than 2
        (100.0, [(1600, 900, 100)] * 6, 4.0),  # twice as long
        (300.0, [(1600, 900, 100)] * 6, 8.0),  # six times as long, but no more than 8
        (20.0, [], 1.0),
    ],
)
def test_limits_follow_what_the_cameras_see_at_once(path_m, images, limits):
    """With the square root of the pixels beyond 350,000, all cameras together; the number of views does not."""
    given = LiftSettings(views=ViewSettings(budget=100_000, max_views=40), colours=ColourSettings(images=50))
    more = given.for_log(path_m, 1.0, images)
    assert more.views.budget == round(100_000 * limits) and more.colours.images == round(50 * limits)
    assert more.views.max_views == round(40 * max(path_m / 50, 1.0))


def test_short_logs_of_large_images_are_worked_on_in_more_detail():
    """8 million pixels: 12 images of 1936 x 1216 fit at half their size; 300 do not even at a quarter, nor does 640."""
    settings = ViewSettings()
    assert settings.widened([(1936, 1216, 2)] * 6).width_px == 968
    assert settings.widened([(1936, 1216, 50)] * 6) == settings
    assert settings.widened([(1242, 375, 51)]) == settings  # 23.8 million at full size, 5.9 at half
    assert settings.widened([(1600, 900, 1)] * 5).width_px == 1600  # 7.2 million
    assert settings.widened([(320, 192, 10)]) == settings and settings.widened([]) == settings
