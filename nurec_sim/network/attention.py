"""Transformer parts that the encoder and the decoders share: attention, rotary positions, feed-forward layers.

Tokens are ``[b, n, c]``. Module and parameter names are those of the released checkpoints.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional

ROPE_BASE = 100.0


class LayerScale(nn.Module):
    """One learned factor per channel (Touvron et al. 2021): small at first, deep networks begin as identities."""

    def __init__(self, width: int, initial: float) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.full((width,), initial))

    def forward(self, x: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
        """Scaled tokens."""
        return x * self.gamma


class Mlp(nn.Module):
    """Linear, exact GELU, linear."""

    def __init__(self, width: int, hidden: int, out: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.fc2 = nn.Linear(hidden, out)

    def forward(self, x: Float[Tensor, "*n c"]) -> Float[Tensor, "*n d"]:
        """Transformed tokens."""
        return self.fc2(functional.gelu(self.fc1(x)))


class Rope:
    """Rotary positions in two dimensions: half of each head's channels encode y, the other half x.

    Args:
        positions: (y, x) of every token, in patches.
        head_width: channels of one head, a multiple of 4.
    """

    def __init__(self, positions: Int64[Tensor, "n 2"], head_width: int) -> None:
        axis = head_width // 2
        # Su et al. 2021, for each axis by itself: channel pair k turns by position * base^(-2k / axis), so that the dot
        # product of a query and a key depends on how far apart they are, not on where they are.
        power = torch.arange(0, axis, 2, device=positions.device, dtype=torch.float32) / axis
        angle = positions.to(torch.float32)[:, :, None] * ROPE_BASE**-power  # [n, 2, axis / 2]
        angle = torch.cat([angle, angle], dim=-1)
        self.cos, self.sin = angle.cos(), angle.sin()

    def __call__(self, x: Float[Tensor, "b heads n c"]) -> Float[Tensor, "b heads n c"]:
        """Queries or keys turned by their positions."""
        # [.., axis (y, x), channels of the axis]; pairs are (k, k + half), as in the checkpoints, not neighbours.
        halves = x.unflatten(-1, (2, -1))
        first, second = halves.chunk(2, dim=-1)
        turned = halves * self.cos + torch.cat([-second, first], dim=-1) * self.sin
        return turned.flatten(-2)


class SelfAttention(nn.Module):
    """Multi-head self-attention, with normalised queries and keys if ``normed``."""

    def __init__(self, width: int, heads: int, normed: bool) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        if normed:
            self.q_norm = nn.LayerNorm(width // heads)
            self.k_norm = nn.LayerNorm(width // heads)
        self.normed = normed
        self.proj = nn.Linear(width, width)

    def forward(self, x: Float[Tensor, "b n c"], rope: Rope | None = None) -> Float[Tensor, "b n c"]:
        """Attended tokens."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        if self.normed:
            # QK-norm (paper section 3.3, "for stability"): logits cannot grow beyond half precision. Norms come before
            # RoPE, as rotations keep lengths.
            q, k = self.q_norm(q), self.k_norm(k)
        if rope is not None:
            q, k = rope(q), rope(k)
        # Norms and rotations come out in float32 where the rest runs in half precision.
        attended = functional.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v)
        return self.proj(attended.transpose(1, 2).flatten(-2))


class KeyValueProjector(nn.Module):
    """Keys and values of what is attended to; computed once and shared by all cross-attentions."""

    def __init__(self, width: int, heads: int, normed: bool) -> None:
        super().__init__()
        self.heads, self.normed = heads, normed
        # One projection for all blocks: keys and values of thousands of patches are computed once, not per block.
        self.to_k = nn.Linear(width, width)
        self.to_v = nn.Linear(width, width)
        if normed:
            self.k_norm = nn.LayerNorm(width // heads)

    def forward(self, x: Float[Tensor, "b m c"]) -> tuple[Float[Tensor, "b heads m d"], Float[Tensor, "b heads m d"]]:
        """Keys and values by head."""
        k, v = (part(x).unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in (self.to_k, self.to_v))
        return (self.k_norm(k).to(v.dtype) if self.normed else k), v


class CrossAttention(nn.Module):
    """Multi-head attention of queries to keys and values; with ``own_keys`` it holds the projector that makes them."""

    def __init__(self, width: int, heads: int, normed: bool, own_keys: bool = False) -> None:
        super().__init__()
        self.heads, self.normed = heads, normed
        if own_keys:
            self.kv_projector = KeyValueProjector(width, heads, normed)
        self.to_q = nn.Linear(width, width)
        if normed:
            self.q_norm = nn.LayerNorm(width // heads)
        self.proj = nn.Linear(width, width)

    def forward(
        self, x: Float[Tensor, "b n c"], k: Float[Tensor, "b heads m d"], v: Float[Tensor, "b heads m d"]
    ) -> Float[Tensor, "b n c"]:
        """What the queries gather."""
        q = self.to_q(x).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        if self.normed:
            q = self.q_norm(q).to(v.dtype)
        # Queries have no positions here: where a query lies is part of its token.
        return self.proj(functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(-2))


class SelfBlock(nn.Module):
    """A transformer block: attention, then feed-forward, each normed before and scaled after."""

    def __init__(self, width: int, heads: int, normed: bool, eps: float, scale: float) -> None:
        super().__init__()
        # Pre-norm (Xiong et al. 2020): the residual path stays free of norms, which keeps deep stacks stable.
        self.norm1 = nn.LayerNorm(width, eps=eps)
        self.attn = SelfAttention(width, heads, normed)
        self.ls1 = LayerScale(width, scale)
        self.norm2 = nn.LayerNorm(width, eps=eps)
        self.mlp = Mlp(width, 4 * width, width)
        self.ls2 = LayerScale(width, scale)

    def forward(self, x: Float[Tensor, "b n c"], rope: Rope | None = None) -> Float[Tensor, "b n c"]:
        """Tokens after the block."""
        x = x + self.ls1(self.attn(self.norm1(x), rope))
        return x + self.ls2(self.mlp(self.norm2(x)))


class QueryBlock(nn.Module):
    """A decoder block: queries attend to the features, then to each other, then pass through an MLP."""

    def __init__(self, width: int, heads: int, scale: float) -> None:
        super().__init__()
        self.ca_norm = nn.LayerNorm(width)
        self.ca = CrossAttention(width, heads, normed=True)
        self.ls_ca = LayerScale(width, scale)
        self.sa_norm = nn.LayerNorm(width)
        self.sa = SelfAttention(width, heads, normed=True)
        self.ls_sa = LayerScale(width, scale)
        self.mlp_norm = nn.LayerNorm(width)
        self.mlp = Mlp(width, 4 * width, width)
        self.ls_mlp = LayerScale(width, scale)

    def forward(
        self, x: Float[Tensor, "b n c"], k: Float[Tensor, "b heads m d"], v: Float[Tensor, "b heads m d"]
    ) -> Float[Tensor, "b n c"]:
        """Queries after the block."""
        # The order of the release: cross-attention, self-attention among all queries of all images, MLP.
        x = x + self.ls_ca(self.ca(self.ca_norm(x), k, v))
        x = x + self.ls_sa(self.sa(self.sa_norm(x)))
        return x + self.ls_mlp(self.mlp(self.mlp_norm(x)))
