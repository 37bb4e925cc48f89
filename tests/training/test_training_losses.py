import dataclasses

import numpy as np
import pytest
import torch
from training_samples import ground_sample, mean_difference, with_moving_block

from nurec_sim import network
from nurec_sim.network.tensors import ContextMaps, SemanticClass
from nurec_sim.training.config import LossWeights, Stage
from nurec_sim.training.losses.objective import PREFIXES, Objective
from nurec_sim.training.losses.rendered import context_losses, motion_loss, sky_loss
from nurec_sim.training.moving import gaussians_at
from nurec_sim.training.rendering import render_losses, render_view
from nurec_sim.training.start import prepare


def perfect_context(sample):
    truth = sample.truth
    logits = torch.nn.functional.one_hot(truth.semantic.clamp(min=0), 5).float() * 50
    depth = torch.where(truth.depth_m > 0, truth.depth_m, 50.0)
    return ContextMaps(depth, sample.inputs.rgb.clone(), truth.normal.clone(), logits, truth.motion_m.clone())


def test_context_losses_of_the_truth_are_zero():
    sample = ground_sample()
    losses = context_losses(perfect_context(sample), sample.inputs, sample.truth, LossWeights())
    assert set(losses) == {"depth", "edges", "normal", "semantic", "rgb"}
    assert all(float(value) < 1e-6 for value in losses.values())


def test_a_depth_ten_percent_too_far_costs_its_logarithm_and_no_slope():
    sample = ground_sample()
    context = perfect_context(sample)
    context = dataclasses.replace(context, depth_m=context.depth_m * 1.1)
    losses = context_losses(context, sample.inputs, sample.truth, LossWeights())
    assert float(losses["depth"]) == pytest.approx(np.log(1.1), rel=1e-4)
    assert float(losses["edges"]) < 1e-6


def test_terms_of_weight_zero_are_not_computed():
    sample = ground_sample()
    weights = LossWeights(depth=0, edges=0, normal=0)
    assert set(context_losses(perfect_context(sample), sample.inputs, sample.truth, weights)) == {"semantic", "rgb"}


def test_motion_loss_counts_moving_and_standing_points_apart():
    sample = with_moving_block(ground_sample())
    assert float(motion_loss(sample.truth.motion_m, sample.truth)) == 0
    still = torch.zeros_like(sample.truth.motion_m)
    assert float(motion_loss(still, sample.truth)) == pytest.approx(0.5, rel=1e-5)
    drifting = sample.truth.motion_m + torch.tensor([0.1, 0, 0])
    assert float(motion_loss(drifting, sample.truth)) == pytest.approx(0.1 * 1.3, rel=1e-4)


def test_sky_loss_is_zero_for_a_sky_of_the_right_colour_and_reaches_the_cubemap():
    sample = ground_sample()
    blue = torch.tensor([0.3, 0.5, 0.9])
    inputs = dataclasses.replace(sample.inputs, rgb=blue.expand_as(sample.inputs.rgb))
    assert float(sky_loss(blue.expand(6, 8, 8, 3), inputs, sample.truth)) < 1e-6
    black = torch.zeros(6, 8, 8, 3, requires_grad=True)
    sky_loss(black, inputs, sample.truth).backward()
    assert black.grad.abs().sum() > 0


def perfect_gaussians(sample):
    """One Gaussian per pixel, where the truth says, as wide as its pixel."""
    model = network.build("tiny", seed=0)
    prepare(model)
    with torch.no_grad():
        features = model.features(sample.inputs)
        query = model.decoder.gaussians(features, perfect_context(sample), sample.inputs)
    pixel = 1 / (0.7 * sample.inputs.rgb.shape[3])
    depth = sample.truth.depth_m.reshape(1, -1)
    scale = (depth * pixel * 0.6).clamp(1e-3, 0.3)[..., None].expand(-1, -1, 3)
    opacity = torch.where(depth > 0, 0.95, 0.0)
    return dataclasses.replace(query, scale_m=scale, opacity=opacity)


def test_true_gaussians_show_the_input_image_again():
    sample = ground_sample(targets=1, images=1)
    query = perfect_gaussians(sample)
    sky = torch.full((6, 8, 8, 3), 0.5)
    identity = torch.eye(3, 4)
    shown = render_view(query, sky, identity, sample.inputs, sample.targets[0])
    ground = (sample.truth.depth_m[0, 0] > 0) & (sample.truth.depth_m[0, 0] < 12)
    assert float((shown.rgb - sample.targets[0].rgb)[ground].abs().mean()) < 0.05
    near = shown.depth_m[ground] / sample.truth.depth_m[0, 0][ground]
    assert float((near - 1).abs().median()) < 0.03
    top = shown.rgb[:5]
    assert torch.allclose(top, torch.full_like(top, 0.5), atol=1e-3)
    losses = render_losses(shown, sample.targets[0], LossWeights(), mean_difference)
    assert set(losses) == {"colour", "perceptual", "opacity", "rendered_depth"}
    assert float(losses["opacity"]) < 0.05


def test_the_camera_response_is_applied_after_the_sky():
    sample = ground_sample(images=1)
    query = perfect_gaussians(sample)
    sky = torch.full((6, 8, 8, 3), 0.4)
    response = torch.cat([0.5 * torch.eye(3), torch.full((3, 1), 0.1)], dim=1)
    shown = render_view(query, sky, response, sample.inputs, sample.targets[0]).rgb
    assert torch.allclose(shown[:3], torch.full_like(shown[:3], 0.3), atol=1e-3)


def test_moving_gaussians_follow_their_knots_and_fade():
    sample = with_moving_block(ground_sample())
    query = perfect_gaussians(sample)
    own = gaussians_at(query, sample.inputs, 0.0)
    later = gaussians_at(query, sample.inputs, 0.25)
    moving = (query.semantic[0] == SemanticClass.MOVABLE).sum()
    assert moving > 0
    # At 0 only the first image's moving points live in full; those of the second appear from 0.5 on.
    start = query.position_m[0][query.semantic[0] == SemanticClass.MOVABLE][:60]
    shifted = start + torch.tensor([0.25, 0.0, 0.0])
    assert (torch.cdist(own.mean_m, start).min(dim=0).values < 0.01).all()
    assert (torch.cdist(later.mean_m, shifted).min(dim=0).values < 0.01).all()
    gone = gaussians_at(query, sample.inputs, 3.0)
    assert len(gone) == int((query.semantic[0] != SemanticClass.MOVABLE).sum() - (query.opacity[0] <= 0.01).sum())


@pytest.mark.parametrize("profile", ["tiny", "tiny-selective"])
def test_every_part_of_the_network_belongs_to_one_part_of_the_recipe(profile):
    model = network.build(profile)
    for name, parameter in model.named_parameters():
        owners = [part for part, prefixes in PREFIXES.items() if name.startswith(prefixes)]
        assert len(owners) == 1 or parameter.numel() == 0, name


@pytest.mark.parametrize("profile", ["tiny", "tiny-selective"])
def test_all_trained_parameters_get_a_gradient_and_no_other(profile):
    model = network.build(profile)
    prepare(model)
    trains = ("context", "sky", "gaussians", "isp")
    stage = Stage(name="gaussians", steps=1, trains=trains, targets=1)
    objective = Objective(model, stage, mean_difference, "float32", threads=1)
    loss, said, outputs = objective(ground_sample(width=70, height=56))
    loss.backward()
    got = {name for name, parameter in model.named_parameters() if parameter.grad is not None}
    assert got == set(objective.trained())
    assert not any(name.startswith("encoder.") for name in got)
    assert said["psnr"] > 5 and len(outputs.renderings) == 1


def test_training_starts_with_the_colours_of_the_image():
    sample = ground_sample()
    model = network.build("tiny", seed=3)
    prepare(model)
    with torch.no_grad():
        outputs = model(sample.inputs)
    assert float((outputs.context.rgb - sample.inputs.rgb).abs().mean()) < 0.06
    assert float(outputs.gaussians.opacity.max()) == pytest.approx(0.95, abs=0.02)


def test_training_starts_with_the_depth_of_flat_ground_where_nothing_matches():
    sample = ground_sample(images=1)
    model = network.build("tiny", seed=3)
    prepare(model)
    with torch.no_grad():
        depth = model(sample.inputs).context.depth_m
    ground = (sample.truth.depth_m > 0) & (sample.truth.depth_m < 30)
    assert float((depth / sample.truth.depth_m - 1)[ground].abs().median()) < 0.1


def test_a_network_that_needs_the_cars_view_says_so():
    sample = ground_sample()
    with pytest.raises(ValueError, match="rig_from_scene"):
        network.build("tiny")(dataclasses.replace(sample.inputs, rig_from_scene=None))
