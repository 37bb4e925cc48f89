"""Vector code for Gaussians that move too fast to bound the lines that see them: the exposure is handled in parts.

Within a part, a box seen from the pose of its middle line holds for its other lines once it is widened by how far
places move within half of the part; only what lies on the part's own lines is kept of it.
"""

from __future__ import annotations

from llvmlite import ir

from nurec_sim.render.cpu.project.charts import SHIFTED
from nurec_sim.render.cpu.project.motion import BY_COLUMN, LINE, LINES, Motion, mask_of, widened
from nurec_sim.render.cpu.project.outlines import (
    EVERYWHERE,
    CellBox,
    LensChart,
    LensCone,
    LidarChart,
    LidarCone,
    Outline,
)
from nurec_sim.render.cpu.records import CELLS, STEP
from nurec_sim.render.cpu.simd import I32, INTS, Lanes, Mask, Vector, spread, vector_kernel

PARTS = 8


def _number(v: Lanes, integer: ir.Value) -> Vector:
    return v.from_integers(spread(v.b, v.b.trunc(integer, I32), INTS))


@vector_kernel("iii")
def part_lines(v: Lanes, part: ir.Value, motion: ir.Value, local: ir.Value) -> None:
    """Write the middle line of a part of the exposure as every lane's LINE.

    Args:
        v: vectors.
        part: number of the part, 0 to ``PARTS`` - 1.
        motion: address of ``motion.motion_parameters``.
        local: address of the scratch whose LINE is written.
    """
    line = (_number(v, part) + 0.5) * (1 / PARTS) * v.broadcast(motion, 4 * LINES)
    v.store(line.floor(), local, STEP * LINE)


def _half(v: Lanes, motion: ir.Value) -> Vector:
    """How far from a part's middle line its lines are, at most."""
    return v.broadcast(motion, 4 * LINES) * (0.5 / PARTS) + 1


def _add(
    v: Lanes, part: ir.Value, chosen: ir.Value, box: CellBox, view: ir.Value, seen: Mask, target: ir.Value
) -> None:
    """Enlarge the boxes of the mask ``chosen`` by those of a part; the first part starts anew."""
    width, height = (v.broadcast(view, 4 * (CELLS + k)) for k in range(2))
    (left, right), (top, bottom) = box.column, box.row
    # Boxes that miss the grid must not enlarge the union; a LiDAR's may lie a turn to either side.
    seen = (
        seen & (left <= right) & (top <= bottom) & (bottom > 0) & (top < height) & (right > -width) & (left < width * 2)
    )
    start = _number(v, part) < 0.5
    for k, end in enumerate((left, right, top, bottom)):
        was = v.load(target, STEP * k)
        empty = EVERYWHERE if k % 2 == 0 else -EVERYWHERE
        so_far = start.where(empty, was)
        larger = so_far.min(end) if k % 2 == 0 else so_far.max(end)
        v.store(mask_of(v, chosen).where(seen.where(larger, so_far), was), target, STEP * k)


@vector_kernel("iiiiiiiii")
def add_lens_part(
    v: Lanes, part: ir.Value, chosen: ir.Value, local: ir.Value, params: ir.Value, places: ir.Value, bends: ir.Value,
    motion: ir.Value, view: ir.Value, target: ir.Value,
) -> None:  # fmt: skip
    """Extend boxes by the cells that the lines of one part of a lens's exposure may see.

    Args:
        v: vectors.
        part: number of the part, 0 to ``PARTS`` - 1; the first part replaces what the boxes held.
        chosen: mask of the boxes to change.
        local: address of the group seen from the part's middle line.
        params: address of the chart's parameters, like the next two of ``charts.Chart``.
        places: address of the chart's places.
        bends: address of the chart's bends.
        motion: address of ``motion.motion_parameters``.
        view: address of ``records.view_parameters``.
        target: address of [4,LANES] boxes, changed in place.
    """
    outline = Outline(v, local)
    cone = LensCone(LensChart(v, params, places, bends), outline)
    motions, half = Motion(v, motion, local, outline, 0.0), _half(v, motion)
    turned = motions.turned(half)
    box, (column_rate, row_rate) = cone.box(turned)
    columns, rows = widened(box.column, column_rate * turned), widened(box.row, row_rate * turned)
    by_column = v.broadcast(motion, 4 * BY_COLUMN) > 0.5
    # Along the axis of the lines, a part sees nothing but its own lines.
    low, high = motions.line - half, motions.line + half
    columns = by_column.where(columns[0].max(low), columns[0]), by_column.where(columns[1].min(high), columns[1])
    rows = by_column.where(rows[0], rows[0].max(low)), by_column.where(rows[1], rows[1].min(high))
    _add(v, part, chosen, CellBox(columns, rows), view, ~cone.outside(turned), target)


@vector_kernel("iiiiiiii")
def add_lidar_part(
    v: Lanes, part: ir.Value, chosen: ir.Value, local: ir.Value, params: ir.Value, rows: ir.Value, motion: ir.Value,
    view: ir.Value, target: ir.Value,
) -> None:  # fmt: skip
    """Extend boxes by the cells that one part of a LiDAR's sweep may see.

    Args:
        v: vectors.
        part: as for ``add_lens_part``, like the next two.
        chosen: see part.
        local: see part.
        params: address of the chart's parameters.
        rows: address of the chart's rows by sine of elevation.
        motion: address of ``motion.motion_parameters``.
        view: address of ``records.view_parameters``.
        target: address of [4,LANES] boxes, changed in place.
    """
    lidar, outline = LidarChart(v, params, rows), Outline(v, local)
    shifted = lidar.param(SHIFTED)
    motions, half = Motion(v, motion, local, outline, shifted), _half(v, motion) + shifted
    cone, turned = LidarCone(lidar, outline, motions.line), motions.turned(half)
    left, right = widened(cone.columns, cone.rate(turned) * turned)
    columns = left.max(motions.line - half), right.min(motions.line + half)
    _add(v, part, chosen, CellBox(columns, cone.rows(turned)), view, turned > -1, target)
