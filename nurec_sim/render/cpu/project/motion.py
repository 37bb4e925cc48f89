"""Vector code for sensors that move while they look: the line that sees a Gaussian, and boxes that hold for all lines.

A *line* is a set of rays fired at one instant. A box seen from the pose of one line, the one that sees the centre,
holds for other lines once it is widened by how far places move in between: the turn of directions times the rate of
the chart. Places move more slowly than lines pass, so only lines near the box see it at all. Assumption: what moves
past at less than half the pace of the lines near its box is not seen again by distant lines.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32
from llvmlite import ir

from nurec_sim.render.cpu.project.charts import PER_RADIAN, PERIOD, SHIFTED
from nurec_sim.render.cpu.project.outlines import CellBox, LensChart, LensCone, LidarChart, LidarCone, Outline, Texels
from nurec_sim.render.cpu.records import CELLS, CENTRE, LOG_P, ROTATION, SIGMA, STEP, dot
from nurec_sim.render.cpu.simd import BITS, I64, LANES, Lanes, Mask, Vector, vector_kernel

# Scratch of a group seen from the pose of its line: as ``records`` lays it out, with these behind LOG_P.
LINE, VELOCITY = 16, 17

# Parameters of a motion: lines, 1 where they are columns, radians and metres (three components, length) per line.
LINES, BY_COLUMN, TURN_RATE, TRAVEL_RATE, SPEED = 0, 1, 2, 3, 6
MOTION = 7

TO_LINE = 12
"""First column of line_from_reference in ``ExposureView.lines``: rotation, translation."""
LINE_COLUMNS = 24
MOST = 1e3
"""Radians that represent any turn."""
APART = 16
"""Bits between masks in one integer."""


class LinePath(NamedTuple):
    """Where a sensor is when each of its lines is fired."""

    lines: Float32[np.ndarray, "l 24"]
    """See ``view.ExposureView``; a single row where nothing moves."""
    motion: Float32[np.ndarray, " 7"]
    """See ``motion_parameters``."""


def motion_parameters(lines: Float32[np.ndarray, "l 24"], line_axis: int) -> Float32[np.ndarray, " 7"]:
    """What the kernels need to know of the poses of ``ExposureView.lines``, which follow each other evenly."""
    first, last = lines[0].astype(np.float64), lines[-1].astype(np.float64)
    steps = max(len(lines) - 1, 1)
    turn = first[:9].reshape(3, 3).T @ last[:9].reshape(3, 3)
    sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    angle = math.atan2(sine, (np.trace(turn) - 1) / 2)
    travel = (last[9:12] - first[9:12]) / steps
    return np.array([len(lines), line_axis, angle / steps, *travel, np.linalg.norm(travel)], np.float32)


@vector_kernel("iiiii")
def lens_lines(
    v: Lanes, scratch: ir.Value, params: ir.Value, places: ir.Value, motion: ir.Value, local: ir.Value
) -> None:
    """The image row (or column) in which the centres are seen from their current poses.

    Args:
        v: vectors.
        scratch: address of the group, laid out as by ``records``.
        params: address of the lens chart's parameters.
        places: address of the lens chart's places.
        motion: address of ``motion_parameters``.
        local: address of the scratch whose LINE is written.
    """
    centre = [v.load(scratch, STEP * (CENTRE + k)) for k in range(3)]
    away = 1 / dot(centre, centre).max(1e-20).sqrt()
    texels = Texels(LensChart(v, params, places, places), [component * away for component in centre])
    # The place along the axis of the lines: entry 0 with slopes 2, 3 for columns, entry 1 with slopes 4, 5 for rows.
    axis = 1 - v.broadcast(motion, 4 * BY_COLUMN)
    place = texels.entry(axis) + texels.entry(axis * 2 + 2) * texels.ds + texels.entry(axis * 2 + 3) * texels.dt
    v.store(place.floor().max(0).min(v.broadcast(motion, 4 * LINES) - 1), local, STEP * LINE)


@vector_kernel("iiiii")
def lidar_lines(
    v: Lanes, scratch: ir.Value, params: ir.Value, view: ir.Value, motion: ir.Value, local: ir.Value
) -> None:
    """The column in which the centres are seen from their current poses.

    Args:
        v: vectors.
        scratch: address of the group, laid out as by ``records``.
        params: address of the LiDAR chart's parameters.
        view: address of ``records.view_parameters``.
        motion: address of ``motion_parameters``.
        local: address of the scratch whose LINE is written.
    """
    centre = [v.load(scratch, STEP * (CENTRE + k)) for k in range(3)]
    place = LidarChart(v, params, params).column(centre, v.broadcast(view, 4 * CELLS) * 0.5)
    v.store(place.floor().max(0).min(v.broadcast(motion, 4 * LINES) - 1), local, STEP * LINE)


@vector_kernel("ii")
def other_ends(v: Lanes, motion: ir.Value, local: ir.Value) -> None:
    """Replace lines by the last one where they are in the first half, else by the first one."""
    last = v.broadcast(motion, 4 * LINES) - 1
    v.store((v.load(local, STEP * LINE) < last * 0.5).where(last, 0), local, STEP * LINE)


@vector_kernel("iiii")
def to_lines(v: Lanes, scratch: ir.Value, lines: ir.Value, motion: ir.Value, local: ir.Value) -> None:
    """The Gaussians and the sensor's velocity as seen from the poses of their lines.

    Args:
        v: vectors.
        scratch: address of the group in the reference frame, as ``records.place`` left it.
        lines: address of ``LinePath.lines``.
        motion: address of ``motion_parameters``.
        local: address of the scratch that holds LINE; centre, rotation, scale, velocity and log opacity are written.
    """
    # Each lane has a line, hence a pose, of its own.
    row = v.load(local, STEP * LINE) * LINE_COLUMNS
    pose = [v.gather(lines, (row + (TO_LINE + k)).integers()) for k in range(12)]
    turn = [pose[3 * k : 3 * k + 3] for k in range(3)]
    centre = [v.load(scratch, STEP * (CENTRE + k)) for k in range(3)]
    travel = [v.broadcast(motion, 4 * (TRAVEL_RATE + k)) for k in range(3)]
    for k in range(3):
        v.store(dot(turn[k], centre) + pose[9 + k], local, STEP * (CENTRE + k))
        v.store(dot(turn[k], travel), local, STEP * (VELOCITY + k))
        v.store(v.load(scratch, STEP * (SIGMA + k)), local, STEP * (SIGMA + k))
        for column in range(3):
            axis = [v.load(scratch, STEP * (ROTATION + 3 * j + column)) for j in range(3)]
            v.store(dot(turn[k], axis), local, STEP * (ROTATION + 3 * k + column))
    v.store(v.load(scratch, STEP * LOG_P), local, STEP * LOG_P)


class Motion:
    """How much the directions of a group of Gaussians turn from line to line."""

    def __init__(self, v: Lanes, motion: ir.Value, local: ir.Value, outline: Outline, shifted: Vector | float) -> None:
        velocity = [v.load(local, STEP * (VELOCITY + k)) for k in range(3)]
        speed, self.outline = v.broadcast(motion, 4 * SPEED), outline
        ahead = dot(velocity, outline.f)
        # Sideways speed relative to any direction of the cone.
        # Component perpendicular to f, plus what tilting by the cone's radius adds from the component along it; never
        # more than the speed.
        self.sideways = ((speed * speed - ahead * ahead).max(0).sqrt() + ahead.abs() * outline.reach).min(speed)
        self.speed, self.turn_rate = speed, v.broadcast(motion, 4 * TURN_RATE)
        self.shifted = v.number(0) + shifted
        self.all_lines = v.broadcast(motion, 4 * LINES) + self.shifted
        self.line = v.load(local, STEP * LINE) + 0.5

    def turned(self, lines: Vector) -> Vector:
        """Radians that a direction of the cone turns by within a number of lines, at most."""
        nearest, travel = self.outline.nearest, self.speed * lines
        # Seen from s metres aside, a point at the distance d lies at most asin(s / d) elsewhere.
        aside = (travel < nearest).where(math.pi / 2, math.pi) * travel / nearest
        little = (self.sideways * lines / (nearest - travel)).min(travel * 1.05 / nearest)
        # asin(x) is at most 1.05 x up to x = 1/2, and pi x / 2 up to x = 1.
        turn = (travel < nearest * 0.5).where(little, aside)
        # A sensor inside the ellipsoid may see it anywhere.
        return (nearest > 0).where(turn + self.turn_rate * lines, MOST).min(MOST)

    def guess(self, low: Vector, high: Vector) -> Vector:
        """Lines away from ``line`` within which all that see a box are looked for; the box is that from ``line``."""
        return (self._beyond(low, high) * 2 + (8 + 2 * self.shifted)).min(self.all_lines)

    def lines_away(self, low: Vector, high: Vector, rate: Vector, lines: Vector) -> tuple[Vector, Mask]:
        """How far from ``line`` the lines lie that see a box, and which boxes move too fast for a bound.

        Args:
            low: lower end of the box along the lines (cells).
            high: its upper end.
            rate: most cells per radian, valid within ``lines`` lines.
            lines: how many lines away ``rate`` and the box are known to hold.

        Returns:
            Lines away, at most ``lines``, and the mask of boxes that move too fast.
        """
        # A box at ``_beyond`` cells that recedes by ``pace`` cells per line is met after x = beyond + pace x lines, so
        # x = beyond / (1 - pace); near 1 the box keeps up with the lines.
        pace = rate * self.turned(lines) / lines
        away = (self._beyond(low, high) + pace * self.shifted) / (1 - pace).max(0.1) + self.shifted
        # Written so that NaN counts as too fast.
        told = (pace < 0.9) & (away <= lines)
        return told.where(away, lines), ~told

    def _beyond(self, low: Vector, high: Vector) -> Vector:
        return (high - self.line).max(self.line - low).max(0)


def widened(ends: tuple[Vector, Vector], by: Vector) -> tuple[Vector, Vector]:
    """An interval with something added at either end."""
    return ends[0] - by, ends[1] + by


def masks(v: Lanes, *several: Mask) -> ir.Value:
    """Masks in one integer, ``APART`` bits apart."""
    joined = several[0].integer()
    for k, mask in enumerate(several[1:], 1):
        joined = v.b.or_(joined, v.b.shl(mask.integer(), ir.Constant(I64, APART * k)))
    return joined


def mask_of(v: Lanes, integer: ir.Value) -> Mask:
    """The lowest mask in an integer."""
    return Mask(v.b, v.b.bitcast(v.b.trunc(integer, ir.IntType(LANES)), BITS))


@vector_kernel("iiiiii")
def moving_lens_boxes(
    v: Lanes, local: ir.Value, params: ir.Value, places: ir.Value, bends: ir.Value, motion: ir.Value, target: ir.Value
) -> ir.Value:
    """Cells in which any line of a lens may see Gaussians.

    Args:
        v: vectors.
        local: address of the group seen from the poses of its lines (``to_lines``).
        params: address of the chart's parameters, like the next two of ``charts.Chart``.
        places: address of the chart's places.
        bends: address of the chart's bends.
        motion: address of ``motion_parameters``.
        target: address of [4,LANES] output, see ``outlines.CellBox``.

    Returns:
        Masks of those in the lens's field and of those too fast, ``APART`` bits apart.
    """
    outline = Outline(v, local)
    cone = LensCone(LensChart(v, params, places, bends), outline)
    motions = Motion(v, motion, local, outline, 1.0)
    by_column = v.broadcast(motion, 4 * BY_COLUMN) > 0.5

    def along(column: tuple[Vector, Vector], row: tuple[Vector, Vector]) -> tuple[Vector, Vector]:
        return by_column.where(column[0], row[0]), by_column.where(column[1], row[1])

    # A first guess of the lines involved, rates that hold for them, then the lines that these rates allow.
    still, _ = cone.box()
    lines = motions.guess(*along(still.column, still.row))
    box, (column_rate, row_rate) = cone.box(motions.turned(lines))
    lines, fast = motions.lines_away(*along(box.column, box.row), by_column.where(column_rate, row_rate), lines)
    turned = motions.turned(lines)
    CellBox(widened(box.column, column_rate * turned), widened(box.row, row_rate * turned)).store(v, target)
    return masks(v, ~cone.outside(motions.turned(motions.all_lines)), fast)


@vector_kernel("iiiiii")
def moving_lidar_boxes(
    v: Lanes, local: ir.Value, params: ir.Value, rows: ir.Value, view: ir.Value, motion: ir.Value, target: ir.Value
) -> ir.Value:
    """Cells in which any column of a LiDAR may see Gaussians, were there no seam.

    The seam is where the last column of a sweep meets the first one, fired from elsewhere.

    Args:
        v: vectors.
        local: address of the group seen from the poses of its lines (``to_lines``).
        params: address of the chart's parameters.
        rows: address of the chart's rows by sine of elevation.
        view: address of ``records.view_parameters``.
        motion: address of ``motion_parameters``.
        target: address of [4,LANES] output, see ``outlines.CellBox``.

    Returns:
        Masks of those that may cross the seam, of those that are too fast, and of those whose box holds columns.
    """
    lidar, outline = LidarChart(v, params, rows), Outline(v, local)
    shifted, period, width = lidar.param(SHIFTED), lidar.param(PERIOD), v.broadcast(view, 4 * CELLS)
    motions = Motion(v, motion, local, outline, shifted)
    cone = LidarCone(lidar, outline, motions.line)
    lines = motions.guess(*cone.columns)
    rate = cone.rate(motions.turned(lines))
    lines, fast = motions.lines_away(*cone.columns, rate, lines)
    turned = motions.turned(lines)
    box = CellBox(widened(cone.columns, rate * turned), cone.rows(turned))
    box.store(v, target)
    # Over the whole sweep azimuths turn at most as much as directions do that are level.
    level = (cone.flat - outline.f[2].abs() * outline.reach).max(1e-3)
    farthest = motions.turned(motions.all_lines) / level * lidar.param(PER_RADIAN).abs() * 1.5
    low, high = widened(box.column, farthest + shifted)
    inside = (cone.columns[0] < width + shifted) & (cone.columns[1] > -shifted)
    return masks(v, (low < width - period) | (high > period), fast, inside)


@vector_kernel("iiii")
def join_ends(v: Lanes, chosen: ir.Value, params: ir.Value, box: ir.Value, other: ir.Value) -> None:
    """Extend boxes by what is seen from the other end of the sweep.

    Args:
        v: vectors.
        chosen: mask of the boxes to extend.
        params: address of the LiDAR chart's parameters.
        box: address of [4,LANES] boxes, changed in place.
        other: address of [4,LANES] boxes from the other end.
    """
    period = v.broadcast(params, 4 * PERIOD)
    left, right, top, bottom = (v.load(box, STEP * k) for k in range(4))
    left2, right2, top2, bottom2 = (v.load(other, STEP * k) for k in range(4))
    # Whole turns that bring the other box's middle closest to this one's.
    shift = period * ((left + right - left2 - right2) / (period * 2) + 0.5).floor()
    ends = left.min(left2 + shift), right.max(right2 + shift), top.min(top2), bottom.max(bottom2)
    for k, (own, end) in enumerate(zip((left, right, top, bottom), ends, strict=True)):
        v.store(mask_of(v, chosen).where(end, own), box, STEP * k)
