"""Cells of the grid of the ground, and heights above it, by hand."""

import numpy as np
import pytest

from nurec_sim.reconstruct.lift.ground import Ground


@pytest.fixture
def ground() -> Ground:
    """Two rows of three cells of half a metre from x = 1, y = -1 on; the last cell of the first row is not known."""
    height = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]], np.float32)
    near = np.array([[True, True, False], [True, True, True]])
    return Ground(np.array([1.0, -1.0]), 0.5, height, near, near, near, np.ones((2, 3), np.uint8))


@pytest.mark.parametrize(
    ("xyz", "row", "column", "inside", "above"),
    [
        ((1.0, -1.0, 1.0), 0, 0, True, 0.9),
        ((1.6, -0.4, 0.0), 1, 1, True, -0.5),
        ((2.4, -0.9, 1.0), 0, 2, True, np.inf),
        ((0.99, -0.6, 1.0), 0, 0, False, np.inf),
        ((2.5, 7.0, 1.0), 1, 2, False, np.inf),
        ((1.2, -1.01, 1.0), 0, 0, False, np.inf),
    ],
)
def test_cells_of_points_and_their_heights(ground, xyz, row, column, inside, above):
    points = np.array([xyz])
    assert [each[0] for each in ground.cells(points)] == [row, column, inside]
    assert ground.above(points)[0] == pytest.approx(above, abs=1e-6)
