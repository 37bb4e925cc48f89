"""The motion decoder: displacements of every pixel's point to the camera's previous and next frame (section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nurec_sim.network.attention import LayerScale, Mlp, Rope, SelfAttention
from nurec_sim.network.dpt import DptHead
from nurec_sim.network.encoder import Features, local_positions, resampled_positions
from nurec_sim.network.profiles import Profile
from nurec_sim.network.tensors import SCENE_RESCALE

LONGEST_PERIOD = 500.0


class TimeEmbedding(nn.Module):
    """A time in 0..1 as sinusoids, transformed."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.channels = channels
        self.mlp = nn.Sequential(nn.Linear(channels, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, time: Float[Tensor, "*n"]) -> Float[Tensor, "*n c"]:
        """Embedded times."""
        half = self.channels // 2
        power = torch.arange(half, device=time.device, dtype=torch.float32) / half
        # The base is a period of 500, although times lie in 0..1: as in the checkpoints, cosines first.
        angle = time.float()[..., None] * LONGEST_PERIOD**-power
        return self.mlp(torch.cat([angle.cos(), angle.sin()], dim=-1))


class ModulatedBlock(nn.Module):
    """A transformer block whose attention is shifted, scaled and gated by a condition (AdaLN, paper section 3.3)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=1e-6, elementwise_affine=False)
        self.attn = SelfAttention(width, heads, normed=True)
        self.ls1 = LayerScale(width, 1.0)
        self.norm2 = nn.LayerNorm(width, eps=1e-6)
        self.mlp = Mlp(width, 4 * width, width)
        self.ls2 = LayerScale(width, 1.0)
        self.modulation = nn.Linear(width, 3 * width)

    def forward(self, x: Float[Tensor, "n t c"], condition: Float[Tensor, "n c"], rope: Rope) -> Float[Tensor, "n t c"]:
        """Tokens after the block."""
        # Peebles and Xie 2023; the feed-forward half stays unconditioned, as in the checkpoints.
        shift, scale, gate = self.modulation(functional.silu(condition))[:, None].chunk(3, dim=-1)
        # AdaLN: the norm has no affine part of its own; scale and shift come from the target times instead.
        x = x + gate * self.ls1(self.attn(self.norm1(x) * (1 + scale) + shift, rope))
        return x + self.ls2(self.mlp(self.norm2(x)))


class MotionTransformer(nn.Module):
    """One modulated block over the tokens of single images; it has no class tokens of its own (empty parameters)."""

    def __init__(self, width: int, heads: int, grid: int) -> None:
        super().__init__()
        self.heads = heads
        self.cls_tokens = nn.Parameter(torch.zeros(0, width))
        self.cls_pos_embed = nn.Parameter(torch.zeros(0, width))
        self.img_pos_embed = nn.Parameter(torch.zeros(grid, grid, width))
        self.norm_layer = nn.LayerNorm(width)
        self.blocks = nn.ModuleList([ModulatedBlock(width, heads)])

    def forward(
        self, patches: Float[Tensor, "n y x c"], extra: Float[Tensor, "n e c"], condition: Float[Tensor, "n c"]
    ) -> Float[Tensor, "n y x d"]:
        """The patches' states, then the same normed, side by side."""
        n, rows, columns, width = patches.shape
        patches = patches + resampled_positions(self.img_pos_embed, rows, columns)
        x = torch.cat([extra.to(patches.dtype), patches.reshape(n, -1, width)], dim=1)
        rope = Rope(local_positions(rows, columns, extra.shape[1], x.device), width // self.heads)
        for block in self.blocks:
            x = block(x, condition, rope)
        x = x[:, extra.shape[1] :]
        return torch.cat([x, self.norm_layer(x).to(x.dtype)], dim=-1).reshape(n, rows, columns, -1)


class MotionDecoder(nn.Module):
    """Displacements of every pixel's point to two other times, from the features shared across images."""

    def __init__(self, profile: Profile) -> None:
        super().__init__()
        width, channels = profile.encoder.width, profile.motion.time_channels
        self.vit = MotionTransformer(width, profile.encoder.heads, profile.encoder.position_grid)
        self.source_time_embed = TimeEmbedding(channels, width)
        self.source_time_norm = nn.LayerNorm(width)
        self.target_time_embed = TimeEmbedding(channels, width // 2)
        self.final_motion_head = DptHead(2 * width, profile.head, out=6)
        self.cls_token_norm = nn.LayerNorm(width)

    def forward(
        self,
        features: Sequence[Features],
        image_size: tuple[int, int],
        time: Float[Tensor, "b v"],
        time_before: Float[Tensor, "b v"],
        time_after: Float[Tensor, "b v"],
    ) -> Float[Tensor, "b v h w 2 3"]:
        """Displacements to the times before and after, in metres, in the scene frame.

        Args:
            features: four levels of the encoder.
            image_size: height and width.
            time: of each image, as a fraction of the chunk.
            time_before: the time of the camera's last frame.
            time_after: that of its next one.
        """
        source = self.source_time_norm(self.source_time_embed(time.flatten()))
        # Half of the condition's channels for each of the two times that displacements lead to.
        targets = self.target_time_embed(torch.stack([time_before.flatten(), time_after.flatten()], dim=-1)).flatten(-2)
        levels = []
        # Motion shows only between images, so the local half of the features is left out; weights are shared by all
        # levels.
        for level in (feature.merged for feature in features):
            token = self.cls_token_norm(level.token.flatten(0, 1))
            # The source time is a token, the target times a condition: together they tell which motion to predict.
            extra = torch.stack([token, source.to(token.dtype)], dim=1)
            levels.append(self.vit(level.patches.flatten(0, 1), extra, targets))
        raw = self.final_motion_head(levels, image_size)
        metres = raw.permute(0, 2, 3, 1).unflatten(-1, (2, 3)) / SCENE_RESCALE
        return metres.unflatten(0, time.shape)
