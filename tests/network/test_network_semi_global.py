"""Semi-global matching: neighbours agree, edges may differ, and the fast path gives the bytes of the other one."""

import numpy as np
import pytest
import torch

from nurec_sim.network.stereo.paths import FORWARDS, add_paths
from nurec_sim.network.stereo.semi_global import _summed_by_torch, semi_global


@pytest.mark.parametrize("shape", [(3, 1, 4), (1, 2, 5), (2, 17, 3), (48, 40, 33)])
def test_the_compiled_sums_are_those_of_torch_to_the_bit(shape):
    generator = torch.Generator().manual_seed(0)
    cost, guide = torch.rand(shape, generator=generator), torch.rand(shape[1:], generator=generator)
    across = _summed_by_torch(cost.permute(2, 0, 1), guide.T, 0.05, 2.0).permute(1, 2, 0)
    down = _summed_by_torch(cost.permute(1, 0, 2), guide, 0.05, 2.0).permute(1, 0, 2)
    assert torch.equal(semi_global(cost, guide, 0.05, 2.0), (across + down) / 4)


@pytest.mark.parametrize("directions", [*([each] for each in FORWARDS), FORWARDS])
@pytest.mark.parametrize("sign", [1, -1])
def test_paths_cost_what_the_published_recursion_says(directions, sign):
    """Equation 13 of Hirschmueller (2008), pixel by pixel; paths begin where they enter the image."""
    rng = np.random.default_rng(3)
    directions = sign * np.array(directions)
    cost, jumps, small = rng.random((5, 6, 4), np.float32), 0.3 + rng.random((len(directions), 5, 6)), 0.2
    total = np.ones_like(cost)
    add_paths(cost, jumps, small, directions, total)
    expected = sum(cost_of_path(cost, jump, small, dy, dx) for (dy, dx), jump in zip(directions, jumps, strict=True))
    np.testing.assert_allclose(total - 1, expected, atol=1e-6)


def cost_of_path(cost, jump, small, dy, dx):
    expected = np.zeros(cost.shape)
    for row in range(5)[:: dy or 1]:
        for column in range(6)[:: dx or 1]:
            expected[row, column] = cost[row, column]
            if 0 <= row - dy < 5 and 0 <= column - dx < 6:
                before = expected[row - dy, column - dx]
                for d in range(4):
                    near = [before[k] + small for k in (d - 1, d + 1) if 0 <= k < 4]
                    expected[row, column, d] += min(before[d], before.min() + jump[row, column], *near) - before.min()
    return expected


def test_a_pixel_that_fits_any_depth_takes_that_of_its_neighbours_up_to_an_edge():
    cost = torch.full((8, 12, 20), 0.5)
    cost[2, :, :10], cost[6, :, 10:] = 0.0, 0.0
    guide = torch.zeros(12, 20)
    guide[:, 10:] = 1.0
    cost[:, 5, 8:12] = 0.5  # nothing is known here
    best = semi_global(cost, guide).argmin(0)
    assert (best[:, :10] == 2).all() and (best[:, 10:] == 6).all()


def test_other_types_give_the_same_depths():
    cost, guide = torch.rand(6, 9, 11, generator=torch.Generator().manual_seed(1)), torch.zeros(9, 11)
    assert torch.equal(semi_global(cost, guide).argmin(0), semi_global(cost.double(), guide.double()).argmin(0))
