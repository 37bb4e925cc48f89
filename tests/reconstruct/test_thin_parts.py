"""Thin parts of movers are found by colour: a rider of a made street, whose leg has the depth of the wall behind."""

import dataclasses

import numpy as np
import pytest

from nurec_sim import geometry
from nurec_sim.reconstruct.lift.bodies import Surfels
from nurec_sim.reconstruct.lift.cloud import Cloud
from nurec_sim.reconstruct.lift.pictures import DepthPicture
from nurec_sim.reconstruct.lift.points import Actor
from nurec_sim.reconstruct.lift.thin_parts import with_thin_parts
from nurec_sim.reconstruct.lift.views import Tile, WorkingView
from nurec_sim.types import Track, Trajectory

SIZE, MIDDLE = 120, 60
WALL, RIDER = np.float32(0.1), np.float32(0.2)
"""Inverse depth, 1/m: the wall is 10 m away and the rider 5 m."""
STEP_PX = 18
"""From image to image."""
LEG = 200
"""Its colour; the wall is darker than 100."""


def leg(step=0, step_px=STEP_PX):
    mask = np.zeros((SIZE, SIZE), bool)
    column = MIDDLE + step_px * step
    mask[MIDDLE + 1 : MIDDLE + 7, column - 1 : column + 2] = True
    return mask


def street(steps=(-1, 0, 1), step_px=STEP_PX, gains=(1.0, 1.0, 1.0), shift_px=(0, 0, 0), focal_px=60.0, deep_m=1.0):
    """Views, bodies and pictures of a rider that passes before a wall: a block of 9 x 9 pixels and a leg below it.

    The leg, 3 pixels wide and 6 high, has the depth of the wall. The brightness of images differs by ``gains``, and the
    wall in them lies so many pixels farther right and farther down than its depth says. The box is ``deep_m`` along the
    camera's axis.
    """
    wall = np.random.default_rng(0).integers(30, 100, (SIZE, SIZE, 3)).astype(np.float32)
    times_us = 100_000 * np.arange(len(steps))
    poses = np.tile(np.eye(4), (len(steps), 1, 1))
    poses[:, :3, 3] = [(5.0 / focal_px * step_px * step, 0.0, 5.0) for step in steps]
    path = Trajectory(times_us, poses)
    actor = Actor(0, Track("rider", "rider", (1.6, 1.6, deep_m), path), False, path)
    tile = Tile(SIZE, SIZE, focal_px, (MIDDLE, MIDDLE), np.eye(3), 1, None, np.ones((SIZE, SIZE), bool), np.zeros(3))
    views, pictures = [], []
    for t_us, step, gain, shift in zip(times_us, steps, gains, shift_px, strict=False):
        rgb, body = np.roll(wall, (shift, shift), axis=(0, 1)), np.zeros((SIZE, SIZE), np.int32)
        column = MIDDLE + step_px * step
        body[MIDDLE - 8 : MIDDLE + 1, column - 4 : column + 5] = 1
        rgb[body == 1], rgb[leg(step, step_px)] = 150, LEG
        rgb = np.clip(gain * rgb, 0, 255).astype(np.uint8)
        views.append(WorkingView("front", len(views), int(t_us), True, tile, np.eye(4), np.zeros(3), rgb))
        surfel = np.full(body.shape, 5, np.int32)
        pictures.append(DepthPicture(np.where(body == 1, RIDER, WALL), body, surfel, body < 0, body < 0))
    nothing, none = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    bodies = [
        Surfels(who, Cloud(nothing.astype(float), nothing, none, none), nothing, none, none, np.zeros(0, np.uint8))
        for who in (None, actor)
    ]
    return views, bodies, pictures


def given(views, bodies, pictures):
    """Which pixels of each picture were given to the rider."""
    found = with_thin_parts(views, bodies, pictures, 0.001)
    return [new.body != old.body for new, old in zip(found, pictures, strict=True)]


def test_a_leg_is_the_riders_as_far_away_as_its_nearest_pixel():
    views, bodies, pictures = street()
    pictures[1].inverse_depth[MIDDLE, MIDDLE - 4 : MIDDLE + 5] = 0.21
    found = with_thin_parts(views, bodies, pictures, 0.001)
    for step, new, old in zip((-1, 0, 1), found, pictures, strict=True):
        assert (new.body == np.where(leg(step), 1, old.body)).all()
        assert (new.surfel == np.where(leg(step), -1, 5)).all()
    assert (found[1].inverse_depth == np.where(leg(), np.float32(0.21), pictures[1].inverse_depth)).all()
    assert (found[0].inverse_depth[leg(-1)] == RIDER).all()


def test_other_exposures_and_a_pixel_of_parallax_are_no_difference():
    for options in ({"gains": (1.6, 1.0, 0.6)}, {"shift_px": (1, 0, 1)}):
        assert [mask.sum() for mask in given(*street(**options))] == [18, 18, 18], options
    # Two pixels are too many: some of the wall that touches the rider then looks otherwise.
    assert given(*street(shift_px=(2, 0, 2)))[1].sum() > 18


def test_the_world_near_the_rider_in_another_image_tells_nothing():
    """Half of the rider is 4 pixels wide, half of its leg 1, and the margin 8; the first and the third image know."""
    assert [mask.sum() for mask in given(*street(step_px=11))] == [18, 0, 18]
    assert [mask.sum() for mask in given(*street(step_px=12))] == [18, 18, 18]


def test_an_image_that_shows_something_else_there_tells_nothing():
    """Inverse depths of one surface differ by less than 0.001 and a twentieth, 0.006 in all."""
    for more, found in ((0.0055, 18), (0.0065, 0)):
        views, bodies, pictures = street()
        for other in (0, 2):
            pictures[other].inverse_depth[leg()] += np.float32(more)
        assert given(views, bodies, pictures)[1].sum() == found


def test_images_of_other_cameras_and_other_tiles_tell_nothing():
    views, bodies, pictures = street()
    turned = dataclasses.replace(views[1].tile, camera_from_tile=np.diag([-1.0, -1.0, 1.0]))
    for other in ({"camera_id": "rear"}, {"tile": turned}):
        some = [views[0], dataclasses.replace(views[1], **other), views[2]]
        assert [mask.sum() for mask in given(some, bodies, pictures)] == [18, 0, 18]


def test_an_actor_that_moves_a_metre_at_most_has_no_thin_parts():
    """At a focal length of 120 pixels, 5 m away, 24 pixels are 1 m."""
    for step_px, found in ((23, 0), (25, 18)):
        assert [mask.sum() for mask in given(*street((0, 1), step_px, focal_px=120.0))] == [found] * 2


def test_what_is_far_from_the_riders_pixels_or_before_its_box_stays_the_worlds():
    views, bodies, pictures = street()
    speck, pole = np.zeros((SIZE, SIZE), bool), np.zeros((SIZE, SIZE), bool)
    speck[MIDDLE + 4 : MIDDLE + 6, MIDDLE + 6 : MIDDLE + 9], pole[:, MIDDLE] = True, True
    views[1].rgb[speck] = LEG
    pictures[1].inverse_depth[pole & leg()] = 0.3
    assert (given(views, bodies, pictures)[1] == (leg() & ~pole)).all()


def test_parts_end_20_cm_outside_of_the_box():
    """1 m below its middle and 4.3 m away: 13.95 pixels."""
    views, bodies, pictures = street()
    for view, step in zip(views, (-1, 0, 1), strict=True):
        view.rgb[MIDDLE + 1 :, MIDDLE + STEP_PX * step - 1 : MIDDLE + STEP_PX * step + 2] = LEG
    assert np.flatnonzero(given(views, bodies, pictures)[1].any(axis=1)).tolist() == list(
        range(MIDDLE + 1, MIDDLE + 14)
    )


def test_a_box_that_reaches_past_the_camera_has_the_outline_of_what_is_before_it():
    """Its middle is 5 m away: one of 8.8 m ends 0.4 m before the camera, one of 12 m 1.2 m behind it."""
    for deep_m in (8.4, 8.8, 12.0):
        assert [mask.sum() for mask in given(*street(deep_m=deep_m))] == [18] * 3
    views, bodies, pictures = street((0, 1))
    behind = [
        dataclasses.replace(view, world_from_view=geometry.pose(np.eye(3), np.array([0, 0, 6.0]))) for view in views
    ]
    assert not any(mask.any() for mask in given(behind, bodies, pictures))


@pytest.mark.parametrize(("label", "solid"), [("automobile", True), ("bus", True), ("rider", False), ("person", False)])
def test_the_lower_half_of_a_vehicle_is_its_own_without_another_image(label, solid):
    """One image of a body of 1.6 m, 5 m away, whose upper half beams met; z of the box is up, y of the camera down.

    The lower half ends 0.2 m above its underside, and begins 0.15 m inside its sides: 0.65 m from the middle, and 0.6 m
    below it. At a focal length of 90 pixels and the depth of the near face, 4.65 m, these are 12.6 and 11.6 pixels.
    """
    views, bodies, pictures = street((0, 1), 36, focal_px=90.0)
    path = bodies[1].actor.path
    upright = Trajectory(path.t_us, path.world_from_body @ geometry.pose(
        np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3)))  # fmt: skip
    track = dataclasses.replace(bodies[1].actor.track, label=label, size_m=(1.0, 1.6, 1.6), path=upright)
    bodies[1] = dataclasses.replace(bodies[1], actor=dataclasses.replace(bodies[1].actor, track=track, path=upright))
    views, pictures = views[:1], pictures[:1]
    expected = np.zeros((SIZE, SIZE), bool)
    expected[MIDDLE : MIDDLE + 12, MIDDLE - 13 : MIDDLE + 13] = solid
    expected &= pictures[0].body == 0
    assert np.array_equal(given(views, bodies, pictures)[0], expected)
    # What is nearer than the lower half hides it, within the box too.
    pictures[0].inverse_depth[MIDDLE + 3 :] = 0.22
    assert np.array_equal(given(views, bodies, pictures)[0], expected & (np.arange(SIZE)[:, None] < MIDDLE + 3))


@pytest.mark.parametrize(("level", "found"), [(130, 18), (129, 0)])
def test_a_leg_differs_by_more_than_30_levels_in_one_channel(level, found):
    views, bodies, pictures = street()
    for view, step in zip(views, (-1, 0, 1), strict=True):
        view.rgb[MIDDLE + 1 : MIDDLE + 8] = 99
        view.rgb[leg(step)] = (99, level, 99)
    assert given(views, bodies, pictures)[1].sum() == found


def test_pixels_that_are_not_valid_are_not_asked_and_those_without_depth_tell_nothing():
    views, bodies, pictures = street()
    pictures[0].inverse_depth[MIDDLE + 4 :] = np.nan
    views[1] = dataclasses.replace(views[1], tile=dataclasses.replace(views[1].tile, valid=~leg()))
    assert [mask.sum() for mask in given(views, bodies, pictures)] == [9, 0, 18]
