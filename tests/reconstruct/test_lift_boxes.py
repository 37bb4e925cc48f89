"""Which box the pixels of a view lie in: the camera stands at the origin and looks along z, y is down."""

import numpy as np
import pytest

from nurec_sim import geometry
from nurec_sim.reconstruct.lift.lifting import NOBODY, STATIC
from nurec_sim.reconstruct.lift.pictures import numbers_of_pixels
from nurec_sim.reconstruct.lift.views import Tile, WorkingView

NUMBERS = np.array([3, 5])


def number_of(x_m, y_m, z_m, drawn=STATIC):
    """Of the pixel of a point, with boxes of 2 m at z = 10 and z = 11.5."""
    tile = Tile(1, 1, 1.0, (0.5 - x_m / z_m, 0.5 - y_m / z_m), np.eye(3), 1, None, np.ones((1, 1), bool), np.zeros(3))
    view = WorkingView("front", 0, 0, True, tile, np.eye(4), np.zeros(3), np.zeros((1, 1, 3), np.uint8))
    # A box looks away from the camera; its left is that of the camera, its up is -y.
    axes = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    boxes = np.stack([geometry.pose(axes, np.array([0.0, 0, z])) for z in (10, 11.5)])
    body = np.zeros((1, 1), np.int32)
    numbers_of_pixels(view.packed, np.eye(4), np.full((1, 1), 1 / z_m, np.float32), np.full((1, 1), drawn, np.int32),
                      NUMBERS, boxes, geometry.inverse(boxes), np.full((2, 3), 2.0), body)  # fmt: skip
    return body[0, 0]


@pytest.mark.parametrize(
    ("place", "drawn", "number"),
    [
        ((0, 0, 9.5), STATIC, 3),
        ((0, 0, 12), STATIC, 5),
        ((0, 0, 10.9), STATIC, 3),  # in both
        ((1.05, 0, 9.5), STATIC, 3),
        ((1.2, 0, 9.5), STATIC, NOBODY),
        ((1.2, 0, 9.5), 0, 0),  # measured
        ((1.7, 0, 9.5), STATIC, 0),
        ((0, 0.9, 9.5), STATIC, 0),  # less than 15 cm over its underside
        ((0, 0.8, 9.5), STATIC, 3),
        ((0, 0, 11.2), STATIC, 5),  # at the rim of the first
        ((0, 0, 9.5), 1, 0),  # another actor's surfel
    ],
)
def test_pixels_belong_to_the_first_box_they_lie_in_and_to_nobody_at_its_rim(place, drawn, number):
    assert number_of(*place, drawn) == number
