"""Surfaces closed between rows of beams; against values worked out by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from nurec_sim.reconstruct.lift.beam_rows import close_rows, row_gaps
from nurec_sim.types import LidarModel

WORLD_FROM_LEVEL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""A camera that looks along x."""


def scanner(*elevation_deg):
    """A LiDAR with rows at these elevations."""
    rows = np.radians(elevation_deg)
    return LidarModel("roof", rows, np.linspace(-3, 3, 8), np.zeros(len(rows)), np.eye(4))


def gaps_of(lidars, height=101):
    """The gaps of a column of pixels, 0.01 of the depth each; the middle one looks level."""
    tile = SimpleNamespace(width=1, height=height, focal_px=100.0, center_px=(0.5, height / 2))
    return row_gaps(SimpleNamespace(tile=tile, world_from_view=WORLD_FROM_LEVEL), lidars)[:, 0]


def test_gaps_follow_the_rows_at_the_elevation_of_a_ray():
    """Rows 2 degrees apart above the horizon and 4 below it: 1.1 times 3.491 and 6.981 pixels."""
    gaps = gaps_of([scanner(2, 0, -4)])
    # 1 degree up is 1.746 pixels above the middle, 2 degrees down 3.492 below it; beyond the rows it stays.
    assert gaps[0] == pytest.approx(3.8397, rel=1e-4) and gaps[-1] == pytest.approx(7.6794, rel=1e-4)
    assert gaps[50] == pytest.approx(1.1 * np.radians(2 + 2 / 3) * 100)
    assert np.all(np.diff(gaps) >= 0)


def test_of_several_scanners_the_finest_counts_and_without_rows_nothing_is_closed():
    fine, coarse = scanner(3, 2, 1), scanner(9, 0, -9)
    assert gaps_of([coarse, fine, scanner(0)]) == pytest.approx(1.1 * np.radians(1) * 100)
    assert not gaps_of([]).any() and not gaps_of([scanner(0)]).any()


def test_rows_close_along_what_is_up_in_the_world_and_not_in_the_image():
    """A camera that lies on its side sees the elevation of its columns."""
    tile = SimpleNamespace(width=3, height=1, focal_px=1.0, center_px=(1.5, 0.5))
    turned = WORLD_FROM_LEVEL.copy()
    turned[:3, 0], turned[:3, 1] = WORLD_FROM_LEVEL[:3, 1], -WORLD_FROM_LEVEL[:3, 0]
    gaps = row_gaps(SimpleNamespace(tile=tile, world_from_view=turned), [scanner(30, 0, -60)])
    # Its x axis points down: pixels look 45 degrees up, level, and 45 degrees down.
    assert gaps[0] == pytest.approx(1.1 * np.radians([30, 40, 60]))


def closed(rows, gap=4):
    """A column of pixels: body, inverse depth and surfel of each, closed over so many pixels."""
    body, inverse_depth, index = (np.array(part)[:, None] for part in zip(*rows, strict=True))
    body, inverse_depth, index = body.astype(np.int32), inverse_depth.astype(np.float32), index.astype(np.int32)
    close_rows(inverse_depth, index, body, np.full(body.shape, gap + 0.5, np.float32))
    return list(
        zip(body[:, 0].tolist(), inverse_depth[:, 0].astype(float).round(4).tolist(), index[:, 0].tolist(), strict=True)
    )


WALL, LOWER, FAR, OPEN, NEAR = (0, 0.1, 7), (0, 0.104, 8), (0, 0.05, 3), (0, 0.0, -1), (0, 0.2, 3)


def test_what_is_behind_a_surface_or_open_between_two_rows_takes_its_depth():
    """In the world it shows no surfel; the depth runs evenly from 0.1 to 0.104 1/m."""
    assert closed([FAR, WALL, FAR, OPEN, FAR, LOWER, FAR, OPEN]) == [
        FAR, WALL, (0, 0.101, -1), (0, 0.102, -1), (0, 0.103, -1), LOWER, FAR, OPEN,
    ]  # fmt: skip


def test_actors_keep_the_surfel_of_the_nearer_end():
    upper, lower = (2, 0.1, 7), (2, 0.1, 8)
    assert closed([upper, FAR, FAR, OPEN, lower]) == [upper, (2, 0.1, 7), (2, 0.1, 8), (2, 0.1, 8), lower]


@pytest.mark.parametrize(
    "column",
    [
        [WALL, FAR, FAR, FAR, FAR, LOWER],  # farther apart than rows are
        [WALL, FAR, (0, 0.106, 8)],  # another surface, 6 % nearer
        [(0, 0.106, 8), FAR, WALL],
        [WALL, FAR, NEAR, FAR, LOWER],  # something before it
        [WALL, FAR, (1, 0.1, 8)],  # another body
        [WALL, OPEN, OPEN, OPEN],
    ],
)
def test_other_gaps_stay(column):
    assert closed(column) == column


def test_a_gap_as_wide_as_rows_are_apart_is_closed_and_a_row_without_a_gap_closes_nothing():
    column = [WALL, FAR, FAR, FAR, WALL]
    assert closed(column)[1:4] == [(0, 0.1, -1)] * 3
    assert closed(column, gap=3) == closed(column, gap=0) == column
