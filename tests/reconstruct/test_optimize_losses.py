"""The losses of per-scene optimisation against skimage and finite differences, and what they compare with."""

import dataclasses

import numpy as np
import pytest
from fitted_street import CROSSING, Flicker, image_of
from reconstruct_street import camera
from skimage.metrics import structural_similarity

from nurec_sim.evaluate.scores.images import psnr
from nurec_sim.reconstruct import OptimizeSettings
from nurec_sim.reconstruct.optimize import method
from nurec_sim.reconstruct.optimize.adam import BRIGHTEST, SkyAdam
from nurec_sim.reconstruct.optimize.coverage import Coverage, coverage_loss
from nurec_sim.reconstruct.optimize.depth_loss import depth_loss
from nurec_sim.reconstruct.optimize.image_loss import colour_loss
from nurec_sim.reconstruct.optimize.settings import LossWeights
from nurec_sim.reconstruct.optimize.views import Returns, returns_in, training_views


def test_the_loss_of_colour_is_that_of_skimage_and_its_gradient_that_of_differences():
    random = np.random.default_rng(0)
    shown, recorded = random.random((2, 24, 30, 3), dtype=np.float32)
    recorded = 0.6 * shown + 0.4 * recorded
    loss, gradient = colour_loss(shown, recorded, 0.2)
    _, similarity = structural_similarity(shown, recorded, channel_axis=2, data_range=1.0, gaussian_weights=True,
                                          sigma=1.5, use_sample_covariance=False, full=True)  # fmt: skip
    inner = (slice(5, -5), slice(5, -5))  # borders differ: zeros here, reflection there
    only_dssim = colour_loss(shown, recorded, 1.0)[0]
    assert np.abs(shown - recorded).mean() * 0.8 + 0.2 * only_dssim == pytest.approx(loss, rel=1e-5)
    assert 1 - similarity[inner].mean() == pytest.approx(only_dssim, abs=0.05)
    for v, u, c in ((0, 0, 0), (12, 15, 1), (23, 7, 2), (6, 29, 0)):
        step = np.zeros_like(shown)
        step[v, u, c] = 2e-3
        difference = (colour_loss(shown + step, recorded, 0.2)[0] - colour_loss(shown - step, recorded, 0.2)[0]) / 4e-3
        assert gradient[v, u, c] == pytest.approx(difference, rel=0.02, abs=2e-6)


def plane_image(height=20, width=30):
    """Depth of a slanted plane 1 / (0.1 + 0.004 u + 0.002 v) at pixel centres, half opaque somewhere."""
    v, u = np.mgrid[:height, :width] + 0.5
    depth = 1 / (0.1 + 0.004 * u + 0.002 * v)
    alpha = np.where(u < 15, 0.7, 0.95)
    return alpha.astype(np.float32), (alpha * depth).astype(np.float32)


def test_returns_on_a_plane_have_no_error_between_pixels():
    alpha, distance = plane_image()
    uv = np.array([[7.3, 4.9], [20.81, 13.02], [12.5, 9.5]])
    depth = 1 / (0.1 + 0.004 * uv[:, 0] + 0.002 * uv[:, 1])
    by_alpha, by_distance = np.zeros_like(alpha), np.zeros_like(alpha)
    assert depth_loss(Returns(uv, depth), alpha, distance, None, 1.0, 0.0, by_alpha, by_distance) < 1e-6
    # Twice as far along rays of z = 0.5 is the same plane.
    half = np.full_like(alpha, 0.5)
    assert depth_loss(Returns(uv, depth), alpha, 2 * distance, half, 1.0, 0.0, by_alpha, by_distance) < 1e-6
    nearer = depth_loss(Returns(uv, depth * 0.9), alpha, distance, None, 1.0, 0.0, by_alpha, by_distance)
    assert nearer == pytest.approx(0.1, rel=1e-4)


def test_gradients_of_the_loss_of_depth_are_those_of_differences():
    alpha, distance = plane_image()
    uv = np.array([[7.3, 4.9], [20.81, 13.02], [3.0, 15.2]])
    returns = Returns(uv, np.array([7.9, 4.4, 7.2]))
    by_alpha, by_distance = np.zeros_like(alpha), np.zeros_like(alpha)

    def loss(a, d):
        return depth_loss(returns, a, d, None, 0.7, 0.3, np.zeros_like(alpha), np.zeros_like(alpha))

    depth_loss(returns, alpha, distance, None, 0.7, 0.3, by_alpha, by_distance)
    for row, column in ((4, 6), (5, 7), (12, 20), (13, 21), (14, 2)):
        for image, gradient in ((0, by_alpha), (1, by_distance)):
            step = np.zeros((2, *alpha.shape), np.float32)
            step[image, row, column] = 1e-3
            difference = (loss(alpha + step[0], distance + step[1]) - loss(alpha - step[0], distance - step[1])) / 2e-3
            assert gradient[row, column] == pytest.approx(difference, rel=0.02, abs=1e-5)


def test_returns_behind_others_are_left_out():
    seen = camera(width=192, height=96)
    pose = np.stack([seen.rig_from_camera] * 2)
    ahead = np.array([[11.5, 0.0, 1.5], [11.5, 0.05, 1.5], [21.5, 0.02, 1.5], [21.5, 5.0, 1.5], [-5.0, 0, 1.5]])
    found = returns_in(seen, pose, ahead)
    assert found.depth_m.tolist() == pytest.approx([10.0, 10.0, 20.0])
    assert found.uv_px[0].tolist() == pytest.approx([96.0, 48.0])


def test_returns_of_labelled_boxes_are_left_out(street, lifted):
    """The moving box is 2 m to the left; without its label its returns would count as static."""
    views = training_views(street, lifted, ["front"], set())
    unlabelled = training_views(street, dataclasses.replace(lifted, tracks=()), ["front"], set())
    assert all(len(a.returns) < len(b.returns) for a, b in zip(views, unlabelled, strict=True))
    assert all(len(view.returns) == 0 for view in training_views(street, lifted, ["front"], {0, 1, 2, 3}))


def test_a_saturated_pixel_says_only_that_it_was_no_darker(street, lifted):
    view = training_views(street, lifted, ["front"], set())[0]
    image = np.full((1, 4, 3), 255, np.uint8)
    image[0, 2:] = 249
    shown = np.array([0.9, 1.3, 0.9, 1.3], np.float32)[None, :, None].repeat(3, axis=2)
    wanted = dataclasses.replace(view, image=image, ego=None).colours_beside(shown)
    assert wanted[0, :, 0] == pytest.approx([1, 1.3, 249 / 255, 249 / 255])


def test_the_sky_may_be_brighter_than_the_white_of_an_image():
    sky = np.full((6, 2, 2, 3), 0.99, np.float32)
    adam, gradient = SkyAdam(sky), np.zeros((6, 2, 2, 3))
    gradient[0, 0, 0] = -1
    for rate in (0.1, 10.0):
        adam.step(sky, gradient, rate)
        assert sky[0, 0, 0] == pytest.approx(min(0.99 + rate, BRIGHTEST), rel=1e-5)
    assert (sky.reshape(-1, 3)[1:] == np.float32(0.99)).all()


def test_the_ego_vehicle_in_an_image_teaches_nothing(street, lifted):
    """A black bonnet over the lower half: with it in the scene's ego image, the street below it stays as it was."""

    class Bonnet(Flicker):
        def image(self, camera_id, index):
            image = super().image(camera_id, index)
            image[40:] = 0
            return image

    clip = Bonnet(frames=4, boxes=CROSSING, cameras=tuple(street.rig.cameras.values()))
    bonnet = np.zeros((64, 128, 4), np.uint8)
    bonnet[40:, :, 3] = 255
    known = dataclasses.replace(lifted, ego_images={"front": bonnet})
    settings = OptimizeSettings(seconds=None, steps=40)
    below = [
        image_of(method.refine(scene, clip, ["front"], set(), lambda *_: None, settings), street, "front", 0)[48:]
        for scene in (known, lifted)
    ]
    before = image_of(lifted, street, "front", 0)[48:]
    assert psnr(below[0], before) > psnr(below[1], before) + 8, (psnr(below[0], before), psnr(below[1], before))


ALPHA = np.array([[0.0, 0.04, 0.5], [0.96, 1.0, 0.0]], np.float32)
RAYS = np.array([[1, 1, 1], [1, 1, 0]], np.float32)
"""The last pixel has no ray."""


def test_sky_stays_open_and_surfaces_stay_closed():
    sky, surface = Coverage().of(0, ALPHA, RAYS)
    assert sky.tolist() == [[True, True, False], [False, False, False]]
    assert surface.tolist() == [[False, False, False], [True, True, False]]
    by_alpha = np.ones((2, 3), np.float32)
    loss = coverage_loss(ALPHA, sky, surface, LossWeights(sky=0.3, surface=0.5), by_alpha)
    # Mean alpha in the sky is 0.02, mean 1 - alpha on the surface as well.
    assert loss == pytest.approx(0.3 * 0.02 + 0.5 * 0.02)
    assert by_alpha == pytest.approx(np.array([[1.15, 1.15, 1.0], [0.75, 0.75, 1.0]]))
    nothing = np.zeros((2, 3), bool)
    assert coverage_loss(ALPHA, nothing, nothing, LossWeights(), by_alpha) == 0


def test_what_shows_the_sky_is_what_showed_it_at_first():
    coverage = Coverage()
    first = coverage.of(3, ALPHA, RAYS)
    again = coverage.of(3, 1 - ALPHA, RAYS)
    assert all(np.array_equal(one, other) for one, other in zip(first, again, strict=True))
    assert not np.array_equal(coverage.of(4, 1 - ALPHA, RAYS)[0], first[0])
    resumed = Coverage()
    resumed.restore({"numbers": np.zeros(5), **coverage.state()})
    assert np.array_equal(resumed.of(3, 1 - ALPHA, RAYS), first)
