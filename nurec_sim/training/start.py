"""How training begins: colours as in the image, depth as matches and ground say, Gaussians as footprints of pixels.

A network that starts so has only to learn how the world differs from that before its renderings look right.
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
"""GELU is nearly the identity from here on; what passes is shifted by it on its way."""
GROUND_CHANNEL = 3 + GROUND_DEPTH
"""Of what the depth head's detail sees: the colours come first."""
FIRST_TRUST = 2.0
"""A logit: nine tenths of the first depth are those of matching, the rest that of flat ground."""


def prepare(model: InstantNuRec) -> None:
    """Change a randomly initialised network as above."""
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
            # The depth head puts out the logarithm, which is what the car's view holds.
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
    """The head's first outputs become these channels of what its fusion sees, by the line that takes seen to wanted."""
    kept = range(len(channels))
    into, last = _convolutions(head.fusion_head.after_conv)
    layers = _convolutions(fusion)
    # The first channels of every layer hand on these inputs, and nothing else.
    for layer, sources in zip((*layers, into), (channels, kept, kept, kept), strict=True):
        layer.weight[: len(channels)] = 0
        layer.weight[list(kept), list(sources), 1, 1] = 1
    _biases(layers[0])[: len(channels)] = LINEAR_PART
    head.fusion_head.before_conv.weight[: len(channels)] = 0
    # The last layer undoes what the others did on the way: the line with the least squared error.
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
    """Biases of the last layer: scale 3, quaternion 4, opacity 1, for each Gaussian of a cluster."""
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
