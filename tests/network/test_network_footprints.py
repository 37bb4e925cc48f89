"""Gaussians as footprints of pixels: a camera above flat ground, where everything is known in closed form."""

import dataclasses

import numpy as np
import pytest
import torch
from training_samples import ground_sample

from nurec_sim import network
from nurec_sim.network.footprints import SHARE, STEEPEST, THICKNESS, footprints, product
from nurec_sim.network.tensors import ContextMaps
from nurec_sim.training.start import prepare


def ground_context(sample):
    """What perfect heads would say of flat ground; above the horizon a wall far away."""
    truth = sample.truth
    depth = torch.where(truth.depth_m > 0, truth.depth_m, torch.tensor(50.0))
    facing = -sample.inputs.rays[..., 3:]
    normal = torch.where((truth.normal != 0).any(-1, keepdim=True), truth.normal, facing)
    return ContextMaps(depth, sample.inputs.rgb, normal, torch.zeros(*depth.shape, 5), None)


def all_footprints(sample, spacing=1.0):
    pixels = sample.truth.depth_m.numel()
    return footprints(sample.inputs, ground_context(sample), torch.arange(pixels)[None], torch.full((pixels,), spacing))


def axes_of(shapes):
    w, x, y, z = shapes.quat_wxyz[0].double().unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def test_footprints_lie_on_the_surface_and_reach_from_pixel_to_pixel():
    sample = ground_sample(images=1)
    shapes, truth = all_footprints(sample), sample.truth
    ground = ((truth.depth_m > 0) & (truth.depth_m < 12)).flatten()
    normal = truth.normal.reshape(-1, 3)[ground].double()
    axes = axes_of(shapes)[ground]
    assert float((axes[..., 2] * normal).sum(-1).abs().min()) > 1 - 1e-4
    # Across the view, half a pixel's width at the point's distance.
    rays = sample.inputs.rays[0, 0]
    distance = (truth.depth_m / sample.inputs.distance_to_depth_scale[..., 0]).flatten()[ground]
    apart = (rays[:, 1:, 3:] - rays[:, :-1, 3:]).norm(dim=-1).median()
    width = shapes.scale_m[0, ground, 1]
    assert float((width / (SHARE * distance * apart) - 1).abs().median()) < 0.15
    # Along the view longer by the slope, but not without end; and thin.
    slant = -(rays[..., 3:].reshape(-1, 3)[ground].double() * normal).sum(-1)
    stretch = shapes.scale_m[0, ground, 0] / width
    assert torch.allclose(stretch.double(), (1 / slant).clamp(max=STEEPEST), rtol=1e-3)
    assert torch.allclose(shapes.scale_m[0, ground, 2], width * THICKNESS, rtol=1e-5)
    along = axes[..., 0]
    sideways = torch.linalg.cross(rays[..., 3:].reshape(-1, 3)[ground].double(), normal)
    assert float((along * sideways).sum(-1).abs().max()) < 1e-3


def test_every_second_pixel_makes_footprints_twice_as_wide():
    sample = ground_sample(images=1)
    assert torch.allclose(all_footprints(sample, 2.0).scale_m, 2 * all_footprints(sample).scale_m)


def test_surfaces_looked_at_straight_on_have_round_footprints():
    sample = ground_sample(images=1)
    shapes = all_footprints(sample)
    assert bool(torch.isfinite(shapes.scale_m).all() and torch.isfinite(shapes.quat_wxyz).all())
    wall = (sample.truth.depth_m == 0).flatten()
    assert torch.allclose(shapes.scale_m[0, wall, 0], shapes.scale_m[0, wall, 1], rtol=1e-3)
    assert torch.allclose(shapes.quat_wxyz[0].norm(dim=-1), torch.ones(len(wall)), atol=1e-5)


def test_changes_of_zero_keep_the_footprint():
    shapes = all_footprints(ground_sample(images=1))
    scale, quat = shapes.changed(torch.zeros_like(shapes.scale_m), torch.tensor([3.0, 0, 0, 0]).expand(1, 1, 4))
    assert torch.allclose(scale, shapes.scale_m.clamp(max=2.0))
    assert torch.allclose(quat, shapes.quat_wxyz, atol=1e-6)


def test_quaternions_multiply_as_turns_one_after_the_other():
    quarter = np.sqrt(0.5)
    about_z, about_x = torch.tensor([quarter, 0, 0, quarter]), torch.tensor([quarter, quarter, 0, 0])
    # x to y by the first, y to z by the second.
    both = product(about_x, about_z).double()
    vector = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    turned = product(product(both, vector), both * torch.tensor([1.0, -1, -1, -1]))
    assert torch.allclose(turned, torch.tensor([0.0, 0, 0, 1], dtype=torch.float64), atol=1e-6)


@pytest.mark.parametrize("profile", ["tiny", "tiny-selective"])
def test_an_untrained_network_puts_out_footprints(profile):
    sample = ground_sample(images=1, width=140, height=112)
    model = network.build(profile, seed=2)
    prepare(model)
    with torch.no_grad():
        outputs = model(sample.inputs, motion=False)
    query = outputs.gaussians
    spacing = torch.ones(query.source.shape[1])
    if profile == "tiny-selective":
        regular = model.decoder.regular_cells(outputs.context.depth_m[0]).numel()
        spacing[:regular] = model.decoder.size.stride
    expected = footprints(sample.inputs, outputs.context, query.source, spacing)
    assert float((query.scale_m / expected.scale_m - 1).abs().median()) < 0.15


def test_the_released_profiles_have_absolute_scales():
    assert not network.PROFILES["pa-front"].log_geometry
    sample = ground_sample(images=1)
    plain = dataclasses.replace(network.PROFILES["tiny"], log_geometry=False)
    from nurec_sim.network.model import InstantNuRec

    with torch.no_grad():
        scale = InstantNuRec(plain).decoder.gaussians(*_features_and_context(plain, sample), sample.inputs).scale_m
    assert float(scale.max()) <= 0.3 + 1e-6


def _features_and_context(profile, sample):
    from nurec_sim.network.model import InstantNuRec

    torch.manual_seed(0)
    return InstantNuRec(profile).features(sample.inputs), ground_context(sample)
