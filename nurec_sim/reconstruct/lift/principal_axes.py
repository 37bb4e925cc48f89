"""Principal axes of symmetric 3 x 3 matrices, by Jacobi's rotations: ``np.linalg.eigh`` takes five times as long."""

from __future__ import annotations

import numpy as np

from nurec_sim.compute.kernels import inner, kernel

MOST_TURNS, NEGLIGIBLE = 20, 1e-32
"""Rounds of rotations at most (about five are needed), and the squared share of what is off the diagonal at the end."""


@inner
def diagonalise(matrix, axes):
    """Turn a symmetric matrix into its eigenvalues, on the diagonal, ascending; and ``axes`` into its eigenvectors.

    These are the columns of ``axes``; both arguments are 3 x 3 and changed.
    """
    a = matrix
    for i in range(3):
        for j in range(3):
            axes[i, j] = 1.0 if i == j else 0.0
    for _ in range(MOST_TURNS):
        off = a[0, 1] * a[0, 1] + a[0, 2] * a[0, 2] + a[1, 2] * a[1, 2]
        if not off > NEGLIGIBLE * (a[0, 0] * a[0, 0] + a[1, 1] * a[1, 1] + a[2, 2] * a[2, 2]):
            break
        # Pairs (0, 1), (0, 2) and (1, 2); by loops over tuples this would take four times as long to compile.
        for turn in range(3):
            p, r = turn // 2, 2 - turn
            q = 3 - p - r
            if a[p, q] == 0.0:
                continue
            half = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
            t = (1.0 if half >= 0 else -1.0) / (abs(half) + np.sqrt(half * half + 1.0))
            c = 1.0 / np.sqrt(t * t + 1.0)
            s = t * c
            a[p, p] -= t * a[p, q]
            a[q, q] += t * a[p, q]
            a[p, q] = a[q, p] = 0.0
            x, y = a[p, r], a[q, r]
            a[p, r] = a[r, p] = c * x - s * y
            a[q, r] = a[r, q] = s * x + c * y
            for k in range(3):
                x, y = axes[k, p], axes[k, q]
                axes[k, p], axes[k, q] = c * x - s * y, s * x + c * y
    for turn in range(3):
        p, q = turn % 2, turn % 2 + 1
        if a[p, p] > a[q, q]:
            a[p, p], a[q, q] = a[q, q], a[p, p]
            for k in range(3):
                axes[k, p], axes[k, q] = axes[k, q], axes[k, p]


@kernel
def principal_axes(matrices):
    """Eigenvalues [n,3], ascending, and eigenvectors [n,3,3], in columns, of symmetric matrices [n,3,3]."""
    values, axes = np.empty((len(matrices), 3)), np.empty((len(matrices), 3, 3))
    a = np.empty((3, 3))
    for i in range(len(matrices)):
        a[:] = matrices[i]
        diagonalise(a, axes[i])
        for k in range(3):
            values[i, k] = a[k, k]
    return values, axes
