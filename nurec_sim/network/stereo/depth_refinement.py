"""Predicted depth refined by matching once more, at full resolution, around the network's prediction.

Nothing is learned. The farther a point, the less certain is the network's depth, and the more its motion in pixels from
frame to frame tells; so far depths follow the matches, near ones the network.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nurec_sim.network.stereo.matching import SmallImages, neighbours, sampled, small_images, window_mean
from nurec_sim.network.stereo.semi_global import semi_global
from nurec_sim.network.tensors import NetworkInputs

LARGEST, STEPS = 0.24, 7
"""How far the logarithm of a depth may change, and how many depths are tried."""
NEIGHBOURS, MOST_NEIGHBOURS = (-1, 1, -2, 2, -3, 3), 3
"""Frames of the same camera to compare with, by their offsets in time order, and the maximum number of them."""
WINDOW_PX = 9
OUTSIDE = 0.3
"""Cost of a depth whose point the other image does not show."""
COLOUR, MOST_COLOUR = 1.0, 0.5
"""Weight of differences of colours, and from which sum of three on nothing gets worse."""
DOUBT, DOUBT_M, MOST_DOUBT = 0.3, 30.0, (0.05, 20.0)
"""Cost of a change by its square, at this depth; at others with the inverse square of it, within these limits."""
SHARPNESS = 25.0
"""How strongly the best match is preferred to those beside it."""
SMALL_STEP, LARGE_STEP = 0.02, 0.5
"""What it costs that the next pixel changes by one step more or less, and by any other."""


@torch.no_grad()
def depth_factor(
    inputs: NetworkInputs, depth_m: Float[Tensor, "b v h w"], is_static: Bool[Tensor, "b v h w"]
) -> Float[Tensor, "b v h w"]:
    """Factors on depths that make the images fit better; 1 where nothing is static or no other frame helps.

    Args:
        inputs: the images.
        depth_m: predicted z-depth, metres.
        is_static: pixels of static surfaces: no sky, nothing that can move.
    """
    with torch.autocast(depth_m.device.type, enabled=False):
        factors = [_clip_factor(inputs, clip, depth_m[clip].float()) for clip in range(len(depth_m))]
    return torch.where(is_static, torch.stack(factors), 1.0)


def _clip_factor(inputs: NetworkInputs, clip: int, depth_m: Float[Tensor, "v h w"]) -> Float[Tensor, "v h w"]:
    images = small_images(inputs, clip, shrink=1)
    look = torch.cat([images.local, images.rgb], dim=1)
    change = torch.linspace(-LARGEST, LARGEST, STEPS, device=depth_m.device)
    # A prior on the change: quadratic, as from a Gaussian error of the log depth whose deviation grows with the depth.
    doubt = DOUBT * (DOUBT_M / depth_m).clamp(*MOST_DOUBT) ** 2
    factors = []
    for k, depth in enumerate(depth_m):
        others = neighbours(inputs.camera_idxs[clip], inputs.time[clip], k, NEIGHBOURS)[:MOST_NEIGHBOURS]
        if not others:
            factors.append(torch.ones_like(depth))
            continue
        # Candidates are equally spaced in log depth, so all pixels share one set of changes and smoothness acts on
        # factors.
        distance = depth * change.exp()[:, None, None] / images.along[k].clamp(min=1e-3)
        costs = torch.stack([_cost(images, look, k, n, distance) for n in others])
        # Half of the images, those that fit better: the others may not see the point.
        fits = costs.sort(0).values[: (len(others) + 1) // 2].mean(0)
        cost = fits + doubt[k] * (change**2)[:, None, None]
        factors.append(_best(semi_global(cost, images.grey[k, 0], SMALL_STEP, LARGE_STEP), change).exp())
    return torch.stack(factors)


def _cost(
    images: SmallImages, look: Float[Tensor, "v 4 h w"], image: int, other: int, distance: Float[Tensor, "d h w"]
) -> Float[Tensor, "d h w"]:
    """How badly each depth fits, by normalized brightness and colours (``look``)."""
    seen = images.views[other].places(images.rays[image], distance)
    apart = (sampled(look[other, None], seen.place) - look[image][:, None]).abs()
    difference = apart[0].clamp(max=2) / 2 + COLOUR * apart[1:].sum(0).clamp(max=MOST_COLOUR)
    return torch.where(seen.inside, window_mean(difference[:, None], WINDOW_PX)[:, 0], OUTSIDE)


def _best(cost: Float[Tensor, "d h w"], change: Float[Tensor, " d"]) -> Float[Tensor, "h w"]:
    """Mean of the cheapest change and those beside it, weighted by their cost."""
    # Soft arg-min around the best candidate: sub-step precision without averaging over separate minima.
    weight = (-SHARPNESS * cost).softmax(0)
    near = (torch.arange(len(change), device=cost.device)[:, None, None] - weight.argmax(0, keepdim=True)).abs() <= 1
    around = weight * near
    return (around * change[:, None, None]).sum(0) / around.sum(0)
