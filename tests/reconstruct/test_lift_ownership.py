"""Which lifted points stay: views along a straight drive, with the sky or a surface behind the points."""

import numpy as np
import pytest

from nurec_sim.reconstruct.lift.lifting import FARTHER, OWNER_BORDER, OWNER_RING, owned

SIZE, FOCAL = (96, 64), 80.0
TOLERANCE = 0.001


def view_at(back_m):
    """A view along z from this far behind the origin, packed as ``WorkingView.packed``."""
    drift = np.zeros(6)
    return np.concatenate([[FOCAL, SIZE[0] / 2, SIZE[1] / 2, *SIZE], np.eye(3).ravel(), [0, 0, back_m], drift])


def kept(depth_m, seen_m, back_m, matched):
    """Whether a point lifted by the view at the origin stays; further views see surfaces ``seen_m`` from themselves."""
    count = len(back_m) + 1
    inverse = np.zeros((count, SIZE[1], SIZE[0]), np.float32)
    for k, distance in enumerate((depth_m, *seen_m)):
        inverse[k] = 1 / distance
    packed = np.stack([view_at(back) for back in (0.0, *back_m)])
    one = np.array([[0.2, -0.1, depth_m]]), np.array([depth_m]), np.zeros(1, np.int32), np.array([matched])
    rgb, pictures = np.full((1, 3), 90, np.float32), np.full((count, SIZE[1], SIZE[0], 3), 90, np.uint8)
    present = np.ones(count, bool)
    return bool(owned(*one, rgb, packed, inverse, pictures, present, TOLERANCE, OWNER_RING, OWNER_BORDER)[0])


SKY_M = np.inf


@pytest.mark.parametrize("back_m", [2.0, 10.0])
def test_a_matched_point_in_front_of_the_sky_of_another_view_goes(back_m):
    """Also if that view is (5 + 10) / 5 times as far away, where it cannot own the point."""
    assert not kept(5.0, [SKY_M], [back_m], matched=True)


def test_a_measured_point_is_not_judged_from_afar():
    near, far = 5.0 * (FARTHER - 1) - 0.1, 5.0 * (FARTHER - 1) + 0.1
    assert not kept(5.0, [SKY_M], [near], matched=False)
    assert kept(5.0, [SKY_M], [far], matched=False)


@pytest.mark.parametrize("agrees_from_m", [2.0, 10.0])
def test_a_matched_point_that_another_view_agrees_with_is_not_judged_from_afar(agrees_from_m):
    assert kept(5.0, [5.0 + agrees_from_m, SKY_M, SKY_M], [agrees_from_m, 12.0, 14.0], matched=True)


def test_a_matched_point_behind_what_other_views_see_stays():
    assert kept(5.0, [4.0], [10.0], matched=True)
