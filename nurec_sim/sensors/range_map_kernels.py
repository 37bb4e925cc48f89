"""Kernels of ``range_map``: what takes NumPy many passes over the points of a sweep."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim.compute.kernels import unchecked_inner, unchecked_kernel

Values = Float64[np.ndarray, " n"]
BLOCK = 1024
ROUNDS = 5
LEAST_ANGLE_RAD = 1e-4
"""Points nearer than this to their cone weigh no more."""
# Cephes (sin.c): sine and cosine up to pi / 4.
_S1, _S2, _S3 = 1.58962301576546568060e-10, -2.50507477628578072866e-8, 2.75573136213857245213e-6
_S4, _S5, _S6 = -1.98412698295895385996e-4, 8.33333333332211858878e-3, -1.66666666666666307295e-1
_C1, _C2, _C3 = -1.13585365213876817300e-11, 2.08757008419747316778e-9, -2.75573141792967388112e-7
_C4, _C5, _C6 = 2.48015872888517045348e-5, -1.38888888888730564116e-3, 4.16666666666665929218e-2


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


@unchecked_kernel
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
    cosine, sine, sector = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    for start in range(0, len(row), BLOCK):
        many = min(BLOCK, len(row) - start)
        place, angle = column[start : start + many], turned[start : start + many]
        for i in range(many):
            cosine[i], sine[i] = _of_turns(place[i])
        for i in range(many):
            within = angle[i] / span * sectors
            within = within if within > 0 else 0.0
            sector[i] = within if within < sectors - 1 else sectors - 1.0
        for i in range(many):
            cell = row[start + i] * sectors + int(sector[i])
            real[cell] += cosine[i]
            imaginary[cell] += sine[i]
    return real, imaginary


@unchecked_inner
def _of_turns(turns: float) -> tuple[float, float]:
    """Cosine and sine of an angle in turns."""
    quarter = np.rint(4 * turns)
    x = 2 * math.pi * (turns - quarter / 4)
    z = x * x
    s = x + x * z * (((((_S1 * z + _S2) * z + _S3) * z + _S4) * z + _S5) * z + _S6)
    c = 1 - 0.5 * z + z * z * (((((_C1 * z + _C2) * z + _C3) * z + _C4) * z + _C5) * z + _C6)
    # Which quarter of a turn: 0, 1, -1, or either half.
    rest = quarter - 4 * np.rint(quarter / 4)
    cosine = c if rest == 0 else (-s if rest == 1 else (s if rest == -1 else -c))
    sine = s if rest == 0 else (c if rest == 1 else (-c if rest == -1 else -s))
    return cosine, sine
