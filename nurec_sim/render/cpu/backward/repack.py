"""Kernel that packs Gaussians in the order given, for callers that change them before every frame."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from nurec_sim.render.cpu.kernel import f4, inner, kernel
from nurec_sim.render.cpu.pack import (
    BLOCK,
    COLOUR,
    FALLOFF,
    INTENSITY,
    LABEL,
    LOG_OPACITY,
    MAX_OPACITY,
    MEAN,
    MIN_SCALE_M,
    NEVER_SEEN,
    NORMAL,
    QUAT,
    SCALE,
)
from nurec_sim.render.layers import LARGEST


class RawGaussians(NamedTuple):
    """Gaussians as a caller has them, or gradients by them; units as in ``types.Gaussians``."""

    mean: Float32[np.ndarray, "n 3"]
    quat: Float32[np.ndarray, "n 4"]
    """Of any norm."""
    scale: Float32[np.ndarray, "n 3"]
    opacity: Float32[np.ndarray, " n"]
    features: Float32[np.ndarray, "n 3"]
    """Colours, or of LiDARs intensity, whether it is known, and drop probability."""


@inner
def _drawable(gaussians, i):
    """What ``pack.drawable`` tests; written so that NaN fails."""
    mean, quat, scale, opacity, features = gaussians
    norm = 0.0
    good = opacity[i] >= f4(1 / 255) and opacity[i] <= f4(LARGEST)
    for k in range(3):
        good = good and scale[i, k] > f4(0)
        for value in (mean[i, k], scale[i, k], features[i, k]):
            good = good and abs(value) <= f4(LARGEST)
    for k in range(4):
        norm += np.float64(quat[i, k]) ** 2
    return good and norm > 1e-24 and norm <= LARGEST * LARGEST


@kernel
def repack(first, last, gaussians, lidar, fields):
    """Fill blocks of ``fields``; row i of the Gaussians becomes packed row i.

    Args:
        first: first block.
        last: one behind the last.
        gaussians: see ``RawGaussians``.
        lidar: whether the features are those of a LiDAR.
        fields: [blocks,22,256] output, see ``pack``; only what a frame without normals reads.
    """
    feature = INTENSITY if lidar else COLOUR
    mean, quat, scale, opacity, features = gaussians
    for block in range(first, last):
        out = fields[block]
        # Frames with gradients have no labels.
        out[LABEL] = f4(0)
        if lidar:
            # Nor does what they return depend on the incidence.
            for c in range(3):
                out[NORMAL + c] = f4(0)
            out[FALLOFF] = f4(0)
        for k in range(BLOCK):
            i = block * BLOCK + k
            if i >= len(mean) or not _drawable(gaussians, i):
                for c in range(3):
                    out[MEAN + c, k], out[feature + c, k], out[SCALE + c, k] = f4(0), f4(0), f4(1)
                for c in range(4):
                    out[QUAT + c, k] = f4(0.5)
                out[LOG_OPACITY, k] = f4(NEVER_SEEN)
                continue
            norm = 0.0
            for c in range(4):
                norm += np.float64(quat[i, c]) ** 2
            inverse = 1 / math.sqrt(norm)
            for c in range(4):
                out[QUAT + c, k] = f4(quat[i, c] * inverse)
            for c in range(3):
                out[MEAN + c, k] = mean[i, c]
                out[SCALE + c, k] = max(scale[i, c], f4(MIN_SCALE_M))
                out[feature + c, k] = features[i, c]
            out[LOG_OPACITY, k] = f4(math.log(min(np.float64(opacity[i]), MAX_OPACITY)))
