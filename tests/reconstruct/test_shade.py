"""Shadows of movers stay out of the colours of the ground."""

from dataclasses import replace

import numpy as np
import pytest
from reconstruct_street import Street, camera

from nurec_sim import geometry
from nurec_sim.reconstruct import ColourSettings, LiftSettings, ViewSettings, reconstruct
from nurec_sim.reconstruct.lift.colour_solve import solve_colours
from nurec_sim.reconstruct.lift.shade import movers, shading_boxes, unweigh_shaded
from nurec_sim.types import Track, Trajectory

SIZE = (4.0, 2.0, 1.5)


def track(along_m):
    """A box that stands on the ground 10 m ahead, turned to the left, and moves to the left."""
    poses = np.stack([geometry.pose_from_xyyaw(10.0, y, np.pi / 2, 0.75) for y in (0.0, along_m)])
    return Track("1", "automobile", SIZE, Trajectory(np.array([0, 1_000_000]), poses))


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
def test_ground_beneath_and_beside_a_mover_is_shaded(point, shaded):
    eye = np.array([0.0, 0.0, 1.6])
    ray = np.array(point) - eye
    distance = np.linalg.norm(ray)
    turn = geometry.pose_from_xyyaw(0, 0, 0.3)[:3, :3]
    direction = (turn.T @ ray / distance).reshape(1, 1, 3)
    planes = np.array([0.8, 0, 0, 0, 0.8 * distance, 0]).reshape(6, 1, 1)
    weight = np.ones((1, 1), np.float32)
    unweigh_shaded(0, len(weight), direction, turn, eye, planes, shading_boxes([track(4.0)], 0), weight)
    assert weight[0, 0] == (not shaded)


def test_what_stands_or_is_not_there_shades_nothing():
    moves, stands = track(4.0), track(0.5)
    assert movers([moves, stands]) == [moves]
    assert len(shading_boxes([moves], 500_000)) == 1 and len(shading_boxes([moves], 1_500_000)) == 0


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
    assert darker.max() < 0.05 and abs(darker.mean()) < 0.005
