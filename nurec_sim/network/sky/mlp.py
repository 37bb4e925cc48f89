"""A sky without a cubemap decoder, as STORM has it: one token that knows the clip, and an MLP from direction to colour.

It stands in for ``learned_sky`` in the paper's ablation (section 5.3, Table 2). The token looks at what the sky decoder
looks at; only how colours come about differs.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nurec_sim.network.attention import CrossAttention, KeyValueProjector
from nurec_sim.network.encoder import PatchEmbedding, normalized
from nurec_sim.network.profiles import Profile, SkySize
from nurec_sim.network.sky import cubemap
from nurec_sim.network.sky.learned import RayEmbedding

DIRECTION_OCTAVES = 4
"""Of the sines and cosines that code a direction, as in NeRF (Mildenhall et al. 2020)."""
HIDDEN_LAYERS = 3


class SkyMlp(nn.Module):
    """Colours of all directions from one token; in and out as ``learned_sky.SkyDecoder``."""

    query_rays: Tensor

    def __init__(self, profile: Profile, size: SkySize) -> None:
        super().__init__()
        self.size = size
        self.token = nn.Parameter(torch.zeros(size.width))
        self.register_buffer("query_rays", cubemap.directions(size.cubemap_px), persistent=False)
        self.feature_transform = nn.Sequential(
            nn.Linear(2 * profile.encoder.width, size.width), nn.LayerNorm(size.width)
        )
        self.patch_embed_img = PatchEmbedding(size.width, normed=True)
        self.patch_embed_ray = RayEmbedding(size.width)
        self.kv_projector = KeyValueProjector(size.width, size.heads, normed=True)
        self.pooling = CrossAttention(size.width, size.heads, normed=True)
        self.from_direction = nn.Linear(3 * (1 + 2 * DIRECTION_OCTAVES), size.width)
        self.from_token = nn.Linear(size.width, size.width)
        self.hidden = nn.ModuleList(nn.Linear(size.width, size.width) for _ in range(HIDDEN_LAYERS - 1))
        self.colour = nn.Linear(size.width, 3)

    def set_constants(self) -> None:
        """Compute the directions again, where the module was made without values."""
        self.query_rays.copy_(cubemap.directions(self.size.cubemap_px, self.query_rays.device))

    def forward(
        self,
        patches: Float[Tensor, "b v y x c"],
        rgb: Float[Tensor, "b v h w 3"],
        directions: Float[Tensor, "b v h w 3"],
    ) -> Float[Tensor, "b 6 s s 3"]:
        """The sky in the frame of the directions, 0..1."""
        b = len(rgb)
        seen = self.feature_transform(patches).flatten(0, 1)
        seen = seen + self.patch_embed_img(normalized(rgb.flatten(0, 1)))
        seen = seen + self.patch_embed_ray(directions.flatten(0, 1))
        k, values = self.kv_projector(seen.reshape(b, -1, self.size.width))
        token = self.token + self.pooling(self.token.expand(b, 1, -1), k, values)
        x = self.from_direction(_sinusoids(self.query_rays)) + self.from_token(token)[:, :, None, None]
        for layer in self.hidden:
            x = layer(functional.gelu(x))
        return self.colour(functional.gelu(x)).float().sigmoid()


def _sinusoids(direction: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n c"]:
    """Directions, and their sines and cosines octave by octave."""
    octave = math.pi * 2.0 ** torch.arange(DIRECTION_OCTAVES, device=direction.device)
    angle = (direction[..., None] * octave).flatten(-2)
    return torch.cat([direction, angle.sin(), angle.cos()], dim=-1)
