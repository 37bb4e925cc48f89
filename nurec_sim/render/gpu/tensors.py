"""Gaussians that are tensors already, as the kernels read them."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nurec_sim.render.cpu import pack
from nurec_sim.render.gpu.pipeline import SPHERE, Blocks

EVERYWHERE_M = 1e30
"""Radius of a sphere that no view can miss."""


def blocks_of(
    mean_m: Float[Tensor, "n 3"],
    quat_wxyz: Float[Tensor, "n 4"],
    scale_m: Float[Tensor, "n 3"],
    opacity: Float[Tensor, " n"],
    features: Float[Tensor, "n 3"],
    device: torch.device,
) -> Blocks:
    """Gaussians in the order in which they come; those that ``cpu.pack`` would leave out are never seen.

    Args:
        mean_m: centres in the world.
        quat_wxyz: rotations, of any length.
        scale_m: standard deviations.
        opacity: 0..1.
        features: what cameras sum as the colour, and LiDARs as intensity, whether it is known, and drop.
        device: where to.
    """
    blocks = max(1, -(-len(mean_m) // pack.BLOCK))
    parts = (mean_m, quat_wxyz, scale_m, features, opacity[:, None])
    given = torch.cat([part.detach().to(device, torch.float32) for part in parts], dim=1)
    length = given[:, 3:7].norm(dim=1)
    sound = torch.isfinite(given).all(dim=1) & (length > 1e-12)
    sound &= (given[:, 7:10] > 0).all(dim=1) & (given[:, 13] >= 1 / 255)
    # Rows that are never seen still pass through the kernels' arithmetic: finite values, opacity pack.NEVER_SEEN.
    given = torch.where(sound[:, None], given, 1.0)
    columns = torch.zeros((blocks * pack.BLOCK, pack.FIELDS), device=device)
    columns[:, pack.LOG_OPACITY] = pack.NEVER_SEEN
    columns[:, [pack.QUAT, pack.SCALE, pack.SCALE + 1, pack.SCALE + 2]] = 1
    rows = columns[: len(mean_m)]
    rows[:, pack.MEAN : pack.MEAN + 3] = given[:, 0:3]
    rows[:, pack.QUAT : pack.QUAT + 4] = given[:, 3:7] / given[:, 3:7].norm(dim=1, keepdim=True)
    rows[:, pack.SCALE : pack.SCALE + 3] = given[:, 7:10].clamp(min=pack.MIN_SCALE_M)
    rows[:, pack.COLOUR : pack.COLOUR + 3] = given[:, 10:13]
    rows[:, pack.INTENSITY : pack.INTENSITY + 3] = given[:, 10:13]
    rows[:, pack.LOG_OPACITY] = torch.where(sound, given[:, 13].clamp(max=pack.MAX_OPACITY).log(), pack.NEVER_SEEN)
    fields = columns.reshape(blocks, pack.BLOCK, pack.FIELDS).transpose(1, 2).contiguous()
    return Blocks(fields, torch.zeros((0, 0, 0), device=device), unbounded_spheres(blocks, device))


def unbounded_spheres(blocks: int, device: torch.device) -> Float[Tensor, "blocks 6"]:
    """Spheres of blocks of a single level of detail that no view can miss."""
    spheres = torch.zeros((blocks, SPHERE), device=device)
    spheres[:, 3] = EVERYWHERE_M
    # No parent.
    spheres.view(torch.int32)[:, 5] = -1
    return spheres
