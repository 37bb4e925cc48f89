"""Dense depth of a working view: measured where surfels lie, matched against neighbours elsewhere, smoothed over all.

Inverse depth (1/m, along the optical axis) everywhere; 0 is infinitely far. Compiled kernels run without the
interpreter lock.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.lift.matching import census, open_costs
from nurec_sim.reconstruct.lift.smoothing import PRIOR_COST, UNIT, smooth_depth

NOT_SKY, MAYBE_SKY, SKY = 0, 1, 2
"""What a pixel looks like (``sky_pixels.sky_likeness``)."""
SKY_COST, NOT_SKY_COST = 60 * UNIT, 40 * UNIT
NO_SURFACE = 0.0035
"""Levels up to this inverse depth (1/m; from 285 m on) are sky rather than a surface."""


def dense_inverse_depth(
    packed: Float64[np.ndarray, " 23"],
    world_from_view: Float64[np.ndarray, "4 4"],
    rgb: UInt8[np.ndarray, "h w 3"],
    prior: Float32[np.ndarray, "h w"],
    sky: UInt8[np.ndarray, "h w"],
    neighbours: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
    inverse_depths: Float64[np.ndarray, " levels"],
) -> Float32[np.ndarray, "h w"]:
    """Inverse depth of every pixel: the prior where it holds, matching and smoothness elsewhere, 0 in the sky.

    Args:
        packed: the view's projection (``WorkingView.packed``).
        world_from_view: its pose.
        rgb: its colours, 0..255.
        prior: measured inverse depth, 1/m; 0 where there is none.
        sky: ``NOT_SKY``, ``MAYBE_SKY`` or ``SKY``.
        neighbours: (packed view, rgb, census) of the views to match against; empty leaves only priors and smoothness.
        inverse_depths: the hypotheses, 1/m, increasing from 0.
    """
    open_pixels = ~(prior > 0)
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    cost = open_costs(packed, world_from_view, rgb, census(gray), open_pixels, neighbours, inverse_depths)
    add_sky(cost, sky[open_pixels], surface_levels(inverse_depths))
    result = smooth_depth(cost, measured_levels(prior, inverse_depths), gray, inverse_depths)
    # The prior is exact where smoothing agrees with it; nearer than the nearest level, smoothing cannot express it.
    step = inverse_depths[-1] / (len(inverse_depths) - 1)
    trusted = (prior > 0) & ((np.abs(result - prior) < 1.5 * step + 0.1 * prior) | (prior > inverse_depths[-2]))
    return np.where(trusted, prior, result).astype(np.float32)


def surface_levels(inverse_depths: Float64[np.ndarray, " levels"]) -> int:
    """The first level that may be a surface; those before it are sky, the one at infinity in any case."""
    return max(1, int(np.searchsorted(inverse_depths, NO_SURFACE, side="right")))


@kernel
def add_sky(cost, sky, surfaces):
    """Bend costs towards infinity in the sky.

    Args:
        cost: [open,levels] int16, in parts of 1 / ``UNIT``; changed.
        sky: [open] ``NOT_SKY``, ``MAYBE_SKY`` or ``SKY``.
        surfaces: the first level that may be a surface.
    """
    for pixel in range(len(sky)):
        if sky[pixel] == SKY:
            for level in range(surfaces, cost.shape[1]):
                cost[pixel, level] += SKY_COST
        elif sky[pixel] == NOT_SKY:
            # Infinity fits any pixel without texture; without this charge plain walls would become sky.
            for level in range(surfaces):
                cost[pixel, level] += NOT_SKY_COST


@kernel
def measured_levels(prior, inverse_depths):
    """Level of each measured inverse depth [h,w] (1/m), in whole parts of 1 / ``PRIOR_COST``; -1 where there is none.

    Between levels [levels], and beyond the last one, it is interpolated.
    """
    height, width = prior.shape
    at = np.full((height, width), -1, np.int32)
    for row in range(height):
        for column in range(width):
            w = prior[row, column]
            if w > 0:
                above = min(max(np.searchsorted(inverse_depths, w), 1), len(inverse_depths) - 1)
                below = inverse_depths[above - 1]
                level = above - 1 + (w - below) / (inverse_depths[above] - below)
                # From some levels beyond the last one on, all levels cost the same.
                at[row, column] = np.int32(np.rint(PRIOR_COST * min(level, len(inverse_depths) + 10.0)))
    return at
