"""Depth of neighbouring views fused: cameras side by side, 0.5 m apart, look at walls across their axes.

With a focal length of 20 pixels a wall at 10 m lies 20 * 0.5 / 10 = 1 pixel further left in the next view.
"""

import numpy as np
import pytest

from nurec_sim import geometry
from nurec_sim.reconstruct.lift import depth, fusion, sky_pixels
from nurec_sim.reconstruct.lift.settings import ViewSettings
from nurec_sim.reconstruct.lift.smoothing import PRIOR_COST, UNIT
from nurec_sim.reconstruct.lift.splat import project_point, world_point
from nurec_sim.reconstruct.lift.views import Tile, WorkingView

SHAPE, FOCAL, TOLERANCE = (6, 12), 20.0, 0.001
WALL = np.float32(0.1)
NUMBERS = np.arange(72).reshape(SHAPE)


def view_at(right_m, drift_m=(0.0, 0.0, 0.0), fraction=(0.0, 0.0, 0.0), turn=None):
    tile = Tile(SHAPE[1], SHAPE[0], FOCAL, (SHAPE[1] / 2, SHAPE[0] / 2), np.eye(3), 1, None, np.ones(SHAPE, bool),
                np.array(fraction))  # fmt: skip
    pose = geometry.pose(np.eye(3) if turn is None else turn, np.array([right_m, 0.0, 0.0]))
    return WorkingView("front", 0, 0, True, tile, pose, np.array(drift_m), np.zeros((*SHAPE, 3), np.uint8))


def fuse_all(depths, fixed=None, surfaces=None, rounds=1):
    views, nowhere = [view_at(0.5 * k) for k in range(len(depths))], [np.zeros(SHAPE, bool)] * len(depths)
    return fusion.fused_depths(views, depths, fixed or nowhere, surfaces or nowhere, TOLERANCE, rounds)


def fused(depths, **options):
    return fuse_all(depths, **options)[0]


def walls(count):
    return [np.full(SHAPE, WALL) for _ in range(count)]


@pytest.mark.parametrize("wrong", [0.2, 0.05, 0.0])
def test_a_depth_that_the_neighbours_deny_becomes_theirs(wrong):
    """Nearer, farther, and infinitely far."""
    depths = walls(3)
    depths[1][3, 6] = wrong
    assert fused(depths)[1][3, 6] == pytest.approx(0.1, rel=1e-6)


def test_depths_that_agree_become_their_mean():
    depths = walls(3)
    depths[0][:], depths[2][:] = 0.102, 0.103
    assert fused(depths)[1][3, 6] == pytest.approx((0.1 + 0.102 + 0.103) / 3, rel=1e-6)


def test_smoothing_averages_a_surface_and_keeps_its_edges_and_what_is_fixed():
    """A wall whose columns are 1 % nearer and farther by turns, beside one of twice the depth, below the sky."""
    depth, fixed = np.full((40, 40), 0.1, np.float32), np.zeros((40, 40), bool)
    depth[:, ::2] *= np.exp(0.01)
    depth[:, 1::2] *= np.exp(-0.01)
    depth[:, 20:] = 0.05
    depth[:10] = 0
    fixed[25, 10] = True
    found = fusion.smooth_surfaces(depth, fixed)
    # Columns of the other kind differ by 2 %, a fifth of what may be alike: they weigh (1 - 0.2^2)^2 = 0.92, so that
    # (1 - 0.92) / (1 + 0.92) of the noise is left, a twentieth, as far as both kinds lie equally near.
    inside = np.delete(np.abs(np.log(found[14:36, 5:15] / 0.1)), [25 - 14], axis=0)
    assert inside.max() < 0.002
    np.testing.assert_allclose(found[:, 20:], depth[:, 20:], rtol=1e-6)
    assert not found[:10].any()
    assert found[25, 10] == depth[25, 10]


def test_smoothing_leaves_a_slanted_wall_as_it_is_up_to_its_edges():
    """Inverse depth of a plane is linear in the pixel; a mean over a window at its end would be 2 % off."""
    column = np.arange(40)
    depth = np.tile(0.1 * (1 + 0.01 * column), (40, 1)).astype(np.float32)
    depth[:, 30:] = 0
    depth[5, 5] = np.nan
    found = fusion.smooth_surfaces(depth, np.zeros(depth.shape, bool))
    assert np.isnan(found[5, 5])
    depth[5, 5] = found[5, 5] = 0.1
    np.testing.assert_allclose(found, depth, rtol=2e-3)
    # The ridge pulls the slope to 0: least where a whole window lies on one side.
    np.testing.assert_allclose(found[10:30, 10:20], depth[10:30, 10:20], rtol=1e-6)


def test_depths_are_smoothed_between_the_first_rounds():
    """Rows differ by 2 %, which fusing with the same rows of other views leaves; a view alone keeps its own."""
    rows = np.where(np.arange(SHAPE[0]) % 2 == 0, 1.01, 1 / 1.01)[:, None]
    noisy = [(WALL * rows * np.ones(SHAPE)).astype(np.float32) for _ in range(3)]
    once = fusion.smooth_surfaces(noisy[1], np.zeros(SHAPE, bool))
    assert abs(once[3, 6] - noisy[1][3, 6]) > 5e-4
    # Windows of what the neighbours show of the next columns end at the border of the image.
    for rounds, expected in ((1, noisy[1]), (2, once), (3, once)):
        np.testing.assert_allclose(fused(noisy, rounds=rounds)[1][2:4, 5:7], expected[2:4, 5:7], rtol=1e-5)
    assert np.array_equal(fused(noisy[:1], rounds=2)[0], noisy[0])


def test_measured_depths_stay_and_support_others():
    depths, fixed = walls(3), [np.ones(SHAPE, bool), np.zeros(SHAPE, bool), np.ones(SHAPE, bool)]
    depths[0][3, 6], depths[1][3, 6] = 0.104, 0.2
    result = fused(depths, fixed=fixed)
    assert result[0][3, 6] == np.float32(0.104)
    assert result[1][3, 6] == pytest.approx(0.1, rel=1e-6)


@pytest.mark.parametrize(
    ("far", "surface", "result"),
    [(0.002, True, 0.1), (0.002, False, 0.002), (0.0034, True, 0.1), (0.0036, True, 0.0036)],
)
def test_what_does_not_look_like_sky_becomes_no_farther_than_a_surface_can_be(far, surface, result):
    """Surfaces end at 286 m, or 0.0035 1/m; both neighbours look through the own depth of 10 m."""
    depths = [np.full(SHAPE, np.float32(each)) for each in (far, 0.1, far)]
    assert fused(depths, surfaces=[np.full(SHAPE, surface)] * 3)[1][3, 6] == pytest.approx(result, rel=1e-6)


def test_depths_are_disputed_where_neighbours_show_something_and_none_of_them_supports_them():
    # Inverse depths of 0.1 support each other up to 0.001 + 0.05 * 0.1 apart. What the neighbours show of 0.13 and
    # 0.07, 1.3 and 0.7 pixels aside, they show everywhere but at the border.
    depths = [np.full(SHAPE, np.float32(each)) for each in (0.13, 0.1, 0.07)]
    depths[1][3, 6] = 0.124
    depths[1][3, 7] = np.nan
    result, disputed = fuse_all(depths)
    expected = np.ones((SHAPE[0], 6), bool)
    expected[3, 3:5] = False
    assert np.array_equal(disputed[1][:, 3:9], expected)
    assert result[1][2, 5] == np.float32(0.1)
    # Neither measured ones, nor what no neighbour shows, nor without rounds.
    assert not fuse_all(depths, fixed=[np.ones(SHAPE, bool)] * 3)[1][1].any()
    assert not fuse_all([np.full(SHAPE, np.float32(np.nan)), *depths[1:2]])[1][1].any()
    assert not np.any(fuse_all(depths, rounds=0)[1])


def test_masked_pixels_take_no_part():
    depths = walls(3)
    depths[1][3, 6] = np.nan
    depths[0][:] = np.nan
    result = fused(depths)
    assert np.isnan(result[1][3, 6]) and np.isnan(result[0]).all()
    assert result[1][2, 2] == pytest.approx(0.1, rel=1e-6)


def test_without_rounds_or_neighbours_depths_stay():
    depths = [np.random.default_rng(0).uniform(0, 0.3, SHAPE).astype(np.float32) for _ in range(2)]
    assert np.array_equal(fused(depths, rounds=0), depths)
    assert np.array_equal(fused(depths[:1])[0], depths[0])


@pytest.mark.parametrize(("seen", "result"), [([0.2, 0.1], 0.2), ([0.1, 0.1], 0.1), ([0.2, 0.2], 0.2)])
def test_a_farther_depth_wins_only_if_more_neighbours_look_through_the_near_one(seen, result):
    """Three candidates say 10 m, the own depth 5 m; two neighbours show ``seen`` where the near point would be."""
    own = np.full(SHAPE, np.float32(0.2))
    candidates = np.full((3, *SHAPE), WALL)
    others = np.stack([view_at(0.5).packed, view_at(-0.5).packed])
    shown = np.stack([np.full(SHAPE, np.float32(w)) for w in seen])
    view = view_at(0.0)
    found, _ = fusion.fuse(own, NUMBERS, candidates.reshape(3, -1), view.packed, view.world_from_view, others, shown,
                           np.zeros(SHAPE, bool), TOLERANCE)  # fmt: skip
    assert found[3, 6] == pytest.approx(result, rel=1e-6)


def test_the_own_depth_stays_where_another_has_no_more_support():
    own, view = np.full(SHAPE, np.float32(0.2)), view_at(0.0)
    candidates = np.stack([np.full(SHAPE, np.float32(w)) for w in (0.3, 0.2, 0.3)])
    none = np.zeros((0, 23)), np.zeros((0, *SHAPE), np.float32)
    found, _ = fusion.fuse(own, NUMBERS, candidates.reshape(3, -1), view.packed, view.world_from_view, *none,
                           np.zeros(SHAPE, bool), TOLERANCE)  # fmt: skip
    assert found[3, 6] == pytest.approx(0.2, rel=1e-6)


def test_the_nearest_of_what_falls_into_a_pixel_is_shown():
    """A pole at 5 m moves right by 2 pixels, the wall by 1: the pole hides the wall's next column and bares its own."""
    depths = walls(1)[0]
    depths[:, 6] = 0.2
    depths[3, 11] = np.nan
    points = fusion.points_of(view_at(0.0).packed, view_at(0.0).world_from_view, depths, np.ones(SHAPE, bool))
    assert len(points) == 6 * 12 - 1
    # The second row is not asked about.
    asked = np.where(np.arange(6)[:, None] == 1, -1, NUMBERS - 12 * (NUMBERS >= 24))
    shown = np.full(60, np.nan, np.float32)
    fusion.warp(points, view_at(-0.5).packed, asked, shown)
    assert shown.reshape(5, 12)[2].tolist() == pytest.approx(
        [np.nan] + [0.1] * 6 + [np.nan, 0.2] + [0.1] * 3, nan_ok=True
    )


def test_neighbours_are_the_nearest_that_look_the_same_way():
    back = np.diag([-1.0, 1.0, -1.0])
    views = [view_at(x) for x in (0.0, 0.2, 0.5, 9.9, 10.1)] + [view_at(1.0, turn=back)]
    assert fusion.nearest_views(views)[0] == [2, 3]
    assert len(fusion.nearest_views([view_at(0.3 * k) for k in range(20)])[0]) == fusion.NEIGHBOURS


def test_world_point_is_the_reverse_of_projecting_with_a_rolling_shutter():
    turn = geometry.matrix_from_quat(np.array([0.9, 0.1, -0.3, 0.2]) / np.linalg.norm([0.9, 0.1, -0.3, 0.2]))
    view = view_at(0.7, drift_m=(0.1, -0.05, 0.4), fraction=(0.0, 1 / SHAPE[0], -0.5), turn=turn)
    x, y, z = world_point.py_func(view.packed, view.world_from_view, 2.5, 4.5, 0.25)
    u, v, far = project_point.py_func(view.packed[None], 0, x, y, z)
    # The camera is 0.1 m to the right at the row's time, a quarter of the exposure after its middle, of 0.4 m ahead.
    assert (u, v, far) == pytest.approx((2.5, 4.5, 4.0), abs=1e-3)


# -------------------------------------------------------------------------------------------------------------- levels


def test_levels_are_four_times_finer_at_infinity_than_on_average():
    levels = ViewSettings(levels=72, min_depth_m=3.5).inverse_depths
    assert levels[0] == 0 and levels[-1] == pytest.approx(1 / 3.5)
    # 1 / 3.5 / 71 = 4.024e-3; times 0.25 + 0.75 / 71 at the first level, 0.25 + 0.75 * 141 / 71 at the last.
    assert np.diff(levels)[[0, -1]] == pytest.approx([4.024e-3 * 0.26056, 4.024e-3 * 1.73944], rel=1e-3)


def test_the_sky_is_charged_for_surfaces_and_surfaces_for_all_levels_of_the_sky():
    """Levels at infinity, 500, 286, 100 and 50 m."""
    cost = np.zeros((3, 5), np.int16)
    sky = np.array([depth.SKY, depth.NOT_SKY, depth.MAYBE_SKY], np.uint8)
    levels = np.array([0, 0.002, 0.0035, 0.01, 0.02])
    depth.add_sky(cost, sky, depth.surface_levels(levels))
    assert (cost / UNIT).tolist() == [[0, 0, 0, 60, 60], [40, 40, 40, 0, 0], [0, 0, 0, 0, 0]]


def test_measured_depths_lie_between_levels():
    """0.0125 lies a quarter of the way from the level 0.01 to the next, 0.05 half a level beyond the last."""
    prior = np.array([[0.0125, 0, 0.05]], np.float32)
    at = depth.measured_levels(prior, np.array([0, 0.01, 0.02, 0.04]))
    assert at.tolist() == [[1.25 * PRIOR_COST, -1, 3.5 * PRIOR_COST]]


def likeness_of(picture: list[str], colours: dict[str, int]) -> tuple[np.ndarray, np.ndarray]:
    """The signs of a picture, and how much it looks like sky; of its grey ``colours`` those above 99 are the sky's."""
    signs = np.array([list(row) for row in picture])
    gray = np.vectorize(colours.get)(signs).astype(np.uint8)
    return signs, sky_pixels.sky_likeness(np.repeat(gray[..., None], 3, axis=2), gray > 99, signs != "#")


def test_sky_reaches_the_upper_end_and_is_wider_than_a_pole():
    """A white wall below the roof, a white pole into the sky, and a lens whose last columns start at row 2."""
    picture = [
        "ssssss..sssss.###",
        "ssssss..sssss.###",
        "ssssss..sssss.sss",
        "..........pp..sss",
        ".wwww.....pp..sss",
        ".wwww.....pp.....",
        ".wwww.....pp.....",
    ]
    signs, found = likeness_of(picture, {"s": 200, "w": 200, "p": 200, ".": 50, "#": 0})
    expected = np.select([signs == "s", signs == "w"], [depth.SKY, depth.MAYBE_SKY], depth.NOT_SKY)
    assert np.array_equal(found, expected)


def test_sky_ends_where_a_bright_wall_begins():
    """Clouds change the colour by 10 from a pixel to the next; the wall below differs by 13 and may be sky or not."""
    rows = {"a": 250, "b": 240, "c": 230, "w": 217}
    signs, found = likeness_of([each * 9 for each in "aaabbbcccwwww"], rows)
    assert np.array_equal(found, np.where(signs == "w", depth.MAYBE_SKY, depth.SKY))


@pytest.mark.parametrize(("wire_px", "piece_px", "gray", "expected"), [
    (4, 11, 200, depth.SKY),
    (5, 11, 200, depth.MAYBE_SKY),
    (4, 10, 200, depth.MAYBE_SKY),
    (4, 11, 213, depth.MAYBE_SKY),
])  # fmt: skip
def test_a_wide_piece_of_sky_across_a_wire_is_sky(wire_px, piece_px, gray, expected):
    """A piece as bright as the sky, or 13 of 255 brighter, below a wire across the picture; its tail has 4 pixels."""
    picture = ["s" * 20] * 6 + ["." * 20] * wire_px + ["..." + "p" * piece_px + "." * (17 - piece_px)] * piece_px
    picture += ["." * 5 + "p" * 4 + "." * 11] * 8
    signs, found = likeness_of(picture, {"s": 200, ".": 50, "p": gray})
    assert (found[signs == "s"] == depth.SKY).all()
    assert (found[signs == "p"] == expected).all()
