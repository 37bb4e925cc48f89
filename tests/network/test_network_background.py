"""What lies behind the surfaces that images see."""

import numpy as np
import torch

from nurec_sim.network.sky.background import background
from nurec_sim.network.sky.cubemap import coordinates, directions


def test_directions_that_were_looked_at_get_the_mean_of_what_was_seen():
    ahead = directions(32)[4].reshape(-1, 3)
    rays, colour = torch.cat([ahead, ahead]), torch.cat([torch.full((1024, 3), 0.2), torch.full((1024, 3), 0.6)])
    mean, covered = background(colour, rays, 32)
    assert mean.shape == (6, 32, 32, 3) and covered.shape == (6, 32, 32) and mean.dtype == covered.dtype == np.float32
    assert (covered[4] == 1).all() and not covered[[0, 1, 2, 3, 5]].any()
    assert np.allclose(mean[4], 0.4, atol=1e-6) and np.isfinite(mean).all()


def test_gaps_between_the_pixels_of_a_coarse_image_are_closed():
    coarse = directions(24)[0].reshape(-1, 3)
    mean, covered = background(torch.full((len(coarse), 3), 0.3), coarse, 64)
    assert (covered[0] == 1).mean() > 0.6
    fine = directions(48)[0].reshape(-1, 3)
    mean, covered = background(torch.full((len(fine), 3), 0.3), fine, 64)
    assert (covered[0] == 1).all() and np.allclose(mean[0], 0.3, atol=1e-6)


def test_nothing_seen_covers_nothing_and_the_order_of_pixels_does_not_matter():
    mean, covered = background(torch.zeros(0, 3), torch.zeros(0, 3), 8)
    assert not covered.any() and not mean.any()
    rays, colour = torch.randn(5000, 3), torch.rand(5000, 3)
    first, again = background(colour, rays, 16), background(colour.flip(0), rays.flip(0), 16)
    assert all(one.tobytes() == other.tobytes() for one, other in zip(first, again, strict=True))
    assert set(coordinates(rays)[0].tolist()) == set(range(6))
