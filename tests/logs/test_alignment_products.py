"""Normal equations of many points, against dense matrices."""

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy import sparse

from nurec_sim.logs.alignment.products import Rows, add_products, median_apart, solved

GROUP = np.random.default_rng(4).permutation(np.arange(200) % 30)


@pytest.fixture
def rows():
    rng = np.random.default_rng(0)
    low = rng.integers(0, 5, (200, 1))
    columns = np.concatenate([low, low + 1, 6 + 2 * low, 17 + 0 * low], axis=1)
    values = rng.normal(size=columns.shape)
    values[::3, 1] = 0.0
    return Rows(values, columns, 18, GROUP)


@pytest.fixture
def weight():
    return np.random.default_rng(1).uniform(0.1, 1.0, 200)


def test_products_are_those_of_the_dense_matrix(rows, weight):
    dense = rows.matrix.toarray()
    np.testing.assert_allclose(rows.products(weight), np.tril(dense.T @ (weight[:, None] * dense)), atol=1e-12)


def test_a_row_may_name_a_column_twice():
    rows = Rows(np.array([[2.0, 3.0]]), np.array([[1, 1]]), 2, np.array([0]))
    np.testing.assert_allclose(rows.products(np.array([10.0])), [[0.0, 0.0], [0.0, 250.0]])


def test_means_are_those_of_the_rows_of_a_group(rows, weight):
    total = np.bincount(GROUP, weight)
    found, dense = rows.means(weight, total), rows.matrix.toarray()
    for number in range(30):
        own = number == GROUP
        expected = np.average(dense[own], axis=0, weights=weight[own])
        np.testing.assert_allclose(found[number].toarray()[0], expected, atol=1e-12)
    assert (np.diff(found.indptr) > 0).all() and found.has_sorted_indices


def test_products_of_sparse_rows_are_added():
    rng = np.random.default_rng(2)
    rows, weight = sparse.random(50, 12, 0.3, "csr", rng=rng), rng.normal(size=50)
    rows.sort_indices()
    total = np.tril(rng.normal(size=(12, 12)))
    expected = total + np.tril((rows.T @ sparse.diags(weight) @ rows).toarray())
    add_products(total, rows, weight)
    np.testing.assert_allclose(total, expected, atol=1e-12)


@pytest.mark.parametrize("size", [1, 20, 64, 65, 300])
def test_equations_are_solved_from_the_lower_triangle(size):
    rng = np.random.default_rng(3)
    root, right = rng.normal(size=(size, size)), rng.normal(size=size)
    matrix = root @ root.T + np.eye(size)
    np.testing.assert_allclose(solved(np.tril(matrix), right), np.linalg.solve(matrix, right), rtol=1e-9)


def test_equations_have_the_same_solution_whatever_the_number_of_threads():
    code = """
import sys, numpy as np
from nurec_sim.logs.alignment.products import solved
root = np.random.default_rng(3).normal(size=(500, 20))
sys.stdout.buffer.write(solved(np.einsum("ik,jk->ij", root, root) + np.eye(500), root[:, 0]).tobytes())
"""
    found = {
        subprocess.run(
            [sys.executable, "-c", code], env=os.environ | {"OPENBLAS_NUM_THREADS": threads}, stdout=-1, check=True
        ).stdout
        for threads in ("1", "2")
    }
    assert len(found) == 1


def test_points_are_apart_from_the_median_of_their_group():
    # Medians 2 and 6; distances 1, 0, 2 and 1, 1.
    assert median_apart(np.array([1.0, 5.0, 2.0, 7.0, 4.0]), np.array([0, 1, 0, 1, 0])) == 1.0
    assert median_apart(np.array([3.0, 3.0, 9.0]), np.array([0, 1, 0])) == 3.0
