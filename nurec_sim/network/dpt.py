"""DPT heads: four levels of features fused from coarse to fine into a map of every pixel (paper section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nurec_sim.network.profiles import HeadSize

POSITION_WEIGHT = 0.1
POSITION_BASE = 100.0
IMAGES_AT_ONCE = 4
"""How many images go through a head together; bounds the memory of long clips."""


class Reassemble(nn.Module):
    """Feature levels as maps of 4, 2, 1 and 1/2 times the patches' resolution, all with the same number of channels."""

    def __init__(self, width: int, size: HeadSize) -> None:
        super().__init__()
        a, b, c, d = size.levels
        self.norm_layer = nn.LayerNorm(width)
        self.proj_layers = nn.ModuleList(nn.Conv2d(width, level, 1) for level in size.levels)
        self.resize_layers = nn.ModuleList(
            [nn.ConvTranspose2d(a, a, 4, 4), nn.ConvTranspose2d(b, b, 2, 2), nn.Identity(), nn.Conv2d(d, d, 3, 2, 1)]
        )
        self.output_layers = nn.ModuleList(nn.Conv2d(level, size.fused, 3, 1, 1, bias=False) for level in size.levels)

    def forward(self, features: Sequence[Float[Tensor, "n y x c"]], aspect: float) -> list[Float[Tensor, "n d yy xx"]]:
        """Maps from fine to coarse; ``aspect`` is the image's width over its height."""
        maps = []
        for level, feature in enumerate(features):
            x = self.proj_layers[level](self.norm_layer(feature).permute(0, 3, 1, 2))
            # Deeper levels are coarser: together they are the pyramid that a convolutional backbone would give
            # (Ranftl et al. 2021).
            x = self.resize_layers[level](x + position_waves(x, aspect))
            maps.append(self.output_layers[level](x))
        return maps


class Refinement(nn.Module):
    """Adds a finer map to what came from the coarser ones, and enlarges the sum."""

    def __init__(self, width: int, has_skip: bool) -> None:
        super().__init__()
        self.main_block = _residual_layers(width)
        if has_skip:
            self.res_block = _residual_layers(width)
        self.out_conv = nn.Conv2d(width, width, 1)

    def forward(
        self, x: Float[Tensor, "n d y x"], skip: Float[Tensor, "n d y x"] | None, size: tuple[int, int]
    ) -> Float[Tensor, "n d yy xx"]:
        """The fused map at another size."""
        if skip is not None:
            # RefineNet (Lin et al. 2017): the finer level is refined by a residual unit of its own before and after the
            # sum.
            x = x + skip + self.res_block(skip)
        x = x + self.main_block(x)
        # The 1 x 1 convolution and the interpolation commute; on the smaller map it costs a quarter.
        return functional.interpolate(self.out_conv(x), size, mode="bilinear", align_corners=True)


class Fusion(nn.Module):
    """Maps of four sizes to one of the image's size."""

    def __init__(self, size: HeadSize, out: int) -> None:
        super().__init__()
        self.refinement_blocks = nn.ModuleList(Refinement(size.fused, has_skip=level < 3) for level in range(4))
        self.before_conv = nn.Conv2d(size.fused, size.fused // 2, 3, 1, 1)
        self.after_conv = nn.Sequential(
            nn.Conv2d(size.fused // 2, size.last, 3, 1, 1), nn.ReLU(), nn.Conv2d(size.last, out, 1)
        )

    def forward(
        self,
        maps: Sequence[Float[Tensor, "n d y x"]],
        image_size: tuple[int, int],
        detail: Float[Tensor, "n e h w"] | None = None,
    ) -> Float[Tensor, "n out h w"]:
        """The head's output; ``detail`` is added at full resolution."""
        # From coarse to fine; every level enlarges to the size of the next.
        x: Tensor = self.refinement_blocks[3](maps[3], None, maps[2].shape[-2:])
        x = self.refinement_blocks[2](x, maps[2], maps[1].shape[-2:])
        x = self.refinement_blocks[1](x, maps[1], maps[0].shape[-2:])
        finest = maps[0].shape[-2] * 2, maps[0].shape[-1] * 2
        x = self.before_conv(self.refinement_blocks[0](x, maps[0], finest))
        x = functional.interpolate(x, image_size, mode="bilinear", align_corners=True)
        if detail is not None:
            x = x + detail
        return self.after_conv(x + position_waves(x, image_size[1] / image_size[0]))


class DptHead(nn.Module):
    """Features of all images to one map per image, a few images at a time."""

    def __init__(self, width: int, size: HeadSize, out: int) -> None:
        super().__init__()
        self.reassemble = Reassemble(width, size)
        self.fusion_head = Fusion(size, out)

    def forward(
        self,
        features: Sequence[Float[Tensor, "n y x c"]],
        image_size: tuple[int, int],
        detail: nn.Module | None = None,
        images: Float[Tensor, "n 3 h w"] | None = None,
    ) -> Float[Tensor, "n out h w"]:
        """Maps of all images.

        Args:
            features: four levels, from early to deep.
            image_size: height and width of the maps.
            detail: what adds fine structure, called with some of ``images``.
            images: colours for ``detail``.
        """
        # Heads run at full resolution and dominate peak memory; images are independent here, so a few at a time
        # suffice.
        parts = []
        for first in range(0, len(features[0]), IMAGES_AT_ONCE):
            some = slice(first, first + IMAGES_AT_ONCE)
            maps = self.reassemble([feature[some] for feature in features], image_size[1] / image_size[0])
            fine = None if detail is None or images is None else detail(images[some])
            parts.append(self.fusion_head(maps, image_size, fine))
        return torch.cat(parts)


def position_waves(x: Float[Tensor, "n d h w"], aspect: float) -> Float[Tensor, "d h w"]:
    """Sines and cosines of a pixel's position, a tenth as strong as the map they are added to.

    The image's half-diagonal has length 1; half of the channels encode the column, half the row.
    """
    channels, height, width = x.shape[-3:]
    # Relative to the diagonal, so that a pixel's waves do not change with the image's resolution.
    diagonal = (aspect**2 + 1) ** 0.5
    columns = _centred(width, aspect / diagonal, x.device)
    rows = _centred(height, 1 / diagonal, x.device)
    half = channels // 2
    wave_column = _waves(columns, half)[:, None, :].expand(half, height, width)
    wave_row = _waves(rows, half)[:, :, None].expand(half, height, width)
    return (POSITION_WEIGHT * torch.cat([wave_column, wave_row])).to(x.dtype)


def _centred(count: int, span: float, device: torch.device) -> Tensor:
    last = span * (count - 1) / count
    return torch.linspace(-last, last, count, device=device)


def _waves(position: Tensor, channels: int) -> Float[Tensor, "c n"]:
    # Transformer sinusoids (Vaswani et al. 2017) with base 100.
    power = torch.arange(channels // 2, dtype=torch.float64, device=position.device) / (channels / 2)
    angle = position.double()[None] * (POSITION_BASE**-power)[:, None]
    return torch.cat([angle.sin(), angle.cos()]).float()


def _residual_layers(width: int) -> nn.Sequential:
    return nn.Sequential(nn.ReLU(), nn.Conv2d(width, width, 3, 1, 1), nn.ReLU(), nn.Conv2d(width, width, 3, 1, 1))
