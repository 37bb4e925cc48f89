"""Errors of pixels spread over Gaussians and sky, against the weights of the float64 reference."""

import dataclasses

import numpy as np
import pytest
from gradient_worlds import SMALL, poses_of, reference, world

from nurec_sim import geometry
from nurec_sim.render.cpu.backward.colours import spread_errors, spread_sky_errors
from nurec_sim.render.cpu.backward.frame import SENSORS, ExactView, shared_workers
from nurec_sim.render.cpu.blend.background import draw_sky
from nurec_sim.render.cpu.blend.responses import CAMERA
from nurec_sim.render.cpu.blend.tiles import AFFINE
from nurec_sim.render.cpu.pack import pack
from nurec_sim.render.cpu.pipeline import NO_TABLE, Picture, blocks_in_view, draw
from nurec_sim.render.cpu.workers import Buffers


def spread(made, name, weight, error):
    """Shares by Gaussian, and the view."""
    tables = SENSORS.tables(SMALL[name])
    view = ExactView.of(tables.grid, poses_of(name))
    layer = pack(dataclasses.replace(made, label=np.zeros(len(made), np.uint8)))
    with Buffers().lend() as scratch:
        rays = NO_TABLE if view.projection_mode == AFFINE else tables.rays
        picture = Picture(view, rays, CAMERA, [(layer, blocks_in_view(view, layer))], scratch)
        planes = draw([picture], shared_workers(1))[0]
        (shares,) = spread_errors(picture, planes, weight, error, shared_workers(1))
    return shares[np.argsort(layer.index)[np.sum(layer.index < 0) :]], view


@pytest.mark.parametrize("name", ["pinhole", "fisheye", "rolling"])
def test_shares_are_the_weights_with_which_a_gaussian_enters_pixels(name):
    made, shape, rng = world(), (16, 24), np.random.default_rng(0)
    weight, error = rng.random(shape).astype(np.float32), rng.normal(size=(3, *shape)).astype(np.float32)
    shares, _ = spread(made, name, weight, error)
    for i in range(0, len(made), 4):
        # White alone among black ones, a Gaussian shows its weight in every pixel.
        only = dataclasses.replace(made, rgb=(np.arange(len(made)) == i)[:, None] * np.ones(3))
        seen = reference(only, SMALL[name], poses_of(name))["rgb"][..., 0]
        expected = [(weight * seen).sum(), *(weight * seen * error).sum(axis=(1, 2))]
        # A ray that just misses a Gaussian in float32 and not in float64 has a weight of 1/255.
        assert shares[i] == pytest.approx(expected, abs=0.01), i
    assert shares[:, 0].max() > 1


def test_texels_get_what_a_look_up_takes_from_them():
    shape, rng = (16, 24), np.random.default_rng(0)
    weight, error = rng.random(shape).astype(np.float32), rng.normal(size=(3, *shape)).astype(np.float32)
    grid, turn = SENSORS.tables(SMALL["fisheye"]).grid, geometry.matrix_from_quat(np.array([0.9, 0.3, -0.2, 0.25]))
    shares = np.zeros((6, 4, 4, 4), np.float32)
    spread_sky_errors(grid.direction, turn, weight, error, shares)
    for texel in ((0, 1, 2), (1, 3, 3), (2, 0, 1), (4, 2, 2), (5, 1, 1)):
        sky = np.zeros((6, 4, 4, 3), np.float32)
        sky[texel] = 1
        seen = draw_sky(grid.direction, turn, sky, shared_workers(1))[0]
        assert shares[texel] == pytest.approx([(weight * seen).sum(), *(weight * seen * error).sum((1, 2))], abs=1e-3)
    assert shares[..., 0].sum() == pytest.approx(weight.sum(), rel=1e-4)
