"""Camera response: white balance, exposure, vignette, gamma and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8


@dataclass(frozen=True)
class CameraResponse:
    """Deviations of a camera from an ideal one; the defaults are ideal.

    Args:
        white_balance: gain of red, green and blue.
        exposure: gain of all channels.
        vignette: fraction of the light lost in the corners, 0..1; the loss grows with the square of the distance from
            the image centre.
        gamma: exponent applied to the values 0..1 after the gains; below 1 brightens.
        noise: standard deviation of the noise at white, in values 0..1; black has 30 % of it.

    Raises:
        ValueError: a value is out of range.
    """

    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    exposure: float = 1.0
    vignette: float = 0.0
    gamma: float = 1.0
    noise: float = 0.0

    def __post_init__(self) -> None:
        gains = (*self.white_balance, self.exposure, self.gamma)
        if len(self.white_balance) != 3 or not all(0 < gain < np.inf for gain in gains):
            raise ValueError(
                "white_balance [3], exposure and gamma must be positive and finite, "
                f"got {self.white_balance}, {self.exposure}, {self.gamma}"
            )
        if not (0 <= self.vignette <= 1 and 0 <= self.noise <= 1):
            raise ValueError(f"vignette and noise must lie in 0..1, got {self.vignette}, {self.noise}")


def random_response(rng: np.random.Generator) -> CameraResponse:
    """A random response with the spread between cameras of one car, in colour, brightness, vignette and contrast."""
    red, green, blue = rng.normal(1.0, 0.03, 3)
    return CameraResponse(
        (float(np.clip(red, 0.9, 1.1)), float(np.clip(green, 0.9, 1.1)), float(np.clip(blue, 0.9, 1.1))),
        exposure=float(rng.uniform(0.88, 1.12)),
        vignette=float(rng.uniform(0.0, 0.25)),
        gamma=float(rng.uniform(0.92, 1.08)),
        noise=float(rng.uniform(0.002, 0.012)),
    )


def apply_response(
    rgb: UInt8[np.ndarray, "h w 3"], response: CameraResponse, seed: int | Sequence[int]
) -> UInt8[np.ndarray, "h w 3"]:
    """An ideal image as this camera records it; the same seed gives the same noise."""
    value = rgb.astype(np.float32)
    # Light first (gains, vignette), then saturation, the tone curve, and noise last.
    value *= np.asarray(response.white_balance, np.float32) * np.float32(response.exposure / 255)
    if response.vignette > 0:
        value *= _vignette(rgb.shape[0], rgb.shape[1], response.vignette)[..., None]
    np.clip(value, 0, 1, out=value)
    if response.gamma != 1:
        value = np.asarray(cv2.pow(value, response.gamma), np.float32)
    if response.noise > 0:
        noise = np.random.default_rng(seed).standard_normal(value.shape, np.float32)
        # A constant part as of read-out, and a part that grows with the square root of the signal, as shot noise does.
        noise *= np.float32(0.3 * response.noise) + np.float32(0.7 * response.noise) * np.sqrt(value)
        value += noise
    value *= 255
    return np.clip(np.rint(value, out=value), 0, 255, out=value).astype(np.uint8)


def _vignette(height: int, width: int, corner: float) -> Float32[np.ndarray, "h w"]:
    """Fraction of the light that reaches each pixel."""
    v, u = (np.arange(n, dtype=np.float32) * 2 + (1 - n) for n in (height, width))
    radius2 = (v * v)[:, None] + u * u
    return 1 - np.float32(corner) * radius2 / np.float32(max((height - 1) ** 2 + (width - 1) ** 2, 1))
