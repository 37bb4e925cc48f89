"""Silhouettes in depth pictures cut back to the edges in the image, by a weighted median (Ma et al. 2013).

Surfels reach over silhouettes, and so do windows of matching: near surfaces are up to three pixels too wide in depth
pictures, and carry the colours of what lies behind them. Of the pixels around one, those that look like it are most
often of its surface.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from nurec_sim.compute.kernels import inner, kernel
from nurec_sim.reconstruct.lift.depth import NO_SURFACE

REACH_PX = 5
"""Half the edge of the window, less half a pixel."""
ALIKE = 15.0
"""Levels of 255, summed over the channels, that two colours differ by for a weight of 1/e."""
SAME, SAME_FAR = 0.1, 0.003
"""Inverse depths of one surface differ by less than this share, plus 1/m."""

_WEIGHTS = np.exp(-np.arange(3 * 255 + 1) / ALIKE).astype(np.float32)


def trim_edges(
    inverse_depth: Float32[np.ndarray, "h w"], rgb: UInt8[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w"]:
    """Inverse depth in which pixels take that of a surface behind them, if most pixels that look alike show one.

    "Most" is by weight: the new depth is the median of the window, in which each pixel counts as much as its colour is
    alike. Pixels never come nearer, which would close the gaps of fences and crowns of trees; and they do not become
    sky, which shines through crowns everywhere.

    Args:
        inverse_depth: 1/m, 0 in the sky; NaN takes no part.
        rgb: colours, 0..255.
    """
    surfaces = np.where(inverse_depth > NO_SURFACE, inverse_depth, np.float32(np.inf))
    behind = cv2.erode(surfaces, np.ones((2 * REACH_PX + 1, 2 * REACH_PX + 1), np.uint8))
    return _trimmed(inverse_depth, behind, rgb, _WEIGHTS)


@inner
def _median(values, weights, total):
    """The first value, in their order, at which the weights up to it are half of their total."""
    reached = np.float32(0)
    for k in np.argsort(values):
        reached += weights[k]
        if reached >= 0.5 * total:
            return values[k]
    return values.max()


@kernel
def _trimmed(inverse_depth, behind, rgb, weights):
    """``trim_edges`` with the farthest surface [h,w] in each window, and weights [766] of differences of colour."""
    height, width = inverse_depth.shape
    result, most = inverse_depth.copy(), (2 * REACH_PX + 1) ** 2
    depths, shares = np.empty(most, np.float32), np.empty(most, np.float32)
    for row in range(height):
        top, bottom = max(row - REACH_PX, 0), min(row + REACH_PX + 1, height)
        for column in range(width):
            own = inverse_depth[row, column]
            another = own - SAME * own - SAME_FAR
            if not behind[row, column] <= another:
                continue
            red, green, blue = rgb[row, column]
            count, total, same = 0, np.float32(0), np.float32(0)
            for r in range(top, bottom):
                for c in range(max(column - REACH_PX, 0), min(column + REACH_PX + 1, width)):
                    other = inverse_depth[r, c]
                    if not other >= 0:
                        continue
                    apart = abs(np.int32(rgb[r, c, 0]) - np.int32(red)) + abs(np.int32(rgb[r, c, 1]) - np.int32(green))
                    share = weights[apart + abs(np.int32(rgb[r, c, 2]) - np.int32(blue))]
                    total += share
                    if abs(other - own) < SAME * max(other, own) + SAME_FAR:
                        same += share
                    depths[count], shares[count] = other, share
                    count += 1
            # Most pixels agree with those that look like them, and need not be sorted.
            if same < 0.5 * total:
                median = _median(depths[:count], shares, total)
                if NO_SURFACE < median <= another:
                    result[row, column] = median
    return result
