"""The logistic regression of ray drop: a probability from the features of a beam, fitted to all beams of a log."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim.compute.kernels import kernel

RIDGE = 1.0
"""Pull of the regression's coefficients to 0, in votes."""
ROUNDS = 12
SETTLED = 1e-9
"""The regression ends when no coefficient changes by more."""
FEW, MANY = 50_000, 200_000
"""More than the many beams start from where a regression on the few ends."""
LARGEST = 30.0
"""Log odds are kept within this."""


def logistic(features: Float64[np.ndarray, "n k"], dropped: Bool[np.ndarray, " n"]) -> Float64[np.ndarray, " k"]:
    """Coefficients of the logistic regression, by Newton's method with a ridge."""
    features = np.ascontiguousarray(features, np.float64)
    weights = np.zeros(features.shape[1])
    if len(features) > MANY:
        # Some of the beams lead near the solution at little cost; the few steps that remain take all of them.
        weights = logistic(features[:: len(features) // FEW], dropped[:: len(features) // FEW])
    for _ in range(ROUNDS):
        gradient, curvature = _slopes(features, dropped, weights)
        step = np.linalg.solve(curvature + RIDGE * np.eye(len(weights)), gradient - RIDGE * weights)
        weights = weights + step
        if np.abs(step).max() < SETTLED:
            break
    return weights


def sigmoid(x: np.ndarray) -> np.ndarray:
    """The probability of log odds, which are kept within ``LARGEST``."""
    return 1 / (1 + np.exp(-np.clip(x, -LARGEST, LARGEST)))


@kernel
def _slopes(features, dropped, weights):
    """First and negative second derivatives of the log likelihood by the coefficients."""
    size = features.shape[1]
    gradient, curvature = np.zeros(size), np.zeros((size, size))
    for i in range(len(features)):
        odds = 0.0
        for k in range(size):
            odds += features[i, k] * weights[k]
        p = 1 / (1 + math.exp(-min(max(odds, -LARGEST), LARGEST)))
        off, spread = (1.0 if dropped[i] else 0.0) - p, p * (1 - p)
        for k in range(size):
            gradient[k] += features[i, k] * off
            scaled = features[i, k] * spread
            for j in range(k + 1):
                curvature[k, j] += scaled * features[i, j]
    for k in range(size):
        for j in range(k):
            curvature[j, k] = curvature[k, j]
    return gradient, curvature
