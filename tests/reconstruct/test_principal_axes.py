"""Principal axes against ``np.linalg.eigh``."""

import numpy as np
import pytest

from nurec_sim.reconstruct.lift.principal_axes import principal_axes


@pytest.mark.parametrize("flatness", [1.0, 1e-3, 1e-9])
def test_axes_and_variances_are_those_of_eigh(flatness):
    """Of round neighbourhoods, of planes and of nearly perfect ones, turned in any way."""
    random = np.random.default_rng(0)
    turn, _ = np.linalg.qr(random.normal(size=(500, 3, 3)))
    variance = random.uniform(0.01, 1, (500, 3)) * (flatness, 1, 3)
    matrices = np.einsum("nij,nj,nkj->nik", turn, variance, turn)
    matrices = (matrices + np.swapaxes(matrices, 1, 2)) / 2
    values, axes = principal_axes(matrices)
    expected, vectors = np.linalg.eigh(matrices)
    np.testing.assert_allclose(values, expected, rtol=1e-9, atol=1e-14)
    assert (np.diff(values, axis=1) >= 0).all()
    np.testing.assert_allclose(np.swapaxes(axes, 1, 2) @ axes, np.tile(np.eye(3), (500, 1, 1)), atol=1e-12)
    gap = np.diff(expected, axis=1).min(axis=1) > 1e-3
    alike = np.abs(np.sum(axes * vectors, axis=1))[gap]
    np.testing.assert_allclose(alike, 1.0, atol=1e-9)


def test_axes_of_lines_of_single_points_and_of_equal_variances():
    line, diagonal = np.outer([1.0, 2.0, 2.0], [1.0, 2.0, 2.0]), np.diag([3.0, 1.0, 2.0])
    values, axes = principal_axes(np.stack([line, diagonal, np.zeros((3, 3)), np.eye(3)]))
    np.testing.assert_allclose(values, [[0, 0, 9], [1, 2, 3], [0, 0, 0], [1, 1, 1]], atol=1e-12)
    np.testing.assert_allclose(np.abs(axes[0, :, 2]), [1 / 3, 2 / 3, 2 / 3])
    np.testing.assert_array_equal(axes[1], [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(axes[2], np.eye(3))
