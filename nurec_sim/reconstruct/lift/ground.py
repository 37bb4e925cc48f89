"""The ground as a height grid, fitted to the lowest points near the driven path."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.lift.cloud import Cloud
from nurec_sim.reconstruct.lift.road import DRIVEN_M, FILL_M, grow_road
from nurec_sim.reconstruct.lift.settings import GroundSettings

MAX_CELLS = 16_000_000
"""Larger grids get larger cells."""
BAND_M, BAND_SLOPE = 0.4, 0.08
"""Ground is looked for this far above and below the driven path, and this much more per metre away from it."""
BESIDE_M, FEWEST_BESIDE, LEAST_RISE_M = 3.0, 30, 0.03
"""Under the car, the ground is as far from the path as the median of the returns this near to it, if there are so many:
the origins of rigs lie on the ground within a decimetre only. Less than the last is the crown of the road."""
EVEN_M = 0.6
"""Standard deviation of the Gaussian that evens out a road of which there is one sweep; with more, as much less."""
UNDER_M = 0.05
"""Returns from under a vehicle are of the ground if they lie this near to it, and else of wheels and sills."""
LEAST_MASS = 0.01
"""Where less than this share of the cells around was measured, the road is as even as it gets by filling holes."""
ENOUGH_SHARE, ENOUGH_CELLS = 0.12, 3.0
"""A hole is filled with the mean under the narrowest Gaussian that holds this share of measured cells, or as many."""


@dataclass(frozen=True)
class Ground:
    """Heights over a grid of the world's x, y; row and column 0 start at ``corner_m``.

    ``height_m`` is smooth and has no holes; ``known`` says where it was measured, ``near`` where it is measured or
    filled over a short distance, ``road`` where a car can drive to from the path without meeting a step, ``stride`` how
    many cells one point of the sheet represents.
    """

    corner_m: Float64[np.ndarray, " 2"]
    cell_m: float
    height_m: Float32[np.ndarray, "rows columns"]
    known: Bool[np.ndarray, "rows columns"]
    near: Bool[np.ndarray, "rows columns"]
    road: Bool[np.ndarray, "rows columns"]
    stride: UInt8[np.ndarray, "rows columns"]

    def cells(self, xyz_m: Float64[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, " n"]]:
        """Row and column (clipped to the grid) of points, and whether they lie in it."""
        return _cells(np.asarray(xyz_m, np.float64), *self.corner_m, self.cell_m, *self.height_m.shape)

    def above(self, xyz_m: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Height of points above the ground; infinite outside of the known ground and its short fills."""
        return _above(np.asarray(xyz_m, np.float64), *self.cells(xyz_m), self.height_m, self.near)

    def is_road(self, xyz_m: Float64[np.ndarray, "n 3"], tolerance_m: float = 0.12) -> Bool[np.ndarray, " n"]:
        """Points on the road surface."""
        row, column, inside = self.cells(xyz_m)
        flat = np.abs(np.asarray(xyz_m)[:, 2] - self.height_m[row, column]) < tolerance_m
        return inside & flat & self.road[row, column]

    def sheet(self, static: Cloud) -> Cloud:
        """The ground as one regular cloud wherever it is known or filled over a short distance.

        One point per cell near the driven path, per 2 x 2 cells from 8 m on and per 4 x 4 from 16 m on. Intensity
        is the mean of the points in the cell, or in its surroundings; NaN where there are none.
        """
        size = self.stride
        rows, columns = np.arange(size.shape[0])[:, None], np.arange(size.shape[1])[None]
        row, column = np.nonzero(self.near & (rows % size == 0) & (columns % size == 0))
        size = size[row, column]
        row, column = (
            np.minimum(i + size // 2, n - 1) for i, n in zip((row, column), self.height_m.shape, strict=True)
        )
        xyz = np.column_stack([self.corner_m + (np.column_stack([column, row]) + (size % 2)[:, None] / 2) * self.cell_m,
                               self.height_m[row, column]])  # fmt: skip
        source = static[np.abs(self.above(static.xyz_m)) < 0.1]
        known = np.isfinite(source.intensity)
        r, c, _ = self.cells(source.xyz_m[known])
        total, count = np.zeros(self.height_m.shape, np.float32), np.zeros(self.height_m.shape, np.float32)
        np.add.at(total, (r, c), source.intensity[known])
        np.add.at(count, (r, c), 1)
        for width in (5, 21, 61):
            soft_total, soft_count = cv2.blur(total, (width, width)), cv2.blur(count, (width, width))
            empty = count == 0
            total, count = np.where(empty, soft_total, total), np.where(empty, soft_count, count)
        with np.errstate(invalid="ignore", divide="ignore"):
            intensity = np.where(count > 1e-6, total / count, np.nan)[row, column]
        spacing = (size * self.cell_m).astype(np.float32)
        eye = xyz + (0, 0, 2.0)
        return Cloud(xyz, eye, spacing, intensity.astype(np.float32))

    @cached_property
    def normals(self) -> Float64[np.ndarray, "rows columns 3"]:
        """Upward unit normals of the smoothed surface."""
        smooth = cv2.GaussianBlur(self.height_m, (0, 0), 3.0)
        slope_y, slope_x = np.gradient(smooth.astype(np.float64), self.cell_m)
        normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


@kernel
def _cells(xyz, x, y, cell, rows, columns):
    """``Ground.cells`` of a grid that starts at x, y."""
    row, column, inside = np.empty(len(xyz), np.int64), np.empty(len(xyz), np.int64), np.empty(len(xyz), np.bool_)
    for i in range(len(xyz)):
        a, b = np.floor((xyz[i, 0] - x) / cell), np.floor((xyz[i, 1] - y) / cell)
        inside[i] = 0 <= a < columns and 0 <= b < rows
        row[i], column[i] = np.int64(min(max(b, 0.0), rows - 1.0)), np.int64(min(max(a, 0.0), columns - 1.0))
    return row, column, inside


@kernel
def _above(xyz, row, column, inside, height_m, near):
    """``Ground.above``."""
    result = np.full(len(xyz), np.inf)
    for i in range(len(xyz)):
        if inside[i] and near[row[i], column[i]]:
            result[i] = xyz[i, 2] - height_m[row[i], column[i]]
    return result


def find_ground(
    xyz_m: Float64[np.ndarray, "n 3"],
    world_from_rig: Float64[np.ndarray, "k 4 4"],
    settings: GroundSettings,
    under_m: Float64[np.ndarray, "m 3"] | None = None,
    sweeps: int | None = None,
) -> Ground:
    """Fit the height grid to the lowest points near the driven path and grow the road from it.

    Args:
        xyz_m: points of the static world.
        world_from_rig: the driven path.
        settings: cells, and what ends a road.
        under_m: points in the lowest part of boxes. Where nothing else was measured they tell heights, but not where
            the road ends: a ring of returns from wheels would fence off what is under a parked car.
        sweeps: how many sweeps the points are of; None: many.
    """
    from scipy.spatial import cKDTree

    path = densify_path(world_from_rig)
    low, high = path[:, :2].min(axis=0) - settings.reach_m, path[:, :2].max(axis=0) + settings.reach_m
    cell = max(settings.cell_m, float(np.sqrt(np.prod(high - low) / MAX_CELLS)))
    columns, rows = (np.ceil((high - low) / cell)).astype(int)
    centres_x, centres_y = low[0] + (np.arange(columns) + 0.5) * cell, low[1] + (np.arange(rows) + 0.5) * cell
    # Distance to the path and its height at each cell, on a grid four times coarser: both change slowly.
    coarse = np.stack(np.meshgrid(centres_x[::4], centres_y[::4]), axis=-1)
    distance, nearest = cKDTree(path[:, :2]).query(coarse)
    distance = cv2.resize(distance.astype(np.float32), (columns, rows), interpolation=cv2.INTER_LINEAR)
    expected = cv2.resize(path[nearest, 2].astype(np.float32), (columns, rows), interpolation=cv2.INTER_LINEAR)

    def in_grid(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        index = np.floor((xyz[:, :2] - low) / cell).astype(np.int64)
        inside = np.all((index >= 0) & (index < (columns, rows)), axis=1)
        return xyz[inside], index[inside, 1] * columns + index[inside, 0]

    points, flat = in_grid(xyz_m)
    offset = points[:, 2] - expected.reshape(-1)[flat]
    # The band widens with the distance: the ground may slope away from the path.
    band = np.abs(offset) < BAND_M + BAND_SLOPE * distance.reshape(-1)[flat]
    height, known = _low_heights(points[band, 2], flat[band], rows, columns)
    beside = offset[band & (distance.reshape(-1)[flat] < BESIDE_M)]
    rise = float(np.median(beside)) if len(beside) >= FEWEST_BESIDE else 0.0
    for x, y, z in path + (0, 0, rise if abs(rise) > LEAST_RISE_M else 0.0):
        row, column = int((y - low[1]) / cell), int((x - low[0]) / cell)
        if not known[row, column]:
            height[row, column], known[row, column] = z, True
    known &= distance <= settings.reach_m
    known = _drop_raised(height, known, cell)
    filled = _fill(height, known)
    above = points[:, 2] - filled.reshape(-1)[flat]
    tall = np.bincount(flat[(above > 0.2) & (above < 1.5)], minlength=rows * columns).reshape(rows, columns) >= 2
    road = grow_road(filled, known, tall, distance, low, cell, world_from_rig, settings)
    if under_m is not None:
        points, flat = in_grid(under_m)
        below = np.abs(points[:, 2] - filled.reshape(-1)[flat]) < UNDER_M
        more, measured = _low_heights(points[below, 2], flat[below], rows, columns)
        filled, known = _fill(np.where(known, height, more), known | measured), known | measured
    if sweeps is not None and EVEN_M >= sweeps * cell:
        filled = _evened(filled, road, known, EVEN_M / sweeps / cell)
    near = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, 5) * cell <= FILL_M
    stride = np.where(distance < 8, 1, np.where(distance < 16, 2, 4)).astype(np.uint8)
    return Ground(low, cell, filled, known, near | (distance < DRIVEN_M), road, stride)


def densify_path(world_from_rig: Float64[np.ndarray, "k 4 4"], step_m: float = 0.1) -> Float64[np.ndarray, "m 3"]:
    """Contact points of a car driving along the poses: a footprint of 4 x 1.6 m at each end, its middle between."""
    position = world_from_rig[:, :3, 3]
    pieces = [position[:1]]
    for a, b in zip(position[:-1], position[1:], strict=True):
        count = max(int(np.linalg.norm(b - a) / step_m), 1)
        pieces.append(a + (b - a) * np.arange(1, count + 1)[:, None] / count)
    along, across = np.meshgrid(np.arange(-0.8, 3.2, step_m), np.arange(-0.8, 0.81, 0.2))
    footprint = np.column_stack([along.ravel(), across.ravel(), np.zeros(along.size)])
    for end in (world_from_rig[0], world_from_rig[-1]):
        pieces.append(footprint @ end[:3, :3].T + end[:3, 3])
    return np.concatenate(pieces)


def _low_heights(z: np.ndarray, flat: np.ndarray, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean height of the lowest centimetres in each cell: less noisy than a quantile, unaffected by objects on it."""
    height = np.zeros(rows * columns, np.float32)
    known = np.zeros(rows * columns, bool)
    if len(z):
        order = np.lexsort((z, flat))
        z, flat = z[order], flat[order]
        first = np.flatnonzero(np.concatenate([[True], flat[1:] != flat[:-1]]))
        count = np.diff(np.append(first, len(flat)))
        # The lowest fifth is skipped: stray returns below the road.
        low = z[first + count // 5]
        close = np.abs(z - np.repeat(low, count)) < 0.06
        total, number = np.add.reduceat(np.where(close, z, 0.0), first), np.add.reduceat(close.astype(float), first)
        height[flat[first]], known[flat[first]] = total / number, True
    return height.reshape(rows, columns), known.reshape(rows, columns)


def _drop_raised(height: np.ndarray, known: np.ndarray, cell_m: float) -> np.ndarray:
    """Cells far above the lowest ground around them are tops of things, not ground."""
    low = np.where(known, height, 1e6).astype(np.float32)
    # First small things, then larger ones, whose middle the small window cannot see past.
    for edge_m, rise_m in ((1.0, 0.3), (4.0, 0.5)):
        size = 2 * int(edge_m / cell_m / 2) + 1
        low = np.where(known, low, 1e6).astype(np.float32)
        around = cv2.erode(low, np.ones((size, size), np.uint8))
        known = known & (height - around < rise_m)
    return known


def _evened(height: np.ndarray, road: np.ndarray, known: np.ndarray, sigma: float) -> np.ndarray:
    """Heights of which those of the road are even over ``sigma`` cells, and end at its kerbs.

    A beam's elevation is wrong by hundredths of a degree. The rings of one sweep then lie centimetres too high or too
    low, and from beside the path the lines on such a road wind. What the mean takes away from crowns and ramps is added
    again, as far as it is even itself (twicing, Tukey 1977).
    """
    weight = (road & known).astype(np.float32)
    mass = cv2.GaussianBlur(weight, (0, 0), sigma)

    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(values * weight, (0, 0), sigma) / np.maximum(mass, 1e-6)

    once = mean(height)
    return np.where(road & (mass > LEAST_MASS), once + mean(height - once), height)


def _fill(height: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Normalised smoothing with ever wider Gaussians: each cell takes the finest that saw enough."""
    weight, value = known.astype(np.float32), np.where(known, height, 0).astype(np.float32)
    result, done = np.zeros_like(value), np.zeros(value.shape, bool)
    for sigma in (0.8, 1.6, 3.2, 6.4, 12.8, 25.6, 51.2, 102.4):
        shrink = max(1, int(sigma / 3))
        size = (max(value.shape[1] // shrink, 1), max(value.shape[0] // shrink, 1))
        small = [cv2.resize(a, size, interpolation=cv2.INTER_AREA) for a in (value, weight)]
        small = [cv2.GaussianBlur(a, (0, 0), sigma / shrink, borderType=cv2.BORDER_CONSTANT) for a in small]
        total, mass = (cv2.resize(a, value.shape[::-1], interpolation=cv2.INTER_LINEAR) for a in small)
        # Beams are sparse far away: a share of the cells would never be reached there, a number of them is.
        take = ~done & (mass > min(ENOUGH_SHARE, ENOUGH_CELLS / (2 * np.pi * sigma**2)))
        result[take], done = total[take] / mass[take], done | take
    if done.any() and not done.all():
        result[~done] = np.median(result[done])
    return result
