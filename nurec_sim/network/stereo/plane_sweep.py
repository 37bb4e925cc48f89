"""Depth by matching: how well every pixel fits its camera's other frames, for depths from near to far (a plane sweep).

Nothing is learned. Images are compared in small windows after local normalisation of brightness; nothing lies below
flat ground; and neighbours agree unless there is an edge (``semi_global``). The result is wrong for what moves, has no
texture or lies where the car drives to: three more channels measure how far to trust a depth.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from nurec_sim.network.stereo.flat_ground import flat_ground
from nurec_sim.network.stereo.matching import Places, SmallImages, neighbours, sampled, small_images, window_mean
from nurec_sim.network.stereo.semi_global import semi_global
from nurec_sim.network.tensors import SCENE_RESCALE, NetworkInputs

CHANNELS = 4
"""Logarithm of the depth in the network's unit; how much of the weight of all depths lies around it; how much better
than others it fits by the pixel alone; and how well another image agrees."""
NEAREST_M, FARTHEST_M, DEPTHS = 2.0, 120.0, 48
"""Depths are tried in equal steps of their logarithm, each 9 % farther than the last."""
USUAL_M, UNUSUAL = 40.0, 0.003
"""Prior: depth in metres, and weight of the squared difference of the logarithms."""
NEIGHBOURS = (-1, 1, -2)
"""Frames of the same camera to compare with, by their places in the order of time."""
WINDOW_PX = 5
"""Windows in which brightness is compared."""
SHARPNESS = 25.0
"""How strongly the best match is preferred to the others."""
OUTSIDE = 0.3
"""Cost of a depth whose point the other image does not show: neither a good match nor a bad one."""
BELOW_GROUND, BELOW, WELL_BELOW = 0.5, 0.05, 0.25
"""Cost of points below flat ground: none if their logarithm is up to ``BELOW`` farther, all from ``WELL_BELOW`` on."""
ON_GROUND, GROUND_WIDTH = 0.05, 0.1
"""Bonus of points on the ground, and its width in the logarithm of depth."""
AGREEING = 0.15
"""Two images agree on a point if the logarithms of its depth differ by less than about this."""


@torch.no_grad()
def plane_sweep(inputs: NetworkInputs) -> Float[Tensor, "b v h w 4"]:
    """The channels above, of every pixel.

    Raises:
        ValueError: the inputs lack ``rig_from_scene``.
    """
    ground_m, there = flat_ground(inputs)
    with torch.autocast(inputs.rgb.device.type, enabled=False):
        return torch.stack([_clip_sweep(inputs, k, ground_m[k], there[k]) for k in range(len(inputs.rgb))])


def _clip_sweep(
    inputs: NetworkInputs, clip: int, ground_m: Float[Tensor, "v h w"], there: Bool[Tensor, "v h w"]
) -> Float[Tensor, "v h w 4"]:
    images = small_images(inputs, clip)
    # Equal steps in log depth: relative errors matter, and one set of planes covers 2 to 120 m.
    log_m = torch.linspace(math.log(NEAREST_M), math.log(FARTHEST_M), DEPTHS, device=ground_m.device)
    maps, compared = [], []
    for k, view_rays in enumerate(images.rays):
        others = neighbours(inputs.camera_idxs[clip], inputs.time[clip], k, NEIGHBOURS)
        ground, meets = _shrunk(ground_m[k], images.size), _shrunk(there[k].float(), images.size)
        # z-depth over the z of the unit ray is the distance along it.
        distance = log_m.exp()[:, None, None] / images.along[k].clamp(min=1e-3)
        costs = [_cost(images.views[n].places(view_rays, distance), images.local[k], images.local[n]) for n in others]
        fits = _of_the_better_half(costs) if costs else torch.full_like(distance, OUTSIDE)
        # Priors enter before smoothing, so that texture-free road takes the ground's depth from its surroundings.
        cost = semi_global(fits + _expectation(ground, meets, log_m), images.grey[k, 0])
        maps.append(_chosen(fits, cost, log_m))
        compared.append(others)
    found = torch.stack(maps)
    agreed = [_agreement(found, images, k, others) for k, others in enumerate(compared)]
    found = torch.cat([found, torch.stack(agreed)[..., None]], dim=-1)
    # log(depth * 0.15): the unit of the depth head, so that the channel can be compared with its output.
    found[..., 0] += math.log(SCENE_RESCALE)
    size = (ground_m.shape[1], ground_m.shape[2])
    return functional.interpolate(found.permute(0, 3, 1, 2), size, mode="nearest").permute(0, 2, 3, 1)


def _shrunk(values: Float[Tensor, "h w"], size: tuple[int, int]) -> Float[Tensor, "hh ww"]:
    return functional.interpolate(values[None, None], size, mode="nearest")[0, 0]


def _expectation(
    ground_m: Float[Tensor, "h w"], there: Float[Tensor, "h w"], log_m: Float[Tensor, " d"]
) -> Float[Tensor, "d h w"]:
    """Cost of depths before anything is compared: of points below the ground, off it, and unusually near or far."""
    depths = log_m[:, None, None]
    beyond = depths - ground_m.log()
    below = ((beyond - BELOW) / (WELL_BELOW - BELOW)).clamp(0, 1) * BELOW_GROUND
    on = torch.exp(-0.5 * (beyond / GROUND_WIDTH) ** 2) * ON_GROUND
    return there * (below - on) + UNUSUAL * (depths - math.log(USUAL_M)) ** 2


def _cost(seen: Places, own: Float[Tensor, "1 h w"], other: Float[Tensor, "1 h w"]) -> Float[Tensor, "d h w"]:
    """How badly each depth fits, 0..1."""
    difference = (sampled(other[None], seen.place)[0] - own).abs().clamp(max=2) / 2
    return torch.where(seen.inside, window_mean(difference[:, None], WINDOW_PX)[:, 0], OUTSIDE)


def _of_the_better_half(costs: list[Float[Tensor, "d h w"]]) -> Float[Tensor, "d h w"]:
    """Mean over the images that fit better: others do not see the point. One, two or three of them."""
    stacked = torch.stack(costs)
    return (stacked.sum(0) - stacked.amax(0)) / 2 if len(costs) == len(NEIGHBOURS) else stacked.amin(0)


def _agreement(
    found: Float[Tensor, "v h w 3"], images: SmallImages, image: int, others: list[int]
) -> Float[Tensor, "h w"]:
    """1 where another image has found the same point, falling to 0 the more its depth differs."""
    distance = found[image, ..., 0].exp() / images.along[image].clamp(min=1e-3)
    best = torch.zeros_like(distance)
    for n in others:
        seen = images.views[n].places(images.rays[image], distance[None])
        # Left-right check: the other image's own depth at the projection should be the depth of the point there.
        # Nearest, as a mean across an edge belongs to neither side.
        theirs = functional.grid_sample(found[n, None, None, ..., 0], seen.place, mode="nearest", align_corners=False)
        apart = theirs[0, 0] - seen.depth_m[0].clamp(min=1e-3).log()
        close = torch.exp(-0.5 * (apart / AGREEING) ** 2)
        best = torch.maximum(best, torch.where(seen.inside[0], close, 0.0))
    return best


def _chosen(
    fits: Float[Tensor, "d h w"], cost: Float[Tensor, "d h w"], log_m: Float[Tensor, " d"]
) -> Float[Tensor, "h w 3"]:
    """Mean of the log depths around the cheapest, weighted by their cost, and the two numbers about it."""
    weight = (-SHARPNESS * cost).softmax(0)
    peak = weight.argmax(0, keepdim=True)
    near = (torch.arange(len(log_m), device=peak.device)[:, None, None] - peak).abs() <= 2
    around = weight * near
    share = around.sum(0)
    # By the unsmoothed cost: whether the pixel itself supports the depth, or only its neighbours do.
    better = (fits.mean(0) - fits.gather(0, peak)[0]).clamp(min=0)
    return torch.stack([(around * log_m[:, None, None]).sum(0) / share, share, better], dim=-1)
