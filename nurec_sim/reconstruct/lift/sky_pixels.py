"""Which pixels look like sky."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from nurec_sim.reconstruct.lift.depth import MAYBE_SKY, NOT_SKY, SKY
from nurec_sim.reconstruct.lift.lifting import rays_of
from nurec_sim.reconstruct.lift.views import WorkingView

SKY_PX = 3
"""Least width of a patch of sky, pixels."""


def sky_coloured(view: WorkingView, prior: Float32[np.ndarray, "h w"], bright: float) -> Bool[np.ndarray, "h w"]:
    """Pixels that look like sky: above the horizon, no surface measured, and bright or clearly blue."""
    rgb = view.rgb.astype(np.float32)
    up = rays_of(view) @ view.world_from_view[2, :3]
    light = rgb.mean(axis=-1)
    blue = (rgb[..., 2] > 1.15 * rgb[..., 0] + 5) & (light > 0.45 * bright)
    return (up > 0.0) & (prior <= 0) & ((light > 0.8 * bright) | blue) & view.tile.valid


def sky_likeness(coloured: Bool[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """How much pixels look like sky: ``NOT_SKY``, ``MAYBE_SKY`` or ``SKY``.

    White walls and bright poles have the colour of the sky too. But the sky goes on beyond the upper end of the image,
    and is wider than a pole. Sky-coloured pixels that surfaces enclose may be either.

    Args:
        coloured: pixels with the colour of the sky (``sky_coloured``).
        valid: pixels that show the world.
    """
    wide = cv2.morphologyEx(coloured.astype(np.uint8), cv2.MORPH_OPEN, np.ones((SKY_PX, SKY_PX), np.uint8))
    count, region = cv2.connectedComponents(wide, connectivity=8)
    upper_end = valid & ~np.pad(valid, ((1, 0), (0, 0)))[:-1]
    ends_above = np.zeros(count, bool)
    ends_above[region[upper_end]] = True
    return np.where(ends_above[region] & (wide > 0), SKY, np.where(coloured & (wide > 0), MAYBE_SKY, NOT_SKY)).astype(
        np.uint8
    )
