"""The learned sky decoder: cubemap texels attend to the features of the images that saw them (paper section 3.3)."""

from __future__ import annotations

import abc
import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nurec_sim.network.attention import KeyValueProjector, QueryBlock
from nurec_sim.network.dpt import Fusion, Reassemble
from nurec_sim.network.encoder import PatchEmbedding, normalized
from nurec_sim.network.profiles import HeadSize, Profile, SkySize
from nurec_sim.network.sky import cubemap

RAY_OCTAVES = 8


class RayEmbedding(nn.Module):
    """Patches of ray directions as tokens: sines and cosines of eight octaves per axis."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.ray_embed = PatchEmbedding(width, 3 * 2 * RAY_OCTAVES, normed=True)

    def forward(self, direction: Float[Tensor, "n h w 3"]) -> Float[Tensor, "n y x c"]:
        """Tokens by row and column."""
        # NeRF octaves 2^0..2^7 times pi, per axis [sin.., cos..]: the order of the checkpoints.
        octave = math.pi * 2.0 ** torch.arange(RAY_OCTAVES, device=direction.device)
        angle = direction[..., None] * octave
        return self.ray_embed(torch.cat([angle.sin(), angle.cos()], dim=-1).flatten(-2))


class SkyUpsampling(nn.Module):
    """One feature level, used for all four, fused to the cubemap's resolution."""

    def __init__(self, size: SkySize, head: HeadSize) -> None:
        super().__init__()
        levels = HeadSize(size.levels, head.fused, head.last)
        self.reassemble = Reassemble(size.width, levels)
        self.decode_head = Fusion(levels, out=3)

    def forward(self, feature: Float[Tensor, "n y x c"], edge_px: int) -> Float[Tensor, "n 3 e e"]:
        """Faces of the cubemap, not yet in 0..1."""
        return self.decode_head(self.reassemble([feature] * 4, 1.0), (edge_px, edge_px))


class SkyQueries(nn.Module, abc.ABC):
    """Shared by both sky decoders: the directions of the cubemap, and image tokens with their rays."""

    query_rays: Tensor
    kv_projector: KeyValueProjector

    def __init__(self, profile: Profile, size: SkySize, stored: bool) -> None:
        super().__init__()
        self.size = size
        self.token = nn.Parameter(torch.zeros(size.width))
        self.register_buffer("query_rays", cubemap.directions(size.cubemap_px), persistent=stored)
        self.feature_transform = nn.Sequential(
            nn.Linear(2 * profile.encoder.width, size.width), nn.LayerNorm(size.width)
        )
        self.patch_embed_img = PatchEmbedding(size.width, normed=True)
        self.patch_embed_ray = RayEmbedding(size.width)

    def set_constants(self) -> None:
        """Compute the directions again, where the module was built without values."""
        self.query_rays.copy_(cubemap.directions(self.size.cubemap_px, self.query_rays.device))

    def forward(
        self,
        patches: Float[Tensor, "b v y x c"],
        rgb: Float[Tensor, "b v h w 3"],
        directions: Float[Tensor, "b v h w 3"],
    ) -> Float[Tensor, "b 6 s s 3"]:
        """The sky in the frame of the directions, 0..1."""
        # A token per patch of the clip: encoder features, colours and ray directions, added up.
        tokens = self.feature_transform(patches).flatten(0, 1)
        tokens = tokens + self.patch_embed_img(normalized(rgb.flatten(0, 1)))
        tokens = tokens + self.patch_embed_ray(directions.flatten(0, 1))
        return self.decode(*self.kv_projector(tokens.reshape(len(rgb), -1, self.size.width)))

    @abc.abstractmethod
    def decode(
        self, k: Float[Tensor, "b heads m d"], values: Float[Tensor, "b heads m d"]
    ) -> Float[Tensor, "b 6 s s 3"]:
        """The sky from keys and values of the clip's patches."""


class SkyDecoder(SkyQueries):
    """Colours of all directions, from the encoder's deepest features, the images and their rays."""

    def __init__(self, profile: Profile, size: SkySize) -> None:
        super().__init__(profile, size, profile.training_buffers)
        self.blocks = nn.ModuleList(QueryBlock(size.width, size.heads, scale=1.0) for _ in range(size.depth))
        self.kv_projector = KeyValueProjector(size.width, size.heads, normed=True)
        self.upsample = SkyUpsampling(size, profile.head)

    def decode(
        self, k: Float[Tensor, "b heads m d"], values: Float[Tensor, "b heads m d"]
    ) -> Float[Tensor, "b 6 s s 3"]:
        """The sky from keys and values of the clip's patches."""
        b = len(k)
        # Texels and image patches share one ray embedding, so a texel finds the patches that look in its direction.
        query = self.patch_embed_ray(self.query_rays) + self.token
        x = query.reshape(1, -1, self.size.width).expand(b, -1, -1)
        for block in self.blocks:
            x = block(x, k, values)
        faces = self.upsample(x.reshape(b * 6, *query.shape[1:]), self.size.cubemap_px).float()
        # A clamp, not a sigmoid: a saturated white sky is reached exactly.
        return (faces.clamp(-1, 1) * 0.5 + 0.5).permute(0, 2, 3, 1).unflatten(0, (b, 6))
