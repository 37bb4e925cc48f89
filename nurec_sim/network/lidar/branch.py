"""The LiDAR branch: an encoder of range maps, and a decoder of Gaussians for every return.

A sweep goes through on its own. Convolutions see beams, tokens of 4 x 4 beams, and tokens of 8 x 8 beams; azimuth wraps
around. What the decoder says is a change of what the returns themselves say: a disc on the plane through a return and
its neighbours, as wide as the spacing of beams, with the measured intensity. So the branch starts from there.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nurec_sim.network.lidar.footprints import FLOOR, bounded, surface_axes
from nurec_sim.network.lidar.inputs import FEATURES, LidarInputs
from nurec_sim.network.lidar.profiles import LidarProfile
from nurec_sim.render.torch_maths import quat_multiply

TOKEN, COARSE = 4, 2
"""Beams per token along each axis, and tokens per coarse token."""
KERNEL = 5
CLASSES = 3
"""``Label`` OTHER, ROAD and MOVABLE."""
PER_GAUSSIAN = 12
"""Offset (3), flattening, slopes (2), widths (2), thickness, opacity, intensity, ray drop."""
OFFSET_ALONG_M = 0.2
"""Bound of the offset along the beam; across it is half of the spacing of beams."""
WIDEST = 4.0
"""Widths are 1 to so many times the floor."""
THICKNESS_M = 0.02
FREE_SCALE_M, LARGEST_FREE_M = 0.0165, 0.3
"""Without the floor: the first scale and the largest, as in the camera branch."""
FIRST_OPACITY, FIRST_DROP, FIRST_FLAT, FIRST_WIDTH = 2.2, -3.0, -4.0, -4.0
"""Logits that training starts from: opacity 0.9, drop 0.05, the plane as fitted, 1.05 times the floor."""


@dataclass(frozen=True)
class LidarGaussians:
    """Gaussians of a sweep in the axes of its range image, in activated units.

    ``beam`` is the index of the return, in the order of ``LidarInputs``, that each was decoded from; ``logits`` are
    those of the return's class.
    """

    position_m: Float[Tensor, "n 3"]
    quat_wxyz: Float[Tensor, "n 4"]
    scale_m: Float[Tensor, "n 3"]
    opacity: Float[Tensor, " n"]
    intensity: Float[Tensor, " n"]
    ray_drop: Float[Tensor, " n"]
    beam: Tensor
    logits: Float[Tensor, "n 3"]


class LidarBranch(nn.Module):
    """Range map to Gaussians (paper section "Extension to LiDAR Reconstruction").

    Attributes:
        profile: the sizes that it was built with.
    """

    def __init__(self, profile: LidarProfile) -> None:
        super().__init__()
        self.profile = profile
        beam, token = profile.beam_width, profile.token_width
        self.stem = _Around(FEATURES, beam, 3)
        self.to_tokens = nn.Conv2d(beam, token, TOKEN, TOKEN)
        half = profile.blocks // 2
        self.fine = nn.ModuleList(_Block(token) for _ in range(half))
        self.to_coarse = nn.Conv2d(token, token, COARSE, COARSE)
        self.coarse = nn.ModuleList(_Block(token) for _ in range(profile.blocks - half))
        self.join = nn.Conv2d(2 * token, beam, 1)
        self.hidden = nn.Conv2d(2 * beam, 2 * beam, 1)
        self.head = nn.Conv2d(2 * beam, PER_GAUSSIAN * profile.per_return + CLASSES, 1)

    def forward(self, inputs: LidarInputs) -> LidarGaussians:
        """Gaussians of one sweep."""
        decoded = self._decode(inputs)
        return self._gaussians(inputs, decoded)

    def _decode(self, inputs: LidarInputs) -> Float[Tensor, "n outputs"]:
        """What the network says about every return."""
        rows, columns = inputs.chosen.shape
        around = inputs.full_turn
        features, cut = _to_multiple(inputs.features[None], TOKEN * COARSE, around)
        beams = functional.gelu(self.stem(features, around))
        tokens = self.to_tokens(beams)
        for block in self.fine:
            tokens = block(tokens, around)
        coarse = self.to_coarse(tokens)
        for block in self.coarse:
            coarse = block(coarse, around)
        tokens = torch.cat([tokens, functional.interpolate(coarse, scale_factor=COARSE, mode="nearest")], dim=1)
        context = _enlarged(self.join(tokens), around)
        every = torch.cat([beams, context], dim=1)[0, :, :rows, cut : cut + columns]
        every = every[:, inputs.chosen].T
        hidden = functional.gelu(functional.linear(every, self.hidden.weight[:, :, 0, 0], self.hidden.bias))
        return functional.linear(hidden, self.head.weight[:, :, 0, 0], self.head.bias)

    def _gaussians(self, inputs: LidarInputs, decoded: Float[Tensor, "n outputs"]) -> LidarGaussians:
        """Activations: all zeros are the footprints of the returns."""
        many = self.profile.per_return
        logits = decoded[:, PER_GAUSSIAN * many :].repeat_interleave(many, 0)
        x = decoded[:, : PER_GAUSSIAN * many].reshape(-1, PER_GAUSSIAN)
        beam = torch.arange(len(inputs.xyz_m)).repeat_interleave(many)
        given = dataclasses.replace(
            inputs, **{name: getattr(inputs, name)[beam] for name in
                       ("xyz_m", "quat_wxyz", "range_m", "spacing_m", "slope", "intensity")}
        ) if many > 1 else inputs  # fmt: skip
        # Several Gaussians of a return share its part of the surface, from left to right.
        place = (torch.arange(many) + 0.5) / many - 0.5
        spacing = given.spacing_m / torch.tensor([many, 1.0])
        across = (place.repeat(len(inputs.xyz_m)) * given.spacing_m[:, 0])[:, None] * torch.tensor([1.0, 0.0])
        slope = bounded(given.slope * torch.sigmoid(x[:, 3:4] - FIRST_FLAT) + x[:, 4:6])
        turn, floor = surface_axes(slope, FLOOR * spacing)
        across = across + 0.5 * spacing * torch.tanh(x[:, 0:2])
        along = OFFSET_ALONG_M * torch.tanh(x[:, 2]) - (across * slope.detach()).sum(-1)
        if self.profile.scale_floor:
            wide = floor * (1 + (WIDEST - 1) * torch.sigmoid(x[:, 6:8] + FIRST_WIDTH))
            thick = THICKNESS_M * torch.exp(x[:, 8:9].clamp(-2, 3))
            scale = torch.cat([wide, thick], dim=-1)
        else:
            scale = (FREE_SCALE_M * torch.exp(x[:, 6:9].clamp(max=5))).clamp(max=LARGEST_FREE_M)
        return LidarGaussians(
            given.xyz_m + rotated(given.quat_wxyz, torch.cat([across, along[:, None]], dim=-1)),
            quat_multiply(given.quat_wxyz, turn),
            scale,
            torch.sigmoid(x[:, 9] + FIRST_OPACITY),
            (given.intensity + 0.25 * torch.tanh(x[:, 10])).clamp(0, 1),
            torch.sigmoid(x[:, 11] + FIRST_DROP),
            beam,
            logits,
        )


def rotated(quat_wxyz: Float[Tensor, "n 4"], vector: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Vectors turned by unit quaternions."""
    w, axis = quat_wxyz[:, :1], quat_wxyz[:, 1:]
    turned = 2 * torch.linalg.cross(axis, vector)
    return vector + w * turned + torch.linalg.cross(axis, turned)


def build_lidar(profile: LidarProfile, seed: int = 0) -> LidarBranch:
    """A branch as training starts from it: random features, and footprints of the returns as output."""
    model = LidarBranch(profile)
    generator = torch.Generator().manual_seed(seed)
    for module in model.modules():
        if isinstance(module, (nn.Conv2d, nn.Linear)):
            nn.init.trunc_normal_(module.weight, std=module.weight[0].numel() ** -0.5, generator=generator)
            assert module.bias is not None
            nn.init.zeros_(module.bias)
    nn.init.zeros_(model.head.weight)
    return model.eval()


def _padded(x: Tensor, reach: int, around: bool) -> Tensor:
    """Beams beyond the ends of an image: those on the other side of the seam, or none."""
    sides = (reach, reach, 0, 0)
    x = functional.pad(x, sides, mode="circular") if around else functional.pad(x, sides)
    return functional.pad(x, (0, 0, reach, reach))


def _enlarged(tokens: Tensor, around: bool) -> Tensor:
    """Tokens interpolated to beams, over the seam as well."""
    edged = functional.pad(tokens, (1, 1, 0, 0), mode="circular" if around else "replicate")
    return functional.interpolate(edged, scale_factor=TOKEN, mode="bilinear")[..., TOKEN:-TOKEN]


def _to_multiple(x: Tensor, unit: int, around: bool) -> tuple[Tensor, int]:
    """An image enlarged to a multiple of a unit, and the column at which the old one starts."""
    rows, columns = (math.ceil(n / unit) * unit - n for n in x.shape[-2:])
    before = columns // 2
    sides = (before, columns - before, 0, 0)
    x = functional.pad(x, sides, mode="circular") if around and columns else functional.pad(x, sides)
    return functional.pad(x, (0, 0, 0, rows)), before


class _Around(nn.Conv2d):
    """A convolution whose columns wrap around."""

    def forward(self, x: Tensor, around: bool) -> Tensor:  # type: ignore[override]
        return self._conv_forward(_padded(x, self.kernel_size[0] // 2, around), self.weight, self.bias)


class _Block(nn.Module):
    """Convolution by channel, then two layers on each token, added to what came in (ConvNeXt)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.spread = _Around(width, width, KERNEL, groups=width)
        self.norm = nn.LayerNorm(width)
        self.first = nn.Linear(width, 2 * width)
        self.second = nn.Linear(2 * width, width)

    def forward(self, x: Tensor, around: bool) -> Tensor:
        change = self.norm(self.spread(x, around).movedim(1, -1))
        change = self.second(functional.gelu(self.first(change)))
        return x + change.movedim(-1, 1)
