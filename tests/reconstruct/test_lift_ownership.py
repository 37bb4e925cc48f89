"""Which lifted points stay: views along a straight drive, with the sky or a surface behind the points."""

import dataclasses

import numpy as np
import pytest

from nurec_sim import geometry
from nurec_sim.reconstruct.lift import bake
from nurec_sim.reconstruct.lift.bake import body_gaussians, body_pixels, not_replaced
from nurec_sim.reconstruct.lift.bodies import Surfels
from nurec_sim.reconstruct.lift.cloud import Cloud
from nurec_sim.reconstruct.lift.ground import Ground
from nurec_sim.reconstruct.lift.lifting import FARTHER, OWNER_BORDER, OWNER_RING, Lifted, owned, owning
from nurec_sim.reconstruct.lift.pictures import DepthPicture
from nurec_sim.reconstruct.lift.points import Actor
from nurec_sim.reconstruct.lift.settings import LiftSettings
from nurec_sim.reconstruct.lift.views import Tile, WorkingView
from nurec_sim.types import Track, Trajectory

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
    place, normal = np.array([[0.2, -0.1, depth_m]]), np.array([[0.0, 0.0, -1.0]])
    one = place, normal, np.array([depth_m]), np.zeros(1, np.int32), np.array([matched])
    rgb, pictures = np.full((1, 3), 90, np.float32), np.full((count, SIZE[1], SIZE[0], 3), 90, np.uint8)
    present, owns = np.ones(count, bool), np.ones(inverse.shape, bool)
    return bool(
        owned(*one, rgb, packed, inverse, owns, pictures, present, TOLERANCE, OWNER_RING, OWNER_BORDER, False)[0]
    )


def test_a_pixel_between_two_rows_of_beams_is_not_only_matched():
    """Two pictures of 5 rows and 1 column: the first has beams in rows 0 and 4 at one depth, the second has none."""
    surfel = np.array([7, -1, -1, -1, 8], np.int32)[:, None]
    flat, none = np.full((5, 1), 0.1, np.float32), np.zeros((5, 1), bool)
    pictures = [DepthPicture(flat, 0 * surfel, each, none, none) for each in (surfel, 0 * surfel - 1)]
    three, vector, index = np.ones(3), np.zeros((3, 3)), np.array([0, 0, 1], np.int32)
    pixels = Lifted(vector, vector, vector, three, three, vector.astype(np.float32), np.array([7, -1, -1], np.int32),
                    index, np.array([0, 2, 2], np.int32), np.ones(3, np.uint8))  # fmt: skip
    assert bake._only_matched(pixels, pictures).tolist() == [False, False, True]


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


def test_a_matched_point_behind_what_a_view_from_afar_sees_stays():
    assert kept(5.0, [4.0, 4.0], [10.0, 10.0], matched=True)


@pytest.mark.parametrize("matched", [True, False])
def test_a_matched_point_that_none_confirms_and_two_views_see_something_in_front_of_goes(matched):
    assert kept(5.0, [3.0], [1.0], matched)
    assert kept(5.0, [3.0, 3.0], [1.0, 1.5], matched) is not matched


def test_masked_pixels_of_other_views_do_not_hide_a_point():
    assert kept(5.0, [np.nan, np.nan], [1.0, 1.5], matched=True)


def test_a_hidden_matched_point_that_another_view_confirms_stays():
    assert kept(5.0, [3.0, 3.0, 7.0], [1.0, 1.5, 2.0], matched=True)


@pytest.mark.parametrize(("moves", "stays"), [(False, [False, True]), (True, [True, False])])
def test_views_of_actors_are_compared_by_area_and_those_of_the_world_by_distance(moves, stays):
    """A side that the second view, 2 m nearer, sees from a sine of 0.095, the first from 0.177."""
    shape = SIZE[1], SIZE[0]
    tile = Tile(*SIZE, FOCAL, (SIZE[0] / 2, SIZE[1] / 2), np.eye(3), 1, None, np.ones(shape, bool), np.zeros(3))
    rgb, flags = np.full((*shape, 3), 90, np.uint8), (np.zeros(shape, np.int32), np.full(shape, -1, np.int32))
    poses = [geometry.pose(np.eye(3), np.array([0.0, 0.0, ahead_m])) for ahead_m in (0.0, 2.0)]
    views = [WorkingView("front", k, 500_000, True, tile, pose, np.zeros(3), rgb) for k, pose in enumerate(poses)]
    depth_m, none = np.array([10.0, 8.0]), np.zeros((2, *shape), bool)
    pictures = [DepthPicture(np.full(shape, 1 / m, np.float32), *flags, *none) for m in depth_m]
    path = Trajectory(np.array([0, 1_000_000]), np.tile(np.eye(4), (2, 1, 1)))
    actor = Actor(0, Track("car", "automobile", (4.0, 2.0, 2.0), path), False, path) if moves else None
    nothing = np.zeros((0, 3), np.float32), *np.zeros((2, 0), np.float32), np.zeros(0, np.uint8)
    place, normal = np.array([[4.0, 0.0, 10.0]] * 2), np.array([[2.0, 0.0, -1.25]] * 2) / np.hypot(2.0, 1.25)
    pixels = Lifted(place, normal, normal, depth_m, depth_m, np.full((2, 3), 90, np.float32), np.full(2, -1, np.int32),
                    np.array([0, 1], np.int32), np.zeros(2, np.int32), np.ones(2, np.uint8))  # fmt: skip
    body = Surfels(actor, Cloud.empty(), *nothing)
    assert bake._owned(pixels, body, views, pictures, [rgb, rgb], LiftSettings()).tolist() == stays


def looking_down(*ahead_m):
    """Views that look down, each from so many metres lower, their pictures by depth, and bare ground below them."""
    shape, turn = (8, 8), np.diag([1.0, -1.0, -1.0])
    tile = Tile(8, 8, 16.0, (4.0, 4.0), np.eye(3), 1, None, np.ones(shape, bool), np.zeros(3))
    rgb = np.full((*shape, 3), 99, np.uint8)
    poses = [geometry.pose(turn, np.array([0, 0, -each])) for each in ahead_m]
    views = [WorkingView("front", k, 1_000_000, True, tile, pose, np.zeros(3), rgb) for k, pose in enumerate(poses)]
    nothing = np.zeros((0, 3), np.float32), *np.zeros((2, 0), np.float32), np.zeros(0, np.uint8)
    none = np.zeros((4, 4), bool)
    ground = Ground(np.zeros(2), 0.1, np.zeros((4, 4), np.float32), none, none, none, np.ones((4, 4), np.uint8))

    def pictures(*depths_m):
        flags = np.zeros(shape, np.int32), np.full(shape, -1, np.int32), *np.zeros((2, *shape), bool)
        return [DepthPicture(np.full(shape, 1 / m, np.float32), *flags) for m in depths_m]

    body, settings = Surfels(None, Cloud.empty(), *nothing), LiftSettings(opacity=0.5)
    return views, pictures, body, ground, settings, [rgb] * len(views)


def test_two_views_that_leave_level_ground_to_each_other_both_keep_it():
    """Rings of distance end at exp(2.3) = 9.97 m. Both views look down, the second from 0.3 m lower.

    What the first sees at 10.0 m is at 9.7 m for the second, one ring nearer, which hence owns it. What the second sees
    at 9.4 m is at 9.7 m for the first, in the same ring, and the first of two views owns.
    """
    views, pictures_at, body, ground, settings, rgb = looking_down(0.0, 0.3)

    def centres(first_m, second_m):
        pictures = pictures_at(first_m, second_m)
        pixels = body_pixels([body], views, pictures, rgb, settings)[0]
        gaussians, *_ = body_gaussians(body, pixels, ground, views, pictures, rgb, settings)
        middle = (np.abs(gaussians.mean_m[:, :2]) < 0.5).all(axis=1)
        return sorted({round(-float(z), 1) for z in gaussians.mean_m[middle, 2]})

    assert centres(10.0, 9.4) == [9.7, 10.0]
    assert centres(10.3, 10.0) == [10.3], "both in the same ring: the first owns, once"


def test_of_pixels_in_a_gap_of_the_ground_the_nearest_stay(monkeypatch):
    """Two views show one gap: each left it to others in the end, but only where another pixel is still there."""
    views, pictures_at, body, ground, settings, rgb = looking_down(0.0, -0.5)
    pictures = pictures_at(10.0, 10.5)
    pixels = body_pixels([body], views, pictures, rgb, settings)[0]

    def owned(everything, *rest):
        """Every pixel is left to others at first; then to the same pixel of a nearer view, if that owns."""
        owns = rest[-1] if len(rest) == 6 else None
        first = np.zeros(len(everything), bool)
        return first if owns is None else (everything.view == 0) | ~owns[0].ravel()[everything.pixel]

    monkeypatch.setattr(bake, "_owned", owned)
    monkeypatch.setattr(bake, "backdrop", lambda *arguments: Lifted.empty())
    gaussians, *_ = body_gaussians(body, pixels, ground, views, pictures, rgb, settings)
    assert len(gaussians) == np.count_nonzero(pixels.view == 0) > 0


@pytest.mark.parametrize("count", [1, 6])
def test_the_budget_is_met_however_many_views_show_a_surface(count):
    """Of six views from one place the first owns all but what lies at their border."""
    shape, rng = (96, 96), np.random.default_rng(0)
    tile = Tile(96, 96, 96.0, (48.0, 48.0), np.eye(3), 1, None, np.ones(shape, bool), np.zeros(3))
    contrast = np.kron(rng.uniform(1, 120, (12, 12)), np.ones((8, 8)))  # any number of blocks has its tolerance
    rgb = [(128 + contrast[..., None] * rng.uniform(-1, 1, (*shape, 3))).astype(np.uint8)] * count
    views = [WorkingView("front", k, 1_000_000, True, tile, np.eye(4), np.zeros(3), rgb[0]) for k in range(count)]
    flags = np.zeros(shape, np.int32), np.full(shape, -1, np.int32), *np.zeros((2, *shape), bool)
    pictures = [DepthPicture(np.full(shape, 0.1, np.float32), *flags)] * count
    nothing = np.zeros((0, 3), np.float32), *np.zeros((2, 0), np.float32), np.zeros(0, np.uint8)
    body, settings = Surfels(None, Cloud.empty(), *nothing), LiftSettings()
    settings = dataclasses.replace(settings, views=dataclasses.replace(settings.views, budget=3000))
    pixels = body_pixels([body], views, pictures, rgb, settings)[0]
    owned = bake._owned(pixels, body, views, pictures, rgb, settings)
    assert owned.sum() == pytest.approx(3000 / bake.STAYING, rel=0.15)


def test_pixels_of_a_kept_block_own_and_those_of_other_bodies_do():
    """Of nine columns body 0 shows six, as a block of four by four, which was not kept, and one of two by two."""
    body = np.array([[0, 0, 0, 0, 0, 0, 3, 3, 3]] * 4, np.int32)
    two = Lifted.concatenate([Lifted.empty()])
    two = dataclasses.replace(two, xyz_m=np.zeros((2, 3)), view=np.zeros(2, np.int32), pixel=np.array([0, 4], np.int32),
                              edge=np.array([4, 2], np.uint8))  # fmt: skip
    masks = owning([body, body], two, np.array([False, True]))
    assert masks[0].astype(int).tolist() == [[0, 0, 0, 0, 1, 1, 1, 1, 1]] * 2 + [[0, 0, 0, 0, 0, 0, 1, 1, 1]] * 2
    assert masks[1].astype(int).tolist() == [[0, 0, 0, 0, 0, 0, 1, 1, 1]] * 4


def test_surfels_stay_where_pixels_are_twice_as_wide_or_no_view_came_near():
    """Surfels 0.1 m apart: seen sharply, seen obliquely, seen by none, looked through."""
    pixel_m = np.array([0.19, 0.21, np.inf, np.inf], np.float32)
    through = np.array([3, 3, 0, 1], np.int32)
    assert not_replaced(pixel_m, through, np.full(4, 0.1, np.float32)).tolist() == [False, True, True, False]
