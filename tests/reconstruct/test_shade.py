"""Shadows of movers stay out of the colours of the ground, and move with what casts them."""

from dataclasses import replace

import numpy as np
import pytest
from reconstruct_street import Street, camera

from nurec_sim import geometry
from nurec_sim.reconstruct import ColourSettings, LiftSettings, ViewSettings, reconstruct
from nurec_sim.reconstruct.lift.colour_solve import solve_colours
from nurec_sim.reconstruct.lift.shade import CELL_M, SHADED_WEIGHT, Shades, add_shaded, find_shaded, headings
from nurec_sim.reconstruct.lift.shadows import STRONGER, shadow_of, with_shadows
from nurec_sim.render import CpuRenderer
from nurec_sim.scene.edits import _rows
from nurec_sim.types import DynamicGaussians, Gaussians, GaussianScene, Label, SensorRequest, Track, Trajectory

SIZE = (4.0, 2.0, 1.5)


def track(along_m):
    """A box that stands on the ground 10 m ahead, turned to the left, and moves to the left."""
    poses = np.stack([geometry.pose_from_xyyaw(10.0, y, np.pi / 2, 0.75) for y in (0.0, along_m)])
    return Track("1", "automobile", SIZE, Trajectory(np.array([0, 1_000_000]), poses))


def look(at, shades, wanted=0.5):
    """The weight of a grey pixel that shows a point, what it lacks, its cell, and what is added to that."""
    eye = np.array([0.0, 0.0, 1.6])
    ray = np.array(at) - eye
    distance = np.linalg.norm(ray)
    turn = geometry.pose_from_xyyaw(0, 0, 0.3)[:3, :3]
    direction = (turn.T @ ray / distance).reshape(1, 1, 3)
    planes = np.array([0.8, 0.4, 0.4, 0.4, 0.8 * distance, 0]).reshape(6, 1, 1)
    clear, behind = np.full((1, 1), 0.2), np.full((3, 1, 1), 0.5)  # 0.5 in all
    weight, error = np.full((1, 1), 2.0, np.float32), np.full((3, 1, 1), wanted - 0.5)
    cell, shade = np.zeros((1, 1), np.int32), np.zeros((4, 1, 1))
    ground = (direction, turn, eye, planes, clear, behind, shades.boxes(0), shades.sums, weight, error, cell, shade)
    find_shaded(0, 1, *ground)
    add_shaded(cell, shade, shades.sums)
    return weight[0, 0], error[:, 0, 0], cell[0, 0], shade[:, 0, 0]


@pytest.mark.parametrize(
    ("point", "shaded"),
    [
        ((10.0, 0.0, 0.0), True),
        ((10.0, 2.9, 0.0), True),  # half of its length lies to the left, and 0.9 m more
        ((10.0, 3.1, 0.0), False),
        ((8.1, 0.0, 0.05), True),  # half of its width lies towards the camera
        ((7.9, 0.0, 0.0), False),
        ((9.0, 0.0, 0.3), False),  # its own side
        ((10.0, 0.0, -0.3), True),
        ((10.0, 0.0, -0.5), False),  # a street below
    ],
)
def test_ground_beneath_and_beside_a_mover_counts_little(point, shaded):
    assert look(point, Shades([track(4.0)]))[0] == pytest.approx(2 * SHADED_WEIGHT if shaded else 2)


@pytest.mark.parametrize(
    ("point", "cell"),
    [
        # The ray falls by 1.6 m in 8 m: it is 6 cm above the ground 0.3 m before it, 2.3 m from the box's axis. The box
        # is turned to the left, so this is on its left, and the middle of its length is 5 m from where its grid begins.
        ((8.0, 0.0, 0.0), (50, (2.3 + 1 + 3) / 0.1)),
        ((8.0, -1.05, 0.0), (None, None)),
        ((5.5, 0.0, 0.0), None),  # 4.5 m before its axis: beyond half of its width and 3 m
        ((10.0, 5.5, 0.0), None),
    ],
)
def test_pixels_of_the_ground_around_a_mover_have_a_cell(point, cell):
    shades = Shades([track(4.0)])
    columns = shades.grounds[0].shape[1]
    _, _, found, added = look(point, shades)
    if cell is None:
        assert found == -1
    elif cell[0] is not None:
        assert np.abs(np.array(divmod(found, columns)) - cell).max() <= 1 and added[3] == pytest.approx(0, abs=1e-6)
    else:
        assert divmod(found, columns)[0] < 45


def test_ground_between_two_movers_belongs_to_the_nearer_one():
    right = Track("2", "automobile", SIZE, Trajectory(track(4.0).path.t_us, track(4.0).path.world_from_body.copy()))
    right.path.world_from_body[:, 0, 3] = 16.0  # 6 m farther away
    shades = Shades([right, track(4.0)])
    cells = shades.grounds[1].first
    assert look((12.0, 0.0, 0.0), shades)[2] >= cells > look((14.6, 0.0, 0.0), shades)[2] >= 0


def test_what_stands_or_is_not_there_shades_nothing():
    endless = replace(track(4.0), size_m=(1e6, 2.0, 1.5))
    assert len(Shades([track(4.0), track(0.5), endless]).grounds) == 1
    shades = Shades([track(4.0)])
    assert len(shades.boxes(500_000)) == 1 and len(shades.boxes(1_500_000)) == 0


def test_a_mover_that_turns_has_a_grid_for_every_15_degrees():
    """It turns by 10 degrees a second from the third to the seventh second, and back by 5."""
    t_s = np.arange(11)
    yaw_deg = np.array([0, 0, 0, 10, 20, 30, 40, 40, 35, 35, 35]) + 175.0  # past 180
    poses = np.stack(
        [geometry.pose_from_xyyaw(2.0 * t, 0, np.radians(y), 0.75) for t, y in zip(t_s, yaw_deg, strict=True)]
    )
    path = Trajectory(t_s * 1_000_000, poses)
    assert headings(path) == [(0, 4_000_000), (4_000_000, 6_000_000), (6_000_000, 10_000_001)]
    shades = Shades([Track("1", "automobile", SIZE, path)])
    first = [ground.first for ground in shades.grounds]
    boxes = [shades.boxes(t_us) for t_us in (0, 3_999_999, 4_000_000, 10_000_000)]
    assert [rows[:, 15].tolist() for rows in boxes] == [[first[0]], [first[0]], [first[1]], [first[2]]]
    assert headings(track(4.0).path) == [None]


def test_a_shadow_lasts_as_long_as_its_heading():
    """A car that turns to the left, in whose scene only the first of the headings has a shadow."""
    t_us = np.arange(5) * 500_000
    poses = np.stack([geometry.pose_from_xyyaw(4.0 * k, 0, np.radians(10 * k), 0.75) for k in range(5)])
    turning = Track("1", "automobile", SIZE, Trajectory(t_us, poses))
    street = Street(frames=2)
    body = DynamicGaussians.rigid(Gaussians.empty(1), np.zeros(1, np.int32), 0)
    scene = GaussianScene("s", Gaussians.empty(), body, np.zeros((6, 8, 8, 3), np.float32), {}, street.rig, street.ego,
                          (turning,), None, (0, 2_000_000))  # fmt: skip
    shades = Shades([turning])
    first, *others = shades.grounds
    assert first.window_us == (0, 1_000_000) and others
    shades.sums_of(first)[:] = seen_ground()
    shades.sums_of(first)[25:75, 25:55, 0] *= 0.4
    dynamic = with_shadows(scene, shades).dynamic
    at = {at_us: dynamic.at(at_us)[0] for at_us in (500_000, 1_500_000)}
    assert (dynamic.gaussians.label[at[500_000]] == Label.ROAD).sum() > 1000
    assert (dynamic.gaussians.label[at[1_500_000]] == Label.ROAD).sum() == 0
    # Of a car of which nothing was lifted there is no shadow either.
    assert not len(with_shadows(replace(scene, dynamic=DynamicGaussians.empty()), shades).dynamic)


def test_pixels_add_to_their_cell_and_lack_less_once_the_shadow_is_known():
    """Grey of 0.5, so 1.5 for all channels, where the image has 0.2, from ground 4 cm above the underside."""
    shades, point = Shades([track(4.0)]), (10.0, 0.0, 0.04)
    _, error, cell, added = look(point, shades, 0.2)
    assert added == pytest.approx([2 * 1.5 * 0.6, 2 * 1.5**2, 2, 2 * 0.04]) and error == pytest.approx(-0.3)
    assert shades.sums[cell] == pytest.approx(added) and np.count_nonzero(shades.sums.any(axis=1)) == 1
    # Two pixels with a light share of 0.4 and three without a shadow: 3.8 of 5 are left.
    assert look(point, shades, 0.2)[1] == pytest.approx(0.2 - 0.5 * 3.8 / 5)
    assert shades.sums[cell] == pytest.approx(2 * added)
    shades.sums[cell] *= 1e6
    assert look(point, shades, 0.2)[1] == pytest.approx(0, abs=1e-5)
    shades.sums[cell, 0] *= 4  # brighter than the ground: no shadow
    assert look(point, shades, 0.2)[1] == pytest.approx(-0.3)


def seen_ground(left=1.0, pixels=100.0):
    """Sums of a grid whose cells have shown so many pixels of 0.5, with this share of their light left."""
    along, across = Shades([track(4.0)]).grounds[0].shape
    return np.tile(pixels * np.array([0.25 * left, 0.25, 1, 0.02]), (along, across, 1))


def test_a_shadow_is_as_dark_as_what_images_show():
    sums = seen_ground(pixels=1e6)
    sums[25:75, 25:55, 0] *= 0.4  # 0.5 m beyond the box on all sides
    shadow = shadow_of(sums, SIZE, 0.3)
    inside = np.abs(shadow.mean_m[:, :2]) < np.array([2.0, 1.0])
    assert inside.all(axis=1).sum() == pytest.approx(40 * 20, rel=0.1)
    assert np.abs(shadow.mean_m[:, :2]).max(axis=0) == pytest.approx([2.5, 1.5], abs=1.5 * CELL_M)
    assert (shadow.label == Label.ROAD).all() and not shadow.rgb.any() and (shadow.intensity == np.float32(0.3)).all()
    # 2 cm above the underside of the box, and 6 cm above the ground.
    assert shadow.mean_m[:, 2] == pytest.approx(-0.75 + 0.02 + 0.06, abs=1e-5)
    middle = (np.abs(shadow.mean_m[:, :2]) < 0.06).all(axis=1)
    # All Gaussians over the middle, as they are blended there.
    x, y = shadow.mean_m[:, :2].T - shadow.mean_m[middle][0, :2, None]
    response = np.exp(-((x**2 + y**2) / (2 * shadow.scale_m[0, 0] ** 2)))
    assert np.prod(1 - shadow.opacity * response) == pytest.approx(0.4**STRONGER, abs=0.01)


@pytest.mark.parametrize(
    "sums",
    [seen_ground(), seen_ground(left=1.3), seen_ground(left=0.97), seen_ground(left=0.5, pixels=0.0)],
    ids=["lit", "lit by a lamp", "faint", "unseen"],
)
def test_no_shadow(sums):
    assert len(shadow_of(sums, SIZE, 0.3)) == 0


def test_a_few_pixels_make_no_shadow():
    sums = seen_ground()
    sums[45:55, 35:45] = seen_ground(left=0.5, pixels=0.05)[45:55, 35:45]
    assert len(shadow_of(sums, SIZE, 0.3)) == 0


def test_dark_spots_away_from_a_box_are_not_its_shadow():
    sums = seen_ground()
    sums[5:15, 5:15, 0] *= 0.3  # 1.5 to 2.5 m behind it
    assert len(shadow_of(sums, SIZE, 0.3)) == 0
    sums[12:40, 12:40, 0] *= 0.3  # a shadow that reaches as far
    assert len(shadow_of(sums, SIZE, 0.3)) > 500


class Shaded(Street):
    """A street in which boxes shade the road up to 0.7 m beside them."""

    def colours(self, what, hit, index):
        rgb = super().colours(what, hit, index)
        for name, (size, _) in self.boxes.items():
            from_box = np.abs(hit - self._box_poses(name)[index][:3, 3])
            near = (from_box[:, 0] < size[0] / 2 + 0.7) & (from_box[:, 1] < size[1] / 2 + 0.7)
            rgb[near & (what == 1)] *= 0.3
        return rgb


@pytest.mark.slow
def test_the_road_keeps_its_colour_where_a_mover_passed():
    """It drives away from the camera, which sees from near where it was in the first images."""
    away = np.column_stack([9.0 + 2.5 * np.arange(7), np.zeros(7)])
    street = {"frames": 7, "boxes": {"lead": (SIZE, away)}, "cameras": (camera(),)}
    settings = LiftSettings(sky_px=32, views=ViewSettings(levels=32), colours=ColourSettings(rounds=0))
    lifted = reconstruct(Street(**street), settings=settings)
    settings = replace(settings, colours=ColourSettings())
    lit, shaded = (
        solve_colours(lifted, kind(**street), ["front"], settings, lambda fraction: None).scene.static
        for kind in (Street, Shaded)
    )
    x, y, z = lit.mean_m.T
    where = (x > 7) & (x < 12) & (np.abs(y) < 1) & (z < 0.1)
    assert where.sum() > 500
    darker = (lit.rgb[where] - shaded.rgb[where]).mean(axis=1)
    assert darker.max() < 0.05 and abs(darker.mean()) < 0.02


@pytest.mark.slow
def test_the_shadow_of_a_mover_is_rendered_where_it_is():
    """The road between the camera and a car that drives away is as dark as in the images, and only there."""
    away = np.column_stack([9.0 + 1.5 * np.arange(7), np.zeros(7)])
    street = Shaded(frames=7, boxes={"lead": (SIZE, away)}, cameras=(camera(),))
    scene = reconstruct(street, settings=LiftSettings(sky_px=32, views=ViewSettings(levels=32)), complete_actors=False)
    shadow = scene.dynamic.gaussians.label == Label.ROAD
    assert shadow.sum() > 50 and scene.dynamic.in_box[shadow].all() and (scene.dynamic.track[shadow] == 0).all()
    bright = replace(scene, dynamic=_rows(scene.dynamic, ~shadow))
    error = []
    for shown in (scene, bright):
        squares = []
        for k in range(7):
            t_us = int(street.t_us[k])
            pose = street.world_from_camera("front", k)
            request = SensorRequest(scene.id, street.rig.cameras["front"], t_us, t_us + 1, pose)
            frame = CpuRenderer(shown, threads=1).render_camera(request, ("rgb",))
            squares.append((frame.rgb.astype(float) - street.image("front", k)) ** 2)
        error.append(np.mean(squares))
    assert error[0] < 0.7 * error[1]
