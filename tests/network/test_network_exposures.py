"""Camera gains from the colours that cameras show of the same surfaces."""

import numpy as np
import pytest

from nurec_sim.reconstruct.feedforward.merging.exposures import LARGEST_GAIN, LEAST_SHARED, camera_gains


def pairs_of(brightness, shared):
    """Sums over shared pixels (camera, camera) -> number, of cameras that show a grey surface each in its own way."""
    brightness = np.asarray(brightness, float)
    pairs = np.zeros((len(brightness), len(brightness), 7))
    for (a, b), count in shared.items():
        pairs[a, b] = np.concatenate([count * brightness[a], count * brightness[b], [count]])
    return pairs


def test_a_chain_of_cameras_becomes_alike_in_every_channel():
    brightness = [[0.5, 0.5, 0.5], [0.4, 0.5, 0.6], [0.2, 0.25, 0.25]]
    gain = camera_gains(np.arange(3), pairs_of(brightness, {(0, 1): 5000, (1, 2): 900}))
    alike = gain * brightness
    assert np.allclose(alike, alike[0], rtol=1e-4) and gain.max(axis=0) == pytest.approx(1)


def test_images_of_one_camera_count_together_and_in_either_direction():
    brightness = [[0.5] * 3, [0.25] * 3]
    one_way = camera_gains(np.array([0, 1]), pairs_of(brightness, {(0, 1): 1000}))
    images = np.zeros((4, 2, 7))
    for image, (a, b) in enumerate([(0, 1), (0, 1), (1, 0), (1, 0)]):
        images[image, b] = np.concatenate([250 * np.array(brightness[a]), 250 * np.array(brightness[b]), [250]])
    assert np.allclose(camera_gains(np.array([0, 0, 1, 1]), images), one_way)
    assert np.allclose(one_way, [[0.5] * 3, [1] * 3], rtol=1e-4)


def test_too_few_pixels_and_a_camera_that_shares_none_change_nothing():
    brightness = [[0.5] * 3, [0.25] * 3, [0.9] * 3]
    assert np.allclose(camera_gains(np.arange(3), pairs_of(brightness, {(0, 1): LEAST_SHARED - 1})), 1)
    gain = camera_gains(np.arange(3), pairs_of(brightness, {(0, 1): 1000}))
    assert np.allclose(gain[0] / gain[1], 0.5, rtol=1e-4) and gain[0, 0] < gain[2, 0] <= gain[1, 0]
    assert np.allclose(camera_gains(np.array([0]), np.zeros((1, 1, 7))), 1)


def test_gains_are_bounded():
    gain = camera_gains(np.arange(2), pairs_of([[0.9] * 3, [0.04] * 3], {(0, 1): 1000}))
    assert np.allclose(gain[0], 1 / LARGEST_GAIN) and np.allclose(gain[1], 1)
