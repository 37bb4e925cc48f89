"""How training begins: colours start as those of the image, Gaussians as wide as a few centimetres and nearly opaque.

A network that starts so has only geometry to learn before its renderings look like the images.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from nurec_sim.errors import TrainingError
from nurec_sim.network.checkpoints import load_state_dict
from nurec_sim.network.decoders import DenseDecoder, SelectiveDecoder
from nurec_sim.network.model import InstantNuRec

FIRST_LOG_SCALE = 1.0
"""Of the raw scale; about 4.5 cm."""
FIRST_RAW_OPACITY = 3.5
"""An opacity of 0.82."""
LINEAR_PART = 3.0
"""GELU is nearly the identity from here on; colours are shifted by it while they pass."""


def prepare(model: InstantNuRec) -> None:
    """Change a randomly initialised network as above."""
    with torch.no_grad():
        _pass_colours_through(model)
        _first_gaussians(model.decoder)


def _pass_colours_through(model: InstantNuRec) -> None:
    """Three channels of the context head carry the image's colours from its input to its output."""
    layers = [layer for layer in model.decoder.rgb_fusion if isinstance(layer, nn.Conv2d)]
    head = model.decoder.context_head.fusion_head
    for layer in (*layers, head.after_conv[0]):
        layer.weight[:3] = 0
        layer.weight[range(3), range(3), 1, 1] = 1
    layers[0].bias[:3] = LINEAR_PART
    head.before_conv.weight[:3] = 0
    # Raw colours r are shown as sigmoid(2 r): the line that fits best, found from what goes through.
    grey = torch.linspace(0.05, 0.95, 10)[:, None, None, None].expand(-1, 3, 5, 5)
    passed = torch.relu(model.decoder.rgb_fusion(grey)[:, 0, 2, 2])
    wanted = torch.logit(grey[:, 0, 2, 2]) / 2
    slope = ((passed - passed.mean()) * wanted).sum() / ((passed - passed.mean()) ** 2).sum()
    last = head.after_conv[2]
    last.weight[:3] = 0
    last.weight[range(3), range(3), 0, 0] = slope
    last.bias[:3] = wanted.mean() - slope * passed.mean()


def _first_gaussians(decoder: DenseDecoder | SelectiveDecoder) -> None:
    """Biases of the last layer: scale 3, quaternion 4, opacity 1, for each Gaussian of a cluster."""
    first = torch.tensor([FIRST_LOG_SCALE] * 3 + [1.0, 0, 0, 0] + [FIRST_RAW_OPACITY])
    if isinstance(decoder, DenseDecoder):
        last: nn.Module = decoder.gaussians_head.fusion_head.after_conv[2]
    else:
        last = decoder.gs_linear
    last.bias.copy_(first.repeat(last.bias.numel() // len(first)))
    last.weight.mul_(0.1)


def load_shared(model: InstantNuRec, path: Path) -> list[str]:
    """Weights of a file for all parts that fit, such as those that dense and selective share; names of the rest.

    Raises:
        WeightsError: the file cannot be read.
        TrainingError: nothing in it fits.
    """
    given: Mapping[str, Tensor] = load_state_dict(path)
    needed = model.state_dict()
    fitting = {name: value for name, value in given.items() if name in needed and value.shape == needed[name].shape}
    if not fitting:
        raise TrainingError(f"{path} holds no weights that fit profile {model.profile.name!r}")
    model.load_state_dict({name: value.to(needed[name].dtype) for name, value in fitting.items()}, strict=False)
    return [name for name in needed if name not in fitting]
