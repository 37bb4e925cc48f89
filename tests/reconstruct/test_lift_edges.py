"""Silhouettes in depth pictures end where the image shows an edge (``lift/edges.py``)."""

import numpy as np
import pytest

from nurec_sim.reconstruct.lift.edges import trim_edges

NEAR, WALL = 1 / 4, 1 / 10
RED, GREY = (200, 60, 50), (90, 90, 90)


def _scene(seen_px: int, drawn_px: int, behind: float = WALL) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A red post in front of a grey wall: depth drawn, the image, and true depth. Widths of the post in pixels."""
    depth, truth = np.full((24, 40), behind, np.float32), np.full((24, 40), behind, np.float32)
    image = np.full((24, 40, 3), GREY, np.uint8)
    depth[:, 20 - drawn_px // 2 : 20 + drawn_px // 2] = NEAR
    truth[:, 20 - seen_px // 2 : 20 + seen_px // 2] = NEAR
    image[:, 20 - seen_px // 2 : 20 + seen_px // 2] = RED
    return depth, image, truth


def test_a_post_drawn_too_wide_is_as_wide_as_in_the_image() -> None:
    # Of the grey pixels within 5 columns of the outer column drawn too wide, two are near and five far; of the inner
    # one two and four.
    depth, image, truth = _scene(seen_px=8, drawn_px=12)
    np.testing.assert_array_equal(trim_edges(depth, image), truth)


def test_a_thin_post_of_its_own_colour_stays() -> None:
    depth, image, truth = _scene(seen_px=2, drawn_px=2)
    np.testing.assert_array_equal(trim_edges(depth, image), truth)


def test_a_post_drawn_too_narrow_stays_so() -> None:
    depth, image, _ = _scene(seen_px=8, drawn_px=6)
    np.testing.assert_array_equal(trim_edges(depth, image), depth)


def test_a_wide_post_of_the_colour_of_the_wall_stays() -> None:
    depth, image, _ = _scene(seen_px=0, drawn_px=14)
    np.testing.assert_array_equal(trim_edges(depth, image), depth)


@pytest.mark.parametrize("sky", [0.0, 0.003])
def test_nothing_becomes_sky(sky: float) -> None:
    depth, image, _ = _scene(seen_px=8, drawn_px=14, behind=sky)
    np.testing.assert_array_equal(trim_edges(depth, image), depth)


def test_one_surface_that_leans_away_stays() -> None:
    # Within 5 pixels its inverse depth changes by less than a tenth, plus 0.003.
    depth = np.tile(np.linspace(0.25, 0.18, 40, dtype=np.float32), (24, 1))
    image = np.random.default_rng(0).integers(0, 255, (24, 40, 3)).astype(np.uint8)
    np.testing.assert_array_equal(trim_edges(depth, image), depth)


def test_nothing_becomes_sky_beside_a_wall() -> None:
    depth, image, truth = _scene(seen_px=8, drawn_px=12, behind=0.0)
    # A wall far away, in sight of the lowest rows only; most of what they see is sky.
    depth[21:, :10], truth[21:, :10] = 1 / 30, 1 / 30
    truth[:, 14:26] = NEAR
    np.testing.assert_array_equal(trim_edges(depth, image), truth)


def test_nothing_comes_nearer_beside_what_is_farther() -> None:
    depth, image, _ = _scene(seen_px=8, drawn_px=6)
    depth[21:, :10] = depth[21:, 30:] = 1 / 30
    image[21:, :10] = image[21:, 30:] = (0, 0, 0)
    depth[:3, 17:23] = 1 / 30
    image[:3, 17:23] = (0, 0, 0)
    np.testing.assert_array_equal(trim_edges(depth, image), depth)


def test_what_is_masked_takes_no_part() -> None:
    depth, image, truth = _scene(seen_px=8, drawn_px=12)
    # Of the grey pixels around the outer column drawn too wide, two are near, three far and two masked.
    depth[:, 29:] = truth[:, 29:] = np.nan
    np.testing.assert_array_equal(trim_edges(depth, image), truth)


def test_nothing_moves_within_its_surface() -> None:
    # Of eleven columns three are far, five of one surface and three nearer: the median is of its surface, 5 % behind.
    depth, image = np.full((24, 40), 0.19, np.float32), np.full((24, 40, 3), GREY, np.uint8)
    depth[:, 15:18], depth[:, 20], depth[:, 23:26] = 0.05, 0.2, 0.4
    np.testing.assert_array_equal(trim_edges(depth, image)[:, 20], depth[:, 20])
