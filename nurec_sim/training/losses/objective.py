"""One step of a stage: a forward pass through the required parts, and the weighted sum of its losses."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from nurec_sim.network.image_colours import image_colours
from nurec_sim.network.model import InstantNuRec
from nurec_sim.network.sky.background import background, is_static
from nurec_sim.network.tensors import ContextMaps, NetworkInputs, QueryGaussians
from nurec_sim.reconstruct.feedforward.merging.consensus import find_consensus
from nurec_sim.training.config import Part, Stage
from nurec_sim.training.data.sample import TrainingSample
from nurec_sim.training.losses.rendered import context_losses, motion_loss, sky_loss
from nurec_sim.training.rendering import PerceptualLoss, Rendering, psnr_db, render_losses, render_view

PREFIXES: Mapping[Part, tuple[str, ...]] = {
    "encoder": ("encoder.",),
    "context": ("decoder.depth_head.", "decoder.depth_fusion.", "decoder.rgb_fusion.", "decoder.context_head."),
    "motion": ("decoder.context_motion_head.",),
    "sky": ("sky.",),
    "gaussians": ("decoder.gaussians_head.", "decoder.xyz_embed.", "decoder.ca_", "decoder.gs_linear."),
    "isp": ("post_processing.",),
}
"""Prefixes of the parameter names of each part."""


@dataclass(frozen=True)
class StepOutputs:
    """Results of a step; None if its stage does not need them."""

    context: ContextMaps
    gaussians: QueryGaussians | None
    sky: Tensor | None
    isp: Tensor | None
    renderings: tuple[Rendering, ...]


class Objective(nn.Module):
    """A network with a stage's losses; ``forward`` returns the loss of one sample, so that DDP can wrap it.

    Args:
        model: the network; parameters of parts that the stage does not train are frozen here.
        stage: the parts to train and the loss weights.
        perceptual: the perceptual term.
        precision: data type of matrix products and convolutions.
        threads: threads of the renderer.
    """

    def __init__(
        self, model: InstantNuRec, stage: Stage, perceptual: PerceptualLoss, precision: str, threads: int | None = None
    ) -> None:
        super().__init__()
        self.model, self.stage, self.perceptual, self.threads = model, stage, perceptual, threads
        self.precision = getattr(torch, precision)
        prefixes = tuple(prefix for part in stage.trains for prefix in PREFIXES[part])
        for name, parameter in model.named_parameters():
            parameter.requires_grad_(name.startswith(prefixes) and parameter.numel() > 0)

    def trained(self) -> dict[str, nn.Parameter]:
        """Parameters of the stage, by name."""
        return {name: each for name, each in self.model.named_parameters() if each.requires_grad}

    def forward(self, sample: TrainingSample) -> tuple[Tensor, dict[str, float], StepOutputs]:
        """The loss, its terms before weighting (with ``psnr`` of rendered views and ``abs_rel``), and the outputs."""
        outputs = self.run(sample)
        losses = self._losses(sample, outputs)
        weights = self.stage.losses
        total = torch.stack([getattr(weights, name) * value for name, value in losses.items()]).sum()
        figures = {name: float(value.detach()) for name, value in losses.items()}
        if outputs.renderings:
            pairs = zip(outputs.renderings, sample.targets, strict=False)
            figures["psnr"] = sum(psnr_db(each.rgb, view.rgb) for each, view in pairs) / len(outputs.renderings)
        known = sample.truth.depth_m > 0
        true = sample.truth.depth_m[known]
        figures["abs_rel"] = float(((outputs.context.depth_m.detach()[known] - true).abs() / true).mean())
        return total, figures, outputs

    def run(self, sample: TrainingSample) -> StepOutputs:
        """The forward pass of the stage, with its renderings."""
        inputs, stage, model = sample.inputs, self.stage, self.model
        gaussians = sky = isp = None
        with torch.autocast(inputs.rgb.device.type, self.precision, enabled=self.precision is not torch.float32):
            # No activations are kept for a frozen encoder.
            frozen = "encoder" not in stage.trains
            with torch.no_grad() if frozen else contextlib.nullcontext():
                features = model.features(inputs)
            context = model.decoder.context(features, inputs, motion="motion" in stage.trains)
            if model.sky is not None and ("sky" in stage.trains or stage.targets):
                sky = model.sky(features[-1].patches, inputs.rgb, inputs.rays[..., 3:])
            behind = None
            if stage.targets and sky is not None:
                isp = model.post_processing(features[-1].patches, inputs.camera_idxs)
                shown, behind, isp = self._shown(sample, context, sky, isp)
                gaussians = self._agreed(model.decoder.gaussians(features, shown, inputs), shown, inputs)
        # Outside autocast: projection and blending need float32.
        renderings: tuple[Rendering, ...] = ()
        if gaussians is not None and behind is not None and isp is not None:
            renderings = tuple(
                render_view(gaussians, behind, isp[0, view.camera_idx], inputs, view, self.threads)
                for view in sample.targets[: stage.targets]
            )
        return StepOutputs(context, gaussians, sky, isp, renderings)

    def _shown(
        self, sample: TrainingSample, context: ContextMaps, sky: Tensor, isp: Tensor
    ) -> tuple[ContextMaps, Tensor, Tensor]:
        """Context as a reconstruction uses it, the background cubemap, and the matching camera responses."""
        inputs, profile = sample.inputs, self.model.profile
        shown = self.model.refined(context, inputs) if profile.log_geometry else context
        if shown.motion_m is None:
            # Shapes and opacities are learned at the true positions, independent of errors of the motion head.
            shown = dataclasses.replace(shown, motion_m=sample.truth.motion_m)
        if profile.image_colours:
            rgb, sky, isp = image_colours(inputs, sky, isp)
            shown = dataclasses.replace(shown, rgb=rgb)
        surface = is_static(shown.logits[0])
        colour, direction = shown.rgb[0][surface], inputs.rays[0, ..., 3:][surface]
        colour, covered = (torch.from_numpy(each).to(sky) for each in background(colour, direction, sky.shape[2]))
        return shown, torch.lerp(sky[0], colour, covered[..., None]), isp

    def _agreed(self, gaussians: QueryGaussians, context: ContextMaps, inputs: NetworkInputs) -> QueryGaussians:
        """The Gaussians that a reconstruction would keep."""
        semantic = context.logits[0].argmax(-1).cpu().numpy()
        depth_m, rgb = (each[0].detach().float().cpu().numpy() for each in (context.depth_m, context.rgb))
        return find_consensus(inputs, depth_m, semantic, rgb).apply(gaussians, inputs)

    def _losses(self, sample: TrainingSample, outputs: StepOutputs) -> dict[str, Tensor]:
        weights, trains = self.stage.losses, self.stage.trains
        losses: dict[str, Tensor] = {}
        if "context" in trains or "encoder" in trains:
            losses |= context_losses(outputs.context, sample.inputs, sample.truth, weights)
        if weights.motion and "motion" in trains and outputs.context.motion_m is not None:
            losses["motion"] = motion_loss(outputs.context.motion_m, sample.truth)
        if weights.sky and "sky" in trains and outputs.sky is not None:
            losses["sky"] = sky_loss(outputs.sky[0], sample.inputs, sample.truth)
        if outputs.renderings:
            each = [
                render_losses(rendering, view, weights, self.perceptual)
                for rendering, view in zip(outputs.renderings, sample.targets, strict=False)
            ]
            losses |= {name: torch.stack([one[name] for one in each]).mean() for name in each[0]}
        return losses
