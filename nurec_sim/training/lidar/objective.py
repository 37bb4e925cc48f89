"""The losses of the LiDAR branch: rendered range, intensity, opacity and ray drop from another pose; classes."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from nurec_sim.network.lidar.branch import LidarBranch
from nurec_sim.render.cpu.backward.gradients import GaussianTensors, render_lidar
from nurec_sim.training.lidar.config import ScanLosses
from nurec_sim.training.lidar.samples import ScanSample

OUTLIER_M = 1.0
"""Range errors count up to this: larger ones are another surface."""
SOLID, SAME_M = 0.5, 0.5
"""Beams with less opacity have no range; beams with larger errors do not compare intensities."""
CLOSEST = 1e-3


def scan_loss(
    branch: LidarBranch, sample: ScanSample, weights: ScanLosses, threads: int | None = None
) -> tuple[Tensor, dict[str, float]]:
    """The weighted sum of the losses of a sample, and each of them.

    ``range`` is the mean of the L1 errors of the range, where half of a beam is absorbed, and of the mean distance over
    all that it meets; the paper renders one range. ``intensity`` is the MSE. Beams whose surface the input has not seen
    count for none of them.
    """
    found = branch(sample.inputs)
    rgb = torch.zeros_like(found.position_m)
    gaussians = GaussianTensors(found.position_m, found.quat_wxyz, found.scale_m, found.opacity, rgb,
                                intensity=found.intensity, ray_drop=found.ray_drop)  # fmt: skip
    seen, image = sample.seen, render_lidar(gaussians, sample.lidar, sample.poses, threads)
    solid = seen & (image.alpha.detach() > SOLID)
    errors = [(each - sample.range_m)[solid].abs() for each in (image.range, image.distance)]
    same = solid & ((image.range - sample.range_m).detach().abs() < SAME_M)
    empty = sample.range_m == 0
    alpha = image.alpha.clamp(CLOSEST, 1 - CLOSEST)
    terms = {
        "range": (_mean(errors[0].clamp(max=OUTLIER_M)) + _mean(errors[1].clamp(max=OUTLIER_M))) / 2,
        "intensity": _mean((image.intensity - sample.intensity)[same & ~sample.lost] ** 2),
        "alpha": _mean(-torch.log(alpha)[seen]) + _mean(-torch.log1p(-alpha)[empty]),
        "drop": _cross_entropy(image.ray_drop[same], sample.lost[same]),
        "label": functional.cross_entropy(found.logits, sample.label.repeat_interleave(branch.profile.per_return)),
    }
    total = torch.stack([getattr(weights, name) * term for name, term in terms.items()]).sum()
    figures = {name: float(term.detach()) for name, term in terms.items()}
    figures["median_range"] = float(errors[0].detach().median()) if len(errors[0]) else float("nan")
    figures["holes"] = 1 - float(solid.sum()) / max(float(seen.sum()), 1.0)
    return total, figures


def _mean(values: Tensor) -> Tensor:
    return values.sum() / max(values.numel(), 1)


def _cross_entropy(probability: Tensor, happened: Tensor) -> Tensor:
    if not len(probability):
        return probability.sum()
    return functional.binary_cross_entropy(probability.clamp(CLOSEST, 1 - CLOSEST), happened.to(probability.dtype))
