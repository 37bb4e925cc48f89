"""A perceptual distance between images without trained weights: presence, sharpness and approximate position of edges.

At four scales, quadrature pairs of Gabor filters give a complex response per pixel and orientation: edge strength
(magnitude) and exact position (phase). Cells of 4 x 4 pixels are compared by 1 - 2 |sum(a b*)| / sum(|a|^2 + |b|^2), as
in complex wavelet SSIM (Sampat et al. 2009). A small shift rotates all phases of a cell alike and costs little; blur
and lost contrast reduce one magnitude, noise and double edges decorrelate the phases. Regions that are flat in both
images contribute nothing. Colours are compared at the coarser scales only, where the eye resolves them.

An L1 loss is minimised by the median of all plausible images, which is blurred; this one is not.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

SCALES = 4
"""Pyramid levels; the first is the image itself, each further one has half its resolution."""
FILTER_PX, WAVELENGTH_PX, SIGMA_PX, ORIENTATIONS = 5, 4.0, 1.2, 4
CELL = 4
"""Side length, in pixels, of the cells in which phases are compared."""
UNSEEN = 0.02
"""Edges of this strength, a fiftieth of the range from black to white, have half the weight of strong ones."""
PLACED = 0.1
"""Weight of the exact position of edges relative to their presence; penalises inverted edges."""
FIRST_COLOUR_SCALE, COLOUR_SHARE = 2, 0.2
"""First scale at which colour differences count, and their share of a scale's distance."""
TONE_WEIGHT = 2.0
"""Weight of the mean difference of tones and colours at the coarsest scale."""
SMALLEST_PX = FILTER_PX - 1 + CELL
"""Minimum width and height of an image; smaller pyramid levels are omitted."""

_OPPONENT = ((0.299, 0.587, 0.114), (-0.169, -0.331, 0.5), (0.5, -0.419, -0.081))


def perceptual_distance(image: Float[Tensor, "h w 3"], reference: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Perceived difference of two images: 0 if equal, about 0.05 to 0.1 for a clear blur, about 1 at most.

    Args:
        image: colours in 0..1; receives gradients.
        reference: colours in 0..1; receives no gradients.

    Raises:
        ValueError: the images differ in shape, are no [h, w, 3], or are smaller than 8 px.
    """
    if image.shape != reference.shape or image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < SMALLEST_PX:
        raise ValueError(
            f"two images of one shape [h, w, 3] and at least {SMALLEST_PX} px are needed, "
            f"got {list(image.shape)}, {list(reference.shape)}"
        )
    planes, true_planes = _planes(image), _planes(reference.detach())
    bank = _gabor_bank().to(planes)
    distances = []
    for scale in range(SCALES):
        count = 3 if scale >= FIRST_COLOUR_SCALE else 1
        each = _edge_distance(planes[:count], true_planes[:count], bank)
        distances.append(each[0] if count == 1 else (1 - COLOUR_SHARE) * each[0] + COLOUR_SHARE * each[1:].mean())
        if scale == SCALES - 1 or min(planes.shape[2:]) < 2 * SMALLEST_PX:
            break
        planes, true_planes = functional.avg_pool2d(planes, 2), functional.avg_pool2d(true_planes, 2)
    return torch.stack(distances).mean() + TONE_WEIGHT * (planes - true_planes).abs().mean()


def _planes(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "3 1 h w"]:
    """Luma, blue against yellow, red against green."""
    opponent = torch.tensor(_OPPONENT, dtype=image.dtype, device=image.device)
    return (opponent @ image.permute(2, 0, 1).flatten(1)).view(3, 1, *image.shape[:2])


@functools.cache
def _gabor_bank() -> Float[Tensor, "filters 1 5 5"]:
    """Even filters of all orientations, then the odd ones; the response to a wave of amplitude 1 is 1."""
    place = torch.arange(FILTER_PX, dtype=torch.float64) - FILTER_PX // 2
    y, x = torch.meshgrid(place, place, indexing="ij")
    window = torch.exp(-(x**2 + y**2) / (2 * SIGMA_PX**2))
    even, odd = [], []
    for k in range(ORIENTATIONS):
        angle = math.pi * k / ORIENTATIONS
        phase = 2 * math.pi / WAVELENGTH_PX * (x * math.cos(angle) + y * math.sin(angle))
        wave = window * phase.cos()
        wave = wave - window * wave.sum() / window.sum()  # zero mean: no response to flat regions
        even.append(wave / (wave * phase.cos()).sum())
        wave = window * phase.sin()
        odd.append(wave / (wave * phase.sin()).sum())
    return torch.stack(even + odd)[:, None].float()


def _edge_distance(
    image: Float[Tensor, "n 1 h w"], reference: Float[Tensor, "n 1 h w"], bank: Float[Tensor, "filters 1 k k"]
) -> Float[Tensor, " n"]:
    """Mean over the cells of each plane, 0..1."""
    seen = _Filtered.apply(image, bank)
    with torch.no_grad():
        true = functional.conv2d(reference, bank)
        even, odd = true.chunk(2, dim=1)
        # Rotated by 90 degrees (times i), so that real products with it give the imaginary part.
        turned = torch.cat([-odd, even], dim=1)
    strength = _cells((seen.square() + true.square()).sum(dim=1, keepdim=True))[:, 0]
    alike = _cells((seen * true).unflatten(1, (2, -1)).sum(dim=1))  # real part of sum(a b*), per orientation
    aside = _cells((seen * turned).unflatten(1, (2, -1)).sum(dim=1))  # its imaginary part
    # |sum(a b*)| is invariant to a common phase, that is to a small shift; its real part alone is not.
    anywhere = (alike.square() + aside.square()).clamp(min=1e-24).sqrt()  # without a gradient at 0, not an infinite one
    shared = (PLACED * alike + (1 - PLACED) * anywhere).sum(dim=1)
    return ((strength - 2 * shared) / (strength + UNSEEN**2)).mean(dim=(1, 2))


def _cells(values: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c y x"]:
    return functional.avg_pool2d(values, CELL)


class _Filtered(torch.autograd.Function):
    """Convolution of one plane with a bank; torch's own gradient for it takes ten times as long on a CPU."""

    @staticmethod
    def forward(ctx: Any, plane: Float[Tensor, "n 1 h w"], bank: Float[Tensor, "filters 1 k k"]) -> Tensor:
        ctx.save_for_backward(bank)
        ctx.size = plane.shape[2:]
        return functional.conv2d(plane, bank)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (bank,) = ctx.saved_tensors
        patches = bank.flatten(1).T @ gradients[0].flatten(2)
        return functional.fold(patches, ctx.size, bank.shape[-1]), None
