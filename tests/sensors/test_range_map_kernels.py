"""Kernels of range maps against the plain formulas."""

import numpy as np
import pytest

from nurec_sim.sensors.range_map_kernels import BLOCK, LEAST_ANGLE_RAD, ROUNDS, cone_apex, phase_sums


def test_the_apex_of_a_cone_is_that_of_reweighted_least_squares():
    random = np.random.default_rng(1)
    across = random.uniform(3, 60, 2 * BLOCK + 100)
    height = 0.21 - 0.13 * across + random.normal(0, 2e-3, len(across)) * across
    weight = 1 / across
    for _ in range(ROUNDS):
        design = np.stack([weight, weight * across], axis=1)
        apex, slope = np.linalg.lstsq(design, weight * height, rcond=None)[0]
        off = np.abs(height - apex - slope * across) / across
        weight = 1 / across / np.sqrt(np.maximum(off, LEAST_ANGLE_RAD))
    assert cone_apex(height, across) == pytest.approx(apex, abs=1e-11)
    assert cone_apex(0.21 - 0.13 * across, across) == pytest.approx(0.21, abs=1e-11)


def test_phases_are_summed_by_row_and_sector():
    random = np.random.default_rng(2)
    rows, sectors, span = 3, 8, 6.3
    row, column = random.integers(0, rows, 5000), random.uniform(-3, 2000, 5000)
    # Every eighth of a turn, and angles beyond both ends.
    column[:17], turned = np.arange(-8, 9) / 8, random.uniform(-0.1, 6.4, 5000)
    cell = row * sectors + np.clip(turned / span * sectors, 0, sectors - 1).astype(int)
    wanted = [np.bincount(cell, f(2 * np.pi * column), rows * sectors) for f in (np.cos, np.sin)]
    np.testing.assert_allclose(phase_sums(row, turned, column, span, rows, sectors), wanted, atol=1e-9)
    one = phase_sums(np.zeros(1, np.int64), np.zeros(1), np.array([1 / 12]), span, 1, 1)
    np.testing.assert_allclose(one, [[np.sqrt(0.75)], [0.5]], atol=1e-15)
