"""Kernels of ``range_map``: what takes NumPy many passes over the points of a sweep."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim.compute.kernels import kernel, unchecked_kernel

Values = Float64[np.ndarray, " n"]
BLOCK = 1024
ROUNDS = 5
LEAST_ANGLE_RAD = 1e-4
"""Points nearer than this to their cone weigh no more."""


@unchecked_kernel
def cone_apex(height: Values, across: Values) -> float:
    """Height at which the cone of a row starts: height = apex + across * slope, of the smallest sum of angles, about.

    Args:
        height: [n] of the points of the row.
        across: [n] their distances from the axis, positive.
    """
    weight = np.empty(BLOCK)
    apex, slope = 0.0, 0.0
    for turn in range(ROUNDS):
        one, by, by_by, by_height, by_both = 0.0, 0.0, 0.0, 0.0, 0.0
        for start in range(0, len(height), BLOCK):
            many = min(BLOCK, len(height) - start)
            z, rho = height[start : start + many], across[start : start + many]
            for i in range(many):
                # Weights approach those of the smallest sum of absolute angles.
                off = abs(z[i] - apex - slope * rho[i]) / rho[i]
                off = off if off > LEAST_ANGLE_RAD else LEAST_ANGLE_RAD
                weight[i] = 1 / (rho[i] * rho[i] * (off if turn > 0 else 1.0))
            # Normal equations.
            for i in range(many):
                w = weight[i]
                one, by, by_by = one + w, by + w * rho[i], by_by + w * rho[i] * rho[i]
                by_height, by_both = by_height + w * z[i], by_both + w * rho[i] * z[i]
        det = one * by_by - by * by
        apex, slope = (by_by * by_height - by * by_both) / det, (one * by_both - by * by_height) / det
    return apex


@kernel
def phase_sums(
    row: Int64[np.ndarray, " n"], turned: Values, column: Values, span: float, rows: int, sectors: int
) -> tuple[Float64[np.ndarray, " cells"], Float64[np.ndarray, " cells"]]:
    """Sums of cosines and sines of the points' phases, one turn per column, by row and sector: [rows * sectors] each.

    Args:
        row: [n] of each point.
        turned: [n] angle turned, in sectors of ``span`` / ``sectors``; beyond the ends it counts to the last ones.
        column: [n] place among the columns.
        span: angle of all sectors.
        rows: number of rows.
        sectors: number of sectors.
    """
    real, imaginary = np.zeros(rows * sectors), np.zeros(rows * sectors)
    for i in range(len(row)):
        sector = min(max(turned[i] / span * sectors, 0.0), sectors - 1.0)
        cell = row[i] * sectors + int(sector)
        phase = 2 * math.pi * column[i]
        real[cell] += math.cos(phase)
        imaginary[cell] += math.sin(phase)
    return real, imaginary
