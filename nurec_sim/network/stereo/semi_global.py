"""Semi-global matching of tensors: neighbours agree on their depth unless there is an edge (``paths``).

Four directions, along the rows and the columns.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nurec_sim.network.stereo.paths import add_paths, brightness_steps

SMALL_STEP, LARGE_STEP = 0.05, 2.0
"""Default penalties for moving to the adjacent depth, and to any other, from a pixel to its neighbour."""
EDGE = 40.0
"""How much cheaper a large step is where the brightness (0..1) changes."""


def semi_global(
    cost: Float[Tensor, "d h w"], guide: Float[Tensor, "h w"], small: float = SMALL_STEP, large: float = LARGE_STEP
) -> Float[Tensor, "d h w"]:
    """Cost volume smoothed by semi-global matching along the rows and the columns, both ways.

    Args:
        cost: of each pixel alone; about 0..1.
        guide: brightness 0..1, whose edges are likely those of the depth.
        small: penalty for moving to the adjacent depth, from a pixel to its neighbour.
        large: penalty for moving to any other depth.
    """
    if cost.device.type == "cpu" and cost.dtype == torch.float32:
        return _on_cpu(cost, guide, small, large)
    across = _summed_by_torch(cost.permute(2, 0, 1), guide.T, small, large)
    down = _summed_by_torch(cost.permute(1, 0, 2), guide, small, large)
    return (across.permute(1, 2, 0) + down.permute(1, 0, 2)) / 4


def _on_cpu(
    cost: Float[Tensor, "d h w"], guide: Float[Tensor, "h w"], small: float, large: float
) -> Float[Tensor, "d h w"]:
    """The sums by a compiled kernel; to the bit those of ``_summed_by_torch``."""
    # Depths innermost: the kernel runs along them, so they should be contiguous.
    volume, brightness = cost.permute(1, 2, 0).contiguous().numpy(), guide.float().numpy()
    across, down = np.zeros_like(volume), np.zeros_like(volume)
    for total, dy, dx in ((across, 0, 1), (across, 0, -1), (down, 1, 0), (down, -1, 0)):
        jump = small + large / (1 + EDGE * brightness_steps(brightness, dy, dx))
        add_paths(volume, jump[None], np.float32(small), np.array([[dy, dx]]), total)
    return torch.from_numpy((across + down) / 4).permute(2, 0, 1)


def _summed_by_torch(
    cost: Float[Tensor, "length d m"], guide: Float[Tensor, "length m"], small: float, large: float
) -> Float[Tensor, "length d m"]:
    """The sums of ``paths.add_paths`` in both directions along the first axis, on any device."""
    jump = small + large / (1 + EDGE * (guide[1:] - guide[:-1]).abs())
    total = torch.zeros_like(cost)
    for order, jumps in ((range(len(cost)), jump), (range(len(cost) - 1, -1, -1), jump.flip(0))):
        before: Tensor | None = None
        for number, place in enumerate(order):
            now = cost[place]
            if before is not None:
                now = now + _carried(before, jumps[number - 1], small)
            total[place] += now
            before = now
    return total


def _carried(before: Float[Tensor, "d m"], jump: Float[Tensor, " m"], small: float) -> Float[Tensor, "d m"]:
    """Least cost of getting to each depth from the pixel before."""
    least = before.amin(0)
    carried = torch.minimum(before, least + jump)
    carried[1:] = torch.minimum(carried[1:], before[:-1] + small)
    carried[:-1] = torch.minimum(carried[:-1], before[1:] + small)
    # Without subtracting the minimum, sums would grow along the path (Hirschmueller 2008, after equation 13).
    return carried - least
