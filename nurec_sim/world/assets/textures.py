"""Building blocks of procedural textures: tileable noise and grain; images are uint8 RGB ``[h, w, 3]``."""

from __future__ import annotations

import functools

import cv2
import numpy as np
from jaxtyping import UInt8
from scipy import sparse

Image = UInt8[np.ndarray, "h w 3"]


def noise(
    rng: np.random.Generator, size: int, octaves: int = 5, cells: int = 4, persistence: float = 0.55
) -> np.ndarray:
    """Tileable fractal value noise.

    Args:
        rng: random generator.
        size: pixels of the square image.
        octaves: number of layers, each with twice the frequency of the previous one.
        cells: random values across the image in the coarsest layer.
        persistence: amplitude of a layer relative to the previous one.

    Returns:
        ``[size, size]`` in 0..1.
    """
    total, weight = np.zeros((size, size), np.float32), 0.0
    for octave in range(octaves):
        n = min(cells * 2**octave, size)
        between = _periodic_weights(size, n)
        # Interpolation is separable: the same sparse weights on both axes.
        total += persistence**octave * (between @ (between @ rng.random((n, n), dtype=np.float32)).T)
        weight += persistence**octave
    return np.clip(total / weight, 0, 1)


@functools.lru_cache(maxsize=64)
def _periodic_weights(size: int, n: int) -> sparse.csr_array:
    """Weights ``[size, n]`` of the periodic cubic interpolation from n values to ``size`` samples."""
    place = (np.arange(size) + 0.5) * n / size - 0.5
    whole = np.floor(place).astype(int)
    t = (place - whole).astype(np.float32)
    # Catmull-Rom weights of the four neighbours; indices modulo n make it periodic.
    cubic = [-0.5 * t + t**2 - 0.5 * t**3, 1 - 2.5 * t**2 + 1.5 * t**3, 0.5 * t + 2 * t**2 - 1.5 * t**3,
             -0.5 * t**2 + 0.5 * t**3]  # fmt: skip
    rows, columns = np.tile(np.arange(size), 4), np.concatenate([(whole + shift) % n for shift in (-1, 0, 1, 2)])
    return sparse.csr_array((np.concatenate(cubic), (rows, columns)), shape=(size, n))


def grain(rng: np.random.Generator, size: int, sigma_px: float) -> np.ndarray:
    """Tileable blurred white noise ``[size, size]`` of unit variance."""
    margin = int(np.ceil(4 * sigma_px))
    # Wrapping before the blur makes the result tileable.
    white = np.pad(rng.standard_normal((size, size), np.float32), margin, mode="wrap")
    blurred = cv2.GaussianBlur(white, (0, 0), sigma_px)[margin:-margin, margin:-margin]
    return blurred / float(blurred.std())


def as_image(values: np.ndarray, colour: tuple[float, ...] | None = None) -> Image:
    """A uint8 image of ``values [h,w]`` times a colour, or of ``values [h,w,3]``, clipped to 0..255."""
    values = values if colour is None else values[..., None] * np.asarray(colour, np.float32)
    return np.ascontiguousarray(np.clip(values, 0, 255).astype(np.uint8))
