"""Losses on rendered views (paper section 4.1): the Gaussians of a pass rendered from held-out viewpoints.

Static and moving Gaussians are rendered at the view's time in front of the sky, then the camera response is applied.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nurec_sim.network.sky import cubemap
from nurec_sim.network.tensors import NetworkInputs, QueryGaussians, SemanticClass
from nurec_sim.reconstruct.feedforward.inputs.rays import camera_rays, scene_rays
from nurec_sim.render.cpu.backward.gradients import render_camera
from nurec_sim.training.config import LossWeights
from nurec_sim.training.data.sample import TargetView
from nurec_sim.training.moving import gaussians_at

PerceptualLoss = Callable[[Tensor, Tensor], Tensor]
"""Takes two images [h, w, 3] in 0..1."""


@dataclass(frozen=True)
class Rendering:
    """One rendered view: ``rgb`` [h, w, 3] as the camera shows it, ``depth_m`` and ``alpha`` [h, w]."""

    rgb: Float[Tensor, "h w 3"]
    depth_m: Float[Tensor, "h w"]
    alpha: Float[Tensor, "h w"]


def render_view(
    query: QueryGaussians,
    sky: Float[Tensor, "6 s s 3"],
    isp: Float[Tensor, "3 4"],
    inputs: NetworkInputs,
    view: TargetView,
    threads: int | None = None,
) -> Rendering:
    """A view of one pass, differentiable in the Gaussians, the sky and the response.

    Args:
        query: Gaussians in the scene frame, b = 1.
        sky: the network's cubemap, in the scene frame.
        isp: affine response of the view's camera: shown = ``isp[:, :3] @ colour + isp[:, 3]``.
        inputs: inputs of the pass; give the times of the moving Gaussians.
        view: camera, poses and time.
        threads: threads of the renderer.
    """
    gaussians = gaussians_at(query, inputs, view.time)
    rendered = render_camera(gaussians, view.camera, torch.from_numpy(view.scene_from_camera), None, threads)
    rays, _ = camera_rays(view.camera)
    direction = scene_rays(view.camera, rays, view.scene_from_camera)[..., 3:].astype(np.float32)
    behind = cubemap.sample(sky, torch.from_numpy(direction))
    # Premultiplied colours: the sky shows through the remaining transmittance. The response comes last, as in a camera,
    # so that Gaussians and sky share one canonical colour space.
    canonical = rendered.rgb + (1 - rendered.alpha)[..., None] * behind
    shown = canonical @ isp[:, :3].T + isp[:, 3]
    return Rendering(shown.clamp(0, 1), rendered.depth, rendered.alpha)


def render_losses(
    rendering: Rendering, view: TargetView, weights: LossWeights, perceptual: PerceptualLoss
) -> dict[str, Tensor]:
    """Loss terms of one view before weighting; terms of weight 0 are not computed.

    ``colour``: L1. ``perceptual``. ``opacity``: mean alpha over sky pixels. ``rendered_depth``: L1 of the logarithm
    where both depths exist.

    Args:
        rendering: the rendered view.
        view: its ground truth.
        weights: weights of the terms.
        perceptual: the perceptual distance.
    """
    losses = {}
    if weights.colour:
        losses["colour"] = (rendering.rgb - view.rgb).abs().mean()
    if weights.perceptual:
        losses["perceptual"] = perceptual(rendering.rgb, view.rgb)
    if weights.opacity:
        sky = view.semantic == SemanticClass.SKY
        # Otherwise sky could be explained by Gaussians at arbitrary depth.
        losses["opacity"] = torch.where(sky, rendering.alpha, 0).sum() / sky.sum().clamp(min=1)
    if weights.rendered_depth:
        both = (view.depth_m > 0) & (rendering.depth_m > 0.1)
        # Clamped before the logarithm: ``where`` alone does not keep NaN gradients of masked pixels out.
        error = rendering.depth_m.clamp(min=0.1).log() - view.depth_m.clamp(min=0.1).log()
        losses["rendered_depth"] = torch.where(both, error.abs(), 0).sum() / both.sum().clamp(min=1)
    return losses


def psnr_db(rgb: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """Peak signal-to-noise ratio of colours in 0..1."""
    return float(-10 * torch.log10(((rgb.detach() - truth) ** 2).mean().clamp(min=1e-10)))
