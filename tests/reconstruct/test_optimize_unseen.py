"""Colours of Gaussians that images hardly show."""

import dataclasses

import numpy as np
import pytest

from nurec_sim.reconstruct import OptimizeSettings, unseen_colours
from nurec_sim.reconstruct.optimize import method, unseen
from nurec_sim.reconstruct.optimize.adam import RGB
from nurec_sim.reconstruct.optimize.parameters import Parameters
from nurec_sim.reconstruct.optimize.unseen import LEAST_PX, SHOWN_PX, colour_hardly_shown, pixel_shares
from nurec_sim.reconstruct.optimize.views import training_views
from nurec_sim.types import DynamicGaussians, Label


def test_an_image_shows_what_is_before_it_and_not_what_is_behind(street, lifted):
    """The camera looks along x; one Gaussian is 20 m before it, one behind it, one behind a wall."""
    (view, *_) = training_views(street, lifted, ["front"], set())
    eye = view.world_from_camera[0, :3, 3]
    static = lifted.static[:4]
    places = eye + np.array([[20.0, 0, 0], [-20.0, 0, 0], [10.0, 2.0, 0.0], [20.0, 4.0, 0.0]])
    small = dataclasses.replace(
        static,
        mean_m=places.astype(np.float32),
        scale_m=np.where([[False], [False], [True], [False]], 0.5, 0.1).repeat(3, axis=1).astype(np.float32),
        opacity=np.full(4, 0.9999, np.float32),
    )
    # The wall is three Gaussians deep: one lets a hundredth through.
    deep = small[np.array([0, 1, 2, 2, 2, 3])]
    parameters = Parameters(dataclasses.replace(lifted, static=deep, dynamic=DynamicGaussians.empty(), tracks=()))
    x = parameters.static_gaussians(np.arange(6)).mean_m - eye.astype(np.float32)
    seen = pixel_shares(parameters, [view]) > SHOWN_PX
    assert seen[x[:, 0] < 0].tolist() == [False]
    assert seen[(x[:, 0] == 20) & (x[:, 1] == 0)].tolist() == [True]
    assert seen[(x[:, 1] > 3)].tolist() == [False]
    assert not parameters.gradients.features.any()


def test_shares_are_in_pixels_of_the_full_size(street, lifted, monkeypatch):
    """Of images that are drawn at a quarter of their size as well: nothing but roundings at edges."""
    views, parameters = training_views(street, lifted, ["front"], set()), Parameters(lifted)
    whole = pixel_shares(parameters, views)
    monkeypatch.setattr(unseen, "WIDTH_PX", 32)
    coarse = pixel_shares(parameters, views)
    assert 0.5 * 4 * 128 * 64 < whole.sum() < 4 * 128 * 64
    assert coarse.sum() == pytest.approx(whole.sum(), rel=0.05)


def test_the_colour_is_that_of_what_is_alike(lifted):
    """Bright upright, dark upright and road: green, red, grey. What is hardly seen takes the colour of its kind.

    Seven places stand a metre apart, each of so many Gaussians that their intensities are not mixed with the next.
    """
    each = 2 * unseen_colours.SMOOTHED * unseen_colours.THINNED
    kinds = np.array([0, 1, 2, 0, 1, 2, 0]).repeat(each)
    colours = np.array([[0, 1, 0], [1, 0, 0], [0.5, 0.5, 0.5]], np.float32)
    unseen = np.array([False, False, False, True, True, True, True]).repeat(each)
    count = len(kinds)
    place = np.arange(count) // each + np.arange(count) % each * 1e-3
    made = dataclasses.replace(
        lifted.static[:count],
        mean_m=np.column_stack([np.zeros(count), place, np.where(kinds == 2, 0.0, 2.0)]).astype(np.float32),
        normal=np.where((kinds == 2)[:, None], [0.0, 0, 1], [1.0, 0, 0]).astype(np.float32),
        intensity=np.array([0.9, 0.1, 0.3], np.float32)[kinds],
        label=np.where(kinds == 2, Label.ROAD, Label.OTHER).astype(lifted.static.label.dtype),
        rgb=np.where(unseen[:, None], np.float32(1), colours[kinds]),
    )
    parameters = Parameters(dataclasses.replace(lifted, static=made, dynamic=DynamicGaussians.empty(), tracks=()))
    order = np.searchsorted(place, parameters.static_gaussians(np.arange(count)).mean_m[:, 1] - 5e-4)
    assert np.array_equal(np.sort(order), np.arange(count))
    colour_hardly_shown(parameters, np.where(unseen[order], 0.1, 1.0))
    got = parameters.values[:, RGB : RGB + 3][np.argsort(order)]
    np.testing.assert_array_equal(got[~unseen], colours[kinds[~unseen]])
    assert got[unseen] == pytest.approx(colours[kinds[unseen]], abs=0.2)


def test_a_fit_colours_what_images_hardly_show(street, lifted):
    """What no image shows, as the street behind the car, keeps its colours."""
    views = training_views(street, lifted, ["front"], set())
    run = method.Optimization(lifted, views, OptimizeSettings(seconds=None, steps=1))
    run.run(lambda *_: None)
    fitted = run.parameters.visits[: run.parameters.static_count] > 0
    pixels = pixel_shares(run.parameters, views)
    shown, hardly = pixels > SHOWN_PX, (pixels > LEAST_PX) & (pixels <= SHOWN_PX)
    assert (shown & ~fitted).any(), "one of four images has been fitted"
    assert (hardly & fitted).any(), "few pixels change colours, and do not determine them"
    assert not (shown | hardly).all()
    before = run.parameters.values.copy()
    run.colour_hardly_shown()
    changed = run.parameters.values != before
    assert not changed[:, :RGB].any(), "colours alone change"
    changed = changed.any(axis=1)
    assert changed[: len(hardly)][hardly].mean() > 0.9
    assert not changed[: len(hardly)][~hardly].any() and not changed[len(hardly) :].any()
