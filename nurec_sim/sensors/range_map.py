"""Range maps: the points of a sweep as images over the beams of its LiDAR, so that beams without a return are known.

Logs store points, not beams. Rows are found from the order of the points if they are stored row by row, otherwise from
their elevation. A row is a cone: its apex may lie above the sensor's origin (the two blocks of an HDL-64E are 0.2 m and
0.12 m above it), so that its elevation, seen from the origin, changes with range. Columns follow from the azimuth.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex128, Float32, Float64, Int32, Int64

from nurec_sim.sensors.range_map_kernels import cone_apex, phase_sums
from nurec_sim.types import LidarModel, Spin

Points = Float64[np.ndarray, "n 3"]
Values = Float64[np.ndarray, " n"]

FEWEST_POINTS = 50
"""A row with fewer points keeps its table's elevation."""
NEAREST_M = 1.0
"""Points nearer than this do not fix a row: they lie on the car or are noise."""
LEAST_SPREAD = 0.3
"""Least spread of the distances that fix the apex of a row, as a part of their median."""
HIGHEST_APEX_M = 0.5
"""Apexes farther from the origin are not of one sensor: the row keeps its table's."""
SCATTERED = 0.5
"""Rows are not known if points lie this far from them, as a part of the distance of random directions."""


SECTORS = 72
"""The rate of turning is measured in so many sectors."""
MOST_COLUMNS = 4.0
"""A point belongs to a beam up to this many columns away: lasers beside the axis (26 mm in an HDL-64E) see near things
at other azimuths, and an encoder counts in steps."""


@dataclass(frozen=True, eq=False)
class RangeMap:
    """A sweep over the beams of its LiDAR.

    Attributes:
        lidar: beams as found in the sweep: rows that occur in it, columns at its own spacing.
        apex_m: height above the sensor's origin at which the beams of each row start.
        point: index of the point that each beam returned, -1 for beams without a return.
        range_m: distance of that point from the sensor's origin, NaN without a return.
        points: number of points in the sweep.
        residual_rad: angle between each mapped point and its beam.
        scatter: median distance of all points from their row as a part of that of random directions: 0 is a perfect
            fit, 1 says that elevations are not those of rows.
        ordered: whether rows were found from the order of the points.
    """

    lidar: LidarModel
    apex_m: Float64[np.ndarray, " rows"]
    point: Int32[np.ndarray, "rows columns"]
    range_m: Float32[np.ndarray, "rows columns"]
    points: int
    residual_rad: Float64[np.ndarray, " mapped"]
    scatter: float
    ordered: bool

    @property
    def mapped(self) -> float:
        """Share of the points that have a beam of their own; NaN for an empty sweep."""
        return len(self.residual_rad) / self.points if self.points else float("nan")

    @property
    def known(self) -> bool:
        """Whether the points are those of this LiDAR's beams: most are mapped, and close to rows."""
        return self.mapped > 0.9 and self.scatter < SCATTERED

    def image(self, values: np.ndarray, missing: float = np.nan) -> np.ndarray:
        """Values of the points, [n], as an image [rows, columns]; beams without a return get ``missing``."""
        if not self.points:
            return np.full(self.point.shape, missing)
        return np.where(self.point >= 0, np.asarray(values)[self.point], missing)

    def fraction(self, point_fraction: Values) -> Float64[np.ndarray, " columns"]:
        """When within the sweep each column was fired, 0..1, from the times of its points."""
        columns = self.point.shape[1]
        seen = np.flatnonzero((self.point >= 0).any(axis=0))
        if not len(seen):
            return np.linspace(0, 1, columns)
        return np.interp(np.arange(columns), seen, np.nanmedian(self.image(point_fraction)[:, seen], axis=0))


def range_map(lidar: LidarModel, xyz_fired_m: Points) -> RangeMap:
    """Maps the points of a sweep to the beams of its LiDAR.

    Args:
        lidar: the nominal model; elevations, spacing of columns and apexes are refined from the points.
        xyz_fired_m: points, each in the sensor frame at its firing time.
    """
    xyz = np.asarray(xyz_fired_m, np.float64).reshape(-1, 3)
    across = np.maximum(np.hypot(xyz[:, 0], xyz[:, 1]), 1e-6)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    found = _rows_in_order(azimuth, xyz[:, 2], across, len(lidar.elevation_rad))
    ordered = found is not None
    if found is None:
        row, elevation, apex = _rows_by_elevation(lidar.elevation_rad, xyz[:, 2], across)
        offset = lidar.row_azimuth_offset_rad
    else:
        row, elevation, apex = found
        # Nominal offsets belong to nominal rows.
        nearest = np.abs(elevation[:, None] - lidar.elevation_rad).argmin(axis=1)
        offset = lidar.row_azimuth_offset_rad[nearest]
    off_row = np.arctan((xyz[:, 2] - apex[row]) / across) - elevation[row]
    spacing = _spacing(elevation)[row]
    scatter = float(np.median(np.abs(off_row) / spacing) * 4) if len(xyz) else np.nan

    sign = -1.0 if lidar.spin is Spin.CLOCKWISE else 1.0
    # From half a column before the first one, so that points at the seam do not become the last ones of a turn.
    half = np.pi / len(lidar.azimuth_rad)
    turned = (sign * (azimuth - lidar.azimuth_rad[0] - offset[row]) + half) % (2 * np.pi) - half
    order = _in_turn(row, turned, len(elevation))
    grid = _columns(lidar, row, turned, order)
    columns, step = len(grid), (grid[-1] - grid[0]) / max(len(grid) - 1, 1)
    place = np.empty(len(xyz), np.int64)
    column = np.interp(turned, np.append(grid, grid[-1] + step), np.arange(columns + 1))
    # Rows fire with a phase of their own: rounding without it would put neighbours onto one column, then skip one.
    phase = np.zeros(len(elevation))
    total = _phases(row, turned, column, columns * step)[0].sum(axis=1)
    phase[: len(total)] = np.angle(total) / (2 * np.pi)
    place[order] = _places(row[order], (column - phase[row])[order])
    offset = offset + sign * phase * step
    good = (np.abs(off_row) <= spacing / 2) & (place >= 0) & (place < columns)
    off_column = turned - grid[np.clip(place, 0, columns - 1)] - phase[row] * step
    good &= np.abs(off_column) <= MOST_COLUMNS * step
    point = np.full((len(elevation), columns), -1, np.int32)
    point[row[good], place[good]] = np.flatnonzero(good)
    own = point[point >= 0]
    distance = np.full(point.shape, np.nan, np.float32)
    distance[point >= 0] = np.linalg.norm(xyz[own], axis=1)
    refined = dataclasses.replace(
        lidar,
        elevation_rad=elevation,
        azimuth_rad=lidar.azimuth_rad[0] + sign * grid,
        row_azimuth_offset_rad=offset,
        blocked=np.zeros(0, np.int64),
    )
    residual = np.hypot(off_row[own], off_column[own] * np.cos(elevation[row[own]]))
    return RangeMap(refined, apex, point, distance, len(xyz), residual, scatter, ordered)


def _rows_in_order(
    azimuth: Values, height: Values, across: Values, most: int
) -> tuple[Int64[np.ndarray, " n"], Values, Values] | None:
    """Rows, their elevations and apexes, if points are stored row by row from one end of the elevations to the other.

    None if they are not.

    Within a row the azimuth advances from where the file starts a turn: straight ahead, behind, or at its first point.
    A new row starts where it falls back by most of a turn.
    """
    if len(azimuth) < 2:
        return None
    step = (np.diff(azimuth) + np.pi) % (2 * np.pi) - np.pi
    sense = 1.0 if np.median(step) >= 0 else -1.0
    for start in (0.0, np.pi, azimuth[0]):
        turned = (sense * (azimuth - start)) % (2 * np.pi)
        row = np.concatenate([[0], np.cumsum(np.diff(turned) < -np.pi)])
        if not 2 <= row[-1] + 1 <= most or np.bincount(row).min() < FEWEST_POINTS:
            continue
        elevation, apex = _cones(row, height, across)
        steps = np.diff(elevation)
        if np.all(steps < 0):
            return row, elevation, apex
        if np.all(steps > 0):
            row = row[-1] - row
            return row, *_cones(row, height, across)
    return None


def _rows_by_elevation(table: Values, height: Values, across: Values) -> tuple[Int64[np.ndarray, " n"], Values, Values]:
    """The nearest row of each point; the elevations of a table are moved to where the points are."""
    elevation, apex = table.copy(), np.zeros(len(table))
    seen = np.arctan(height / across)
    # A device's elevations deviate by 0.2 degrees from its data sheet; denser rows than that can only move together.
    shift = np.radians(np.linspace(-0.3, 0.3, 61))
    some = seen[:: max(len(seen) // 5000, 1)]
    if len(some):
        off = [np.median(np.abs(some - (table + s)[_nearest(table + s, some)])) for s in shift]
        elevation = elevation + shift[int(np.argmin(off))]
    for _ in range(2):
        row = _nearest(elevation, seen)
        elevation = np.where(
            np.bincount(row, minlength=len(table)) < FEWEST_POINTS, elevation, _medians(row, seen, elevation)
        )
        elevation = np.where(np.append(np.diff(elevation) < 0, True), elevation, table)
    return _nearest(elevation, seen), elevation, apex


def _nearest(falling: Values, value: Values) -> Int64[np.ndarray, " n"]:
    """Index of the nearest of falling values."""
    middle = -(falling[1:] + falling[:-1]) / 2
    return np.searchsorted(middle, -value)


def _medians(group: Int64[np.ndarray, " n"], value: Values, missing: Values) -> Values:
    """Median of each group; ``missing`` where it is empty."""
    result, (order, ends) = np.array(missing, np.float64), _by_row(group, len(missing))
    for k, (start, end) in enumerate(zip(ends[:-1], ends[1:], strict=True)):
        if start < end:
            middle = (end - start) // 2
            result[k] = np.partition(value[order[start:end]], middle)[middle]
    return result


def _by_row(row: Int64[np.ndarray, " n"], rows: int) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " rows+1"]]:
    """Indices of points sorted by row, in their order within each row, and where each row starts and the last ends."""
    # Numbers of 16 bits are not compared but counted.
    order = np.argsort(row.astype(np.uint16) if rows <= 1 << 16 else row, kind="stable")
    return order, np.concatenate([[0], np.cumsum(np.bincount(row, minlength=rows))])


def _in_turn(row: Int64[np.ndarray, " n"], turned: Values, rows: int) -> Int64[np.ndarray, " n"]:
    """Indices of points sorted by row, and by angle within each row."""
    order, ends = _by_row(row, rows)
    for start, end in zip(ends[:-1], ends[1:], strict=True):
        mine = order[start:end]
        order[start:end] = mine[np.argsort(turned[mine], kind="stable")]
    return order


def _cones(row: Int64[np.ndarray, " n"], height: Values, across: Values) -> tuple[Values, Values]:
    """Elevation and apex of each row: the line height = apex + across * tan(elevation), fitted robustly.

    Rows that see one distance only, such as flat ground, take the apex of the nearest row that is fitted.
    """
    count = row.max() + 1
    apex = np.full(count, np.nan)
    usable = np.flatnonzero(across > NEAREST_M)
    order, ends = _by_row(row[usable], count)
    usable = usable[order]
    height_of, across_of = height[usable], across[usable]
    for k in range(count):
        z, rho = height_of[ends[k] : ends[k + 1]], across_of[ends[k] : ends[k + 1]]
        if len(z) < FEWEST_POINTS:
            continue
        spread, most = np.ptp(rho), rho.max()
        # The median is at most the largest one, which is known at once.
        if spread < LEAST_SPREAD * most and spread < LEAST_SPREAD * np.median(rho):
            continue
        a = cone_apex(z, rho)
        apex[k] = a if abs(a) < HIGHEST_APEX_M else np.nan
    fitted = np.flatnonzero(np.isfinite(apex))
    if len(fitted):
        apex = apex[fitted[np.abs(np.arange(count)[:, None] - fitted).argmin(axis=1)]]
    apex = np.nan_to_num(apex)
    return _medians(row, np.arctan((height - apex[row]) / across), np.zeros(count)), apex


def _spacing(falling: Values) -> Values:
    """Angle from each row to its nearest neighbour."""
    if len(falling) < 2:
        return np.full(len(falling), np.radians(1.0))
    gap = -np.diff(falling)
    return np.minimum(np.append(gap, gap[-1]), np.insert(gap, 0, gap[0]))


def _columns(lidar: LidarModel, row: Int64[np.ndarray, " n"], turned: Values, order: Int64[np.ndarray, " n"]) -> Values:
    """Angle turned at each column, from the distance between neighbouring points of a row; the model's if too few.

    The rate of a turn varies by some percent, so the distance is measured in sectors. ``order`` sorts points by row and
    angle.
    """
    columns = len(lidar.azimuth_rad)
    step = abs(float(lidar.azimuth_rad[-1] - lidar.azimuth_rad[0])) / max(columns - 1, 1) or 2 * np.pi
    span = step * columns
    gap, at = np.diff(turned[order]), turned[order][1:]
    # An encoder's steps average out; gaps of several columns are left out.
    near = (np.diff(row[order]) == 0) & (gap > 0.3 * step) & (gap < 1.45 * step)
    gap, sector = gap[near], np.clip(at[near] / span * SECTORS, 0, SECTORS - 1).astype(np.int64)
    if len(gap) < FEWEST_POINTS:
        return step * np.arange(columns)
    count = np.bincount(sector, minlength=SECTORS)
    mean = np.bincount(sector, gap, minlength=SECTORS) / np.maximum(count, 1)
    mean = np.where(count < FEWEST_POINTS, gap.mean(), mean)
    passed = np.concatenate([[0.0], np.cumsum(span / SECTORS / mean)])
    passed *= round(passed[-1]) / passed[-1]
    edges = np.linspace(0, span, SECTORS + 1)
    for _ in range(3):
        drift = _phases(row, turned, np.interp(turned, edges, passed), span)[1]
        passed -= np.interp(edges, (edges[1:] + edges[:-1]) / 2, drift)
    found = np.arange(round(float(passed[-1] - passed[0])))
    return np.interp(found, passed - passed[0], edges)


def _phases(
    row: Int64[np.ndarray, " n"], turned: Values, column: Values, span: float
) -> tuple[Complex128[np.ndarray, "rows sectors"], Float64[np.ndarray, " sectors"]]:
    """Sums of the points' phases (one turn per column) by row and sector, and the drift of all rows over the sectors.

    The drift is that from sector to sector, of all rows together, summed up: 0 in the first one.
    """
    rows = int(row.max(initial=0)) + 1
    real, imaginary = phase_sums(row, turned, column, float(span), rows, SECTORS)
    total = (real + 1j * imaginary).reshape(rows, SECTORS)
    steps = np.angle((total[:, 1:] * total[:, :-1].conj()).sum(axis=0)) / (2 * np.pi)
    return total, np.concatenate([[0.0], np.cumsum(steps)])


def _places(row: Int64[np.ndarray, " n"], column: Values) -> Int64[np.ndarray, " n"]:
    """Nearest whole columns of points sorted by row and column, but rising, so that points do not collide."""
    whole, index = np.rint(column).astype(np.int64), np.arange(len(row))
    # Rows are kept apart by an offset; within a row place[i] >= place[i - 1] + 1.
    apart = row * (2 * int(whole.max(initial=0)) + len(row) + 2)
    return np.maximum.accumulate(whole + apart - index) + index - apart
