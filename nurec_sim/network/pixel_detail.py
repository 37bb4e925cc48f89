"""Full-resolution inputs to the heads of our own profiles: pixels, and the log's geometric priors (``car_view``).

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
    """Full-resolution maps for a head's last layers: local (``pixels``), and from a wide context (``hourglass``).

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
        """The sum of both branches."""
        return self.pixels(images[:, : self.near]) + self.hourglass(images)


def pixel_layers(channels: int, out: int) -> nn.Sequential:
    """Three convolutions that widen pixels to the channels of a head's last layers."""
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
        # Strided levels see far at little cost; the sums restore what striding blurs (U-Net, Ronneberger et al. 2015).
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
    """The matched log depth where it is trusted (a logit), the predicted one elsewhere; blended by its sigmoid."""
    # A blend of logarithms is a weighted geometric mean of depths; unlike a choice it passes gradients to all three.
    return torch.lerp(predicted, matched, trust.sigmoid())
