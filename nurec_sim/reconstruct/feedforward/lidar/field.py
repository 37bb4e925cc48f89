"""Factors on an image's depth that follow LiDAR points across the image and across depth.

A factor belongs to a cell of the image and of log depth (a bilateral grid, Chen et al. 2007), so that points on a car
do not change the house behind it. Grids are refined step by step: where points are sparse, only coarse ones have data.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import gaussian_filter, map_coordinates

CELLS_PER_WIDTH = (10, 20, 40, 80, 160)
LOG_DEPTH_CELLS = (0.8, 0.4, 0.2, 0.1, 0.05)
"""Edges of the cells, across the image and in the logarithm of depth, from coarse to fine."""
SPREAD_CELLS = 1.0
"""Standard deviation by which a point's factor spreads."""
DOUBT = 0.015
"""Spread weight at which a factor counts half; a single point has 0.06 in its own cell."""
LARGEST_LOG = 1.5
"""Points that differ by a larger factor belong to something that the image does not show there."""
LEAST_DEVIATION = 0.02


def field_factor(
    depth_m: Float64[np.ndarray, "h w"],
    use: Bool[np.ndarray, "h w"],
    uv: Float64[np.ndarray, "n 2"],
    measured_m: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, "h w"]:
    """Factors on an image's depth; 1 where no point is near.

    Args:
        depth_m: predicted depth, already right on the whole.
        use: pixels that may be compared.
        uv: pixels of the points.
        measured_m: their depth.
    """
    height, width = depth_m.shape
    column, row = np.clip(np.floor(uv).astype(np.int64), 0, (width - 1, height - 1)).T
    near = use[row, column]
    column, row, measured = column[near], row[near], np.log(measured_m[near])
    places = np.mgrid[:height, :width].astype(np.float64)
    first = log_depth = np.log(depth_m.astype(np.float64))
    for cells, thick in zip(CELLS_PER_WIDTH, LOG_DEPTH_CELLS, strict=True):
        residual = measured - log_depth[row, column]
        if not len(residual):
            break
        # 1.4826 * MAD estimates the standard deviation of a normal distribution, unmoved by outliers.
        deviation = max(1.4826 * float(np.median(np.abs(residual))), LEAST_DEVIATION)
        # Cauchy weights from three deviations on; they shrink as the field fits better from level to level.
        weight = (np.abs(residual) < LARGEST_LOG) / (1 + (residual / (3 * deviation)) ** 2)
        # Where each pixel lies in the grid.
        lowest = log_depth.min()
        grid = np.stack([*(places * cells / width), (log_depth - lowest) / thick])
        shape = tuple(int(axis.max()) + 2 for axis in grid)
        cell = tuple(np.rint(grid[:, row, column]).astype(np.int64))
        total, known = np.zeros(shape), np.zeros(shape)
        np.add.at(total, cell, weight * residual)
        np.add.at(known, cell, weight)
        # Normalised convolution: blurred residuals over blurred weights; DOUBT pulls towards no change where there are
        # few.
        total, known = (gaussian_filter(each, SPREAD_CELLS, mode="constant") for each in (total, known))
        # Trilinear slicing at each pixel's own depth: the factor is smooth within a surface and may jump between
        # surfaces.
        log_depth = log_depth + map_coordinates(total / (known + DOUBT), grid, order=1, mode="nearest")
    return np.exp(log_depth - first)
