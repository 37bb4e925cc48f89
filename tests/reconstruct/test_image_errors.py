"""What a picture lacks to be the recorded image, by hand."""

import numpy as np
import pytest

from nurec_sim.reconstruct.lift.image_errors import image_errors

RESPONSE = np.array([[2.0, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 0.5, 0]])
"""Red is doubled and 0.1 brighter in the image, blue is halved."""


def errors(rgb, opacity, colours, sky, counts=(3.0, 5.0), valid=1.0):
    """Error, weight and weight in the sky of a single pixel."""
    planes = np.array([opacity, *colours, 0, 0], np.float32).reshape(6, 1, 1)
    clear, behind = np.float32([[1 - opacity]]), np.array(sky, np.float32).reshape(3, 1, 1)
    error, weight, sky_weight = np.empty((3, 1, 1), np.float32), *np.empty((2, 1, 1), np.float32)
    recorded, each = np.array(rgb, np.uint8).reshape(1, 1, 3), np.array(counts, np.float32).reshape(2, 1, 1)
    here, back = np.float32([[valid]]), (np.linalg.inv(RESPONSE[:, :3]), RESPONSE[:, 3].copy())
    image_errors(0, 1, recorded, *back, planes, clear, behind, each, here, error, weight, sky_weight)
    return error.ravel(), float(weight[0, 0]), float(sky_weight[0, 0])


def test_errors_are_those_of_colours_before_the_response():
    error, weight, sky_weight = errors((102, 51, 51), 0.75, (0.2, 0.1, 0.3), (0.4, 0.2, 0.0))
    # 0.4 = 2 x 0.15 + 0.1; 0.2; 0.2 = 0.4 / 2. Shown: 0.2 + 0.25 x 0.4, 0.1 + 0.25 x 0.2, 0.3.
    assert error == pytest.approx([0.15 - 0.3, 0.2 - 0.15, 0.4 - 0.3], abs=1e-6)
    assert (weight, sky_weight) == (3.0, 1.25)


def test_white_may_be_brighter_and_says_nothing_where_all_channels_are():
    error, weight, _ = errors((255, 51, 51), 1.0, (0.9, 0.1, 0.3), (0, 0, 0))
    assert error == pytest.approx([0, 0.1, 0.1], abs=1e-6) and weight == 3.0
    error, weight, sky_weight = errors((255, 255, 255), 0.5, (0.9, 1.2, 2.5), (0, 0, 0))
    assert not error.any() and weight == sky_weight == 0
    # Darker than white is an error.
    error, weight, _ = errors((255, 255, 255), 1.0, (0.25, 1.2, 2.5), (0, 0, 0))
    assert error == pytest.approx([0.45 - 0.25, 0, 0], abs=1e-6) and weight == 3.0


def test_a_pixel_without_a_ray_counts_nothing():
    assert errors((102, 51, 51), 0.5, (0.2, 0.1, 0.3), (0, 0, 0), valid=0.0)[1:] == (0, 0)
