"""Surfels drawn into views: what is in front, gaps of actors, rims; against values worked out by hand."""

import numpy as np
import pytest
from packed_views import TOWARDS, looking_ahead

from nurec_sim.reconstruct.lift import pictures, splat
from nurec_sim.reconstruct.lift.bodies import Surfels
from nurec_sim.reconstruct.lift.cloud import Cloud
from nurec_sim.reconstruct.lift.pictures import depth_pictures
from nurec_sim.reconstruct.lift.points import Actor
from nurec_sim.reconstruct.lift.settings import LiftSettings
from nurec_sim.reconstruct.lift.views import Tile, WorkingView
from nurec_sim.types import LidarModel, Track, Trajectory


@pytest.mark.parametrize(("behind", "shown"), [(0.097, (0.1 + 0.097) / 2), (0.095, 0.1)])
def test_surfels_within_four_percent_of_the_front_are_averaged(behind, shown):
    """Two at the middle of the same pixel, at inverse depths 0.1 and a little less."""
    bodies = [
        (looking_ahead(), np.array([[0.0, 0.0, 1 / w]]), TOWARDS, np.array([1.0]), 8.0, offset)
        for offset, w in ((5, 0.1), (8, behind))
    ]
    inverse_depth, index = splat.draw_surfels((9, 9), bodies)
    assert inverse_depth[4, 4] == pytest.approx(shown, rel=1e-5) and index[4, 4] == 5
    assert np.count_nonzero(inverse_depth) == 1 and (index >= 0).sum() == 1


@pytest.mark.parametrize(("degrees", "shown"), [(0, True), (90, True), (100, True), (105, False), (180, False)])
def test_surfels_seen_from_behind_are_not_drawn(degrees, shown):
    """They face the camera at 0, the other way at 180 degrees; what they were not measured from may hide them."""
    angle = np.deg2rad(degrees)
    normal = np.array([[np.sin(angle), 0.0, -np.cos(angle)]])
    body = (looking_ahead(), np.array([[0.0, 0.0, 10.0]]), normal, np.array([1.0]), 8.0, 0)
    inverse_depth, index = splat.draw_surfels((9, 9), [body])
    assert (inverse_depth[4, 4] > 0) == (index[4, 4] == 0) == shown


def test_the_ray_to_a_surfel_tells_which_side_it_shows():
    """Seen at 45 degrees to the right, a wall that faces right, measured from there, is seen from behind.

    The last normal is turned away from the ray (1, 0, 1) by a cosine of 0.25 / 2^0.5 = 0.18.
    """
    place = np.array([[3.0, 0.0, 3.0]])
    for normal, shown in (([1, 0, 0], False), ([-1, 0, 0], True), ([0.6, 0, -0.8], True), ([0.821, 0, -0.571], True)):
        body = (looking_ahead(width=41), place, np.array([normal]), np.array([1.0]), 8.0, 0)
        assert (splat.draw_surfels((9, 41), [body])[1] == 0).any() == shown


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


def wall_and_car():
    """Points of a wall 12 m ahead, and of two rows of beams on a car 2 m before it."""
    across, up = (part.ravel() for part in np.meshgrid(np.arange(-2, 2, 0.05), np.arange(-2, 2, 0.05)))
    wall = np.column_stack([across, up, np.full(len(across), 12.0)])
    rows = np.column_stack([np.tile(np.arange(-1, 1, 0.05), 2), np.repeat([-0.2, 0.2], 40), np.full(80, 10.0)])
    path = Trajectory(np.array([0, 2_000_000]), np.stack([np.eye(4), np.eye(4)]))
    return wall, rows, Actor(0, Track("car", "automobile", (4.0, 2.0, 1.5), path), False, path)


def picture_of(bodies, lidars=()):
    """The picture, in a grey image of 40 x 40 pixels, of bodies: pairs of actor, or None, and points."""
    tile = Tile(40, 40, 100.0, (20.0, 20.0), np.eye(3), 1, None, np.ones((40, 40), bool), np.zeros(3))
    grey = np.full((40, 40, 3), 90, np.uint8)
    view = WorkingView("front", 0, 1_000_000, True, tile, np.eye(4), np.zeros(3), grey)
    made = [
        Surfels(who, Cloud(np.array(xyz), np.zeros((len(xyz), 3)), sizes, sizes), np.repeat(TOWARDS, len(xyz), 0)
                .astype(np.float32), sizes, sizes, np.zeros(len(xyz), np.uint8))
        for who, xyz in bodies for sizes in [np.full(len(xyz), 0.06, np.float32)]
    ]  # fmt: skip
    (picture,) = depth_pictures([view], made, lidars, LiftSettings(), lambda fraction: None)
    return picture


def test_pictures_show_an_actor_between_its_rows_of_returns_and_the_world_between_its_own():
    """A wall, and before it a car of which beams met two rows, or the same as part of the world."""
    wall, rows, actor = wall_and_car()
    for bodies, number, depth_m in (([(None, wall), (actor, rows)], 1, 10.0), ([(None, [*wall, *rows])], 0, 12.0)):
        picture = picture_of(bodies)
        assert picture.body[18:22, 15:25].tolist() == [[number] * 10] * 4
        assert 1 / picture.inverse_depth[19:21, 15:25] == pytest.approx(depth_m, abs=0.1)


def test_pictures_show_a_surface_of_the_world_between_its_rows_of_beams():
    """Rows of beams 0.04 apart, 4 pixels, over a wall that is seen from elsewhere; the pixels show no surfel."""
    wall, rows, _ = wall_and_car()
    for step, depth_m in ((0.04, 10.0), (0.02, 12.0)):
        lidar = LidarModel("roof", np.array([step, 0.0]), np.linspace(-3, 3, 8), np.zeros(2), np.eye(4))
        picture = picture_of([(None, [*wall, *rows])], [lidar])
        assert 1 / picture.inverse_depth[19:21, 15:25] == pytest.approx(depth_m, abs=0.1)
        assert ((picture.surfel[19:21, 15:25] < 0) == (depth_m == 10)).all()


def test_fusing_keeps_sky_and_surfaces_apart_and_disputed_depths_are_not_believed(monkeypatch):
    """Beams met the lower half of the wall; above it the image is as bright as its brightest parts, up to its end."""
    wall, doubted = wall_and_car()[0], np.arange(40)[:, None] * np.ones(40) > 35

    def fused(views, depths, fixed, surfaces, *rest):
        # The wall begins half a pixel below the axis of the camera; its discs reach 3 pixels farther.
        assert fixed[0][:16].all() and not surfaces[0][:16].any()
        # It ends 2 m aside and below: 16 pixels.
        assert surfaces[0][21:36, 5:35].all() and (depths[0][:16] == 0).all()
        return depths, [doubted]

    monkeypatch.setattr("nurec_sim.reconstruct.lift.pictures.fused_depths", fused)
    picture = picture_of([(None, wall[wall[:, 1] > 0])])
    assert np.array_equal(picture.free, doubted)


def test_discs_of_near_actors_are_as_wide_as_their_surfels_are_apart_and_others_are_not():
    """One surfel 0.31 m ahead: half of 0.06 m are 9.7 pixels; the world's discs end at 8."""
    _, _, actor = wall_and_car()
    for who, shown in ((actor, True), (None, False)):
        picture = picture_of([(None, np.zeros((0, 3))), (who, [[0.0, 0.0, 0.31]])])
        assert (picture.surfel[20, 27] >= 0) and (picture.surfel[20, 28] >= 0) == shown
    # 8.6 pixels left of the image, its disc ends 1.1 pixels inside.
    picture = picture_of([(None, np.zeros((0, 3))), (actor, [[-0.286 * 0.31, 0.0, 0.31]])])
    assert (picture.surfel[20] >= 0).tolist() == [True] + [False] * 39


def test_pixels_that_edges_of_the_image_move_to_the_wall_show_the_world_and_no_surfel(monkeypatch):
    """One pixel of a row of returns on a car, and the one beside it, which stays."""
    wall, rows, actor = wall_and_car()
    bodies = [(None, wall), (actor, rows)]
    before = picture_of(bodies)
    assert (before.body[18, 20:22] == 1).all() and (before.surfel[18, 20:22] >= 0).all()

    def moved(inverse_depth, rgb):
        depth = inverse_depth.copy()
        depth[18, 20] = 1 / 12
        return depth

    monkeypatch.setattr(pictures, "trim_edges", moved)
    after = picture_of(bodies)
    assert after.inverse_depth[18, 20] == np.float32(1 / 12)
    assert (after.body[18, 20], after.surfel[18, 20]) == (0, -1)
    assert (after.body[18, 21], after.surfel[18, 21]) == (1, before.surfel[18, 21])


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
