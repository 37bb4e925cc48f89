"""Ground heights around a recorded path, propagated from the wheel contacts over road-class Gaussians.

Small height steps keep the result on the driven surface: bridges above and roads below are never reached.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

PITCH_M = 0.5
STEP_M = 0.15
"""Constant part of the height difference allowed between neighbouring cells ..."""
STEP_PER_M = 0.08
"""... and its part per metre: roads slope and bank, kerbs are 0.10 to 0.20 m."""
SEED_STEP_M = 0.5
"""Height difference allowed under the wheels, relative to the recorded pose."""
QUANTILE = 0.2
PLANE_SIGMA_M = 3.0
MAX_SLOPE = 0.15


@dataclass(frozen=True)
class GroundHeights:
    """Height of the ground in cells of ``PITCH_M``; ``observed`` marks the cells that have road Gaussians."""

    origin_m: tuple[float, float]
    height_m: Float64[np.ndarray, "rows columns"]
    observed: np.ndarray

    def at(self, xy_m: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, " n"]:
        """Heights at points, bilinear between cell centres; constant beyond the border."""
        from scipy.ndimage import map_coordinates

        place = (np.asarray(xy_m, np.float64) - np.asarray(self.origin_m)) / PITCH_M - 0.5
        return map_coordinates(self.height_m, [place[:, 1], place[:, 0]], order=1, mode="nearest")


def fit_ground(
    road_m: Float64[np.ndarray, "n 3"],
    path_m: Float64[np.ndarray, "k 3"],
    low_m: tuple[float, float],
    high_m: tuple[float, float],
) -> GroundHeights:
    """Ground heights over a rectangle.

    Args:
        road_m: centres of road-class Gaussians.
        path_m: points where the wheels touched the ground, closely spaced.
        low_m: lower corner of the rectangle (x, y).
        high_m: upper corner.
    """
    columns, rows = (int(np.ceil((high_m[axis] - low_m[axis]) / PITCH_M)) for axis in (0, 1))

    def cell_of(xy: np.ndarray) -> np.ndarray:
        index = np.floor((xy - np.asarray(low_m)) / PITCH_M).astype(np.int64)
        return np.clip(index[:, 1], 0, rows - 1) * columns + np.clip(index[:, 0], 0, columns - 1)

    heights = _CellHeights(cell_of(road_m[:, :2]), road_m[:, 2])
    flat_level = np.full(rows * columns, np.nan)
    path_cells = cell_of(path_m[:, :2])
    seeds, inverse, counts = np.unique(path_cells, return_inverse=True, return_counts=True)
    wheels = np.bincount(inverse, path_m[:, 2]) / counts
    # Wheel contacts seed the growth. Where Gaussians lie near them these take precedence, since the recorded pose may
    # be off relative to the reconstruction.
    found = heights.low_quantile(seeds, wheels, SEED_STEP_M)
    flat_level[seeds] = np.where(np.isnan(found), wheels, found)

    level = flat_level.reshape(rows, columns)
    while _grow(level, heights):
        pass
    observed = np.isfinite(level)
    return GroundHeights((float(low_m[0]), float(low_m[1])), _extrapolate(level, observed), observed)


class _CellHeights:
    """Heights sorted within cells, so that a quantile inside a gate takes two binary searches."""

    def __init__(self, cell: np.ndarray, height_m: np.ndarray) -> None:
        # One sorted key for both: cell index times a span larger than all heights, plus the height.
        order = np.lexsort((height_m, cell))
        self.base = float(height_m.min()) - 1.0
        self.span = float(height_m.max()) - self.base + 1.0
        self.height = height_m[order]
        self.key = cell[order] * self.span + (self.height - self.base)

    def low_quantile(self, cell: np.ndarray, around_m: np.ndarray, gate_m: float) -> np.ndarray:
        """The ``QUANTILE`` of the heights within ``gate_m`` of ``around_m`` in each cell; NaN where there is none."""
        offset = np.clip(around_m - self.base, 0, self.span - 1e-6)
        first = np.searchsorted(self.key, cell * self.span + np.maximum(offset - gate_m, 0))
        last = np.searchsorted(self.key, cell * self.span + np.minimum(offset + gate_m, self.span - 1e-6), side="right")
        at = np.minimum(first + np.floor(QUANTILE * (last - first)).astype(np.int64), len(self.height) - 1)
        return np.where(last > first, self.height[at], np.nan)


def _grow(level: np.ndarray, heights: _CellHeights) -> bool:
    """Accepts neighbours of accepted cells with matching heights; False if nothing was added."""
    rows, columns = level.shape
    # Mean height of the accepted cells among the eight neighbours; the cell itself is still unknown where it matters.
    total, count = np.zeros_like(level), np.zeros(level.shape, np.int64)
    padded = np.pad(level, 1, constant_values=np.nan)
    for dy in (0, 1, 2):
        for dx in (0, 1, 2):
            neighbour = padded[dy : dy + rows, dx : dx + columns]
            known = np.isfinite(neighbour)
            total[known] += neighbour[known]
            count += known
    front = np.flatnonzero(np.isnan(level) & (count > 0))
    around = total.reshape(-1)[front] / count.reshape(-1)[front]
    found = heights.low_quantile(front, around, STEP_M + STEP_PER_M * PITCH_M)
    level.reshape(-1)[front] = found
    return bool(np.isfinite(found).any())


def _extrapolate(level: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Fill unobserved cells from the plane fitted around the nearest observed one."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    rows, columns = np.indices(level.shape)
    x, y = np.asarray(columns * PITCH_M), np.asarray(rows * PITCH_M)
    weight = observed.astype(np.float64)
    base = float(level[observed].mean())
    z: np.ndarray = np.where(observed, level - base, 0.0)

    def smooth(values: np.ndarray) -> np.ndarray:
        return gaussian_filter(values * weight, PLANE_SIGMA_M / PITCH_M, mode="constant", truncate=2.0)

    # Weighted least-squares plane around every cell from smoothed first and second moments. Heights are taken relative
    # to their mean ``base`` to limit cancellation.
    mass = np.maximum(smooth(np.ones_like(z)), 1e-12)
    mean_x, mean_y, mean_z = smooth(x) / mass, smooth(y) / mass, smooth(z) / mass
    xx, yy = smooth(x * x) / mass - mean_x**2, smooth(y * y) / mass - mean_y**2
    xy = smooth(x * y) / mass - mean_x * mean_y
    xz, yz = smooth(x * z) / mass - mean_x * mean_z, smooth(y * z) / mass - mean_y * mean_z
    ridge = 0.05  # m^2, ridge term: the cross slope of a narrow strip is unobservable; keep it level
    xx, yy = xx + ridge, yy + ridge
    determinant = np.maximum(xx * yy - xy**2, 1e-9)
    slope_x = np.clip((xz * yy - yz * xy) / determinant, -MAX_SLOPE, MAX_SLOPE)
    slope_y = np.clip((yz * xx - xz * xy) / determinant, -MAX_SLOPE, MAX_SLOPE)

    nearest = distance_transform_edt(~observed, return_distances=False, return_indices=True)
    row, column = nearest[0], nearest[1]
    plane = mean_z[row, column] + slope_x[row, column] * (x - mean_x[row, column])
    plane += slope_y[row, column] * (y - mean_y[row, column])
    return np.where(observed, level, plane + base)
