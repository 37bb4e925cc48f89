"""A sky without a cubemap decoder, as in STORM: one token per clip, and an MLP from direction to colour.

It replaces ``learned`` in the paper's ablation (section 5.3, Table 2). The token attends to what the sky decoder
attends to; only the decoding of colours differs.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nurec_sim.network.attention import CrossAttention, KeyValueProjector
from nurec_sim.network.profiles import Profile, SkySize
from nurec_sim.network.sky.learned import SkyQueries

DIRECTION_OCTAVES = 4
"""Of the sines and cosines that code a direction, as in NeRF (Mildenhall et al. 2020)."""
HIDDEN_LAYERS = 3


class SkyMlp(SkyQueries):
    """Colours of all directions from one token; in and out as ``learned.SkyDecoder``."""

    def __init__(self, profile: Profile, size: SkySize) -> None:
        super().__init__(profile, size, stored=False)
        self.kv_projector = KeyValueProjector(size.width, size.heads, normed=True)
        self.pooling = CrossAttention(size.width, size.heads, normed=True)
        self.from_direction = nn.Linear(3 * (1 + 2 * DIRECTION_OCTAVES), size.width)
        self.from_token = nn.Linear(size.width, size.width)
        self.hidden = nn.ModuleList(nn.Linear(size.width, size.width) for _ in range(HIDDEN_LAYERS - 1))
        self.colour = nn.Linear(size.width, 3)

    def decode(
        self, k: Float[Tensor, "b heads m d"], values: Float[Tensor, "b heads m d"]
    ) -> Float[Tensor, "b 6 s s 3"]:
        """The sky from keys and values of the clip's patches."""
        token = self.token + self.pooling(self.token.expand(len(k), 1, -1), k, values)
        x = self.from_direction(_sinusoids(self.query_rays)) + self.from_token(token)[:, :, None, None]
        for layer in self.hidden:
            x = layer(functional.gelu(x))
        return self.colour(functional.gelu(x)).float().sigmoid()


def _sinusoids(direction: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n c"]:
    """Directions, and their sines and cosines octave by octave."""
    octave = math.pi * 2.0 ** torch.arange(DIRECTION_OCTAVES, device=direction.device)
    angle = (direction[..., None] * octave).flatten(-2)
    return torch.cat([direction, angle.sin(), angle.cos()], dim=-1)
