"""What cameras make of light."""

import dataclasses

import numpy as np
import pytest

from nurec_sim.world.sense.isp import CameraResponse, apply_response, random_response

GREY = np.full((40, 60, 3), 120, np.uint8)


def test_an_ideal_camera_changes_nothing():
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    np.testing.assert_array_equal(apply_response(image, CameraResponse(), 1), image)


def test_gains_scale_colours_and_stop_at_white():
    response = CameraResponse(white_balance=(1.1, 1.0, 0.9), exposure=1.2)
    assert apply_response(GREY, response, 0)[5, 5].tolist() == [158, 144, 130]
    assert apply_response(np.full_like(GREY, 240), response, 0)[5, 5].tolist() == [255, 255, 255]


def test_corners_lose_the_vignette_and_the_middle_nothing():
    image = apply_response(np.full((41, 61, 3), 200, np.uint8), CameraResponse(vignette=0.25), 0)
    assert image[20, 30].tolist() == [200] * 3
    assert (image[[0, 0, 40, 40], [0, 60, 0, 60]] == 150).all()
    assert (np.diff(image[20, 30:, 0].astype(int)) <= 0).all()


def test_gamma_below_one_brightens_and_keeps_black_and_white():
    ramp = np.tile(np.arange(256, dtype=np.uint8)[None, :, None], (2, 1, 3))
    bright = apply_response(ramp, CameraResponse(gamma=0.8), 0)[0, :, 0].astype(int)
    expected = np.rint(255 * (np.arange(256) / 255) ** 0.8)
    assert np.abs(bright - expected).max() <= 1 and bright[0] == 0 and bright[255] == 255


def test_noise_follows_the_seed_and_grows_with_light():
    response, seed = CameraResponse(noise=0.02), (3, 4, 5)
    noisy = apply_response(GREY, response, seed)
    assert noisy.tobytes() == apply_response(GREY, response, seed).tobytes()
    assert noisy.tobytes() != apply_response(GREY, response, (3, 4, 6)).tobytes()
    spread = [apply_response(np.full((200, 200, 3), value, np.uint8), response, 1).std() for value in (30, 120, 200)]
    expected = [255 * 0.02 * (0.3 + 0.7 * np.sqrt(value / 255)) for value in (30, 120, 200)]
    np.testing.assert_allclose(spread, expected, rtol=0.03)


def test_random_responses_are_those_of_sane_cameras():
    drawn = [random_response(np.random.default_rng(seed)) for seed in range(60)]
    assert len(set(drawn)) == 60 and drawn[3] == random_response(np.random.default_rng(3))
    for response in drawn:
        brightness = apply_response(GREY, dataclasses.replace(response, noise=0.0), 0).mean() / 120
        assert 0.65 < brightness < 1.35


@pytest.mark.parametrize(
    "wrong, text",
    [
        ({"exposure": 0.0}, "exposure and gamma must be positive"),
        ({"gamma": np.inf}, "exposure and gamma must be positive"),
        ({"white_balance": (1.0, 1.0)}, r"white_balance \[3\]"),
        ({"vignette": 1.5}, "vignette and noise must lie in 0..1, got 1.5"),
        ({"noise": -0.1}, "vignette and noise must lie in 0..1"),
    ],
)
def test_impossible_cameras_are_refused(wrong, text):
    with pytest.raises(ValueError, match=text):
        CameraResponse(**wrong)
