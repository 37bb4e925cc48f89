"""Surfels, views and matching costs one at a time, against values worked out by hand."""

import numpy as np
import pytest
from reconstruct_street import Street

from nurec_sim import geometry
from nurec_sim.reconstruct.free_space import BeamCounts
from nurec_sim.reconstruct.lift import colour, lifting, splat, surfaces
from nurec_sim.reconstruct.lift.bodies import Surfels, surfels_of
from nurec_sim.reconstruct.lift.cloud import Cloud
from nurec_sim.reconstruct.lift.pictures import depth_pictures
from nurec_sim.reconstruct.lift.points import Actor, actors_of, gather, voxel_edge_m
from nurec_sim.reconstruct.lift.settings import LiftSettings, PointSettings
from nurec_sim.reconstruct.lift.smoothing import UNIT, smooth_depth
from nurec_sim.reconstruct.lift.views import Tile, WorkingView
from nurec_sim.types import Track, Trajectory

TOWARDS = np.array([[0.0, 0.0, -1.0]])
"""The normal of a surface that faces the views of these tests, which look along z."""


def looking_ahead(behind_m=0.0, width=9, height=9, focal_px=10.0):
    """A packed view (``WorkingView.packed``) from as far behind the origin, without drift."""
    pose = geometry.pose(np.eye(3), np.array([0.0, 0.0, behind_m]))
    return np.concatenate(
        [[focal_px, width / 2, height / 2, width, height], pose[:3, :3].ravel(), pose[:3, 3], np.zeros(6)]
    )


# ------------------------------------------------------------------------------------------------------------- drawing


@pytest.mark.parametrize(("behind", "shown"), [(0.097, (0.1 + 0.097) / 2), (0.095, 0.1)])
def test_surfels_within_four_percent_of_the_front_are_averaged(behind, shown):
    """Two at the middle of the same pixel, at inverse depths 0.1 and a little less."""
    bodies = [
        (looking_ahead(), np.array([[0.0, 0.0, 1 / w]]), TOWARDS, np.array([1.0]), offset)
        for offset, w in ((5, 0.1), (8, behind))
    ]
    inverse_depth, index = splat.draw_surfels((9, 9), bodies)
    assert inverse_depth[4, 4] == pytest.approx(shown, rel=1e-5) and index[4, 4] == 5
    assert np.count_nonzero(inverse_depth) == 1 and (index >= 0).sum() == 1


def seen_among(others, count):
    """What is left of a pixel at 10 m, of whose 48 neighbours so many are at the other inverse depth."""
    inverse_depth = np.full(49, 0.1, np.float32)
    inverse_depth[[i for i in range(49) if i != 24][:count]] = others
    inverse_depth, index = inverse_depth.reshape(7, 7), np.zeros((7, 7), np.int32)
    splat.drop_shine_through(inverse_depth, index)
    return inverse_depth[3, 3], index[3, 3]


def test_what_shines_through_a_surface_is_dropped():
    """Most of the surroundings lie clearly, more than 20 %, in front of it."""
    assert seen_among(0.2, 40) == (0.0, -1)
    assert seen_among(0.2, 20) == (np.float32(0.1), 0)
    assert seen_among(0.115, 48) == (np.float32(0.1), 0)


@pytest.mark.parametrize(("standing", "share"), [(None, 0.5), (True, 0.5), (False, 8 / 9)])
def test_noise_of_beams_counts_on_what_stands_and_the_margin_for_poses_on_what_moves(standing, share):
    """Passed by one of eight beams by the margin, and by two of three across it; each Gaussian has stopped one more."""
    counts = BeamCounts(*(np.array([n]) for n in (1, 7, 2, 1)))
    path = Trajectory(np.array([0, 2_000_000]), np.stack([np.eye(4), np.eye(4)]))
    actor = standing if standing is None else Actor(0, Track("", "automobile", (4.0, 2.0, 1.5), path), standing, path)
    empty = np.zeros(0, np.float32)
    body = Surfels(actor, Cloud(np.zeros((0, 3)), np.zeros((0, 3)), empty, empty), empty, empty, empty, empty)
    assert body.ended_share(counts)[0] == pytest.approx(share)


def closed(rows, length_m=4.0):
    """A column of pixels: body, inverse depth and surfel of each, its gaps filled; 0.1 m high at 10 m."""
    body, inverse_depth, index = (np.array(part)[:, None] for part in zip(*rows, strict=True))
    body, inverse_depth, index = body.astype(np.int32), inverse_depth.astype(np.float32), index.astype(np.int32)
    splat.close_gaps(inverse_depth, index, body, np.array([0.0, length_m, 4.0]), np.float32(100.0))
    return list(
        zip(body[:, 0].tolist(), inverse_depth[:, 0].astype(float).round(4).tolist(), index[:, 0].tolist(), strict=True)
    )


CAR, FAR, OPEN, NEAR = (1, 0.1, 7), (0, 0.09, 3), (0, 0.0, -1), (0, 0.2, 3)


def test_scenery_does_not_shine_through_between_rows_of_beams_on_an_actor():
    """The gap takes the depth between those of its ends, and the surfel of the nearer one; what is nearer stays."""
    lower = (1, 0.104, 8)
    assert closed([FAR, CAR, FAR, OPEN, NEAR, lower, FAR]) == [
        FAR, CAR, (1, 0.101, 7), (1, 0.102, 8), (0, 0.2, 3), lower, FAR,
    ]  # fmt: skip


def test_gaps_that_are_high_or_deep_for_an_actor_stay_and_so_do_those_of_the_world():
    # Up to an eighth of its length, 0.5 m or five pixels, and a quarter of it, 1 m, in depth.
    for rows, kept in ((5, False), (6, True)):
        column = [CAR, *[FAR] * (rows - 1), CAR]
        assert (closed(column) == column) == kept
    for length_m, kept in ((4.0, False), (0.6, True)):
        column = [CAR, FAR, CAR]
        assert (closed(column, length_m) == column) == kept
    for depth_m, kept in ((10.9, False), (11.1, True)):
        column = [CAR, OPEN, (1, round(1 / depth_m, 4), 8)]
        assert (closed(column) == column) == kept
    assert closed([CAR, OPEN, (2, 0.1, 9)]) == [CAR, OPEN, (2, 0.1, 9)]
    assert closed([(0, 0.1, 1), OPEN, (0, 0.1, 2)]) == [(0, 0.1, 1), OPEN, (0, 0.1, 2)]


def test_pictures_show_an_actor_between_its_rows_of_returns_and_the_world_between_its_own():
    """A wall 12 m ahead, and 2 m before it a car of which beams met two rows, or the same as part of the world."""
    across, up = (part.ravel() for part in np.meshgrid(np.arange(-2, 2, 0.05), np.arange(-2, 2, 0.05)))
    wall = np.column_stack([across, up, np.full(len(across), 12.0)])
    rows = np.column_stack([np.tile(np.arange(-1, 1, 0.05), 2), np.repeat([-0.2, 0.2], 40), np.full(80, 10.0)])
    tile = Tile(40, 40, 100.0, (20.0, 20.0), np.eye(3), 1, None, np.ones((40, 40), bool), np.zeros(3))
    grey = np.full((40, 40, 3), 90, np.uint8)
    view = WorkingView("front", 0, 1_000_000, True, tile, np.eye(4), np.zeros(3), grey)
    path = Trajectory(np.array([0, 2_000_000]), np.stack([np.eye(4), np.eye(4)]))
    actor = Actor(0, Track("car", "automobile", (4.0, 2.0, 1.5), path), False, path)
    for bodies, number, depth_m in (([(None, wall), (actor, rows)], 1, 10.0), ([(None, [*wall, *rows])], 0, 12.0)):
        made = [
            Surfels(who, Cloud(np.array(xyz), np.zeros((len(xyz), 3)), sizes, sizes), np.repeat(TOWARDS, len(xyz), 0)
                    .astype(np.float32), sizes, sizes, np.zeros(len(xyz), np.uint8))
            for who, xyz in bodies for sizes in [np.full(len(xyz), 0.06, np.float32)]
        ]  # fmt: skip
        (picture,) = depth_pictures([view], made, LiftSettings(), lambda fraction: None)
        assert picture.body[18:22, 15:25].tolist() == [[number] * 10] * 4
        assert 1 / picture.inverse_depth[19:21, 15:25] == pytest.approx(depth_m, abs=0.1)


@pytest.mark.parametrize(("grey", "kept"), [(28, False), (92, True)])
def test_a_rim_that_looks_like_what_lies_behind_it_is_trimmed(grey, kept):
    """A near surface of grey 100 left of a far one of grey 20; the rim of the near one has another grey."""
    inverse_depth = np.full((9, 10), 0.2, np.float32)
    inverse_depth[:, 5:] = 0.1
    index, image = np.zeros((9, 10), np.int32), np.full((9, 10), 100, np.uint8)
    image[:, 5:], image[4, 4] = 20, grey
    splat.trim_silhouettes(inverse_depth, index, image)
    assert (inverse_depth[4, 4] > 0) == kept and (index[4, 4] == 0) == kept
    inverse_depth[4, 4] = 0.2
    assert (inverse_depth[:, :5] == np.float32(0.2)).all() and (inverse_depth[:, 5:] == np.float32(0.1)).all()


# ------------------------------------------------------------------------------------------------------------ surfaces


def noisy_wall(noise_m, seed=0):
    """A wall 4 m by 3 m at x = 10 m with points as near as 6 cm, measured from the origin with noise along x."""
    random = np.random.default_rng(seed)
    y, z = random.uniform(-2, 2, 3300), random.uniform(-1.5, 1.5, 3300)
    xyz = np.column_stack([10 + random.normal(0, noise_m, len(y)), y, z])
    return Cloud(xyz, np.zeros_like(xyz), np.full(len(y), 0.06, np.float32), np.zeros(len(y), np.float32))


def test_a_wall_thicker_than_its_points_are_apart_becomes_thin():
    """Noise of 3 cm on points 6 cm apart: the 20 nearest lie as much across the wall as along it."""
    wall = noisy_wall(0.03)
    flat, normals, _, _ = surfaces.surface_of(wall)
    inner = (np.abs(wall.xyz_m[:, 1]) < 1.8) & (np.abs(wall.xyz_m[:, 2]) < 1.3)
    # Points beyond two standard deviations, 4.6 % of them, keep their place.
    assert np.mean(np.abs(flat.xyz_m[inner, 0] - 10) < 0.01) > 0.9
    assert np.mean(normals[inner, 0] < -np.cos(np.radians(8))) > 0.9


def test_a_pole_before_a_wall_stays_before_it():
    """Its points are too few to hide the plane of the wall, and lie 2.4 standard deviations before it."""
    wall, z = noisy_wall(0.01), np.arange(-1.4, 1.4, 0.06)
    pole = np.column_stack([np.full(len(z), 9.88), np.zeros(len(z)), z])
    same = np.full(len(z), 0.06, np.float32)
    found, _, _, _ = surfaces.surface_of(Cloud.concatenate([wall, Cloud(pole, np.zeros_like(pole), same, same)]))
    assert np.mean(np.abs(found.xyz_m[len(wall) :, 0] - 9.88) < 0.04) > 0.9
    assert np.mean(np.abs(found.xyz_m[: len(wall), 0] - 10) < 0.01) > 0.9


def test_cells_get_the_sums_of_those_beside_them():
    cells = np.unique(np.random.default_rng(0).integers(1, 5, (30, 3)), axis=0)
    keys, own = (cells << (42, 21, 0)).sum(axis=1), np.arange(2.0 * len(cells)).reshape(-1, 2)
    for step in [(0, 0, 0), (1, -1, 0), (-1, 0, 1), (0, 0, -1)]:
        total = np.ones_like(own)
        surfaces._add_beside(keys, sum(each << bits for each, bits in zip(step, (42, 21, 0), strict=True)), own, total)
        for cell, found in zip(cells, total - 1, strict=True):
            assert (found == own[(cells == cell + step).all(axis=1)].sum(axis=0)).all()


def test_planes_do_not_depend_on_where_the_origin_is():
    """Sums of squares of coordinates in the hundreds of kilometres would have no digits left for millimetres."""
    wall, far = noisy_wall(0.03), np.array([5e5, -4e6, 100.0])
    moved = Cloud(wall.xyz_m + far, wall.eye_m + far, wall.spacing_m, wall.intensity)
    here, there = surfaces.surface_of(wall), surfaces.surface_of(moved)
    np.testing.assert_allclose(there[0].xyz_m - far, here[0].xyz_m, atol=1e-6)
    np.testing.assert_allclose(there[1], here[1], atol=1e-4)


# ------------------------------------------------------------------------------------------------------------- owning


def owned(views, own_view=0, own_rgb=100.0, depth_m=10.0, owning=True):
    """Whether a point 10 m ahead, which its own view saw at ``depth_m``, stays, and its colour.

    Views are (metres behind the origin, inverse depth seen, grey shown); they may own or not.
    """
    packed = np.stack([looking_ahead(behind_m) for behind_m, _, _ in views])
    inverse_depth = np.stack([np.full((9, 9), w, np.float32) for _, w, _ in views])
    pictures = np.stack([np.full((9, 9, 3), grey, np.uint8) for _, _, grey in views])
    rgb, owns = np.full((1, 3), own_rgb, np.float32), np.full(inverse_depth.shape, owning)
    one = np.array([[0.0, 0.0, 10.0]]), np.array([depth_m]), np.array([own_view], np.int32), np.zeros(1, bool)
    keep = lifting.owned(*one, rgb, packed, inverse_depth, owns, pictures, np.ones(len(views), bool), 0.002,
                         lifting.OWNER_RING, lifting.OWNER_BORDER)  # fmt: skip
    return bool(keep[0]), rgb[0, 0]


AGREES, THROUGH = (0.0, 0.1, 100), (0.0, 0.02, 100)


@pytest.mark.parametrize(
    ("others", "stays"),
    [([THROUGH], False), ([AGREES, THROUGH], False), ([AGREES, AGREES, THROUGH], True), ([AGREES], True), ([], True)],
)
def test_points_go_if_more_than_half_as_many_views_look_through_them_as_agree(others, stays):
    assert owned([AGREES, *others])[0] == stays


def test_the_nearest_view_owns_a_surface_and_of_equally_near_ones_the_first():
    """Rings grow by exp(0.1): 10 m lies in ring 23, as 10.4 m does, 8 m in ring 20."""
    assert owned([AGREES, AGREES], own_view=0)[0] and not owned([AGREES, AGREES], own_view=1)[0]
    assert not owned([AGREES, (-2.0, 1 / 8, 100)], own_view=0)[0]
    assert owned([(2.0, 1 / 12, 100), AGREES], own_view=1)[0]
    assert not owned([(0.4, 1 / 10.4, 100), AGREES], own_view=1)[0]


def test_a_view_whose_pixel_is_gone_agrees_and_owns_nothing():
    nearer = (-2.0, 1 / 8, 100)
    assert not owned([AGREES, nearer])[0] and owned([AGREES, nearer], owning=False)[0]
    assert owned([AGREES, nearer, THROUGH, nearer], owning=False)[0]


def test_other_views_mix_into_a_colour_with_three_tenths_of_its_weight():
    """Two as near, which show 200; then one 1.25 times as far away, which counts (1 / 1.25)^2 as much."""
    same = (0.0, 0.1, 200)
    assert owned([AGREES, same, same])[1] == pytest.approx((100 + 0.3 * 200 * 2) / 1.6)
    share = 0.3 / 1.25**2
    assert owned([AGREES, (2.5, 1 / 12.5, 200)])[1] == pytest.approx((100 + share * 200) / (1 + share))


def test_a_nearer_view_mixes_in_by_as_much_more():
    """From 10 m pixels are 1 / 1.09 as wide as from 10.9 m."""
    share = 0.3 * 1.09**2
    assert owned([(0.9, 1 / 10.9, 100), (0.0, 0.1, 200)], depth_m=10.9)[1] == pytest.approx(
        (100 + share * 200) / (1 + share)
    )


def view_of(rgb):
    """A level view along x with a focal length of 10 pixels."""
    height, width = rgb.shape[:2]
    tile = Tile(width, height, 10.0, (width / 2, height / 2), np.eye(3), 1, None, np.ones((height, width), bool),
                np.zeros(3))  # fmt: skip
    pose = geometry.pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
    return WorkingView("front", 0, 1_000_000, True, tile, pose, np.zeros(3), rgb)


def test_normals_face_the_camera_where_one_surface_ends_before_another():
    """Walls across the view at 5 and 10 m: square to it, but for the two pixels on each side of the step."""
    inverse_depth = np.full((9, 10), 0.2, np.float32)
    inverse_depth[:, 5:] = 0.1
    normal = lifting.normals_of(view_of(np.zeros((9, 10, 3), np.uint8)), inverse_depth)
    assert normal[4, [0, 1, 2, 7, 8, 9]] == pytest.approx(np.tile([-1.0, 0, 0], (6, 1)), abs=1e-6)
    for column in (3, 4, 5, 6):
        ray = np.array([1.0, -(column + 0.5 - 5) / 10, 0.0])
        assert normal[4, column] == pytest.approx(-ray / np.linalg.norm(ray))


@pytest.mark.parametrize(
    ("rgb", "sky"), [((200, 190, 195), True), ((100, 110, 140), True), ((60, 70, 100), False), ((120, 110, 115), False)]
)
def test_sky_is_bright_or_clearly_blue_and_above_the_horizon(rgb, sky):
    """Beside a brightest grey of 240: from 192 on it is bright; what is blue counts from 108 on."""
    found = lifting.sky_coloured(view_of(np.full((8, 8, 3), rgb, np.uint8)), np.zeros((8, 8), np.float32), 240.0)
    assert (found[:4] == sky).all() and not found[4:].any()


# ------------------------------------------------------------------------------------------------------------- colours


def seen_colours(depths_m, free=(False, False)):
    """A point 10 m from one view and 20 m from another one behind it, grey of 100 and 200."""
    packed = np.stack([looking_ahead(), looking_ahead(10.0)])
    inverse_depth = np.stack([np.full((9, 9), 1 / depth_m, np.float32) for depth_m in depths_m])
    wrong = np.stack([np.full((9, 9), each) for each in free])
    pictures = np.stack([np.full((9, 9, 3), grey, np.uint8) for grey in (100, 200)])
    return colour.seen_colours(np.array([[0.0, 0.0, 10.0]]), TOWARDS, packed, inverse_depth, wrong, pictures,
                               np.ones(2, bool), 0.002)  # fmt: skip


def test_views_colour_a_point_by_the_inverse_square_of_their_distance():
    """10 and 20 m away: four to one."""
    rgb, pixel_m, through = seen_colours((10, 20))
    assert rgb[0] == pytest.approx([(4 * 100 + 200) / 5] * 3)
    assert pixel_m[0] == pytest.approx(10.0 / 10.0) and through[0] == 0


def test_what_lies_well_behind_a_depth_that_beams_passed_is_not_seen_there():
    """0.3 m and 2 % of 10 m behind it: 9.4 m hides the point, 9.6 m does not."""
    for depth_m, grey in ((9.4, 200), (9.6, (4 * 100 + 200) / 5)):
        assert seen_colours((depth_m, 20), (True, False))[0][0] == pytest.approx([grey] * 3)


def test_points_that_no_image_shows_are_grey_by_their_intensity():
    """From 0.2 to 0.6, reached at the ninth decile of the known intensities; unknown ones count as half of that."""
    grey = colour.grey_of(np.array([*range(11), np.nan], np.float32))
    assert grey[[0, 3, 9, 10, 11], 1] == pytest.approx([0.2, 0.2 + 0.4 / 3, 0.6, 0.6, 0.4])
    assert colour.grey_of(np.full(2, np.nan, np.float32)) == pytest.approx(0.4)


def test_the_response_of_a_camera_is_not_that_of_the_glare_in_it():
    """Four fifths of the light everywhere, but in 15 % of the points, which are white."""
    random = np.random.default_rng(0)
    true = random.uniform(0.1, 0.9, (2000, 3)).astype(np.float32)
    shown = 0.8 * true
    shown[:300] = 1.0
    isp, _ = colour.solve_isp(["a", "b"], {"a": (true, np.ones(2000, bool)), "b": (shown, np.ones(2000, bool))})
    assert isp["b"] @ [0.4, 0.4, 0.4, 1] == pytest.approx([0.32] * 3, abs=0.02)


def test_pixels_without_depth_have_no_point_and_those_at_infinity_lie_at_1000_m():
    points = lifting.points_of(view_of(np.zeros((1, 3, 3), np.uint8)), np.array([[np.nan, 0, 0.1]], np.float32))
    assert np.isnan(points[0, 0]).all() and points[0, 1:, 0] == pytest.approx([1000, 10])


@pytest.mark.parametrize(("count", "compared"), [(299, False), (300, True)])
def test_cameras_are_compared_from_300_shared_points_on(count, compared):
    true = np.random.default_rng(0).uniform(0.1, 0.9, (1000, 3)).astype(np.float32)
    isp, unaligned_cameras = colour.solve_isp(
        ["a", "b"], {"a": (true, np.ones(1000, bool)), "b": (0.8 * true, np.arange(1000) < count)}
    )
    assert (unaligned_cameras == []) == compared and np.allclose(isp["b"], np.eye(3, 4)) != compared


# ------------------------------------------------------------------------------------------------------------- depth


def smoothed_middle(jump_to):
    """Level in the middle of a picture of level 10, where level 16 costs nothing and level 10 costs 30."""
    cost = np.full((9, 9, 24), 200.0, np.float32)
    cost[:, :, 10] = 0
    cost[4, 4, 10], cost[4, 4, 16] = 30, 0
    image = np.full((9, 9), 0, np.uint8)
    image[4, 4] = jump_to
    return smoothed(cost, image)[4, 4] / 0.01


def smoothed(cost, image):
    """Depth by these costs of all pixels, of which none is measured."""
    whole = np.rint(cost.reshape(-1, 24) * UNIT).astype(np.int16)
    return smooth_depth(whole, np.full(image.shape, -1, np.int32), image, 0.01 * np.arange(24))


def test_lone_matches_are_smoothed_away_unless_an_edge_surrounds_them():
    """Staying alone costs 80 on each of 8 paths, 11 beside a change of 240 grey levels; the match counts 30 on each."""
    assert smoothed_middle(jump_to=0) == pytest.approx(10, abs=0.5)
    assert smoothed_middle(jump_to=240) == pytest.approx(16, abs=0.5)


def test_inverse_depth_lies_at_the_vertex_between_levels():
    cost = ((np.arange(24) - 10.3) ** 2).astype(np.float32)[None, None]
    assert smoothed(cost, np.zeros((1, 1), np.uint8))[0, 0] == pytest.approx(0.103, rel=1e-3)


# ------------------------------------------------------------------------------------------------------------- points


def cloud_of(xyz_m):
    n = len(xyz_m)
    return Cloud(np.array(xyz_m, float), np.zeros((n, 3)), np.full(n, 0.1, np.float32), np.full(n, np.nan, np.float32))


def test_a_scan_line_with_noise_of_its_ranges_faces_the_sensor():
    """Its points spread least across the plane of its beams, which says nothing of the wall that they hit."""
    noise_m = np.random.default_rng(0).normal(0, 0.01, 50)
    line = np.column_stack([np.linspace(-1, 1, 50), 5 + noise_m, np.zeros(50)])
    _, normal, _, _ = surfaces.surface_of(cloud_of(line))
    assert (-normal[:, 1] > 0.95).all()


def test_discs_are_a_twentieth_as_thick_as_wide_but_3_mm():
    n = 2
    made = surfaces.discs(np.zeros((n, 3)), np.repeat(-TOWARDS, n, axis=0), np.array([0.045, 0.18]), np.zeros((n, 3)),
                          np.zeros(n), np.zeros(n, np.uint8), 0.9)  # fmt: skip
    assert made.scale_m[0] == pytest.approx([0.045, 0.045, 0.003])
    assert made.scale_m[1] == pytest.approx([0.18, 0.18, 0.009])


def test_the_sheet_of_the_ground_has_no_gaps():
    """Where four discs of its lattice meet, less than a tenth of what is below shows through, at 0.95 of opacity."""
    found = gather(Street(frames=3), [], set(), PointSettings())
    (world,), ground = surfels_of(Street(frames=3), [], found, LiftSettings())
    sheet = np.arange(len(world.cloud)) >= len(world.cloud) - len(ground.sheet(found.static))
    corner = world.spacing_m[sheet] / np.sqrt(2)
    each = 0.95 * np.exp(-((corner / world.sigma_m[sheet]) ** 2) / 2)
    assert sheet.sum() > 100 and ((1 - each) ** 4 < 0.1).all()


def lattice(*counts, pitch_m):
    """Points of a lattice, 0.1 m voxels each, and which of them are not at its border."""
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    wide = [axis for axis in range(3) if counts[axis] > 1]
    inner = np.all((index[:, wide] >= 2) & (index[:, wide] < np.array(counts)[wide] - 2), axis=1)
    n = len(index)
    return Cloud(index * pitch_m, np.full((n, 3), 50.0), np.full(n, 0.1, np.float32), np.zeros(n, np.float32)), inner


@pytest.mark.parametrize(("pitch_m", "spacing_m", "sigma_m"), [
    (0.05, 0.1, 0.063), (0.12, 0.12, 0.0756), (0.2, 0.2, 0.126), (0.25, 0.25, 0.126), (0.4, 0.3, 0.126)])  # fmt: skip
def test_discs_close_a_wall_that_beams_sampled_in_rows_and_columns(pitch_m, spacing_m, sigma_m):
    """0.63 of the distance between points, of two to three edges of a voxel (0.1 m) at most."""
    wall, inner = lattice(1, 12, 12, pitch_m=pitch_m)
    _, _, spacing, sigma = surfaces.surface_of(wall)
    assert spacing[inner] == pytest.approx(spacing_m)
    assert sigma[inner] == pytest.approx(sigma_m)


def test_discs_of_foliage_leave_gaps():
    """Points that fill a volume: 0.7 of the distance of the fourth neighbour, and 0.45 of that."""
    leaves, inner = lattice(9, 9, 9, pitch_m=0.2)
    _, _, spacing, sigma = surfaces.surface_of(leaves)
    assert spacing[inner] == pytest.approx(0.14)
    assert sigma[inner] == pytest.approx(0.063)


def test_footprints_have_six_tenths_of_their_pixels():
    made = surfaces.footprints(np.zeros((1, 3)), TOWARDS, -TOWARDS, np.array([0.1]), np.zeros((1, 3)), np.zeros(1),
                               np.zeros(1, np.uint8), 0.9)  # fmt: skip
    assert made.scale_m[0] == pytest.approx([0.06, 0.06, 0.006])


def test_voxels_grow_by_powers_of_two_with_the_distance_from_the_drive():
    """0.75 % of it, between 6 and 24 cm, in powers of two."""
    aside = np.array([2.0, 15.9, 16.1, 31.0, 33.0, 63.0, 100.0])
    edge = voxel_edge_m(np.column_stack([np.zeros(7), aside, np.zeros(7)]), np.zeros((1, 3)), PointSettings())
    assert edge == pytest.approx([0.06, 0.06, 0.12, 0.12, 0.24, 0.24, 0.24])


def test_distances_from_a_long_drive_are_those_from_its_nearest_place():
    random = np.random.default_rng(0)
    path, points = np.cumsum(random.normal(0.2, 0.3, (100, 3)), axis=0), random.uniform(-30, 30, (500, 3))
    settings = PointSettings(min_voxel_m=1e-6, max_voxel_m=1e6, voxel_per_distance=1.0)
    nearest = np.linalg.norm(points[:, None] - path, axis=2).min(axis=1)
    assert voxel_edge_m(points, path, settings) == pytest.approx(1e-6 * 2 ** np.floor(np.log2(nearest / 1e-6)))


def test_the_lowest_30_cm_of_a_box_may_be_road():
    clip = Street(frames=2, boxes={"a": ((4.0, 1.8, 1.5), np.array([12.0, -2.0]))})
    found = gather(clip, actors_of(clip, PointSettings()), set(), PointSettings())
    foot, _ = found.feet[0]
    assert -0.75 + 0.2 < foot.xyz_m[:, 2].max() < -0.75 + 0.3 <= found.actors[0].xyz_m[:, 2].min()
    assert geometry.points_in_box(foot.xyz_m, (4.0, 1.8, 1.5), 0.3).all()
