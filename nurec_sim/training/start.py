"""Initialisation for training: image colours, depth from matching and flat ground, Gaussians of pixel size.

Starting from this baseline, a network only has to learn the deviations from it before renderings look right.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nurec_sim.errors import TrainingError
from nurec_sim.network.car_view import GROUND_DEPTH
from nurec_sim.network.checkpoints.state_dicts import load_state_dict
from nurec_sim.network.decoders import DenseDecoder, SelectiveDecoder
from nurec_sim.network.dpt import DptHead
from nurec_sim.network.model import InstantNuRec
from nurec_sim.network.pixel_detail import PixelDetail

FIRST_RAW_OPACITY = 5.0
"""An opacity of 0.95."""
LINEAR_PART = 3.0
"""GELU is nearly the identity from here on; passed values are shifted by it."""
GROUND_CHANNEL = 3 + GROUND_DEPTH
"""Channel of the ground depth in the input of the depth head's detail branch; the colours come first."""
FIRST_TRUST = 2.0
"""A logit (0.88): initial share of the depth from matching; the rest is that of flat ground."""


def prepare(model: InstantNuRec) -> None:
    """Applies this initialisation to a randomly initialised network."""
    decoder = model.decoder
    with torch.no_grad():
        # Raw colours r are shown as sigmoid(2 r).
        grey = torch.linspace(0.05, 0.95, 10)
        colours = decoder.rgb_fusion
        if isinstance(colours, PixelDetail):
            colours.hourglass.last.weight[:3] = 0
            colours = colours.pixels
        assert isinstance(colours, nn.Sequential)
        _pass_through(colours, decoder.context_head, (0, 1, 2), grey, torch.logit(grey) / 2)
        if decoder.depth_fusion is not None:
            # The depth head predicts the logarithm of the depth, as the car-view channel contains it.
            log_depth = torch.linspace(-1.2, 2.9, 10)
            _pass_through(decoder.depth_fusion.pixels, decoder.depth_head, (GROUND_CHANNEL,), log_depth, log_depth)
            decoder.depth_fusion.hourglass.last.weight[0] = 0
            _biases(_convolutions(decoder.depth_head.fusion_head.after_conv)[1])[1] = FIRST_TRUST
        _first_gaussians(decoder)


def _pass_through(
    fusion: nn.Sequential,
    head: DptHead,
    channels: tuple[int, ...],
    seen: Float[Tensor, " n"],
    wanted: Float[Tensor, " n"],
) -> None:
    """Makes the head's first outputs copies of these input channels of its fusion, mapped from ``seen`` to ``wanted``.

    The map is the least-squares line.
    """
    kept = range(len(channels))
    into, last = _convolutions(head.fusion_head.after_conv)
    layers = _convolutions(fusion)
    # The first channels of every layer pass on these inputs only: an identity kernel at the centre.
    for layer, sources in zip((*layers, into), (channels, kept, kept, kept), strict=True):
        layer.weight[: len(channels)] = 0
        layer.weight[list(kept), list(sources), 1, 1] = 1
    _biases(layers[0])[: len(channels)] = LINEAR_PART
    head.fusion_head.before_conv.weight[: len(channels)] = 0
    # The last layer inverts the distortion by the others, by linear regression over probe images of constant value.
    images = torch.zeros(len(seen), layers[0].in_channels, 5, 5)
    images[:, list(channels)] = seen[:, None, None, None]
    passed = torch.relu(fusion(images)[:, 0, 2, 2])
    away = passed - passed.mean()
    slope = (away * wanted).sum() / (away**2).sum()
    last.weight[: len(channels)] = 0
    last.weight[list(kept), list(kept), 0, 0] = slope
    _biases(last)[: len(channels)] = wanted.mean() - slope * passed.mean()


def _convolutions(layers: nn.Sequential) -> list[nn.Conv2d]:
    return [layer for layer in layers if isinstance(layer, nn.Conv2d)]


def _biases(layer: nn.Conv2d | nn.Linear) -> Tensor:
    assert layer.bias is not None
    return layer.bias


def _first_gaussians(decoder: DenseDecoder | SelectiveDecoder) -> None:
    """Biases of the last layer for each Gaussian of a cluster: 3 for scale, 4 for the quaternion, 1 for opacity."""
    first = torch.tensor([0.0] * 3 + [1.0, 0, 0, 0] + [FIRST_RAW_OPACITY])
    last: nn.Module
    if isinstance(decoder, DenseDecoder):
        last = decoder.gaussians_head.fusion_head.after_conv[2]
    else:
        last = decoder.gs_linear
    assert isinstance(last, (nn.Conv2d, nn.Linear))
    _biases(last).copy_(first.repeat(len(_biases(last)) // len(first)))
    last.weight.mul_(0.1)


def load_shared(model: InstantNuRec, path: Path) -> list[str]:
    """Loads all weights of a file that fit by name and shape; returns the names of the others.

    Dense and selective networks, for example, share most of their parts.

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
