"""Canonical colours taken from the images, by the responses of their cameras."""

import dataclasses

import torch
from training_samples import ground_sample
from wall_street import WallStreet, street_chunk

from nurec_sim import network
from nurec_sim.network.image_colours import image_colours, shown


def responses(cameras, seed=0):
    """Of one clip, some way from the identity."""
    generator = torch.Generator().manual_seed(seed)
    near = torch.eye(3) + 0.1 * torch.randn(1, cameras, 3, 3, generator=generator)
    return torch.cat([near, 0.05 * torch.randn(1, cameras, 3, 1, generator=generator)], dim=-1)


def two_cameras():
    chunk, _ = street_chunk(WallStreet(frames=2), ("front", "left"))
    rgb = 0.3 + 0.4 * torch.rand(chunk.tensors.rgb.shape, generator=torch.Generator().manual_seed(1))
    return dataclasses.replace(chunk.tensors, rgb=rgb)


def test_every_image_comes_out_as_it_went_in():
    inputs, isp = two_cameras(), responses(2)
    rgb, _, relative = image_colours(inputs, torch.rand(1, 6, 4, 4, 3), isp)
    for image, camera in enumerate(inputs.camera_idxs[0].tolist()):
        assert torch.allclose(shown(rgb[0, image], relative[0, camera]), inputs.rgb[0, image], atol=1e-5)
    identity = torch.cat([torch.eye(3), torch.zeros(3, 1)], dim=-1)
    assert torch.allclose(relative[0, 0], identity, atol=1e-6) and torch.equal(rgb[0, 0], rgb[0, 0].clamp(0, 1))
    assert torch.allclose(rgb[0, inputs.camera_idxs[0] == 0], inputs.rgb[0, inputs.camera_idxs[0] == 0], atol=1e-6)


def test_cameras_that_see_one_colour_differently_agree_on_it():
    inputs, isp, truth = two_cameras(), responses(2), torch.tensor([0.4, 0.5, 0.6])
    of_image = torch.stack([shown(truth, isp[0, camera]) for camera in inputs.camera_idxs[0].tolist()])
    inputs = dataclasses.replace(inputs, rgb=of_image[None, :, None, None].expand_as(inputs.rgb))
    sky = truth.expand(1, 6, 4, 4, 3)
    rgb, sky, relative = image_colours(inputs, sky, isp)
    assert torch.allclose(rgb, rgb[0, 0, 0, 0].expand_as(rgb), atol=1e-5)
    assert torch.allclose(sky, rgb[0, 0, 0, 0].expand_as(sky), atol=1e-5)  # and so does the sky


def test_our_network_puts_out_the_images_colours_and_the_released_one_its_own():
    inputs = ground_sample().inputs
    assert network.PROFILES["tiny"].image_colours and not network.PROFILES["pa-front"].image_colours
    model = network.build("tiny", seed=3)
    with torch.inference_mode():
        model.post_processing.affine_linear.weight.normal_(0, 0.01)
        outputs = model(inputs)
    assert torch.allclose(outputs.context.rgb, inputs.rgb, atol=1e-5)
    flat = inputs.rgb.reshape(1, -1, 3)
    assert torch.allclose(outputs.gaussians.rgb, flat[:, outputs.gaussians.source[0]], atol=1e-5)


def test_gradients_reach_the_responses():
    inputs, isp = two_cameras(), responses(2).requires_grad_()
    rgb, sky, relative = image_colours(inputs, torch.rand(1, 6, 4, 4, 3), isp)
    (rgb.sum() + sky.sum() + relative.sum()).backward()
    assert isp.grad is not None and bool((isp.grad != 0).any(dim=-1).all())
