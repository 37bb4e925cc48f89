"""Views at the scored size: 240 x 160 pixels, as in the public protocol.

Images are downsampled by area averaging, depth by nearest sampling, masks by logical or.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

SCORED_PIXELS = 240 * 160
"""Number of scored pixels for any aspect ratio."""


@dataclass(frozen=True, eq=False)
class ScoredView:
    """A view at the scored size: colours 0..1, depth 0 where unknown, or None."""

    rgb: Float32[np.ndarray, "h w 3"]
    depth_m: Float32[np.ndarray, "h w"] | None


def scored_size(width_px: int, height_px: int) -> tuple[int, int]:
    """Scored width and height for an image size: 240 x 160 for 3:2, never upsampled."""
    factor = min(1.0, (SCORED_PIXELS / (width_px * height_px)) ** 0.5)
    return max(8, round(width_px * factor)), max(8, round(height_px * factor))


def reduced(rgb: UInt8[np.ndarray, "h w 3"], depth_m: Float32[np.ndarray, "h w"] | None) -> ScoredView:
    """Downsamples a view to the scored size."""
    width, height = scored_size(rgb.shape[1], rgb.shape[0])
    small = cv2.resize(rgb.astype(np.float32) / 255, (width, height), interpolation=cv2.INTER_AREA)
    return ScoredView(np.clip(small, 0, 1), None if depth_m is None else _picked(depth_m, width, height))


def reduced_mask(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Downsamples a mask by logical or, as in the STORM protocol."""
    size = scored_size(mask.shape[1], mask.shape[0])
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 1e-3


def _picked(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """Nearest-neighbour downsampling."""
    rows = ((np.arange(height) + 0.5) * values.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * values.shape[1] / width).astype(int)
    return values[rows][:, columns]
