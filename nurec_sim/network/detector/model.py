"""The detector's network: a small convolutional pyramid with heat and numbers at every fourth pixel."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from nurec_sim.network.detector.codec import NUMBERS
from nurec_sim.network.detector.objects import KINDS

FIRST, WIDTHS, BLOCKS = 16, (32, 48, 80, 96), (1, 2, 1, 1)
"""Channels at half the size; channels and residual blocks at a fourth, eighth, 16th and 32nd."""
HEAD = 48
RARE = 0.02
"""The first heat everywhere (Lin et al. 2017): cells with an object are rare."""


class _Unit(nn.Sequential):
    """Convolution, normalisation and ReLU."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1, kernel: int = 3) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = _Unit(width, width), nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.norm = nn.BatchNorm2d(width)

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.norm(self.second(self.first(x))))


class DetectorNetwork(nn.Module):
    """Heat and numbers (``codec``) of images.

    Args:
        seed: of the initial weights.
    """

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.first = _Unit(5, FIRST, 2)
            self.down = nn.ModuleList(
                nn.Sequential(_Unit(before, width, 2), *(_Residual(width) for _ in range(blocks)))
                for before, width, blocks in zip((FIRST, *WIDTHS), WIDTHS, BLOCKS, strict=False)
            )
            self.up = nn.ModuleList(
                nn.Conv2d(deep, shallow, 1, bias=False)
                for shallow, deep in zip(WIDTHS, WIDTHS[1:], strict=False)
            )  # fmt: skip
            self.merge = nn.ModuleList(
                _Unit(width, width, kernel=3 if k < 2 else 1) for k, width in enumerate(WIDTHS[:-1])
            )
            self.head = _Unit(WIDTHS[0], HEAD)
            self.answer = nn.Conv2d(HEAD, len(KINDS) + NUMBERS, 1)
            for module in self.modules():
                if isinstance(module, nn.Conv2d):
                    nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
            bias = self.answer.bias
            assert bias is not None
            with torch.no_grad():
                self.answer.weight.mul_(0.1)
                bias.zero_()
                bias[: len(KINDS)] = math.log(RARE / (1 - RARE))
                bias[len(KINDS) + 3] = -2.0

    def forward(self, images: Tensor, tangents: Tensor) -> tuple[Tensor, Tensor]:
        """Logarithmic odds of heat [b, kinds, h/4, w/4] and numbers [b, numbers, h/4, w/4].

        Args:
            images: uint8 [b, 3, h, w], sides of multiples of 32.
            tangents: of the rays of pixels [b, 2, h, w].
        """
        x = self.first(torch.cat([images.float() / 127.5 - 1, 2 * tangents], dim=1))
        levels = []
        for stage in self.down:
            levels.append(x := stage(x))
        for k in range(len(levels) - 2, -1, -1):
            larger = functional.interpolate(self.up[k](x), scale_factor=2.0, mode="bilinear", align_corners=False)
            x = self.merge[k](levels[k] + larger)
        answer = self.answer(self.head(x))
        return answer[:, : len(KINDS)], answer[:, len(KINDS) :]
