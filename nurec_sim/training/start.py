"""How training begins: colours as those of the image, depth as that of flat ground, Gaussians small and nearly opaque.

A network that starts so has only to learn how the world differs from a flat one before its renderings look right.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nurec_sim.errors import TrainingError
from nurec_sim.network.checkpoints import load_state_dict
from nurec_sim.network.decoders import DenseDecoder, SelectiveDecoder
from nurec_sim.network.dpt import Fusion
from nurec_sim.network.model import InstantNuRec

FIRST_LOG_SCALE = 1.0
"""Of the raw scale; about 4.5 cm."""
FIRST_RAW_OPACITY = 3.5
"""An opacity of 0.82."""
LINEAR_PART = 3.0
"""GELU is nearly the identity from here on; what passes is shifted by it on its way."""
GROUND_CHANNEL = 3 + 6
"""Of the depth head's view: after the colours, the ray's origin and its direction."""


def prepare(model: InstantNuRec) -> None:
    """Change a randomly initialised network as above."""
    with torch.no_grad():
        _pass_colours_through(model)
        if model.decoder.depth_fusion is not None:
            _pass_ground_through(model)
        _first_gaussians(model.decoder)


def _pass_colours_through(model: InstantNuRec) -> None:
    """Three channels of the context head carry the image's colours from its input to its output."""
    fusion, head = model.decoder.rgb_fusion, model.decoder.context_head.fusion_head
    _open_way(fusion, head, (0, 1, 2))
    # Raw colours r are shown as sigmoid(2 r): the line that fits best, found from what goes through.
    grey = torch.linspace(0.05, 0.95, 10)
    _fit_last_layer(fusion, head, grey[:, None].expand(-1, 3), torch.logit(grey) / 2, 3)


def _pass_ground_through(model: InstantNuRec) -> None:
    """One channel of the depth head carries the depth of flat ground, whose logarithm is what the head puts out."""
    fusion, head = model.decoder.depth_fusion, model.decoder.depth_head.fusion_head
    _open_way(fusion, head, (GROUND_CHANNEL,))
    log_depth = torch.linspace(-1.0, 1.8, 10)
    seen = torch.zeros(10, fusion[0].in_channels)
    seen[:, GROUND_CHANNEL] = log_depth
    _fit_last_layer(fusion, head, seen, log_depth, 1)


def _open_way(fusion: nn.Sequential, head: Fusion, inputs: tuple[int, ...]) -> None:
    """The first channels of every layer hand on these inputs, and nothing else."""
    rows = range(len(inputs))
    layers = [layer for layer in fusion if isinstance(layer, nn.Conv2d)]
    for layer, sources in zip((*layers, head.after_conv[0]), (inputs, rows, rows, rows), strict=True):
        layer.weight[: len(inputs)] = 0
        layer.weight[list(rows), list(sources), 1, 1] = 1
    layers[0].bias[: len(inputs)] = LINEAR_PART
    head.before_conv.weight[: len(inputs)] = 0


def _fit_last_layer(
    fusion: nn.Sequential, head: Fusion, seen: Float[Tensor, "n inputs"], wanted: Float[Tensor, " n"], count: int
) -> None:
    """The first ``count`` outputs of the head become a line over what the open way hands on, with the least squared error."""
    passed = torch.relu(fusion(seen[:, :, None, None].expand(-1, -1, 5, 5))[:, 0, 2, 2])
    away = passed - passed.mean()
    slope = (away * wanted).sum() / (away**2).sum()
    last = head.after_conv[2]
    last.weight[:count] = 0
    last.weight[range(count), range(count), 0, 0] = slope
    last.bias[:count] = wanted.mean() - slope * passed.mean()


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
