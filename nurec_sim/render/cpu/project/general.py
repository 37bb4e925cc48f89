"""Kernel that projects Gaussians for any lens and LiDAR, also in motion: conservative boxes, records, features."""

from __future__ import annotations

import numpy as np
from llvmlite import ir

from nurec_sim.render.cpu.kernel import keep_alive, kernel
from nurec_sim.render.cpu.pack import BLOCK, FIELDS
from nurec_sim.render.cpu.project.charts import PERIOD
from nurec_sim.render.cpu.project.motion import (
    APART,
    join_ends,
    lens_lines,
    lidar_lines,
    masks,
    moving_lens_boxes,
    moving_lidar_boxes,
    other_ends,
    to_lines,
)
from nurec_sim.render.cpu.project.outlines import CellBox, LensChart, LensCone, LidarChart, LidarCone, Outline
from nurec_sim.render.cpu.project.parts import PARTS, add_lens_part, add_lidar_part, part_lines
from nurec_sim.render.cpu.project.pinhole import take_features
from nurec_sim.render.cpu.records import (
    CELLS,
    MACRO,
    RECORD,
    SCRATCH,
    STEP,
    build_records,
    emit,
    place,
)
from nurec_sim.render.cpu.simd import LANES, Lanes, Vector, vector_kernel


@vector_kernel("iiiii")
def lens_boxes(
    v: Lanes, scratch: ir.Value, params: ir.Value, places: ir.Value, bends: ir.Value, box: ir.Value
) -> ir.Value:
    """Cells in which a lens at one pose may see Gaussians.

    Args:
        v: vectors.
        scratch: address of the group that ``records.place`` left.
        params: address of the chart's parameters, like the next two of ``charts.Chart``.
        places: address of the chart's places.
        bends: address of the chart's bends.
        box: address of [4,LANES] output, see ``outlines.CellBox``.

    Returns:
        The mask of the Gaussians in the lens's field.
    """
    cone = LensCone(LensChart(v, params, places, bends), Outline(v, scratch))
    cone.box()[0].store(v, box)
    return (~cone.outside()).integer()


@vector_kernel("iiiii")
def lidar_boxes(v: Lanes, scratch: ir.Value, params: ir.Value, rows: ir.Value, view: ir.Value, box: ir.Value) -> None:
    """Cells in which a LiDAR at one pose may see Gaussians.

    Args:
        v: vectors.
        scratch: address of the group that ``records.place`` left.
        params: address of the chart's parameters.
        rows: address of the chart's rows by sine of elevation.
        view: address of ``records.view_parameters``.
        box: address of [4,LANES] output, see ``outlines.CellBox``.
    """
    # Columns within half a turn of the grid's middle; ``lidar_cells`` adds what a full turn shifts back into the grid.
    cone = LidarCone(LidarChart(v, params, rows), Outline(v, scratch), v.broadcast(view, 4 * CELLS) * 0.5)
    CellBox(cone.columns, cone.rows(0.0)).store(v, box)


def _cells(low: Vector, high: Vector, count: Vector) -> tuple[Vector, Vector]:
    """First and last cell whose centre lies in an interval; the first is larger if there is none."""
    return (low - 0.5).ceil().max(0), (high - 0.5).floor().min(count - 1)


def _store_cells(v: Lanes, ends: tuple[Vector, ...], cells: ir.Value) -> None:
    for k, end in enumerate(ends):
        v.store(end.max(0), cells, STEP * k)


def _tile(cell: Vector) -> Vector:
    return (cell * (1 / MACRO)).floor()


@vector_kernel("iii")
def lens_cells(v: Lanes, box: ir.Value, view: ir.Value, cells: ir.Value) -> ir.Value:
    """Whole cells of boxes.

    Args:
        v: vectors.
        box: address of [4,LANES], see ``outlines.CellBox``.
        view: address of ``records.view_parameters``.
        cells: address of [4,LANES] output: first and last column, first and last row of cells.

    Returns:
        The mask of the boxes that hold the centre of a cell.
    """
    ends = [v.load(box, STEP * k) for k in range(4)]
    x0, x1 = _cells(ends[0], ends[1], v.broadcast(view, 4 * CELLS))
    y0, y1 = _cells(ends[2], ends[3], v.broadcast(view, 4 * (CELLS + 1)))
    _store_cells(v, (x0, x1, y0, y1), cells)
    return ((x0 <= x1) & (y0 <= y1)).integer()


@vector_kernel("iiiii")
def lidar_cells(
    v: Lanes, box: ir.Value, view: ir.Value, params: ir.Value, cells: ir.Value, others: ir.Value
) -> ir.Value:
    """Whole cells of boxes, and of the same boxes a full turn away.

    What leaves one side of the grid enters at the other. The two never share a macro tile.

    Args:
        v: vectors.
        box: address of [4,LANES], see ``outlines.CellBox``.
        view: address of ``records.view_parameters``.
        params: address of the chart's parameters.
        cells: address of [4,LANES] output: first and last column, first and last row of cells.
        others: address of the same for the boxes a full turn away.

    Returns:
        The mask of boxes that hold the centre of a cell, and, from bit ``APART`` on, of those that do a full turn away.
    """
    left, right, top, bottom = (v.load(box, STEP * k) for k in range(4))
    width, period = v.broadcast(view, 4 * CELLS), v.broadcast(params, 4 * PERIOD)
    # At least a full turn wide, or NaN: the whole grid. Written so that NaN is true.
    whole = ~(right - left < period)
    y0, y1 = _cells(top, bottom, v.broadcast(view, 4 * (CELLS + 1)))
    x0, x1 = _cells(whole.where(0, left), whole.where(width, right), width)
    shift = (left < width - period).where(period, -period)
    p0, p1 = _cells(left + shift, right + shift, width)
    rows = y0 <= y1
    first, second = (x0 <= x1) & rows, (p0 <= p1) & rows & ~whole
    # Both parts of a Gaussian in one tile would have two sums of gradients there: join them to one record.
    touch = first & second & (_tile(p0) <= _tile(x1)) & (_tile(x0) <= _tile(p1))
    _store_cells(v, (touch.where(x0.min(p0), x0), touch.where(x1.max(p1), x1), y0, y1), cells)
    _store_cells(v, (p0, p1, y0, y1), others)
    return masks(v, first, second & ~touch)


@kernel
def project_general(layer, first, last, view, is_lidar, chart, path, output, base):
    """Records of the Gaussians that a lens or a LiDAR may see, in the order of the blocks.

    Args:
        layer: see ``pack.LayerBlocks``.
        first: first entry of ``layer.chosen`` to take.
        last: one behind the last.
        view: see ``records.view_parameters``.
        is_lidar: the chart is that of a LiDAR; the features are its own then.
        chart: see ``charts.Chart``.
        path: see ``motion.LinePath``.
        output: see ``records.Projected``.
        base: first row to write; there must be room for 256 per block, for LiDARs 512.

    Returns:
        Number of records written; LiDARs write two of a Gaussian that their seam divides.
    """
    scratch, local = np.empty((SCRATCH, LANES), np.float32), np.empty((SCRATCH, LANES), np.float32)
    rows = np.empty((LANES, RECORD), np.float32)
    box, other_box = np.empty((4, LANES), np.float32), np.empty((4, LANES), np.float32)
    span, other_span = np.empty((4, LANES), np.float32), np.empty((4, LANES), np.float32)
    here, there, around = scratch.ctypes.data, local.ctypes.data, view.ctypes.data
    params, table, bend = chart.params.ctypes.data, chart.places.ctypes.data, chart.bends.ctypes.data
    motion, poses = path.motion.ctypes.data, path.lines.ctypes.data
    cells, other_cells = box.ctypes.data, other_box.ctypes.data
    # Kernels read the path only when the sensor moves; at one pose the line poses are those of the reference frame.
    moving = path.lines.shape[0] > 1
    n = base
    for k in range(first, last):
        number = np.int64(layer.chosen[k])
        for lane in range(0, BLOCK, LANES):
            block = layer.fields.ctypes.data + 4 * (number * (FIELDS * BLOCK) + lane)
            mask = place(block, around, here)
            if mask == 0:
                continue
            again = 0
            if is_lidar:
                if moving:
                    # The line that sees the centre from the reference pose, then a box from that line's own pose.
                    lidar_lines(here, params, around, motion, there)
                    to_lines(here, poses, motion, there)
                    found = moving_lidar_boxes(there, params, table, around, motion, cells)
                    # Too fast for one box: bounded part by part below.
                    fast = mask & (found >> APART)
                    # Fired at opposite ends of a turn, the columns beside the seam see it from different places.
                    seam = mask & found & ~fast
                    if seam != 0:
                        other_ends(motion, there)
                        to_lines(here, poses, motion, there)
                        found = moving_lidar_boxes(there, params, table, around, motion, other_cells)
                        seam &= found >> (2 * APART)
                        fast |= seam & (found >> APART)
                        join_ends(seam, params, cells, other_cells)
                    if fast != 0:
                        for part in range(PARTS):
                            part_lines(part, motion, there)
                            to_lines(here, poses, motion, there)
                            add_lidar_part(part, fast, there, params, table, motion, around, cells)
                else:
                    lidar_boxes(here, params, table, around, cells)
                both = lidar_cells(cells, around, params, span.ctypes.data, other_span.ctypes.data)
                again = mask & (both >> APART)  # what a full turn brings back in at the other side of the grid
                mask &= both
            else:
                if moving:
                    # The line that sees the centre depends on the pose, which depends on the line: two fixed-point
                    # steps.
                    lens_lines(here, params, table, motion, there)
                    to_lines(here, poses, motion, there)
                    lens_lines(there, params, table, motion, there)
                    to_lines(here, poses, motion, there)
                    found = moving_lens_boxes(there, params, table, bend, motion, cells)
                    mask &= found
                    fast = mask & (found >> APART)
                    if fast != 0:
                        for part in range(PARTS):
                            part_lines(part, motion, there)
                            to_lines(here, poses, motion, there)
                            add_lens_part(part, fast, there, params, table, bend, motion, around, cells)
                else:
                    mask &= lens_boxes(here, params, table, bend, cells)
                mask &= lens_cells(cells, around, span.ctypes.data)
            if mask | again == 0:
                continue
            take_features(block, layer.sh_rest, number, lane, around, here, is_lidar)
            build_records(here, rows.ctypes.data, around)
            source = number * BLOCK + lane
            n = emit(mask, rows, scratch, span, source, n, output)
            n = emit(again, rows, scratch, other_span, source, n, output)
    # The kernels above only see addresses; Numba must not free the arrays before the last call.
    keep_alive(local)
    keep_alive(box)
    keep_alive(other_box)
    return n - base
