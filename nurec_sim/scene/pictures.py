"""Pictures of an archive as PNG files: the sky, and what cameras see of the ego vehicle.

OpenCV is imported where it is needed: it takes longer than everything else that a server imports to start.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, UInt8

from nurec_sim.errors import ArchiveError
from nurec_sim.files.decoding import image_pixels
from nurec_sim.scene.checks import MAX_FACE_TEXELS
from nurec_sim.scene.precision import half

_EFFORT = 3
"""Of zlib, 0 to 9: more takes twice the time for 10 % less."""


def png_of_sky(sky: Float32[np.ndarray, "6 h h 3"]) -> bytes:
    """A cubemap as RGB of 16 bits, face below face. A value is the bit pattern of the half float: that loses nothing.

    Patterns of positive half floats grow with their values, so that PNG's prediction from neighbours works.
    """
    import cv2

    patterns = half(sky).view(np.uint16).reshape(-1, sky.shape[2], 3)
    return bytes(cv2.imencode(".png", patterns[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, _EFFORT])[1])


def sky_of_png(data: bytes, where: str) -> Float32[np.ndarray, "6 h h 3"]:
    """The cubemap of ``png_of_sky``.

    Raises:
        ArchiveError: not such a file; ``where`` names it.
    """
    patterns = _pixels(data, where, 6 * MAX_FACE_TEXELS**2)
    height, width = patterns.shape[:2]
    if patterns.ndim != 3 or patterns.shape[2] != 3 or patterns.dtype != np.uint16 or height != 6 * width:
        raise ArchiveError(
            f"{where} must be RGB with 16 bits, six squares below each other, got {patterns.dtype} {patterns.shape}"
        )
    faces = np.ascontiguousarray(patterns[..., ::-1]).view(np.float16).reshape(6, width, width, 3)
    return faces.astype(np.float32)


def png_of_ego_image(image: UInt8[np.ndarray, "h w 4"]) -> bytes:
    """An RGBA image."""
    import cv2

    return bytes(cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA))[1])


def ego_image_of_png(data: bytes, where: str) -> UInt8[np.ndarray, "h w 4"]:
    """The image of ``png_of_ego_image``.

    Raises:
        ArchiveError: not such a file; ``where`` names it.
    """
    import cv2

    bgra = _pixels(data, where)
    if bgra.ndim != 3 or bgra.shape[2] != 4 or bgra.dtype != np.uint8:
        raise ArchiveError(f"{where} must be RGBA with 8 bits, got {bgra.dtype} {bgra.shape}")
    return cv2.cvtColor(bgra, cv2.COLOR_BGRA2RGBA)


def _pixels(data: bytes, where: str, most_pixels: int | None = None) -> np.ndarray:
    import cv2

    try:
        return image_pixels(data, cv2.IMREAD_UNCHANGED, most_pixels)
    except ValueError as error:
        raise ArchiveError(f"{where} is not a readable PNG") from error
