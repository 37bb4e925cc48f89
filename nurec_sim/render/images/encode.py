"""Rendered images as bytes: PNG, JPEG, JPEG 2000, raw planes, or a self-contained video frame."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import UInt8

from nurec_sim.errors import RequestError
from nurec_sim.render.images import encode_video

FORMATS = ("png", "jpeg", "jpeg2000", "rgb_planar", "avc", "av1")

_JPEG2000_MIN_PX = 32  # of a side: OpenCV cuts an image into tiles with six resolutions


@lru_cache(maxsize=1)
def available_formats() -> tuple[str, ...]:
    """Those of ``FORMATS`` for which this installation has an encoder."""
    import cv2

    there = {
        "jpeg2000": cv2.haveImageWriter(".jp2"),
        "avc": encode_video.is_available("avc"),
        "av1": encode_video.is_available("av1"),
    }
    return tuple(name for name in FORMATS if there.get(name, True))


def encode_image(rgb: UInt8[np.ndarray, "h w 3"], image_format: str = "png", quality: int = 95) -> bytes:
    """An image as bytes; the same image gives the same bytes.

    Args:
        rgb: the image.
        image_format: ``png``, ``jpeg``, ``jpeg2000``; ``rgb_planar``: all red rows, then green, then blue, one byte
            each; ``avc``, ``av1``: see ``encode_video.encode_frame``.
        quality: 1..100; without effect on a PNG and raw planes.

    Raises:
        RequestError: a format that is unknown or has no encoder here, a quality outside of 1..100, an image that is not
            8-bit RGB or is too small for the format.
    """
    if image_format not in available_formats():
        raise RequestError(f"unknown image format {image_format!r}; have {list(available_formats())}")
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise RequestError(f"an image must be 8-bit RGB [h,w,3], got {rgb.dtype} {list(rgb.shape)}")
    if image_format not in ("png", "rgb_planar") and not 1 <= quality <= 100:
        raise RequestError(f"image quality must lie in 1..100, got {quality}")
    if image_format == "rgb_planar":
        return np.ascontiguousarray(np.moveaxis(rgb, 2, 0)).tobytes()
    if image_format in ("avc", "av1"):
        return encode_video.encode_frame(rgb, image_format, quality)
    return _encode_still(rgb, image_format, quality)


def _encode_still(rgb: UInt8[np.ndarray, "h w 3"], image_format: str, quality: int) -> bytes:
    import cv2

    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    if image_format == "png":
        return cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
    if image_format == "jpeg":
        return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    if min(rgb.shape[:2]) < _JPEG2000_MIN_PX:
        raise RequestError(f"a JPEG2000 needs sides of at least {_JPEG2000_MIN_PX} pixels, got {rgb.shape[:2]}")
    bytes_kept = 1000 // (101 - quality)  # in thousandths: all at 100, a sixth at 95, an 81st at 20
    return cv2.imencode(".jp2", bgr, [cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, bytes_kept])[1].tobytes()
