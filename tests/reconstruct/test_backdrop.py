"""The layer close behind surfaces: where it is, in which colour, and that it is hidden; values worked out by hand."""

import numpy as np
import pytest
from packed_views import looking_ahead
from reconstruct_street import Street

from nurec_sim import geometry
from nurec_sim.reconstruct import LiftSettings, ViewSettings, reconstruct
from nurec_sim.reconstruct.lift import bake
from nurec_sim.reconstruct.lift.backdrop import backdrop, hidden
from nurec_sim.reconstruct.lift.ground import Ground
from nurec_sim.reconstruct.lift.lifting import Lifted
from nurec_sim.reconstruct.lift.pictures import DepthPicture
from nurec_sim.reconstruct.lift.views import Tile, WorkingView

LOOKING_ALONG_X = geometry.pose(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), np.array([0, 0, 1.5]))
WALL = 0.1


def is_hidden(walls, behind_m=None, around_m=0.1):
    """Whether a point 10.5 m ahead of the first view stays, where views show these inverse depths ([9,9] or one)."""
    behind_m = np.zeros(len(walls)) if behind_m is None else behind_m
    packed = np.stack([looking_ahead(each) for each in behind_m])
    depths = np.stack([np.broadcast_to(np.float32(wall), (9, 9)) for wall in walls])
    point = np.array([[0.0, 0.0, 10.5]]), np.array([around_m]), np.array([10.5])
    return bool(hidden(*point, packed, depths)[0])


def test_what_is_nearer_by_one_per_cent_hides():
    assert is_hidden([1 / 10.38]) and not is_hidden([1 / 10.42])


def test_one_view_in_twenty_may_look_through():
    assert is_hidden([WALL] * 20 + [0.02]) and not is_hidden([WALL] * 19 + [0.02])


@pytest.mark.parametrize(("column", "stays"), [(5, False), (6, True)])
def test_everything_around_a_backdrop_must_be_nearer(column, stays):
    """The point lies in the middle of column 4, and 0.6 m there are 0.57 pixels: from 3.93 to 5.07."""
    wall = np.full((9, 9), WALL, np.float32)
    wall[:, column] = 0.0
    assert is_hidden([wall], around_m=0.6) == stays


def test_what_lies_around_it_outside_of_an_image_needs_not_be_hidden():
    """6 m are 5.7 pixels: from -1.2, which is not the last column, to 10.2; columns 1 and 7 lie between."""
    wall = np.full((9, 9), WALL, np.float32)
    wall[:, 8] = wall[8] = 0.0
    assert is_hidden([wall], around_m=6.0)


@pytest.mark.parametrize(("ahead_m", "stays"), [(1.0, True), (1.1, False)])
def test_a_view_from_much_nearer_has_a_backdrop_of_its_own(ahead_m, stays):
    """10.5 - 1.05 m is 0.9 times as far."""
    assert is_hidden([WALL, 1 / 9], [0.0, -ahead_m]) == stays


def behind_of(depth, rgb, body=0, ground_known=False, valid=True):
    """The backdrop of one view with 8 x 8 pixels, a focal length of 8, 1.5 m above the ground."""
    shape, empty = depth.shape, np.zeros(depth.shape, bool)
    tile = Tile(8, 8, 8.0, (4.0, 4.0), np.eye(3), 1, None, np.broadcast_to(valid, shape).copy(), np.zeros(3))
    view = WorkingView("front", 0, 0, True, tile, LOOKING_ALONG_X, np.zeros(3), rgb)
    bodies = np.broadcast_to(np.int32(body), shape).copy()
    picture = DepthPicture(depth, bodies, np.full(shape, -1, np.int32), empty, empty)
    cells = np.full((100, 100), ground_known)
    ground = Ground(np.array([0.0, -50.0]), 1.0, np.zeros((100, 100), np.float32), cells, cells, np.zeros_like(cells),
                    np.ones((100, 100), np.uint8))  # fmt: skip
    return backdrop([view], [picture], [rgb], ground, 200.0)


def test_a_block_lies_behind_its_farthest_pixels_in_their_colour():
    """A wall at 10 m, grey of 50; one pixel of the upper left block shows what is 2 % farther, another what is 50 %."""
    depth, rgb = np.full((8, 8), WALL, np.float32), np.full((8, 8, 3), 50, np.uint8)
    found = behind_of(depth, rgb)
    assert found.pixel.tolist() == [0, 4, 32, 36] and (found.edge == 4).all()
    assert found.depth_m == pytest.approx(10.5) and found.pixel_m == pytest.approx(4 * 10.5 / 8)
    # Of the upper left block: two pixels left of the middle and above it.
    assert found.xyz_m[0] == pytest.approx([10.5, 2 * 10.5 / 8, 1.5 + 2 * 10.5 / 8])
    assert found.rgb == pytest.approx(50)
    depth[0, 0], rgb[0, 0] = 0.98 * WALL, 66
    assert behind_of(depth, rgb)[:1].depth_m == pytest.approx(10.5 / 0.98)
    assert behind_of(depth, rgb).rgb[0] == pytest.approx(51), "16 pixels, one of which is 16 brighter"
    depth[0, 0] = WALL / 1.5
    assert behind_of(depth, rgb)[:1].depth_m == pytest.approx(15.75)
    assert behind_of(depth, rgb).rgb[0] == pytest.approx(66), "that pixel alone"


def test_blocks_with_sky_or_another_body_have_none():
    depth, rgb = np.full((8, 8), WALL, np.float32), np.full((8, 8, 3), 50, np.uint8)
    body = np.zeros((8, 8), np.int32)
    depth[0, 0], body[0, 7] = 0.0, 1
    assert behind_of(depth, rgb, body).pixel.tolist() == [32, 36]
    assert not len(behind_of(depth, rgb, valid=False))


@pytest.mark.parametrize(("column", "blocks"), [(2, [4, 32, 36]), (3, [32, 36])])
def test_sky_close_to_a_block_shows_what_is_behind_it(column, blocks):
    """Around the middle of the upper right block, column 6, 0.6 times its 4 pixels must be hidden: from 3.6 on."""
    depth = np.full((8, 8), WALL, np.float32)
    depth[1, column] = 0.0
    assert behind_of(depth, np.full((8, 8, 3), 50, np.uint8)).pixel.tolist() == blocks


def test_there_is_none_below_the_ground():
    """The lower blocks, 2 pixels below the middle: 2.6 m below a camera at 1.5 m."""
    depth, rgb = np.full((8, 8), WALL, np.float32), np.full((8, 8, 3), 50, np.uint8)
    assert behind_of(depth, rgb, ground_known=True).pixel.tolist() == [0, 4]


def test_what_is_too_far_has_none():
    assert not len(behind_of(np.full((8, 8), 1 / 201, np.float32), np.zeros((8, 8, 3), np.uint8)))


@pytest.mark.slow
def test_the_method_adds_it_to_the_static_world(monkeypatch):
    street, settings = Street(frames=4), LiftSettings(sky_px=32, views=ViewSettings(levels=32))
    scene = reconstruct(street, settings=settings, cameras=["front"])
    monkeypatch.setattr(bake, "backdrop", lambda *arguments: Lifted.empty())
    without = reconstruct(street, settings=settings, cameras=["front"])
    assert len(scene.static) > len(without.static) + 20
    assert scene.provenance["counts"]["lifted"] - without.provenance["counts"]["lifted"] == len(scene.static) - len(
        without.static
    )
