"""One step of an optimiser, and the moving average of the weights that is published."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn


def update(
    optimiser: torch.optim.Optimizer,
    loss: Tensor,
    model: nn.Module,
    average: nn.Module,
    trained: Mapping[str, nn.Parameter],
    *,
    step: int,
    clip_norm: float,
    decay: float,
) -> dict[str, float]:
    """Steps on the gradient of a loss; a step whose gradient is not finite is skipped and counted.

    Args:
        optimiser: of the trained parameters.
        loss: a scalar.
        model: what is trained.
        average: a copy of it that holds the moving average.
        trained: the model's parameters that are trained, by name.
        step: number of the step, from 0.
        clip_norm: the gradient is shortened to this norm.
        decay: of the moving average, after its first steps.

    Returns:
        Values for the curves: ``gradient``, its norm, and ``skipped``, 0 or 1.
    """
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    norm = float(nn.utils.clip_grad_norm_(list(trained.values()), clip_norm))
    if not math.isfinite(norm):
        return {"skipped": 1.0}
    optimiser.step()
    # A short average at first, otherwise it would keep the initial state for 1 / (1 - decay) steps.
    short = min(decay, (1 + step) / (10 + step))
    with torch.no_grad():
        for mean, (name, now) in zip(average.parameters(), model.named_parameters(), strict=True):
            if name in trained:
                mean.lerp_(now, 1 - short)
    return {"gradient": norm, "skipped": 0.0}
