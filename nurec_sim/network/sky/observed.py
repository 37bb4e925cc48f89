"""The sky without a learned decoder: colours of the pixels classified as sky, and a gradient elsewhere.

This is what the released checkpoints ship with. Every rule and number was recovered from the reference's outputs. The
gradient runs along the scene's z axis, which is forward and not up; ``reconstruct.feedforward.chunk_sky`` therefore
uses only the ``texture`` and fills the rest itself.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional

from nurec_sim.network.sky import cubemap
from nurec_sim.network.tensors import SemanticClass

REACH_PX = 15
"""Texels this near a seen one, along rows and columns, count as seen; their edge is then blurred."""
BLUR_PX = 8
"""Standard deviation of that blur, which is cut off at three times as much."""
STEEPEST = 0.5
"""Largest slope of the gradient: change of a colour (0..1) per unit of z."""
NOTHING_SEEN = 0.6
"""Grey of a sky of which no pixel is known."""

_ONE = 2**32
"""The value of 1 in fixed-point sums."""


def observed_sky(
    rgb: Float[Tensor, "b v h w 3"], logits: Float[Tensor, "b v h w 5"], rays: Float[Tensor, "b v h w 6"], size: int
) -> tuple[Float[Tensor, "b 6 size size 3"], Float[Tensor, "b 6 size size 1"]]:
    """Sky as in the release: mean colour per texel, elsewhere a line over the ray's z; and how surely it was seen.

    Args:
        rgb: the context head's colours in 0..1, before the ISP transform.
        logits: semantic logits in the order of ``SemanticClass``.
        rays: origin and unit direction of every pixel, scene frame.
        size: edge of a cubemap face, texels.
    """
    skies, seen = [], []
    with torch.autocast(rgb.device.type, enabled=False):
        for clip in zip(rgb.float(), logits, rays, strict=True):
            colour, direction = sky_pixels(*clip)
            mean, hits = texture(colour, direction, size)
            skies.append(torch.where((hits > 0)[..., None], mean, _gradient(colour, direction[:, 2], size)))
            seen.append(_soften((hits > 0).float()))
    return torch.stack(skies), torch.stack(seen)[..., None]


def sky_pixels(
    rgb: Float[Tensor, "*n 3"], logits: Float[Tensor, "*n 5"], rays: Float[Tensor, "*n 6"]
) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k 3"]]:
    """Colours and directions of the pixels whose likeliest class is sky."""
    sky = logits.argmax(dim=-1) == SemanticClass.SKY
    return rgb[sky].detach(), rays[..., 3:][sky]


def texture(
    colour: Float[Tensor, "n 3"], direction: Float[Tensor, "n 3"], size: int
) -> tuple[Float[Tensor, "6 size size 3"], Int64[Tensor, "6 size size"]]:
    """Mean colour of the pixels whose rays meet each texel (0 without any), and their number."""
    # Scatter-adds of floats depend on the order of threads; of integers they do not.
    total = torch.zeros(6 * size * size, 4, dtype=torch.int64, device=colour.device)
    total.index_add_(0, cubemap.texels(direction, size), functional.pad(_fixed(colour), (0, 1), value=1))
    hits = total[:, 3]
    mean = (total[:, :3].double() / _ONE / hits.clamp(min=1)[:, None]).to(colour.dtype)
    return mean.reshape(6, size, size, 3), hits.reshape(6, size, size)


def _fixed(value: Float[Tensor, "*n"]) -> Int64[Tensor, "*n"]:
    """Numbers of about 1 as integers, whose sums are the same in any order: on any device, by any number of threads."""
    return (value.double() * _ONE).round().long()


def _gradient(colour: Float[Tensor, "n 3"], z: Float[Tensor, " n"], size: int) -> Float[Tensor, "6 size size 3"]:
    """Least-squares line of the colours over z, not too steep, in every direction."""
    if len(colour) == 0:
        return torch.full((6, size, size, 3), NOTHING_SEEN, dtype=colour.dtype, device=colour.device)
    mean, mean_z = (_fixed(x).sum(dim=0).double() / (_ONE * len(x)) for x in (colour, z))
    away = z - mean_z
    spread = _fixed(away * away).sum().double() / _ONE
    together = _fixed(away[:, None] * (colour - mean)).sum(dim=0).double() / _ONE
    # slope = cov(z, colour) / var(z), the least-squares line; bounded because sky often covers a narrow range of z.
    slope = (together / spread.clamp(min=1e-9)).clamp(-STEEPEST, STEEPEST)
    everywhere = cubemap.directions(size, colour.device)[..., 2:]
    return (mean + slope * (everywhere - mean_z)).clamp(0, 1).to(colour.dtype)


def _soften(seen: Float[Tensor, "6 s s"]) -> Float[Tensor, "6 s s"]:
    """Grow what was seen by a square of 31 texels, then blur its edge; every face by itself."""
    grown = seen[:, None]
    # A square maximum is separable: along rows, then along columns; so is the Gaussian below.
    for window, margin in (((1, 2 * REACH_PX + 1), (0, REACH_PX)), ((2 * REACH_PX + 1, 1), (REACH_PX, 0))):
        grown = functional.max_pool2d(grown, window, stride=1, padding=margin)
    reach = 3 * BLUR_PX
    offset = torch.arange(-reach, reach + 1, device=seen.device, dtype=torch.float64)
    kernel = torch.exp(-0.5 * (offset / BLUR_PX) ** 2)
    kernel = (kernel / kernel.sum()).to(seen.dtype)[None, None]
    padded = functional.pad(grown, (reach, reach, reach, reach), mode="replicate")
    return functional.conv2d(functional.conv2d(padded, kernel[..., None, :]), kernel[..., None])[:, 0]
