"""Depth scores: AbsRel and delta1, as predicted or after a least-squares scale (paper section 5.1).

Depths are z-depths in metres; 0 means unknown. A pixel with true but no predicted depth has relative error 1 and is
outside delta1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

FARTHEST_M = 80.0
"""Maximum scored true depth, about the range of the LiDARs of the public protocols."""
DELTA1 = 1.25


@dataclass(frozen=True)
class DepthScore:
    """Scores over a set of pixels; NaN if empty.

    Attributes:
        abs_rel: mean of abs(d - true) / true.
        delta1: share of pixels with max(d / true, true / d) < 1.25.
        coverage: share of pixels for which a depth was predicted.
        pixels: how many had a true depth.
    """

    abs_rel: float
    delta1: float
    coverage: float
    pixels: int


def known_depth(true_m: Float[np.ndarray, "h w"], farthest_m: float = FARTHEST_M) -> Bool[np.ndarray, "h w"]:
    """Mask of pixels with scored true depth."""
    return (true_m > 0) & (true_m <= farthest_m)


def least_squares_scale(depth_m: Float[np.ndarray, "h w"], true_m: Float[np.ndarray, "h w"]) -> float:
    """The least-squares factor s of s * depth against the truth over pixels with both; 1 if there are none.

    s = sum(true * d) / sum(d^2) (metrics of the paper's Table 1, per frame).
    """
    both = known_depth(true_m) & (depth_m > 0)
    d, true = depth_m[both].astype(np.float64), true_m[both].astype(np.float64)
    return float(true @ d / (d @ d)) if len(d) else 1.0


def depth_score(
    depth_m: Float[np.ndarray, "h w"], true_m: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"] | None = None
) -> DepthScore:
    """Scores of a predicted depth over pixels with known truth, within ``mask`` if given.

    Raises:
        ValueError: the shapes differ.
    """
    if depth_m.shape != true_m.shape or (mask is not None and mask.shape != true_m.shape):
        shapes = depth_m.shape, true_m.shape, None if mask is None else mask.shape
        raise ValueError(f"depth, truth and mask must have one shape, got {shapes}")
    valid = known_depth(true_m) if mask is None else known_depth(true_m) & mask
    d, true = depth_m[valid].astype(np.float64), true_m[valid].astype(np.float64)
    if not len(d):
        return DepthScore(np.nan, np.nan, np.nan, 0)
    # max(d / t, t / d) < 1.25 without a division: a missing depth (0) is outside.
    near = np.maximum(d, true) < DELTA1 * np.minimum(d, true)
    return DepthScore(float(np.mean(np.abs(d - true) / true)), float(near.mean()), float((d > 0).mean()), len(d))
