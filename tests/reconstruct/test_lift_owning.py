"""Which views own a point, and what colours and sky they show; against values worked out by hand."""

import numpy as np
import pytest
from packed_views import TOWARDS, looking_ahead

from nurec_sim import geometry
from nurec_sim.reconstruct.lift import colour, lifting, sky_pixels
from nurec_sim.reconstruct.lift.views import Tile, WorkingView


def owned(views, own_view=0, own_rgb=100.0, depth_m=10.0, owning=True):
    """Whether a point 10 m ahead, which its own view saw at ``depth_m``, stays, and its colour.

    Views are (metres behind the origin, inverse depth seen, grey shown); they may own or not.
    """
    packed = np.stack([looking_ahead(behind_m) for behind_m, _, _ in views])
    inverse_depth = np.stack([np.full((9, 9), w, np.float32) for _, w, _ in views])
    pictures = np.stack([np.full((9, 9, 3), grey, np.uint8) for _, _, grey in views])
    rgb, owns = np.full((1, 3), own_rgb, np.float32), np.full(inverse_depth.shape, owning)
    one = np.array([[0.0, 0.0, 10.0]]), TOWARDS, np.array([depth_m]), np.array([own_view], np.int32), np.zeros(1, bool)
    keep = lifting.owned(*one, rgb, packed, inverse_depth, owns, pictures, np.ones(len(views), bool), 0.002,
                         lifting.OWNER_RING, lifting.OWNER_BORDER, False)  # fmt: skip
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


def test_depth_between_two_rows_of_beams_on_one_surface_is_known():
    """Columns: a wall at 10 m; a gap of another depth; beams on two surfaces, twice; a beam above only. Rows 0 and 4
    hold the beams; row 2 of the first column is 4 % nearer, row 3 6 %.
    """
    inverse_depth = np.full((6, 5), 0.1, np.float32)
    inverse_depth[2:4, 0] = 0.1 / 0.96, 0.1 / 0.94
    inverse_depth[1:4, 1], inverse_depth[4, 2], inverse_depth[0, 3] = 0.02, 0.05, 0.05
    measured = np.zeros((6, 5), bool)
    measured[0], measured[4, :4] = True, True
    found = lifting.between_measured(inverse_depth, measured)
    assert np.argwhere(found).tolist() == [[1, 0], [2, 0]]


def kept_by_two(place, normal, actor):
    """Whether a point stays, lifted by the first of two views and by the second, which is 2 m nearer."""
    normal = np.array([normal]) / np.linalg.norm(normal)
    packed = np.stack([looking_ahead(behind_m, width=219) for behind_m in (0.0, -2.0)])
    inverse_depth = np.stack([np.full((9, 219), 1 / (place[2] - nearer_m), np.float32) for nearer_m in (0.0, 2.0)])
    pictures, owns, grey = (
        np.full((2, 9, 219, 3), 100, np.uint8),
        np.ones((2, 9, 219), bool),
        np.ones((1, 3), np.float32),
    )
    return [
        lifting.owned(np.array([place]), normal, np.array([place[2] - 2.0 * own_view]), np.array([own_view], np.int32),
                      np.zeros(1, bool), grey.copy(), packed, inverse_depth, owns, pictures, np.ones(2, bool), 0.002,
                      lifting.OWNER_RING, lifting.OWNER_BORDER, actor)[0]
        for own_view in (0, 1)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("place", "normal", "stays"),
    [
        ((4.0, 0.0, 10.0), (8.0, 0.0, -4.0), [True, False]),
        ((4.0, 0.0, 10.0), (4.0, 0.0, -8.0), [False, True]),
        ((10.0, 0.0, 3.0), (0.1, 0.0, -1.0), [False, True]),
    ],
)
def test_the_nearer_of_two_views_does_not_own_a_wall_that_it_grazes(place, normal, stays):
    """The rays (4, 0, 8) of the second view lie in the first wall: their product with its normal is 0; the first view
    sees that wall from a sine of 0.083, as if from 10 m / 0.83. Both see the second wall well: sines of 0.66 and 0.6.
    The rays (10, 0, 1) of the second view graze the third surface, but it is level: 0.1 and -1 up.
    """
    assert kept_by_two(place, normal, actor=False) == stays


def test_the_view_with_the_smaller_pixels_owns_the_side_of_an_actor():
    """Sines of 0.177 and 0.0948: pixels as large as if seen squarely from 10 m / 0.177^0.5 = 23.8 m and 26.0 m."""
    side = (4.0, 0.0, 10.0), (2.0, 0.0, -1.25)
    assert kept_by_two(*side, actor=False) == [False, True]
    assert kept_by_two(*side, actor=True) == [True, False]


@pytest.mark.parametrize(("off", "stays"), [(0.0057, False), (-0.0057, False), (0.0058, True), (-0.0058, True)])
def test_a_nearer_view_owns_a_point_only_if_it_shows_it_in_the_same_place(off, stays):
    """From 8 m its inverse depth is 0.125, which 0.002 + 0.03 * 0.125 = 0.00575 more or less are the same as."""
    nearer = (-2.0, 0.125 + off, 100)
    assert owned([AGREES, nearer, AGREES, AGREES])[0] == stays


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
    found = sky_pixels.sky_coloured(view_of(np.full((8, 8, 3), rgb, np.uint8)), np.zeros((8, 8), np.float32), 240.0)
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
    # A disputed depth may be infinite, and then hides nothing.
    rgb, _, through = seen_colours((np.inf, 20), (True, False))
    assert rgb[0] == pytest.approx([200] * 3) and through[0] == 1


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


def test_of_points_of_one_colour_a_camera_has_another_exposure_and_no_haze():
    """Two cameras share grey asphalt, half as bright again in one of them: what is black is so in both."""
    random = np.random.default_rng(0)
    true = np.repeat(random.uniform(0.3, 0.4, (2000, 1)), 3, axis=1) + random.normal(0, 0.01, (2000, 3))
    every = np.ones(2000, bool)
    isp, _ = colour.solve_isp(
        ["a", "b"], {"a": (true.astype(np.float32), every), "b": (1.5 * true.astype(np.float32), every)}
    )
    assert isp["b"] @ [0.35, 0.35, 0.35, 1] == pytest.approx([0.525] * 3, abs=0.005)
    assert np.abs(isp["b"][:, 3]).max() < 0.01


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
