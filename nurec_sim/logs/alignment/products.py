"""Normal equations of many points, each of which depends on few of the unknowns.

Matrices of products are symmetric: only their lower triangle is computed.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64, Int64
from scipy import sparse

from nurec_sim.compute.kernels import kernel

Square = Float64[np.ndarray, "p p"]
BLOCK = 64
"""Rows and columns of the blocks that equations are solved by."""


class Rows:
    """Rows of a matrix with equally many entries each, and sums of them over groups (the planes of points).

    Args:
        values: entries of each row.
        columns: their columns.
        width: number of columns.
        group: of each row, the number of its group, counted from 0; all have rows.
    """

    def __init__(
        self,
        values: Float64[np.ndarray, "n each"],
        columns: Int64[np.ndarray, "n each"],
        width: int,
        group: Int64[np.ndarray, " n"],
    ) -> None:
        count, each = values.shape
        starts = np.arange(0, (count + 1) * each, each)
        self.matrix = sparse.csr_matrix((values.ravel(), columns.ravel(), starts), shape=(count, width))
        self._entries = self.matrix.data.reshape(count, each), self.matrix.indices.reshape(count, each)
        # Rows of the same columns follow each other, so that their products are summed before they are spread.
        self._alike = np.argsort(columns[:, 0] * width + columns[:, -1], kind="stable")
        self._by_group = np.argsort(group, kind="stable")
        self._group_starts = np.searchsorted(group[self._by_group], np.arange(group.max() + 2))
        # Where the sums have entries: half of those of level planes are zero, as such planes do not tell where they are
        # along themselves.
        layout = _entries_of_sums(self._by_group, self._group_starts, *self._entries, width)
        self._sums = sparse.csr_matrix((np.ones(len(layout[1])), layout[1], layout[0]), (len(layout[0]) - 1, width))

    def products(self, weight: Float64[np.ndarray, " n"]) -> Square:
        """``rows.T @ diag(weight) @ rows``, the lower triangle of it."""
        total = np.zeros((self.matrix.shape[1],) * 2)
        _add_alike(total, self._alike, *self._entries, weight)
        return total

    def means(self, weight: Float64[np.ndarray, " n"], total: Float64[np.ndarray, " groups"]) -> sparse.csr_matrix:
        """Weighted mean of the rows of each group.

        Args:
            weight: of each row.
            total: the sum of the weights of each group.
        """
        sums = self._sums
        layout = sums.indptr, sums.indices, sums.shape[1]
        data = _group_means(self._by_group, self._group_starts, *self._entries, weight, 1 / total, *layout)
        return sparse.csr_matrix((data, sums.indices, sums.indptr), shape=sums.shape)


def add_products(total: Square, rows: sparse.csr_matrix, weight: Float64[np.ndarray, " n"]) -> None:
    """Adds ``rows.T @ diag(weight) @ rows`` to the lower triangle of a matrix; columns of rows ascend."""
    # Indices that cannot be negative need not be tested.
    _add_sparse(total, rows.indptr, rows.indices.astype(np.uint64), rows.data, weight)


def solved(lower: Square, right: Float64[np.ndarray, " p"]) -> Float64[np.ndarray, " p"]:
    """The solution of positive definite equations whose matrix is given by its lower triangle.

    By blocks (Cholesky). Their products are too small for libraries to spread over threads, which would wait for each
    other, and sum in another order on another number of cores.
    """
    count = -(-len(right) // BLOCK)
    padded = np.eye(count * BLOCK)
    padded[: len(right), : len(right)] = lower
    columns = padded.reshape(count, BLOCK, count, BLOCK).transpose(2, 0, 1, 3).copy()
    inverses = np.empty((count, BLOCK, BLOCK))
    for j, column in enumerate(columns):
        for before in columns[:j]:
            column[j:] -= before[j:] @ before[j].T.copy()
        _invert_root(column[j], inverses[j])
        column[j + 1 :] = column[j + 1 :] @ inverses[j].T
    result = np.zeros((count, BLOCK))
    result.ravel()[: len(right)] = right
    for j, column in enumerate(columns):
        result[j] = inverses[j] @ result[j]
        result[j + 1 :] -= column[j + 1 :] @ result[j]
    for j in reversed(range(count)):
        below = columns[j, j + 1 :].transpose(0, 2, 1) @ result[j + 1 :, :, None]
        result[j] = inverses[j].T @ (result[j] - below.sum(axis=(0, 2)))
    return result.ravel()[: len(right)]


@kernel
def _invert_root(square: np.ndarray, inverse: np.ndarray) -> None:
    """Inverse of the lower triangular root of a positive definite matrix, whose lower triangle is overwritten."""
    count = len(square)
    inverse[:] = 0.0
    for j in range(count):
        square[j, j] = math.sqrt(square[j, j])
        for i in range(j + 1, count):
            square[i, j] /= square[j, j]
        for k in range(j + 1, count):
            for i in range(k, count):
                square[i, k] -= square[i, j] * square[k, j]
    for i in range(count):
        for k in range(i):
            for j in range(k + 1):
                inverse[i, j] -= square[i, k] * inverse[k, j]
        inverse[i, i] = 1.0
        for j in range(i + 1):
            inverse[i, j] /= square[i, i]


@kernel
def _add_alike(
    total: np.ndarray, order: np.ndarray, values: np.ndarray, columns: np.ndarray, weight: np.ndarray
) -> None:
    count, each = values.shape
    part = np.zeros((each, each))
    for at in range(count):
        i = order[at]
        value, column = values[i], columns[i]
        for a in range(each):
            weighted = weight[i] * value[a]
            for b in range(each):
                part[a, b] += weighted * value[b]
        alike = at + 1 < count
        if alike:
            following = columns[order[at + 1]]
            for a in range(each):
                alike &= column[a] == following[a]
        if not alike:
            for a in range(each):
                for b in range(each):
                    if column[a] >= column[b]:
                        total[column[a], column[b]] += part[a, b]
            part[:] = 0.0


@kernel
def _add_sparse(
    total: np.ndarray, starts: np.ndarray, column: np.ndarray, value: np.ndarray, weight: np.ndarray
) -> None:
    for i in range(len(weight)):
        for a in range(starts[i], starts[i + 1]):
            weighted, row = weight[i] * value[a], total[column[a]]
            for b in range(starts[i], a + 1):
                row[column[b]] += weighted * value[b]


@kernel
def _entries_of_sums(
    order: np.ndarray, groups: np.ndarray, values: np.ndarray, columns: np.ndarray, width: int
) -> tuple[Int64[np.ndarray, " groups+1"], Int64[np.ndarray, " entries"]]:
    """Columns in which a row of each group is not zero, ascending, behind where those of each group start."""
    starts, found = np.zeros(len(groups), np.int64), np.empty(values.size, np.int64)
    taken, count = np.zeros(width, np.bool_), 0
    for group in range(len(groups) - 1):
        for i in order[groups[group] : groups[group + 1]]:
            for a in range(values.shape[1]):
                if values[i, a] != 0 and not taken[columns[i, a]]:
                    taken[columns[i, a]] = True
                    found[count] = columns[i, a]
                    count += 1
        mine = found[starts[group] : count]
        mine.sort()
        for column in mine:
            taken[column] = False
        starts[group + 1] = count
    return starts, found[:count].copy()


@kernel
def _group_means(
    order: np.ndarray, groups: np.ndarray, values: np.ndarray, columns: np.ndarray, weight: np.ndarray, by: np.ndarray,
    starts: np.ndarray, indices: np.ndarray, width: int,
) -> Float64[np.ndarray, " entries"]:  # fmt: skip
    result, sums = np.empty(len(indices)), np.zeros(width)
    for group in range(len(groups) - 1):
        for i in order[groups[group] : groups[group + 1]]:
            for a in range(values.shape[1]):
                sums[columns[i, a]] += weight[i] * values[i, a]
        for at in range(starts[group], starts[group + 1]):
            result[at] = sums[indices[at]] * by[group]
            sums[indices[at]] = 0.0
    return result


def median_apart(across: Float64[np.ndarray, " n"], group: Int64[np.ndarray, " n"]) -> float:
    """Median distance from the median of the same group."""
    order = np.lexsort((across, group))
    ordered, count = across[order], np.bincount(group)
    count = count[count > 0]
    start = np.cumsum(count) - count
    median = (ordered[start + (count - 1) // 2] + ordered[start + count // 2]) / 2
    return float(np.median(np.abs(ordered - np.repeat(median, count))))
