"""The street of the optimisation's tests, and what ``lift`` makes of it."""

import pytest
from fitted_street import CROSSING, SMALL, Flicker
from reconstruct_street import camera

from nurec_sim.reconstruct import reconstruct


@pytest.fixture(scope="module")
def street():
    return Flicker(frames=4, boxes=CROSSING, cameras=(camera(width=128, height=64), camera("beside", 0.5, 128, 64)))


@pytest.fixture(scope="module")
def lifted(street):
    return reconstruct(street, settings=SMALL, cameras=["front"])
