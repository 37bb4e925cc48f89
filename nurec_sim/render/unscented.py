"""The unscented projection: about where in an image a Gaussian lies, through any lens and with a moving camera.

The Gaussian stands for 7 points, its mean and two along each of its axes, which are projected exactly, each at the
instant when its row is taken; their weighted mean and covariance are those of the Gaussian's image (Wan and van der
Merwe 2000; 3DGUT, Wu et al. 2025, section 4). With n = 3 dimensions and

    alpha = 1, beta = 2, kappa = 0:   lambda = alpha^2 (n + kappa) - n = 0

the points lie at sqrt(n + lambda) = 1.73 standard deviations, those on the axes weigh 1 / (2 (n + lambda)) = 1/6 each,
and the one at the mean lambda / (n + lambda) = 0 in the mean and that + 1 - alpha^2 + beta = 2 in the covariance. These
are the parameters of the 3DGUT authors' code. With gsplat's alpha = 0.1 the points lie at 0.17 standard deviations and
weights of -99 and +17 must cancel: fine on a smooth lens, but with the steps from row to row of a rolling shutter the
mean can be many pixels off.

No pixel depends on it: responses are those of ``spec``. It only locates Gaussians.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim import sensors
from nurec_sim.types import CameraModel

ALPHA, BETA, KAPPA = 1.0, 2.0, 0.0
DIMENSIONS = 3
LAMBDA = ALPHA**2 * (DIMENSIONS + KAPPA) - DIMENSIONS


def unscented_projection(
    camera: CameraModel,
    world_from_camera: Float64[np.ndarray, "2 4 4"],
    mean_m: Float64[np.ndarray, "n 3"],
    covariance_m2: Float64[np.ndarray, "n 3 3"],
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2 2"], Bool[np.ndarray, " n"]]:
    """Image of Gaussians.

    Args:
        camera: any lens and shutter.
        world_from_camera: poses at the start and the end of the exposure.
        mean_m: centres in the world.
        covariance_m2: their covariances in the world.

    Returns:
        mean [n,2] in pixels, covariance [n,2,2] in square pixels, and whether all 7 points are in the lens' field;
        NaN where they are not.
    """
    mean_m = np.asarray(mean_m, np.float64)
    variance, axes = np.linalg.eigh(np.asarray(covariance_m2, np.float64))
    steps = np.sqrt((DIMENSIONS + LAMBDA) * np.maximum(variance, 0))[:, None] * axes
    # Square root of the covariance by its eigenvectors: one step along each axis.
    steps = np.moveaxis(steps, 2, 0)
    points = mean_m + np.concatenate([np.zeros((1, *mean_m.shape)), steps, -steps])
    on_axis = 1 / (2 * (DIMENSIONS + LAMBDA))
    weight = np.full(len(points), on_axis)
    weight[0] = LAMBDA / (DIMENSIONS + LAMBDA)
    weight_of_square = weight.copy()
    # beta = 2 is optimal for Gaussian distributions; it enters the covariance only.
    weight_of_square[0] += 1 - ALPHA**2 + BETA

    uv, seen, _ = sensors.project_rolling(camera, world_from_camera, points.reshape(-1, 3))
    uv = uv.reshape(*points.shape[:2], 2)
    valid = np.all(seen.reshape(points.shape[:2]), axis=0)
    uv_mean = np.einsum("k,knc->nc", weight, uv)
    spread = uv - uv_mean
    covariance = np.einsum("k,kni,knj->nij", weight_of_square, spread, spread)
    return np.where(valid[:, None], uv_mean, np.nan), np.where(valid[:, None, None], covariance, np.nan), valid
