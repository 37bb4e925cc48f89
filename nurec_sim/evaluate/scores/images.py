"""Image scores: PSNR and SSIM, over whole images or within a mask.

Images are [h, w] or [h, w, channels] of one type; integers count in 0..255, floats in 0..1 unless ``data_range`` says
otherwise.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool

SSIM_WINDOW = 7
SSIM_K1, SSIM_K2 = 0.01, 0.03


def psnr(image: np.ndarray, reference: np.ndarray, data_range: float | None = None) -> float:
    """Peak signal-to-noise ratio in dB, over all pixels and channels; infinite if the images are equal.

    Raises:
        ValueError: the images differ in shape or are empty.
    """
    a, b, span = _checked(image, reference, data_range)
    error = float(np.mean((a - b) ** 2))
    return float("inf") if error == 0 else float(10 * np.log10(span**2 / error))


def ssim(image: np.ndarray, reference: np.ndarray, data_range: float | None = None) -> float:
    """Structural similarity: mean over channels and all pixels whose 7x7 window lies inside the image.

    Uniform window, unbiased (n - 1) variances, K1 = 0.01, K2 = 0.03 (Wang et al. 2004): the same choices as
    scikit-image's defaults.

    Raises:
        ValueError: the images differ in shape or are smaller than the window.
    """
    return float(np.mean(ssim_map(image, reference, data_range)))


def ssim_map(image: np.ndarray, reference: np.ndarray, data_range: float | None = None) -> np.ndarray:
    """Structural similarity of every 7x7 window inside the image, ``[h - 6, w - 6]`` or with channels; see ``ssim``.

    The window around pixel (row, column) is at (row - 3, column - 3).

    Raises:
        ValueError: the images differ in shape or are smaller than the window.
    """
    a, b, span = _checked(image, reference, data_range)
    if min(a.shape[:2]) < SSIM_WINDOW:
        raise ValueError(f"SSIM needs images of at least {SSIM_WINDOW} x {SSIM_WINDOW} pixels, got {a.shape}")
    c1, c2 = (SSIM_K1 * span) ** 2, (SSIM_K2 * span) ** 2
    count = SSIM_WINDOW**2
    unbiased = count / (count - 1)
    border = SSIM_WINDOW // 2

    # float64 throughout: E[x^2] - E[x]^2 cancels in flat regions.
    def mean(values: np.ndarray) -> np.ndarray:
        full = cv2.boxFilter(values, cv2.CV_64F, (SSIM_WINDOW, SSIM_WINDOW), borderType=cv2.BORDER_REFLECT)
        return full[border:-border, border:-border]

    mean_a, mean_b = mean(a), mean(b)
    var_a = unbiased * (mean(a * a) - mean_a**2)
    var_b = unbiased * (mean(b * b) - mean_b**2)
    covariance = unbiased * (mean(a * b) - mean_a * mean_b)
    # Wang et al. 2004, eq. 13: product of luminance and contrast-structure terms. c1 and c2 keep both finite in black
    # and in flat regions.
    alike = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return alike / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))


def masked_psnr(image: np.ndarray, reference: np.ndarray, mask: Bool[np.ndarray, "h w"]) -> float:
    """PSNR in dB over the pixels of a mask; NaN if it is empty.

    Raises:
        ValueError: the images or the mask differ in shape.
    """
    _check_mask(image, mask)
    return psnr(image[mask][None], reference[mask][None]) if mask.any() else float("nan")


def masked_ssim(image: np.ndarray, reference: np.ndarray, mask: Bool[np.ndarray, "h w"]) -> float:
    """Mean SSIM of the windows whose centre pixel is in a mask; NaN if there are none.

    Windows extend beyond the mask, as in the STORM protocol.

    Raises:
        ValueError: the images or the mask differ in shape, or are smaller than the window.
    """
    _check_mask(image, mask)
    border = SSIM_WINDOW // 2
    inside = mask[border:-border, border:-border]
    return float(np.mean(ssim_map(image, reference)[inside])) if inside.any() else float("nan")


def _check_mask(image: np.ndarray, mask: np.ndarray) -> None:
    if mask.shape != image.shape[:2]:
        raise ValueError(f"a mask must have the size of the images, got {mask.shape} for {image.shape}")


def _checked(
    image: np.ndarray, reference: np.ndarray, data_range: float | None
) -> tuple[np.ndarray, np.ndarray, float]:
    if image.shape != reference.shape or image.size == 0 or image.ndim not in (2, 3):
        raise ValueError(
            f"two images of one shape [h, w] or [h, w, c] are needed, got {image.shape}, {reference.shape}"
        )
    if (image.dtype.kind == "f") != (reference.dtype.kind == "f"):
        raise ValueError(f"images must have the same dtype, got {image.dtype}, {reference.dtype}")
    span = data_range if data_range is not None else (1.0 if image.dtype.kind == "f" else 255.0)
    return image.astype(np.float64), reference.astype(np.float64), float(span)
