"""What the heads of our own profiles see beside features of patches: pixels, and what a log says of their depth.

Not part of the released network, whose patches are trained on enough images to do without.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

CHANNELS = (24, 48, 72, 96)
"""Of the hourglass, at 1/2, 1/4, 1/8 and 1/16 of the resolution."""


class PixelDetail(nn.Module):
    """Maps of every pixel for a head's last layers: from the pixel and those around it (``pixels``), and from afar.

    Args:
        channels: of the images.
        out: of the maps.
        near: how many channels, the first ones, ``pixels`` sees; None is all.
    """

    def __init__(self, channels: int, out: int, near: int | None = None) -> None:
        super().__init__()
        self.near = channels if near is None else near
        self.pixels = pixel_layers(self.near, out)
        self.hourglass = Hourglass(channels, out)

    def forward(self, images: Float[Tensor, "n c h w"]) -> Float[Tensor, "n out h w"]:
        """The sum of both."""
        return self.pixels(images[:, : self.near]) + self.hourglass(images)


def pixel_layers(channels: int, out: int) -> nn.Sequential:
    """Three convolutions that bring pixels to the width of a head's last layers."""
    return nn.Sequential(
        nn.Conv2d(channels, out // 4, 3, 1, 1), nn.GELU(),
        nn.Conv2d(out // 4, out // 2, 3, 1, 1), nn.GELU(),
        nn.Conv2d(out // 2, out, 3, 1, 1), nn.GELU(),
    )  # fmt: skip


class Hourglass(nn.Module):
    """Convolutions down to a sixteenth of the resolution and back, the finer maps added on the way."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        widths = (channels, *CHANNELS)
        self.down = nn.ModuleList(_two_layers(a, b, stride=2) for a, b in zip(widths, CHANNELS, strict=False))
        self.up = nn.ModuleList(_two_layers(b, a) for a, b in zip(CHANNELS, CHANNELS[1:], strict=False))
        self.last = nn.Conv2d(CHANNELS[0], out, 3, 1, 1)

    def forward(self, images: Float[Tensor, "n c h w"]) -> Float[Tensor, "n out h w"]:
        """At the images' resolution."""
        maps = [images]
        for layers in self.down:
            maps.append(layers(maps[-1]))
        x = maps.pop()
        for layers in reversed(self.up):
            finer = maps.pop()
            x = finer + functional.interpolate(layers(x), finer.shape[-2:], mode="bilinear", align_corners=False)
        return functional.interpolate(self.last(x), images.shape[-2:], mode="bilinear", align_corners=False)


def _two_layers(channels: int, out: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, out, 3, stride, 1), nn.GELU(), nn.Conv2d(out, out, 3, 1, 1), nn.GELU()
    )  # fmt: skip


def chosen_depth(
    predicted: Float[Tensor, "n h w"], trust: Float[Tensor, "n h w"], matched: Float[Tensor, "n h w"]
) -> Float[Tensor, "n h w"]:
    """The matched logarithm where it is trusted (a logit), the predicted one elsewhere."""
    return torch.lerp(predicted, matched, trust.sigmoid())
