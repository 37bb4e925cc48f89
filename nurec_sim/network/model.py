"""The whole network: a clip of images in, a layered Gaussian world out, in a single forward pass."""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Literal

import torch
from torch import Tensor, nn

from nurec_sim.network.car_view import car_view
from nurec_sim.network.decoders import DenseDecoder, SelectiveDecoder
from nurec_sim.network.encoder import Encoder, Features
from nurec_sim.network.image_colours import image_colours
from nurec_sim.network.isp import IspDecoder
from nurec_sim.network.profiles import PATCH_PX, Profile, SkySize
from nurec_sim.network.sky.background import is_static
from nurec_sim.network.sky.learned import SkyDecoder
from nurec_sim.network.sky.mlp import SkyMlp
from nurec_sim.network.sky.observed import observed_sky
from nurec_sim.network.stereo.depth_refinement import depth_factor
from nurec_sim.network.stereo.motion_search import searched_motion
from nurec_sim.network.stereo.plane_sweep import plane_sweep
from nurec_sim.network.tensors import ContextMaps, NetworkInputs, NetworkOutputs, SemanticClass

Precision = Literal["float32", "bfloat16", "float16"]
TOKENS_AND_POSITIONS = ("cls_tokens", "cls_pos_embed", "img_pos_embed", "affine_token", "sky.token")


class InstantNuRec(nn.Module):
    """The Instant NuRec network (paper section 3, its Figure 2).

    Attributes:
        profile: the sizes that it was built with.
        precision: of matrix products and convolutions; parameters, norms and results stay float32.
    """

    cuboids_dims_padding: Tensor

    def __init__(self, profile: Profile) -> None:
        super().__init__()
        self.profile = profile
        self.precision: Precision = "float32"
        if profile.training_buffers:
            self.register_buffer("cuboids_dims_padding", torch.ones(3))
        self.encoder = Encoder(profile.encoder)
        self.decoder = DenseDecoder(profile) if profile.decoder == "dense" else SelectiveDecoder(profile)
        self.sky = _learned_sky(profile, profile.sky) if profile.sky else None
        self.post_processing = IspDecoder(2 * profile.encoder.width, profile.isp_heads)

    def forward(self, inputs: NetworkInputs, motion: bool = True) -> NetworkOutputs:
        """One pass over a batch of clips.

        Args:
            inputs: images, poses, rays and times; h and w are multiples of 14.
            motion: whether to run the motion decoder.

        Raises:
            ValueError: sizes that are no multiples of 14 or too small, images not sorted by camera, or more than one
                clip for a selective decoder.
        """
        self._check(inputs)
        with self._half_precision(inputs.rgb.device):
            # Images and cameras become features that all decoders share.
            if self.profile.encoder.car_view and inputs.matches is None:
                inputs = dataclasses.replace(inputs, matches=plane_sweep(inputs))
            features = self.features(inputs)
            deepest = features[-1].patches
            # Per pixel: depth, colour, normal, class, and the motion of its point.
            context = self.decoder.context(features, inputs, motion)
            # Matching works on decoded maps and needs no parameters; the released profiles go without it.
            if self.profile.log_geometry:
                context = self.refined(context, inputs)
                if context.motion_m is not None:
                    movable = context.logits.argmax(-1) == SemanticClass.MOVABLE
                    found = searched_motion(inputs, context.depth_m, movable, context.motion_m)
                    context = dataclasses.replace(context, motion_m=found)
            # The distant background, a cubemap (paper section 3.1).
            directions = inputs.rays[..., 3:]
            if self.sky is None:
                sky, seen = observed_sky(context.rgb, context.logits, inputs.rays, self.profile.observed_sky_px)
            else:
                sky = self.sky(deepest, inputs.rgb, directions)
                seen = torch.ones_like(sky[..., :1])
            # Per-camera affine response, applied after sky compositing.
            isp = self.post_processing(deepest, inputs.camera_idxs)
            if self.profile.image_colours:
                rgb, sky, isp = image_colours(inputs, sky, isp)
                context = dataclasses.replace(context, rgb=rgb)
            # Pixels lifted to points, points grown to Gaussians.
            gaussians = self.decoder.gaussians(features, context, inputs)
        return NetworkOutputs(context, gaussians, sky, seen, self.sky is not None, isp)

    def refined(self, context: ContextMaps, inputs: NetworkInputs) -> ContextMaps:
        """Context with the depth of static surfaces refined by matching; a factor, so that gradients pass through."""
        factor = depth_factor(inputs, context.depth_m, is_static(context.logits))
        return dataclasses.replace(context, depth_m=context.depth_m * factor)

    def features(self, inputs: NetworkInputs) -> tuple[Features, ...]:
        """Four levels of the encoder's features, from early to deep."""
        view = car_view(inputs) if self.profile.encoder.car_view else None
        return self.encoder(inputs.rgb, inputs.c2w, inputs.fov, view)

    def _half_precision(self, device: torch.device) -> contextlib.AbstractContextManager:
        if self.precision == "float32":
            return contextlib.nullcontext()
        # Autocast only converts matrix products and convolutions; the rest is computed in float32.
        return torch.autocast(device.type, getattr(torch, self.precision))

    def _check(self, inputs: NetworkInputs) -> None:
        height, width = inputs.rgb.shape[2:4]
        least = PATCH_PX
        if self.profile.decoder == "selective":
            least = self.profile.selective.stride * self.profile.selective.cell
        if height % PATCH_PX or width % PATCH_PX or min(height, width) < least:
            raise ValueError(
                f"images must be multiples of {PATCH_PX} px wide and high and at least {least} px, "
                f"got {width} x {height}"
            )


def _learned_sky(profile: Profile, size: SkySize) -> SkyDecoder | SkyMlp:
    return SkyDecoder(profile, size) if size.kind == "decoder" else SkyMlp(profile, size)


def initialize(model: InstantNuRec, seed: int) -> None:
    """Random parameters as training starts from them.

    Weights are normal, so narrow that a layer hardly changes the size of what goes through (transformer blocks: 0.02);
    biases are zero, tokens and positions small, and camera responses begin as the identity.
    """
    generator = torch.Generator().manual_seed(seed)
    for name, module in model.named_modules():
        if isinstance(module, (nn.Linear, nn.Conv2d, nn.ConvTranspose2d)):
            # Transposed convolutions store [in, out, h, w]; with kernel = stride each output has one input place, so
            # fan-in is the number of input channels.
            inputs = len(module.weight) if isinstance(module, nn.ConvTranspose2d) else module.weight[0].numel()
            widest = 0.02 if "blocks" in name else 1.0
            nn.init.trunc_normal_(module.weight, std=min(widest, inputs**-0.5), generator=generator)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    # Parameters outside of linear and convolution layers; norms and LayerScale keep the values of their constructors.
    for name, parameter in model.named_parameters():
        if name.endswith(TOKENS_AND_POSITIONS):
            nn.init.trunc_normal_(parameter, std=0.02, generator=generator)
    # Zero weights and biases: the response starts as the identity.
    nn.init.zeros_(model.post_processing.affine_linear.weight)
