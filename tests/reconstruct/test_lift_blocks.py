"""Blocks of pixels that one footprint stands for."""

import numpy as np
import pytest

from nurec_sim.reconstruct.lift.blocks import (
    DEPTH_COST,
    FLAT,
    LEAST_TOLERANCE,
    NEVER,
    SLOPE,
    block_costs,
    block_maxima,
    block_means,
    chosen_blocks,
    painted,
    tolerance_for,
)
from nurec_sim.reconstruct.lift.sky_cubemap import sums_by_texel


def plain(height=8, width=8):
    """A grey wall at 10 m: colours, inverse depth, body 0."""
    rgb = np.full((height, width, 3), 90, np.uint8)
    return rgb, np.full((height, width), 0.1, np.float32), np.zeros((height, width), np.int32)


def edges_of(rgb, inverse_depth, body, tolerance=LEAST_TOLERANCE):
    """The edge of the block that each pixel is in; 0: none."""
    first, edge = chosen_blocks(block_costs(rgb, inverse_depth, body), body, tolerance)
    picture = np.zeros(body.shape, int)
    for f, e in zip(first, edge, strict=True):
        row, column = divmod(int(f), body.shape[1])
        assert not picture[row : row + e, column : column + e].any(), "a pixel in two blocks"
        picture[row : row + e, column : column + e] = e
    return picture


def test_a_plain_wall_is_one_block():
    assert (edges_of(*plain()) == 8).all()


def test_pixels_beyond_the_last_whole_block_are_smaller_blocks():
    picture = edges_of(*plain(10, 11))
    assert (picture[:8, :8] == 8).all() and (picture[8:, :10] == 2).all() and (picture[:, 10] == 1).all()


def test_a_spot_of_colour_splits_only_the_blocks_around_it():
    """The cost of a difference of 4 is 4 in a block of two, 16 in one of four, 64 in one of eight."""
    rgb, depth, body = plain()
    rgb[0, 0, 1] += 4
    two, four, eight = block_costs(rgb, depth, body)
    assert (two[0, 0], four[0, 0], eight[0, 0]) == (4, 16, 64) and not two.ravel()[1:].any()
    for tolerance, corner, rest in ((3, 1, 4), (4, 2, 4), (15, 2, 4), (16, 4, 4), (63, 4, 4), (64, 8, 8)):
        picture = edges_of(rgb, depth, body, tolerance)
        assert (picture[0, 0], picture[7, 7]) == (corner, rest)


@pytest.mark.parametrize(
    ("slope", "bend", "one"),
    [(0.95 * SLOPE, 0, True), (1.05 * SLOPE, 0, False), (0, 3.8 * FLAT, True), (0, 4.2 * FLAT, False)],
)
def test_blocks_lie_on_planes_that_are_not_seen_along_the_ray(slope, bend, one):
    """Two by two pixels that vary by ``slope``, and a corner bent by four times the deviation from a plane."""
    rgb, _, body = plain(2, 2)
    depth = 2 * np.array([[1 - slope / 2, 1 + slope / 2], [1 - slope / 2, 1 + slope / 2 + bend]], np.float32)
    assert (block_costs(rgb, depth, body)[0][0, 0] != NEVER) == one


def test_a_block_is_never_cheaper_than_those_within_it():
    """A twist of 1.04 % of the left columns' inverse depth is too much for them, and not for the mean of all four."""
    rgb, _, body = plain(4, 4)
    row, column = np.mgrid[:4, :4]
    depth = 1 + 0.045 * column + 1.04 * FLAT * (-1.0) ** (row + column)
    two, four, _ = block_costs(rgb, depth.astype(np.float32), body)
    assert two[:, 0].tolist() == [NEVER] * 2 and four[0, 0] == NEVER and (two[:, 1] < NEVER).all()


def test_depth_costs_like_colour_and_the_larger_counts():
    """0.4 m of depth over a plain block of two by two pixels, then with a difference of 30 in one of them."""
    rgb, _, body = plain(2, 2)
    depth = (1 / np.array([[20.4, 20.4], [20.0, 20.0]])).astype(np.float32)
    assert block_costs(rgb, depth, body)[0][0, 0] == pytest.approx(0.4 * DEPTH_COST, abs=1)
    rgb[0, 0] += 30
    assert block_costs(rgb, depth, body)[0][0, 0] == 30


def test_no_block_reaches_over_bodies_nor_over_pixels_without_depth():
    rgb, depth, body = plain()
    body[:, 4:] = 1
    depth[0, 0] = np.nan
    body[7, 7] = -1
    picture = edges_of(rgb, depth, body)
    assert (picture[4:, :4] == 4).all() and (picture[:4, 4:] == 4).all()
    assert (picture[:2, :2] == 1).all() and (picture[:2, 2:4] == 2).all()
    assert picture[7, 7] == 0 and picture[6, 6] == 1 and (picture[4:6, 4:6] == 2).all()


def test_the_budget_takes_the_plainest_blocks_first():
    """Costs 0, 20, 40 and 60 of the four blocks of 4 x 4 pixels: 13 blocks are left at a tolerance of 10, 10 at 20."""
    rgb, depth, body = plain(4, 4)
    for number, (row, column) in enumerate(((0, 0), (0, 2), (2, 0), (2, 2))):
        rgb[row, column] += np.uint8(20 * number)
    costs = [block_costs(rgb, depth, body)]
    found = {wanted: tolerance_for(costs, [16], [1.0], wanted) for wanted in (16, 13, 12, 10, 7, 4)}
    assert found == {16: LEAST_TOLERANCE, 13: LEAST_TOLERANCE, 12: 20, 10: 20, 7: 40, 4: 60}
    for wanted, tolerance in found.items():
        assert len(chosen_blocks(costs[0], body, tolerance)[0]) <= wanted
    assert tolerance_for(costs, [16], [1.0], 1) == 4 * 60 and tolerance_for(costs, [16], [1.0], 0) == NEVER - 1


def test_means_and_maxima_over_blocks():
    values = np.arange(24, dtype=np.float64).reshape(4, 6)
    first, edge = np.array([0, 4, 20], np.int32), np.array([2, 1, 2], np.uint8)
    mask = painted(4, 6, first[:2], edge[:2])
    assert np.argwhere(mask).tolist() == [[0, 0], [0, 1], [0, 4], [1, 0], [1, 1]]
    first = np.array([0, 4, 14], np.int32)
    assert block_means(values[..., None], first, edge)[:, 0].tolist() == [3.5, 4.0, (14 + 15 + 20 + 21) / 4]
    assert block_maxima(values.astype(np.int32), first, edge).tolist() == [7, 4, 21]


def test_texels_of_the_sky_sum_weighted_colours():
    texel, weight = np.array([7, 2, 7]), np.array([1.0, 2.0, 0.5])
    shown, sums = sums_by_texel(texel, weight, np.array([[0.1, 0.2, 0.3], [1, 0, 1], [0.4, 0, 0]]), 9)
    assert shown.tolist() == [7, 2]
    assert sums.ravel().tolist() == pytest.approx([1.5, 0.1 + 0.2, 0.2, 0.3, 2, 2, 0, 2])
