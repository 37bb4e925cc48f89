"""Semi-global matching: neighbours agree, edges may differ, and the fast path gives the bytes of the other one."""

import numpy as np
import pytest
import torch

from nurec_sim.network.stereo.semi_global import _summed, _summed_by_torch, semi_global


@pytest.mark.parametrize("shape", [(1, 3, 4), (2, 1, 5), (17, 2, 3), (40, 48, 33)])
def test_the_compiled_sums_are_those_of_torch_to_the_bit(shape):
    rng = np.random.default_rng(0)
    cost = rng.random(shape, np.float32)
    jump = (0.05 + rng.random((shape[0] - 1, shape[2]))).astype(np.float32)
    expected = _summed_by_torch(torch.from_numpy(cost), torch.from_numpy(jump), 0.05)
    assert _summed(cost, jump, np.float32(0.05)).tobytes() == expected.numpy().tobytes()


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
