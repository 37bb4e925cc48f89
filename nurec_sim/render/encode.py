"""Rendered images as bytes: PNG, JPEG or raw planes."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from nurec_sim.errors import RequestError

FORMATS = ("png", "jpeg", "rgb_planar")


def encode_image(rgb: UInt8[np.ndarray, "h w 3"], image_format: str = "png", quality: int = 95) -> bytes:
    """An image as bytes.

    Args:
        rgb: the image.
        image_format: ``png``, ``jpeg``, or ``rgb_planar``: all red rows, then green, then blue, one byte each.
        quality: of a JPEG, 1..100.

    Raises:
        RequestError: unknown format, quality outside of 1..100, or not an 8-bit RGB image.
    """
    import cv2

    if image_format not in FORMATS:
        raise RequestError(f"unknown image format {image_format!r}; have {list(FORMATS)}")
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise RequestError(f"an image must be 8-bit RGB [h,w,3], got {rgb.dtype} {list(rgb.shape)}")
    if image_format == "rgb_planar":
        return np.ascontiguousarray(np.moveaxis(rgb, 2, 0)).tobytes()
    if image_format == "jpeg" and not 1 <= quality <= 100:
        raise RequestError(f"JPEG quality must lie in 1..100, got {quality}")
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    if image_format == "png":
        return cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
