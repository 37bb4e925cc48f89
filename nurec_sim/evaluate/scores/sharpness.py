"""Sharpness of an image relative to another of the same view: spectral energy by octave."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

OCTAVES = {"1/16": (1 / 16, 1 / 8), "1/8": (1 / 8, 1 / 4), "1/4": (1 / 4, 1 / 2)}
"""Bands of spatial frequency by the name of their lower end, in cycles per pixel."""
_LUMA = (0.299, 0.587, 0.114)


def octave_energy(image: UInt8[np.ndarray, "h w 3"]) -> dict[str, float]:
    """Spectral energy of an image's luma in each band of ``OCTAVES``; NaN for images under 32 pixels.

    A Hann window suppresses the step between opposite borders, which the periodic transform would see as an edge.
    """
    height, width = image.shape[:2]
    if min(height, width) < 32:
        return dict.fromkeys(OCTAVES, float("nan"))
    luma = image.astype(np.float64) @ _LUMA
    window = np.hanning(height)[:, None] * np.hanning(width)[None]
    power = np.abs(np.fft.rfft2((luma - luma.mean()) * window)) ** 2
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
    return {name: float(power[(frequency >= low) & (frequency < high)].sum()) for name, (low, high) in OCTAVES.items()}


def sharpness(image: UInt8[np.ndarray, "h w 3"], reference: UInt8[np.ndarray, "h w 3"]) -> dict[str, float]:
    """Energy of an image by octave relative to the reference's: 1 equally sharp, below blurred, above noisy."""
    shown, there = octave_energy(image), octave_energy(reference)
    return {name: shown[name] / there[name] if there[name] > 0 else float("nan") for name in OCTAVES}
