"""The loss at LiDAR returns: relative error of the rendered inverse depth, and transparency of what was hit."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.optimize.views import Returns

OUTLIER = 0.2
"""Relative errors count linearly up to this and no further: such a return lies on another surface."""


def depth_loss(
    returns: Returns,
    alpha: Float32[np.ndarray, "h w"],
    distance: Float32[np.ndarray, "h w"],
    ray_z: Float32[np.ndarray, "h w"] | None,
    depth_weight: float,
    solid_weight: float,
    by_alpha: Float32[np.ndarray, "h w"],
    by_distance: Float32[np.ndarray, "h w"],
) -> float:
    """The loss of an image; its gradients are added to ``by_alpha`` and ``by_distance``.

    On a plane inverse depth is linear in the pixel, so it is interpolated between the four pixels around a return:
    ``e = depth_m * sum(weight * alpha / (distance * ray_z)) - 1``.

    Args:
        returns: in the image.
        alpha: of the rendered image.
        distance: weighted sum of distances along the ray, or of depths where ``ray_z`` is None.
        ray_z: depth per distance.
        depth_weight: of the mean of abs(e).
        solid_weight: of the mean of 1 - alpha.
        by_alpha: gradients by ``alpha``; changed.
        by_distance: gradients by ``distance``; changed.
    """
    if not len(returns):
        return 0.0
    unit = np.ones((1, 1), np.float32) if ray_z is None else ray_z
    return _depth_loss(returns.uv_px, returns.depth_m, alpha, distance, unit, depth_weight / len(returns),
                       solid_weight / len(returns), by_alpha, by_distance)  # fmt: skip


@kernel
def _depth_loss(uv, depth, alpha, distance, ray_z, depth_weight, solid_weight, by_alpha, by_distance):
    height, width = alpha.shape
    total = 0.0
    weight, inverse = np.zeros((2, 2)), np.zeros((2, 2))
    for n in range(len(depth)):
        u, v = uv[n, 0] - 0.5, uv[n, 1] - 0.5
        left, top = min(max(int(u), 0), width - 2), min(max(int(v), 0), height - 2)
        fu, fv = u - left, v - top
        seen, least = 0.0, 1.0
        for i in range(2):
            for j in range(2):
                weight[i, j] = (fv if i else 1 - fv) * (fu if j else 1 - fu)
                a = alpha[top + i, left + j]
                z = ray_z[top + i, left + j] if ray_z.size > 1 else 1.0
                d = distance[top + i, left + j] * z
                # Rendered distance is the alpha-weighted sum, so distance / alpha is the mean distance and alpha /
                # distance its inverse.
                inverse[i, j] = a / d if d > 1e-6 else 0.0
                seen += weight[i, j] * inverse[i, j]
                least = min(least, a)
                total += solid_weight * weight[i, j] * (1 - a)
                by_alpha[top + i, left + j] -= solid_weight * weight[i, j]
        error = depth[n] * seen - 1
        # Transparent pixels have no meaningful depth, outliers lie on another surface: constant loss, no gradient.
        if least < 0.3 or abs(error) >= OUTLIER:
            total += depth_weight * min(abs(error), OUTLIER)
            continue
        total += depth_weight * abs(error)
        by_inverse = depth_weight * depth[n] * (1.0 if error > 0 else -1.0)
        for i in range(2):
            for j in range(2):
                a, d = alpha[top + i, left + j], distance[top + i, left + j]
                # d(a / d) / da = (a / d) / a and d(a / d) / dd = -(a / d) / d.
                share = by_inverse * weight[i, j] * inverse[i, j]
                by_alpha[top + i, left + j] += share / a
                by_distance[top + i, left + j] -= share / d
    return total
