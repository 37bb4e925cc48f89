"""Which views depth is matched with, and matching across two cameras that look 40 degrees apart."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nurec_sim import geometry
from nurec_sim.reconstruct.lift.bodies import Surfels
from nurec_sim.reconstruct.lift.cloud import Cloud
from nurec_sim.reconstruct.lift.neighbours import BESIDE, in_colours_of, neighbours_of, views_beside
from nurec_sim.reconstruct.lift.pictures import depth_pictures
from nurec_sim.reconstruct.lift.settings import LiftSettings, ViewSettings
from nurec_sim.reconstruct.lift.views import Tile, WorkingView

SIZE, FOCAL = 96, 60.0
"""A field of 77 degrees."""


def view_of(camera, right_m=0.0, yaw_deg=0.0, t_us=0, rgb=None, valid=None):
    """A view from ``right_m`` beside the origin, turned to the right."""
    valid = np.ones((SIZE, SIZE), bool) if valid is None else valid
    tile = Tile(SIZE, SIZE, FOCAL, (SIZE / 2, SIZE / 2), np.eye(3), 1, None, valid, np.zeros(3))
    turn = Rotation.from_euler("y", yaw_deg, degrees=True).as_matrix()
    rgb = np.full((SIZE, SIZE, 3), 90, np.uint8) if rgb is None else rgb
    return WorkingView(camera, 0, t_us, True, tile, geometry.pose(turn, np.array([right_m, 0, 0])), np.zeros(3), rgb)


def test_views_beside_are_of_other_cameras_that_look_elsewhere_and_share_something():
    views = [
        view_of("front"),
        view_of("front", 1.0, 40),  # the same camera
        view_of("near", 0.2, 40),  # too near to tell depth
        view_of("far", -8.5, 30),
        view_of("tele", 0.5, 10),  # looks the same way, to be matched as such
        view_of("side", 0.5, 90),  # fields of 77 degrees do not meet
        view_of("masked", 0.5, 40, valid=np.zeros((SIZE, SIZE), bool)),
        view_of("right", 0.5, 55, t_us=100_000),
        view_of("right", 1.5, 55, t_us=40_000),
        view_of("left", -0.5, -40, t_us=-50_000),
        view_of("left", -1.5, -40, t_us=-150_000),
    ]
    # More of the front is to be seen 40 than 55 degrees beside it; of two frames the one nearest in time counts.
    assert views_beside(views, 0) == [9, 8]
    assert neighbours_of(views, 0, 4) == [4]


def test_at_most_so_many_views_lie_beside_one():
    views = [view_of("front"), *(view_of(f"right {k}", 0.5, 30 + k) for k in range(6))]
    assert views_beside(views, 0) == [1, 2, 3] and BESIDE == 3


@pytest.mark.parametrize(("count", "brightest", "gain"), [(8, 200, 2), (1, 200, 1), (8, 250, 1)])
def test_pictures_beside_are_as_bright_as_the_view(count, brightest, gain):
    """Twice as dark, by pixels of a wall 10 m ahead: of ``count`` rows, dark or too bright to tell."""
    rng = np.random.default_rng(0)
    rgb = np.repeat(rng.integers(20, 100, (SIZE, 1, 3)), SIZE, axis=1)
    view = view_of("front", rgb=rgb.astype(np.uint8))
    # The same rows of the wall: the second camera only stands beside the first one.
    other = view_of("right", 0.5, rgb=(rgb / 2).astype(np.uint8))
    if brightest > 245:
        view.rgb[:], other.rgb[:] = brightest, brightest // 2
    measured = np.zeros((SIZE, SIZE), np.float32)
    measured[40 : 40 + count] = 0.1
    before = other.rgb.astype(int)
    result = in_colours_of(view, other, measured).astype(int)
    assert np.abs(result - gain * before).max() <= 3


def wall_seen_by(view, gain):
    """The picture of two textured walls across z, 10 m ahead below the horizon and 5 m above it."""
    rng = np.random.default_rng(1)
    texture = rng.integers(30, 220, (400, 400, 3))
    v, u = np.indices((SIZE, SIZE)) + 0.5
    rays = np.stack([(u - SIZE / 2) / FOCAL, (v - SIZE / 2) / FOCAL, np.ones_like(u)], axis=-1)
    rays = rays @ view.world_from_view[:3, :3].T
    depth = np.where(rays[..., 1] > 0, 10.0, 5.0)
    points = rays / rays[..., 2:] * depth[..., None] + view.world_from_view[:3, 3]
    cells = np.clip((points / 0.4 + 200).astype(int), 0, 399)
    return (gain * texture[cells[..., 0], cells[..., 1]]).astype(np.uint8)


def test_a_camera_beside_tells_the_depth_of_what_no_beam_met():
    """Beams met the lower wall; the upper one is nearer, and the other camera half as bright."""
    front, right = view_of("front"), view_of("right", 0.8, 40)
    front.rgb[:], right.rgb[:] = wall_seen_by(front, 1.0), wall_seen_by(right, 0.5)
    across, down = (part.ravel() for part in np.meshgrid(np.arange(-8, 20, 0.15), np.arange(0.15, 8, 0.15)))
    xyz = np.column_stack([across, down, np.full(len(across), 10.0)])
    sizes, towards = np.full(len(xyz), 0.15, np.float32), np.repeat([[0.0, 0.0, -1.0]], len(xyz), 0).astype(np.float32)
    cloud = Cloud(xyz, np.zeros((len(xyz), 3)), sizes, sizes)
    world = Surfels(None, cloud, towards, sizes, sizes, np.zeros(len(xyz), np.uint8))
    shared = slice(20, 40), slice(60, 90)
    errors = []
    for count in (ViewSettings.neighbours, 0):
        settings = LiftSettings(views=ViewSettings(neighbours=count))
        picture, _ = depth_pictures([front, right], [world], [], settings, lambda fraction: None)
        errors.append(np.median(np.abs(picture.inverse_depth[shared] - 0.2)))
    assert errors[0] < 0.01 and errors[1] > 0.05
