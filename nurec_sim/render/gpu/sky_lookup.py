"""The sky of a differentiable image: a cubemap looked up along rays, in torch."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def sky_colour(sky: Float[Tensor, "6 s s 3"], direction: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """``spec.sky_colour``: bilinear lookup of a cubemap along world directions, clamped within a face."""
    face, s, t = cubemap_coordinates(direction)
    size = sky.shape[1]
    x, y = ((part * size - 0.5).clamp(0, size - 1) for part in (s, t))
    # The choice of texels has no gradient; the weights fx and fy carry it.
    x0, y0 = x.detach().long(), y.detach().long()
    x1, y1 = (x0 + 1).clamp(max=size - 1), (y0 + 1).clamp(max=size - 1)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    top = sky[face, y0, x0] * (1 - fx) + sky[face, y0, x1] * fx
    bottom = sky[face, y1, x0] * (1 - fx) + sky[face, y1, x1] * fx
    return top * (1 - fy) + bottom * fy


def cubemap_coordinates(direction: Float[Tensor, "h w 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """``geometry.cubemap_coordinates``: face, and column and row on it in 0..1."""
    x, y, z = -direction[..., 1], direction[..., 2], -direction[..., 0]
    ax, ay, az = x.abs(), y.abs(), z.abs()
    by_z = (az > ax) & (az > ay)
    by_y = ~by_z & (ay > ax)
    major = torch.where(by_z, az, torch.where(by_y, ay, ax)).clamp(min=1e-30)
    face = torch.where(by_z, 4 + (z <= 0).long(), torch.where(by_y, 2 + (y <= 0).long(), (x <= 0).long()))
    s = torch.where(by_z, torch.where(z > 0, x, -x), torch.where(by_y, x, torch.where(x > 0, -z, z)))
    t = torch.where(by_y, torch.where(y > 0, z, -z), -y)
    return face, (s / major + 1) / 2, (t / major + 1) / 2
