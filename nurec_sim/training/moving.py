"""Gaussians of one pass at another time: static ones are unchanged, moving ones follow their three knots."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nurec_sim.network.tensors import NetworkInputs, QueryGaussians, SemanticClass
from nurec_sim.render.cpu.backward.gradients import GaussianTensors

LEAST_OPACITY = 0.01
LEAST_MOVING_OPACITY = 0.75
"""As in the reconstruction (``FeedForwardSettings.min_opacity``, ``layers.MIN_DYNAMIC_OPACITY``)."""


def gaussians_at(query: QueryGaussians, inputs: NetworkInputs, time: float) -> GaussianTensors:
    """The Gaussians as rendered at a time (a fraction of the span), in the scene frame; b is 1.

    Positions and fading follow ``types.DynamicGaussians``; Gaussians that the network classifies as movable move.
    """
    pixels = inputs.rgb[0, 0, ..., 0].numel()
    image = query.source[0] // pixels
    moving = query.semantic[0] == SemanticClass.MOVABLE
    position, opacity = query.position_m[0], query.opacity[0]
    if query.motion_m is not None and bool(moving.any()):
        times = torch.stack([inputs.time_before[0], inputs.time[0], inputs.time_after[0]], dim=-1)[image]
        shift, fade = _along_knots(query.motion_m[0], times, time)
        position = torch.where(moving[:, None], position + shift, position)
        opacity = torch.where(moving, opacity.clamp(min=LEAST_MOVING_OPACITY) * fade, opacity)
    # Pruned as in the reconstruction, so that training renders what will be shown.
    kept = opacity.detach() > LEAST_OPACITY
    return GaussianTensors(
        mean_m=position[kept],
        quat_wxyz=query.quat_wxyz[0][kept],
        scale_m=query.scale_m[0][kept],
        opacity=opacity[kept],
        rgb=query.rgb[0][kept],
    )


def _along_knots(
    motion_m: Float[Tensor, "n 2 3"], times: Float[Tensor, "n 3"], time: float
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Displacements at a time, and the fade factor of each Gaussian (0 outside of its lifetime)."""
    before, own, after = times.unbind(-1)
    later = own <= time
    gap = torch.where(later, after - own, own - before).clamp(min=1e-6)
    x = (time - own).abs() / gap
    # Linear between knots; exp(-x^10) is flat near the own time and falls to 1/e at the neighbouring knot.
    shift = torch.where(later[:, None], motion_m[:, 1], motion_m[:, 0]) * x[:, None]
    return shift, torch.where(x <= 1, torch.exp(-(x**10)), 0)
