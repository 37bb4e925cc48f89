"""Semi-global matching: costs of depths summed along lines, so that neighbours agree unless there is an edge.

Hirschmueller, Stereo Processing by Semiglobal Matching and Mutual Information (2008), with four directions.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from nurec_sim.compute.kernels import kernel

SMALL_STEP, LARGE_STEP = 0.05, 2.0
"""What it costs to go to the next depth, and to any other, from a pixel to its neighbour; if nothing else is said."""
EDGE = 40.0
"""How much cheaper a large step is where the brightness (0..1) changes."""


def semi_global(
    cost: Float[Tensor, "d h w"], guide: Float[Tensor, "h w"], small: float = SMALL_STEP, large: float = LARGE_STEP
) -> Float[Tensor, "d h w"]:
    """Cost of each pixel's depths with what its neighbours along the row and the column would have to pay.

    Args:
        cost: of each pixel alone; about 0..1.
        guide: brightness 0..1, whose edges are likely those of the depth.
        small: what it costs to go to the next depth, from a pixel to its neighbour.
        large: what it costs to go to any other.
    """
    across = _along(cost.permute(2, 0, 1), guide.T, small, large)
    down = _along(cost.permute(1, 0, 2), guide, small, large)
    return (across.permute(1, 2, 0) + down.permute(1, 0, 2)) / 4


def _along(
    cost: Float[Tensor, "length d m"], guide: Float[Tensor, "length m"], small: float, large: float
) -> Float[Tensor, "length d m"]:
    """The sum of both directions along the first axis."""
    cost = cost.contiguous()
    jump = small + large / (1 + EDGE * (guide[1:] - guide[:-1]).abs())
    if cost.device.type == "cpu" and cost.dtype == torch.float32:
        return torch.from_numpy(_summed(cost.numpy(), jump.contiguous().numpy(), np.float32(small)))
    return _summed_by_torch(cost, jump, small)


def _summed_by_torch(
    cost: Float[Tensor, "length d m"], jump: Float[Tensor, "length-1 m"], small: float
) -> Float[Tensor, "length d m"]:
    """``_summed`` on any device."""
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
    return carried - least


@kernel
def _summed(
    cost: Float32[np.ndarray, "length d m"], jump: Float32[np.ndarray, "length-1 m"], small: np.float32
) -> Float32[np.ndarray, "length d m"]:
    """Costs summed along the first axis in both directions; to the bit as ``_summed_by_torch``."""
    length, depths, width = cost.shape
    total = np.zeros_like(cost)
    before, now, least = np.empty_like(cost[0]), np.empty_like(cost[0]), np.empty(width, np.float32)
    for backwards in (False, True):
        for number in range(length):
            place = length - 1 - number if backwards else number
            now[:] = cost[place]
            if number:
                jumps = jump[place] if backwards else jump[place - 1]
                least[:] = before[0]
                for d in range(1, depths):
                    for m in range(width):
                        least[m] = min(least[m], before[d, m])
                for d in range(depths):
                    nearer, farther = before[max(d - 1, 0)], before[min(d + 1, depths - 1)]
                    for m in range(width):
                        carried = min(before[d, m], least[m] + jumps[m])
                        if d > 0:
                            carried = min(carried, nearer[m] + small)
                        if d < depths - 1:
                            carried = min(carried, farther[m] + small)
                        now[d, m] += carried - least[m]
            total[place] += now
            before, now = now, before
    return total
