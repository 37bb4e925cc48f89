"""Relative brightness of cameras, measured on surfaces that several of them see.

The network decodes each camera's response from its images alone. On cameras unlike those of its training it can be
wrong by a factor of two and more, and a seam shows wherever their images meet.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, Int64

LEAST_SHARED = 200
"""Two cameras are compared if they share so many pixels."""
LARGEST_GAIN = 4.0
"""No camera is made brighter or darker by more than this against another."""
STAY = 1e-6
"""Weight of leaving a camera as it is, against a share of all pairs: it decides for cameras that share nothing."""


def camera_gains(
    camera: Int64[np.ndarray, " v"], pairs: Float64[np.ndarray, "v cameras 7"]
) -> Float32[np.ndarray, "cameras 3"]:
    """Factors to the colours of each camera that make them alike on shared surfaces; the largest of a channel is 1.

    Least squares over the logarithms of the cameras' mean colours, weighted by how many pixels a pair shares. Means, so
    that it does not matter if pixels of the two are not quite the same place.

    Args:
        camera: index of each image's camera.
        pairs: per image and camera, over shared pixels: sum of the image's colours, of the camera's, and their number.
    """
    count = pairs.shape[1]
    total = np.zeros((count, count, 7))
    np.add.at(total, camera, pairs)
    shared = total[..., 6] + total[..., 6].T
    weight = np.where(shared >= LEAST_SHARED, shared, 0.0)
    both = weight > 0
    gains = np.ones((count, 3))
    if both.any():
        # Minimises sum w_ij (g_i - g_j + r_ij)^2 over log gains g: normal equations with the graph Laplacian of the
        # pairs. Its null space (all gains alike) is held by STAY.
        laplacian = np.diag(weight.sum(axis=1)) - weight + STAY * weight.sum() * np.eye(count)
        for channel in range(3):
            mine = total[..., channel] + total[..., 3 + channel].T
            ratio = np.log(np.where(both, mine, 1.0)) - np.log(np.where(both, mine.T, 1.0))
            gains[:, channel] = np.exp(np.linalg.solve(laplacian, -(weight * ratio).sum(axis=1)))
    return np.clip(gains / gains.max(axis=0), 1 / LARGEST_GAIN, 1.0).astype(np.float32)
