"""Gaussians against recorded beams: a scanner at the origin, or a moving one, in front of walls at known distances."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from reconstruct_street import Street

from nurec_sim import geometry
from nurec_sim.reconstruct import LiftSettings, beam_counting, reconstruct
from nurec_sim.reconstruct.beam_counting import BLOCK, CLEAR, MEETS, THINNEST_M, ellipsoids
from nurec_sim.reconstruct.free_space import (
    MOST_SWEEPS,
    BeamCounts,
    balls,
    chosen_sweeps,
    count_beams,
    in_free_space,
    sweep_beams,
    weighed,
)
from nurec_sim.reconstruct.lift.bake import body_gaussians, body_pixels
from nurec_sim.reconstruct.lift.blocks import LEAST_TOLERANCE
from nurec_sim.reconstruct.lift.bodies import Surfels
from nurec_sim.reconstruct.lift.cloud import Cloud
from nurec_sim.reconstruct.lift.footprints import footprints_of, marked_free, on_ground, outside_free_space
from nurec_sim.reconstruct.lift.ground import Ground
from nurec_sim.reconstruct.lift.lifting import Lifted
from nurec_sim.reconstruct.lift.pictures import DepthPicture
from nurec_sim.reconstruct.lift.points import Actor
from nurec_sim.reconstruct.lift.settings import PointSettings
from nurec_sim.reconstruct.lift.surfaces import PIXEL_SIGMA
from nurec_sim.reconstruct.lift.views import Tile, WorkingView
from nurec_sim.types import Gaussians, Label, Sweep, Track, Trajectory

SIGMA_M = 0.05


def directions():
    """Beams 0.2 degrees apart, 20 degrees to each side and 10 up and down."""
    azimuth, elevation = np.radians(np.meshgrid(np.arange(-20, 20, 0.2), np.arange(-10, 10, 0.2)))
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)


def sweep_of(clip, range_m, index=0):
    """A sweep that returns from ``range_m`` along all beams; the LiDAR is at the origin of the world."""
    xyz = directions() * np.broadcast_to(range_m, len(directions()))[:, None]
    start, end = (int(t) for t in clip.sweep_times_us("top")[index])
    sweep = Sweep(start, start, end, np.eye(4), xyz, None, np.full(len(xyz), start))
    return sweep_beams(clip, "top", sweep)


@pytest.fixture(scope="module")
def parked():
    return Street(frames=3, speed_mps=0.0)


def at(*places, sigma_m=SIGMA_M):
    return balls(np.array(places, float), np.full(len(places), sigma_m))


def test_what_beams_pass_is_free_and_where_they_end_is_not(parked):
    gaussians = at([10, 0, 0], [20, 0, 0], [25, 0, 0], [10, 8, 0])
    assert in_free_space(gaussians, [sweep_of(parked, 20.0)] * 2).tolist() == [True, False, False, False]


def test_what_lets_beams_pass_is_less_opaque():
    """By the square of the share that ended there, and one more: 1, 4/5 and 1/2."""
    gaussians = dataclasses.replace(at([10, 0, 0], [10, 1, 0], [10, 2, 0], [10, 3, 0]), opacity=np.float32([0.9] * 4))
    through, ended = np.array([0, 1, 4, 0]), np.array([7, 3, 3, 0])
    found = weighed(gaussians, BeamCounts(through, ended, through, ended).ended_share)
    np.testing.assert_allclose(found.opacity, [0.9, 0.9 * 0.64, 0.9 * 0.25, 0.9], rtol=1e-6)


def test_beams_that_meet_an_ellipsoid_are_found_whatever_its_place_and_turn(parked):
    """Counts against all beams of the image: within 1.5 of squared Mahalanobis distance, or near the centre."""
    random, count = np.random.default_rng(0), 60
    far = random.uniform(12, 16, (count, 1)) * random.permutation(directions())[:count] + random.normal(
        0, 0.02, (count, 3)
    )
    quat = geometry.quat_normalize(random.normal(size=(count, 4)))
    gaussians = dataclasses.replace(at(*far), scale_m=random.uniform(0.002, 0.08, (count, 3)).astype(np.float32),
                                    quat_wxyz=quat.astype(np.float32))  # fmt: skip
    sweep = sweep_of(parked, 30.0)
    beams = sweep.beams[sweep.image[sweep.image >= 0], :3].astype(np.float64)
    counts = count_beams(gaussians, [sweep])
    centre = gaussians.mean_m.astype(np.float64)
    whiten = geometry.matrix_from_quat(gaussians.quat_wxyz.astype(np.float64)) / gaussians.scale_m[:, None]
    o, d = np.einsum("nji,nj->ni", whiten, centre)[:, None], np.einsum("nji,bj->nbi", whiten, beams)
    mahalanobis = (o**2).sum(-1) - (o * d).sum(-1) ** 2 / (d**2).sum(-1)
    aside = (centre**2).sum(-1)[:, None] - (centre @ beams.T) ** 2
    width_m = sweep.width_rad * np.linalg.norm(centre, axis=1)[:, None]
    meets = ((mahalanobis <= MEETS) | (aside <= width_m**2)).sum(axis=1)
    assert meets.max() > 3
    assert np.abs(counts.passed - meets).sum() <= 0.01 * meets.sum()
    assert not counts.stopped.any()


def test_gaussians_are_counted_alike_however_many_there_are_and_decided_ones_are_left_out(parked):
    """Directions are found block by block, of those that need more beams; here these are every third."""
    random = np.random.default_rng(1)
    places = random.uniform(5, 40, (3 * BLOCK, 1)) * random.permutation(directions())[: 3 * BLOCK]
    places[np.arange(len(places)) % 3 != 0] = [3.0, 0.0, 0.0]
    gaussians, sweeps = at(*places), [sweep_of(parked, distance_m) for distance_m in (20.0, 25.0, 30.0)]
    together = count_beams(gaussians, sweeps)
    for i in (0, 1, 300, len(places) - 3):
        alone = count_beams(gaussians[np.array([i])], sweeps)
        assert [each[i] for each in vars(together).values()] == [each[0] for each in vars(alone).values()]
    assert together.passed[1] > CLEAR and together.free[::3].any() and not together.free[::3].all()


def test_axes_of_ellipsoids_are_those_of_their_quaternions():
    random = np.random.default_rng(2)
    quat = random.normal(size=(20, 4)).astype(np.float32)
    scale = random.uniform(0.01, 0.3, (20, 3)).astype(np.float32)
    scale[0, 1] = 0.0
    xyz, canonical, extent, radius, thinness, thinnest = ellipsoids(quat[:, :3], quat, scale)
    axes, sigma = (
        np.swapaxes(geometry.matrix_from_quat(quat.astype(np.float64)), 1, 2),
        np.maximum(scale.astype(np.float64), THINNEST_M),
    )
    np.testing.assert_array_equal(xyz, quat[:, :3])
    np.testing.assert_allclose(canonical, axes / sigma[:, :, None], rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(extent, axes * np.sqrt(MEETS) * sigma[:, :, None], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(radius, np.sqrt(MEETS) * sigma.max(axis=1))
    np.testing.assert_allclose(thinness, sigma.min(axis=1))
    np.testing.assert_array_equal(thinnest, sigma.argmin(axis=1))


def test_a_body_is_where_its_path_is_at_the_time_of_each_sweep_and_not_outside_of_it():
    """It drives from x = 10 m to 20 m; its Gaussian is outside of its box, and beams pass at these two times only."""
    clip = Street(frames=4, speed_mps=0.0)
    sweeps = [sweep_of(clip, distance_m, k) for k, distance_m in enumerate((30.0, 15.0, 30.0, 30.0))]
    times = [sweep.middle_us for sweep in sweeps]
    ends = np.stack([geometry.pose_from_xyyaw(x, 0.0, 0.0) for x in (10.0, 20.0)])
    track = Track("car", Label.MOVABLE, (0.5, 0.5, 0.5), Trajectory(np.array([times[0], times[2]]), ends))
    body = dataclasses.replace(
        body_of(np.zeros((0, 3)), np.zeros((0, 3), np.float32)), actor=Actor(0, track, False, track.path)
    )
    one = at([0.0, 0.5, 0.0], sigma_m=0.02)
    counts, expected = body.count_beams(one, sweeps), count_beams(one, sweeps[:3], track.path.at)
    assert counts.passed == expected.passed and counts.stopped == expected.stopped
    assert counts.passed > 0 and counts.stopped > 0


def test_of_beams_in_one_cell_the_nearest_is_found():
    clip, ends = Street(frames=3, speed_mps=0.0), np.array([[30.0, 0, 0], [10.0, 0, 0], [20.0, 0, 0]]) + 0.001
    sweep = sweep_beams(clip, "top", Sweep(0, 0, 1, np.eye(4), ends, None, np.zeros(3, np.int64)))
    assert sweep.image.max() == 1
    assert sweep.reach_m.max() == pytest.approx(10, abs=0.01)


def test_beams_end_at_what_lies_a_little_before_their_returns(parked):
    """0.3 m and 2 % of 10 m: returns from 10.45 m count as from there, those from 10.55 m do not."""
    for wall_m, free in ((10.45, False), (10.55, True)):
        assert in_free_space(at([10, 0, 0]), [sweep_of(parked, wall_m)] * 3).tolist() == [free]


def test_few_beams_remove_nothing(parked):
    """At 50 m a beam is 5 cm from the centre of a small Gaussian between rows, and one or none meets it per sweep."""
    small = at([40.0, 0.0, 0.0], sigma_m=0.001)
    sweep = sweep_of(parked, 60.0)
    assert in_free_space(small, [sweep] * 2).tolist() == [False]
    assert in_free_space(small, [sweep] * 3).tolist() == [True]


def test_foliage_stays_as_long_as_half_of_the_beams_return(parked):
    """Every n-th beam passes; a Gaussian of 0.2 m at 10 m is met by some thirty."""
    beams = np.arange(len(directions()))
    for passing, free in ((beams % 3 == 0, False), (beams % 3 != 0, True)):
        sweep = sweep_of(parked, np.where(passing, 30.0, 10.0))
        assert in_free_space(at([10, 0, 0], sigma_m=0.2), [sweep]).tolist() == [free]


def test_beams_that_pass_beside_a_hidden_centre_count(parked):
    """A post in front hides the middle 0.8 degrees of a Gaussian that is 2.8 degrees wide, but not its sides."""
    azimuth = np.degrees(np.arctan2(directions()[:, 1], directions()[:, 0]))
    post = sweep_of(parked, np.where(np.abs(azimuth) < 0.4, 5.0, 30.0))
    counts = count_beams(at([10, 0, 0], sigma_m=0.2), [post])
    assert counts.passed[0] > 3 and counts.stopped[0] == 0
    assert not count_beams(at([10, 0, 0], sigma_m=0.2), [sweep_of(parked, 5.0)]).passed.any()


def test_a_wall_just_behind_foliage_does_not_make_it_opaque(parked):
    """0.3 m are within the errors of poses, which do not remove anything, but beyond the noise of returns."""
    one = at([10, 0, 0], sigma_m=0.02)
    for distance_m, free, share in ((10.05, False, 1.0), (10.3, False, 0.5), (11.0, True, 0.5), (9.7, False, 1.0)):
        counts = count_beams(one, [sweep_of(parked, distance_m)] * 3)
        assert counts.free.tolist() == [free]
        assert (counts.ended_share < share) == [share < 1] and (counts.ended_share == 1) == [share == 1]
    assert counts.stopped > 0 and counts.ended == 0, "9.7 m: within the margin, but these beams say nothing of 10 m"


def test_noise_is_measured_across_the_surface(parked):
    """0.3 m behind are beyond the noise on a wall that faces the beam, and within it on one that the beam grazes."""
    flat = dataclasses.replace(at([10, 0, 0]), scale_m=np.float32([[0.1, 0.1, 0.003]]))
    facing = dataclasses.replace(flat, quat_wxyz=np.float32([[np.sqrt(0.5), 0, np.sqrt(0.5), 0]]))
    beams = [sweep_of(parked, 10.3)] * 3
    assert count_beams(facing, beams).ended == 0 and count_beams(facing, beams).through > 0
    assert count_beams(flat, beams).ended > 0 and count_beams(flat, beams).through == 0


def test_a_footprint_is_judged_by_the_space_that_it_fills(parked):
    """A disc in the plane of grazing beams touches none of them; tipped by 30 degrees it stands in their way."""
    flat = dataclasses.replace(at([10, 0, -0.1]), scale_m=np.array([[0.5, 0.05, 0.002]], np.float32))
    half = np.radians(30) / 2
    tipped = dataclasses.replace(flat, quat_wxyz=np.array([[np.cos(half), 0, np.sin(half), 0]], np.float32))
    # One row of beams 0.1 m above the disc.
    row = np.abs(directions()[:, 2]) < 1e-6
    sweep = sweep_of(parked, np.where(row, 30.0, 1.5))
    assert in_free_space(flat, [sweep] * 3).tolist() == [False]
    assert in_free_space(tipped, [sweep] * 3).tolist() == [True]


def test_beams_start_where_the_sensor_was_when_it_fired_them():
    """The car drives 2 m along y during the sweep, and all points are fired at the end, 1 m left of the reference.

    (10, 0.5, 0) is on their way to (20, 0, 0); (10, 0, 0), on the way from the reference, is not.
    """
    clip = Street(frames=2, speed_mps=0.0)
    lidar = clip.rig.lidars["top"].rig_from_lidar
    poses = np.stack([np.eye(4)] * 3)
    poses[:, 1, 3] = -1, 0, 1
    clip.ego = Trajectory(np.array([0, 1000, 2000]), poses @ geometry.inverse(lidar))
    ends = np.array([[20.0, 0, z] for z in (0.0, 0.02, 0.04)])
    sweep = Sweep(1000, 0, 2000, np.eye(4), ends, None, np.full(3, 2000))
    gaussians = at([10, 0.5, 0], [10, 0, 0], [10, -0.5, 0])
    assert in_free_space(gaussians, [sweep_beams(clip, "top", sweep)] * 3).tolist() == [True, False, False]


def test_what_belongs_to_a_mover_is_tested_where_the_mover_was(parked):
    """Beams pass 10 m ahead; the body is there, elsewhere, or of unknown place."""
    gaussians, sweeps = at([0, 0, 0]), [sweep_of(parked, 20.0)] * 3

    def body(x, y):
        return lambda t_us: geometry.pose_from_xyyaw(x, y, 0.3)

    assert in_free_space(gaussians, sweeps, body(10, 0)).tolist() == [True]
    assert in_free_space(gaussians, sweeps, body(20, 0)).tolist() == [False]
    assert in_free_space(gaussians, sweeps, lambda t_us: None).tolist() == [False]


def test_glass_in_the_box_of_a_car_stays(parked):
    gaussians, sweeps = at([0, 0, 0], [1.1, 0, 0]), [sweep_of(parked, 20.0)] * 3
    there = geometry.pose_from_xyyaw(10, 0, 0)
    assert in_free_space(gaussians, sweeps, lambda t_us: there, (2.0, 2.0, 2.0)).tolist() == [False, True]


def test_nothing_to_test_and_nothing_to_test_with(parked):
    assert in_free_space(Gaussians.empty(), [sweep_of(parked, 20.0)]).tolist() == []
    assert in_free_space(at([10, 0, 0]), []).tolist() == [False]


def test_held_out_sweeps_do_not_carve_and_long_logs_are_thinned_evenly():
    clip = Street(frames=200)
    chosen = [index for _, index in chosen_sweeps(clip, {0, 7})]
    assert len(chosen) == MOST_SWEEPS and chosen[0] == 1 and chosen[-1] == 199
    assert set(np.diff(chosen)) <= {3, 4, 5} and 7 not in chosen
    assert chosen_sweeps(Street(frames=2), {0, 1}) == []


@pytest.mark.slow
def test_lift_keeps_nothing_where_beams_passed():
    """A box stands in the first frame only and is not labelled: a ghost in front of a wall across the street.

    Beams 1 degree apart are 25 cm apart there: between some of them too few pass to say. What is left of the ghost is
    measured by the area of its discs, one of which may stand for many pixels.
    """
    boxes = {
        "van": ((3.0, 2.0, 2.5), np.array([[14.0, 0.0]] + [[80.0, 0.0]] * 4)),
        "wall": ((1.0, 16.0, 6.0), np.array([25.0, 0.0])),
    }
    clip = Street(frames=5, speed_mps=1.0, boxes=boxes, labelled=False)

    def ghosts(carve):
        scene = reconstruct(clip, "lift", settings=LiftSettings(points=PointSettings(carve=carve)))
        inside = geometry.points_in_box(scene.static.mean_m - np.array([14.0, 0, 1.4]), (3.4, 2.4, 2.0), 0.0)
        beams = [sweep_beams(clip, lidar, clip.sweep(lidar, i)) for lidar, i in chosen_sweeps(clip, set())]
        area_m2 = 2 * np.pi * np.prod(np.sort(scene.static.scale_m[inside], axis=1)[:, 1:], axis=1)
        return float(area_m2.sum()), int(in_free_space(scene.static, beams).sum())

    (kept_m2, free), (carved_m2, left) = ghosts(carve=False), ghosts(carve=True)
    assert kept_m2 > 5 and free > 100, "the front of the van has 5 m2"
    assert carved_m2 < 0.4 * kept_m2 and left == 0


def level_ground():
    """At z = 0, x from -1 to 9 m."""
    flat, up = np.zeros((100, 100)), np.ones((100, 100), bool)
    return Ground(np.array([-1.0, -5.0]), 0.1, flat.astype(np.float32), up, up, up, np.ones((100, 100), np.uint8))


def body_of(xyz_m, normal):
    cloud = dataclasses.replace(Cloud.empty(), xyz_m=xyz_m, intensity=np.full(len(xyz_m), 0.5, np.float32))
    return Surfels(None, cloud, normal, *np.full((2, len(xyz_m)), 0.5, np.float32), np.zeros(len(xyz_m), np.uint8))


def test_bodies_keep_what_is_not_free_as_opaque_as_beams_found_it(parked):
    """Three sweeps end at 8 m and one passes; but the ground, known up to 9 m, stays opaque."""
    empty = body_of(np.zeros((0, 3)), np.zeros((0, 3), np.float32))

    def seen(places, distance_m, normal):
        beams = [sweep_of(parked, distance_m)] * 3 + [sweep_of(parked, 2 * distance_m)]
        gaussians = dataclasses.replace(at(*places, sigma_m=0.01), opacity=np.ones(len(places), np.float32),
                                        normal=np.tile(np.float32(normal), (len(places), 1)))  # fmt: skip
        counts = count_beams(gaussians, beams)
        solid, kept = empty.outside_free_space(gaussians, beams, level_ground())
        return solid.opacity, kept.tolist(), counts.ended_share**2

    for normal in ([0, 0, 1], [1, 0, 0]):
        opacity, kept, share = seen([[8, 0, 0], [7.94, 0, 1], [5, 0, 0]], 8.0, normal)
        assert kept == [True, True, False] and 0.3 < share[1] < 0.8
        np.testing.assert_allclose(opacity, [1.0, share[1]], rtol=1e-6)
        # Beyond the known ground what is level may be ground.
        opacity, kept, share = seen([[12, 0, 0]], 12.0, normal)
        assert kept == [True] and 0.3 < share[0] < 0.8
        np.testing.assert_allclose(opacity, [1.0 if normal[2] else share[0]], rtol=1e-6)


def test_what_is_low_over_the_ground_is_weighed_by_the_margin_for_poses(parked):
    """Beams that end 0.3 m behind it, beyond their noise, make grass no less opaque; a bush they do."""
    empty = body_of(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    low, high = [8, 0, 0.25], [8, 0, 0.35]
    gaussians = dataclasses.replace(at(low, high, sigma_m=0.1), opacity=np.ones(2, np.float32))
    solid, kept = empty.outside_free_space(gaussians, [sweep_of(parked, 8.3)] * 3, level_ground())
    assert kept.all() and solid.opacity[0] == 1.0 and solid.opacity[1] < 0.3


def test_boxes_of_actors_that_move_are_not_exact_to_the_noise_of_returns(parked):
    """Beams that end 0.3 m behind make an actor's Gaussians, outside its box, no less opaque."""
    one = at([10, 0, 0], sigma_m=0.1)
    counts = count_beams(one, [sweep_of(parked, 10.3)] * 3)
    world = body_of(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    standing, moving = (dataclasses.replace(world, actor=SimpleNamespace(standing=each)) for each in (True, False))
    assert world.ended_share(counts) < 0.2 and standing.ended_share(counts) < 0.2
    assert moving.ended_share(counts) == 1.0


def test_pixels_low_over_the_road_are_moved_down_to_it_along_their_rays():
    """From 1.5 m above the road at 45 degrees: 0.2 m over it is 0.2 m before it, and pixels grow with the depth."""
    steep, level = np.array([1.0, 0, -1]) / np.sqrt(2), np.array([1.0, 0, -0.01])
    xyz = np.array([[1.3, 0, 0.2], [1.3, 0, 0.6], [1.3, 0, 0.2]])
    depth, pixel, rgb = np.full(3, 1.3 * np.sqrt(2)), np.full(3, 0.01), np.zeros((3, 3), np.float32)
    rays, four = np.stack([steep, steep, level]), np.full(3, 4, np.int32)
    lifted = Lifted(xyz, np.zeros((3, 3)), rays, depth, pixel, rgb, four, four, four, np.ones(3, np.uint8))
    moved = on_ground(lifted, level_ground())
    assert moved.xyz_m == pytest.approx(np.array([[1.5, 0, 0]]), abs=1e-6)
    assert moved.depth_m == pytest.approx([1.5 * np.sqrt(2)]) and moved.pixel_m == pytest.approx([0.01 * 1.5 / 1.3])
    assert moved.normal.tolist() == [[0, 0, 1]] and moved.surfel.tolist() == [-1]


def test_a_pixel_in_free_space_leaves_its_place_to_the_surfels_behind_it(parked):
    """A wall at 10.7 m. Matching puts the right half of the picture at 10 m, where the surfel there agrees with it.

    Stripes keep blocks of pixels to two by two: four in either half. Behind the left half lies one more, its backdrop;
    that of the right half would be seen through the left one.
    """
    wall = np.array([[10.7, -1.0, 0.0], [10.7, 1.0, 0.0]])
    body = body_of(wall, np.tile(np.float32([-1, 0, 0]), (2, 1)))
    shape, turn = (4, 8), np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    tile = Tile(8, 4, 16.0, (4.0, 2.0), np.eye(3), 1, None, np.ones(shape, bool), np.zeros(3))
    rgb = np.full((*shape, 3), 99, np.uint8)
    rgb[:, ::2] += np.uint8(LEAST_TOLERANCE)
    view = WorkingView("front", 0, 1_000_000, True, tile, geometry.pose(turn, np.zeros(3)), np.zeros(3), rgb)
    depth = np.tile(np.float32([1 / 10.7] * 4 + [0.1] * 4), (4, 1))
    picture = DepthPicture(depth, np.zeros(shape, np.int32), np.full(shape, -1, np.int32), *np.zeros((2, *shape), bool))
    settings = LiftSettings(opacity=0.5)
    pixels = body_pixels([body], [view], [picture], [rgb], settings)[0]
    for beams, left, discs in (([], 9, 0), ([sweep_of(parked, 10.7 / directions()[:, 0])] * 3, 5, 1)):
        gaussians, lifted, _ = body_gaussians(body, pixels, level_ground(), [view], [picture], [rgb], settings, beams)
        assert lifted == left and len(gaussians) - lifted == discs
    assert gaussians.mean_m[-1] == pytest.approx(wall[0])
    wrong = pixels[pixels.depth_m < 10.5]
    assert marked_free([picture], wrong)[0].free.tolist() == [[False] * 4 + [True] * 4] * 4


def test_a_footprint_that_is_only_too_long_is_made_round(parked):
    """Five times as long as wide: beams to 50 m pass its ends, and stop at its centre or not."""
    one, four = np.ones(1), np.full(1, 4, np.int32)
    grazing, normal = np.array([[0.2, np.sqrt(0.96), 0]]), np.array([[-1.0, 0, 0]])
    lifted = Lifted(np.array([[30.0, 0, 0]]), normal, grazing, 10 * one, 0.17 * one, np.zeros((1, 3), np.float32),
                    four - 5, four, four, np.ones(1, np.uint8))  # fmt: skip
    near = np.linalg.norm(directions() * 30 - [30, 0, 0], axis=1) < 0.16
    for ranges, round_one in ((np.where(near, 30.0, 50.0), 1), (50.0, 0)):
        sweeps = [sweep_of(parked, ranges)] * 3
        body = body_of(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
        kept, dropped = outside_free_space(lifted, body, level_ground(), LiftSettings(), sweeps)
        assert (len(kept), len(dropped)) == (round_one, 1 - round_one)
        assert kept.scale_m[:, :2] == pytest.approx(np.full((round_one, 2), PIXEL_SIGMA * 0.17), rel=1e-5)


def test_footprints_on_level_surfaces_stretch_as_far_as_they_are_seen_flat_and_others_do_not():
    """Rays fall 1 in 20, so footprints are 20 times as long as wide; on walls, and on slopes of 30 degrees, only 5."""
    three, four = np.ones(3), np.full(3, 4, np.int32)
    slope = np.array([-np.sin(np.radians(30)), 0, np.cos(np.radians(30))])
    normal = np.array([[0.0, 0, 1], slope, [-1.0, 0, 0]])
    along = np.cross(normal, [0.0, 1, 0])
    ray = np.sqrt(1 - 1 / 400) * along - normal / 20
    far = np.array([[500.0, 0, 0]] * 3)
    lifted = Lifted(far, normal, ray, 40 * three, 0.1 * three, np.zeros((3, 3), np.float32), four - 5, four, four,
                    np.ones(3, np.uint8))  # fmt: skip
    body = body_of(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    made = footprints_of(lifted, body, level_ground(), LiftSettings())
    assert made.scale_m[:, 0] / made.scale_m[:, 1] == pytest.approx([20, 5, 5], rel=1e-4)


@pytest.mark.parametrize(("column", "there"), [(-1, 1799), (0, 0), (1800, 0), (-(2**63), 0), (2**62, 1799)])
def test_columns_wrap_and_those_of_no_number_stay_in_the_image(column, there):
    assert beam_counting._wrapped.py_func(column) == there
