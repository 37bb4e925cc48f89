"""Losses on the predictions of the heads for the input images (paper section 4.1): context, motion and sky.

Every loss is a mean over the pixels with known truth, 0 without any.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from nurec_sim.network.sky import cubemap
from nurec_sim.network.tensors import ContextMaps, NetworkInputs, SemanticClass
from nurec_sim.training.config import LossWeights
from nurec_sim.training.data.sample import TrueMaps

EDGE_SCALES = (1, 2, 4)
"""Distances, in pixels, between the neighbours whose depth errors are compared."""
CLASS_WEIGHTS = {SemanticClass.MOVABLE: 3.0}
"""Class weights, 1 if not listed. Movable pixels are few, and missed ones remain in the scene as static ghosts."""
MOVABLE_DEPTH_WEIGHT = 4.0
"""Weight of the depth of movable pixels: stereo matching fails on moving objects, so it must be learned entirely."""
MOVED_M = 0.05
"""Points displaced by more than this count as moving."""
STANDING_SHARE = 0.3
"""Weight of static points relative to moving ones."""
SKY_PIXELS = 8192
"""Approximate number of sky pixels compared, evenly sampled."""


def context_losses(
    context: ContextMaps, inputs: NetworkInputs, truth: TrueMaps, weights: LossWeights
) -> dict[str, Tensor]:
    """Depth (L1 and slopes of its logarithm), normals (1 - cosine), classes (cross entropy), colours (L1).

    The depth head predicts the logarithm; differences of logarithms are relative errors.

    Args:
        context: predictions of the heads.
        inputs: input images, the truth of the colours.
        truth: ground truth of the input images.
        weights: weights of the terms; terms of weight 0 are not computed.

    Returns:
        terms before weighting, by name.
    """
    losses = {}
    known = truth.depth_m > 0
    error = torch.where(known, context.depth_m.log() - truth.depth_m.clamp(min=1e-3).log(), 0)
    if weights.depth:
        weight = torch.where(truth.semantic == SemanticClass.MOVABLE, MOVABLE_DEPTH_WEIGHT, 1.0) * known
        losses["depth"] = (weight * error.abs()).sum() / weight.sum().clamp(min=1)
    if weights.edges:
        losses["edges"] = _slope_error(error, known)
    if weights.normal:
        surface = (truth.normal != 0).any(-1)
        losses["normal"] = _mean(1 - (context.normal * truth.normal).sum(-1), surface)
    if weights.semantic:
        losses["semantic"] = _cross_entropy(context.logits, truth.semantic)
    if weights.rgb:
        losses["rgb"] = (context.rgb - inputs.rgb).abs().mean()
    return losses


def motion_loss(motion_m: Float[Tensor, "b v h w 2 3"], truth: TrueMaps) -> Tensor:
    """L1 of the displacements, metres; moving and static points are averaged separately (paper section 4.1).

    A common mean would be dominated by the static majority, for which predicting no motion is right.
    """
    error = (motion_m - truth.motion_m).abs().sum(-1)
    moves = truth.motion_m.norm(dim=-1) > MOVED_M
    known = truth.motion_known[..., None].expand_as(moves)
    return _mean(error, known & moves) + STANDING_SHARE * _mean(error, known & ~moves)


def sky_loss(sky: Float[Tensor, "6 s s 3"], inputs: NetworkInputs, truth: TrueMaps) -> Tensor:
    """L1 between the sky decoder's cubemap and the sky pixels of the input images."""
    shown = truth.semantic == SemanticClass.SKY
    colour, direction = inputs.rgb[shown], inputs.rays[shown][:, 3:]
    if len(colour) == 0:
        return sky.sum() * 0  # zero, but part of the graph
    step = max(1, len(colour) // SKY_PIXELS)
    return (cubemap.sample(sky, direction[::step]) - colour[::step]).abs().mean()


def _mean(values: Float[Tensor, "*n"], known: Bool[Tensor, "*n"]) -> Tensor:
    return torch.where(known, values, 0).sum() / known.sum().clamp(min=1)


def _slope_error(error: Float[Tensor, "b v h w"], known: Bool[Tensor, "b v h w"]) -> Tensor:
    """Mean change of the error between neighbours with known depth; penalises wrong and blurred depth edges.

    A constant offset costs nothing here, as in the multi-scale gradient loss of MegaDepth (Li and Snavely 2018).
    """
    total = error.new_zeros(())
    for step in EDGE_SCALES:
        for axis in (-1, -2):
            size = error.shape[axis] - step
            near, far = (error.narrow(axis, start, size) for start in (0, step))
            both = known.narrow(axis, 0, size) & known.narrow(axis, step, size)
            total = total + _mean((far - near).abs(), both)
    return total / (2 * len(EDGE_SCALES))


def _cross_entropy(logits: Float[Tensor, "b v h w 5"], semantic: Tensor) -> Tensor:
    weight = torch.tensor([CLASS_WEIGHTS.get(each, 1.0) for each in SemanticClass], device=logits.device)
    if not bool((semantic >= 0).any()):
        return logits.sum() * 0
    return functional.cross_entropy(logits.reshape(-1, 5), semantic.reshape(-1), weight, ignore_index=-1)
