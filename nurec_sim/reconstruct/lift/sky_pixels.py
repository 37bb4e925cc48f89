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
STEP = 12
"""Most that a colour of the sky changes from a pixel to the next, of 255."""
WIRE_PX, PIECE_PX = 5, 11
"""Wires are narrower than the first; a piece of sky beyond a wire is at least as wide as the second."""


def sky_coloured(view: WorkingView, prior: Float32[np.ndarray, "h w"], bright: float) -> Bool[np.ndarray, "h w"]:
    """Pixels that look like sky: above the horizon, no surface measured, and bright or clearly blue."""
    rgb = view.rgb.astype(np.float32)
    up = rays_of(view) @ view.world_from_view[2, :3]
    light = rgb.mean(axis=-1)
    blue = (rgb[..., 2] > 1.15 * rgb[..., 0] + 5) & (light > 0.45 * bright)
    return (up > 0.0) & (prior <= 0) & ((light > 0.8 * bright) | blue) & view.tile.valid


def sky_likeness(
    rgb: UInt8[np.ndarray, "h w 3"], coloured: Bool[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w"]:
    """How much pixels look like sky: ``NOT_SKY``, ``MAYBE_SKY`` or ``SKY``.

    White walls and bright poles have the colour of the sky too. But the sky goes on beyond the upper end of the image,
    is wider than a pole, and its colours change gradually: they end with an edge where a wall begins. Wires cut the sky
    into pieces, and a wide piece with the colours of the sky across the wire is sky. Other sky-coloured pixels, of
    walls and of gaps in the crown of a tree, may be either.

    Args:
        rgb: colours, 0..255.
        coloured: pixels with the colour of the sky (``sky_coloured``).
        valid: pixels that show the world.
    """
    wide = _morphed(coloured.astype(np.uint8), cv2.MORPH_OPEN, SKY_PX)
    upper_end = valid & ~np.pad(valid, ((1, 0), (0, 0)))[:-1]
    sky = _grown(upper_end, wide, rgb)
    # What is darker than the sky and narrower than the window is not in a closed image (greyscale morphology).
    across = _grown(upper_end, _morphed(wide, cv2.MORPH_CLOSE, WIRE_PX), _morphed(rgb, cv2.MORPH_CLOSE, WIRE_PX))
    pieces = _morphed((across & ~sky & (wide > 0)).astype(np.uint8), cv2.MORPH_OPEN, PIECE_PX)
    sky |= _grown(pieces > 0, wide, rgb)
    return np.where(sky, SKY, np.where(wide > 0, MAYBE_SKY, NOT_SKY)).astype(np.uint8)


def _morphed(picture: np.ndarray, operation: int, window_px: int) -> np.ndarray:
    return cv2.morphologyEx(picture, operation, np.ones((window_px, window_px), np.uint8))


def _grown(seeds: np.ndarray, wide: np.ndarray, rgb: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """Pixels of ``wide`` that chains of neighbours of gradually changing colour join to a seed in it."""
    # As flood filling wants it: with a rim of one pixel, 0 where it may go; it writes the value in bits 8 to 15.
    mask = np.pad(1 - wide, 1, constant_values=1)
    filled, step, rgb = mask[1:-1, 1:-1], (STEP,) * 3, rgb.copy()
    flags = 4 | 2 << 8 | cv2.FLOODFILL_MASK_ONLY
    rows, columns = np.nonzero(seeds & (wide > 0))
    while len(rows):
        cv2.floodFill(rgb, mask, (int(columns[0]), int(rows[0])), (0, 0, 0), step, step, flags)
        left = filled[rows, columns] == 0
        rows, columns = rows[left], columns[left]
    return filled == 2
