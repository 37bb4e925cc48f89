"""The loss of an image's colours, 0.8 L1 + 0.2 (1 - SSIM), and its gradient in closed form.

SSIM (Wang et al. 2004) is a function of five local means, each a Gaussian blur of the images, their squares or their
product. The blur is its own adjoint (zeros beyond the border), so the gradient takes one more blur per mean.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32

WINDOW_PX, SIGMA_PX = 11, 1.5
C1, C2 = 0.01**2, 0.03**2
_WINDOW = cv2.getGaussianKernel(WINDOW_PX, SIGMA_PX).astype(np.float32)


def colour_loss(
    shown: Float32[np.ndarray, "h w 3"], recorded: Float32[np.ndarray, "h w 3"], dssim: float
) -> tuple[float, Float32[np.ndarray, "h w 3"]]:
    """The loss and its gradient by ``shown``; colours are 0..1.

    Args:
        shown: the rendered image, not clipped.
        recorded: the image of the log.
        dssim: share of 1 - SSIM, 0..1.
    """
    difference = shown - recorded
    absolute = float(np.abs(difference).mean())
    similarity, by_shown = _mean_ssim(shown, recorded)
    # d|x| / dx = sign(x); each mean divides by the number of values.
    gradient = np.sign(difference) * np.float32((1 - dssim) / shown.size) - np.float32(dssim) * by_shown
    return (1 - dssim) * absolute + dssim * (1 - similarity), gradient


def _mean_ssim(x: np.ndarray, y: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean SSIM over pixels and channels, and its gradient by x."""
    mean_x, mean_y = _blur(x), _blur(y)
    # Var = E[x^2] - E[x]^2 with the Gaussian window as weights.
    variance_x, variance_y = _blur(x * x) - mean_x * mean_x, _blur(y * y) - mean_y * mean_y
    covariance = _blur(x * y) - mean_x * mean_y
    a1, a2 = 2 * mean_x * mean_y + C1, 2 * covariance + C2
    b1, b2 = mean_x * mean_x + mean_y * mean_y + C1, variance_x + variance_y + C2
    scale = 1 / (b1 * b2)
    ssim = a1 * a2 * scale
    # By the blurs of x, of x^2 and of x y, which the variances and the covariance depend on.
    by_mean = 2 * scale * (mean_y * (a2 - a1) - ssim * mean_x * (b2 - b1))
    by_square = -ssim / b2
    by_product = 2 * a1 * scale
    gradient = _blur(by_mean) + 2 * x * _blur(by_square) + y * _blur(by_product)
    return float(ssim.mean()), gradient / np.float32(x.size)


def _blur(image: np.ndarray) -> np.ndarray:
    return cv2.sepFilter2D(image, -1, _WINDOW, _WINDOW, borderType=cv2.BORDER_CONSTANT)
