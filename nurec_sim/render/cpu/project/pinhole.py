"""Kernel that projects Gaussians for an ideal pinhole, at one pose or with a rolling shutter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from llvmlite import ir

from nurec_sim.render.cpu.kernel import inner, kernel
from nurec_sim.render.cpu.pack import BLOCK, FIELDS
from nurec_sim.render.cpu.project.colours import harmonics_1, harmonics_2, harmonics_3
from nurec_sim.render.cpu.records import (
    CELLS,
    CENTRE,
    INTRINSICS,
    LOG_255,
    LOG_P,
    RECORD,
    ROTATION,
    SCRATCH,
    SIGMA,
    STEP,
    build_records,
    colour_features,
    dot,
    emit,
    lidar_features,
    place,
)
from nurec_sim.render.cpu.simd import LANES, Lanes, Mask, Vector, vector_kernel

EVERYWHERE = 1e9
PAD = 2e-3
"""Cells that boxes are widened by, for float32."""

# A line's pose for ``rolling_boxes``: rotation and translation of line_from_reference, and its place on the way.
LINE_POSE = 13


@dataclass(frozen=True)
class PixelBox:
    """Pixels between which Gaussians are seen; ``gone`` where they are not seen at all."""

    u0: Vector
    u1: Vector
    v0: Vector
    v1: Vector
    gone: Mask


def pinhole_box(v: Lanes, centre: list[Vector], axes: list[list[Vector]], k2: Vector, view: ir.Value) -> PixelBox:
    """The exact box around the image of ellipsoids: tangents of the dual conic k2 Sigma - m m^T.

    Args:
        v: vectors.
        centre: m in the frame of the camera.
        axes: rotation times standard deviations, rows by columns.
        k2: squared radius of the ellipsoid in standard deviations.
        view: address of the view's parameters.
    """
    fx, fy, cx, cy = (v.broadcast(view, 4 * (INTRINSICS + k)) for k in range(4))
    width, height = (v.broadcast(view, 4 * (CELLS + k)) for k in range(2))
    x, y, z = centre
    # Rows of Sigma = M M^T with M = rotation times standard deviations.
    xx, yy, zz = (dot(axes[k], axes[k]) for k in range(3))
    xz, yz = dot(axes[0], axes[2]), dot(axes[1], axes[2])
    inverse = 1 / z
    # The image's extent in u are the roots of bottom u^2 - 2 half u + spread = 0 about the centre's tangent.
    scale = k2 * inverse * inverse
    bottom = scale * zz - 1
    crosses = (bottom > -1e-3) | (z <= 0)  # it reaches the plane of the camera
    # Only used where the ellipsoid lies in front of the camera's plane; elsewhere the box is everything.
    divisor = 1 / bottom.min(-1e-3)

    def interval(along: Vector, own: Vector, mixed: Vector, focal: Vector, principal: Vector) -> tuple[Vector, Vector]:
        # With x = u z the discriminant is free of the cancelling m m^T products.
        """Ends of the image along one axis, in pixels.

        Args:
            along: the centre's coordinate along the axis (m).
            own: variance along the axis (m^2).
            mixed: covariance with the depth (m^2).
            focal: focal length in pixels.
            principal: principal point in pixels.
        """
        tangent = along * inverse
        half = scale * (mixed - tangent * zz)
        spread = scale * (own - tangent * mixed * 2 + tangent * tangent * zz)
        root = (half * half - spread * bottom).max(0).sqrt()
        low, high = tangent + (half + root) * divisor, tangent + (half - root) * divisor
        return crosses.where(-EVERYWHERE, focal * low + principal), crosses.where(EVERYWHERE, focal * high + principal)

    def beyond(edge: Vector, sign: float, along: Vector, own: Vector, mixed: Vector) -> Mask:
        """Whether an ellipsoid lies wholly outside of one side of the image.

        Args:
            edge: tangent of the side, (pixel - principal point) / focal length.
            sign: 1 where the image lies above the edge, -1 where below.
            along: the centre's coordinate along the axis (m).
            own: variance along the axis (m^2).
            mixed: covariance with the depth (m^2).
        """
        # Distance from the side's plane against the ellipsoid's support along its normal, both unnormalised.
        height_over = (along - edge * z) * sign
        return (height_over < 0) & (height_over * height_over > k2 * (own - edge * mixed * 2 + edge * edge * zz))

    gone = beyond(-cx / fx, 1.0, x, xx, xz) | beyond((width - cx) / fx, -1.0, x, xx, xz)
    gone = gone | beyond(-cy / fy, 1.0, y, yy, yz) | beyond((height - cy) / fy, -1.0, y, yy, yz)
    u0, u1 = interval(x, xx, xz, fx, cx)
    v0, v1 = interval(y, yy, yz, fy, cy)
    # A finite box is clipped to the grid anyway; the sides only help where it is infinite.
    return PixelBox(u0, u1, v0, v1, crosses & gone)


def store_cells(v: Lanes, box: PixelBox, view: ir.Value, target: ir.Value) -> ir.Value:
    """Store the cells of boxes.

    Args:
        v: vectors.
        box: the boxes, in pixels.
        view: address of ``records.view_parameters``.
        target: address of [4,LANES] output: first and last column, first and last row of cells.

    Returns:
        The mask of the boxes that hold the centre of a cell.
    """

    def cells(low: Vector, high: Vector, size: Vector) -> tuple[Vector, Vector]:
        return (low - (0.5 + PAD)).ceil().max(0), (high - (0.5 - PAD)).floor().min(size - 1)

    x0, x1 = cells(box.u0, box.u1, v.broadcast(view, 4 * CELLS))
    y0, y1 = cells(box.v0, box.v1, v.broadcast(view, 4 * (CELLS + 1)))
    for k, cell in enumerate((x0, x1, y0, y1)):
        v.store(cell.max(0), target, STEP * k)
    return ((x0 <= x1) & (y0 <= y1) & ~box.gone).integer()


def _ellipsoid(v: Lanes, scratch: ir.Value) -> tuple[list[Vector], list[list[Vector]], Vector]:
    """Centre, axes and squared radius at 1/255 of the group that ``place`` left."""
    centre = [v.load(scratch, STEP * (CENTRE + k)) for k in range(3)]
    sigma = [v.load(scratch, STEP * (SIGMA + k)) for k in range(3)]
    axes = [[v.load(scratch, STEP * (ROTATION + 3 * row + k)) * sigma[k] for k in range(3)] for row in range(3)]
    return centre, axes, (v.load(scratch, STEP * LOG_P) + LOG_255) * 2


@vector_kernel("iii")
def pinhole_boxes(v: Lanes, scratch: ir.Value, view: ir.Value, target: ir.Value) -> ir.Value:
    """Cells of Gaussians seen from the reference pose.

    Args:
        v: vectors.
        scratch: address of the group that ``place`` left.
        view: address of ``records.view_parameters``.
        target: address of [4,LANES] output, see ``store_cells``.

    Returns:
        The mask of those seen.
    """
    return store_cells(v, pinhole_box(v, *_ellipsoid(v, scratch), view), view, target)


@vector_kernel("iiiiff")
def rolling_boxes(
    v: Lanes, scratch: ir.Value, view: ir.Value, ends: ir.Value, target: ir.Value, first: ir.Value, step: ir.Value
) -> ir.Value:
    """Cells of Gaussians seen through a shutter that rolls along y.

    Gaussians are boxed from the poses at both ends of the exposure; in between, edges move almost evenly. A Gaussian is
    seen by the rows of its boxes only, that is during the part of the exposure from row v0 to row v1.

    Args:
        v: vectors.
        scratch: address of the group that ``place`` left.
        view: address of ``records.view_parameters``.
        ends: address of [2,LINE_POSE]: line_from_reference at both ends of the exposure.
        target: address of [4,LANES] output, see ``store_cells``.
        first: place of row 0 on the sensor's way, which leads from -0.5 to 0.5.
        step: the same per row.

    Returns:
        The mask of those seen.
    """
    centre, axes, k2 = _ellipsoid(v, scratch)
    boxes = []
    for end in range(2):
        part = [v.broadcast(ends, 4 * (LINE_POSE * end + k)) for k in range(12)]
        turn = [part[0:3], part[3:6], part[6:9]]
        columns = [[axes[row][k] for row in range(3)] for k in range(3)]
        turned = [[dot(turn[row], columns[k]) for k in range(3)] for row in range(3)]
        boxes.append(pinhole_box(v, [dot(turn[k], centre) + part[9 + k] for k in range(3)], turned, k2, view))
    start, stop = boxes
    low, high = start.v0.min(stop.v0), start.v1.max(stop.v1)
    rate, offset = v.spread(step), v.spread(first) + 0.5
    # As fractions of the way between the ends; one row more to either side.
    places = [(offset + rate * edge).max(0).min(1) for edge in (low - 1, high + 1)]
    # Where an end has no finite box the rows do not bound the time, so the whole exposure counts.
    wild = (low < -EVERYWHERE / 2) | (high > EVERYWHERE / 2)

    def moved(a: Vector, b: Vector, larger: bool) -> Vector:
        between = [a + (b - a) * t for t in places]
        # Edges move almost, not exactly, evenly.
        slack = (b - a).abs() * 0.02 + 0.1
        whole = a.max(b) if larger else a.min(b)
        part = between[0].max(between[1]) + slack if larger else between[0].min(between[1]) - slack
        return wild.where(whole, part)

    union = PixelBox(
        moved(start.u0, stop.u0, False),
        moved(start.u1, stop.u1, True),
        moved(start.v0, stop.v0, False),
        moved(start.v1, stop.v1, True),
        start.gone & stop.gone,
    )
    return store_cells(v, union, view, target)


@inner
def take_features(block, sh_rest, number, lane, view, scratch, lidar):
    """Write what the sensor sums up: colours (seen from the eye) or LiDAR values.

    Args:
        block: address of the group's first Gaussian in its block.
        sh_rest: see ``pack.LayerBlocks``.
        number: number of the block.
        lane: place of the group's first Gaussian in the block.
        view: address of ``records.view_parameters``.
        scratch: address of the group's scratch; its FEATURES are written.
        lidar: whether the features are those of a LiDAR.
    """
    if lidar:
        lidar_features(block, view, scratch)
    elif sh_rest.shape[1] == 0:
        colour_features(block, scratch)
    else:
        rest = sh_rest.ctypes.data + 4 * (number * sh_rest.shape[1] * BLOCK + lane)
        if sh_rest.shape[1] == 9:
            harmonics_1(block, rest, view, scratch)
        elif sh_rest.shape[1] == 24:
            harmonics_2(block, rest, view, scratch)
        else:
            harmonics_3(block, rest, view, scratch)


@kernel
def project_pinhole(layer, first, last, view, ends, motion, output, base):
    """Records of the Gaussians that an ideal pinhole can see, in the order of the blocks.

    Args:
        layer: see ``pack.LayerBlocks``.
        first: first entry of ``layer.chosen`` to take.
        last: one behind the last.
        view: see ``records.view_parameters``.
        ends: [2,13] poses at the ends of a rolling exposure, see ``rolling_boxes``; empty at one pose.
        motion: see ``rays.rolling_basis``.
        output: see ``records.Projected``.
        base: first row to write; there must be room for 256 per block.

    Returns:
        Number of records written.
    """
    scratch = np.empty((SCRATCH, LANES), np.float32)
    rows = np.empty((LANES, RECORD), np.float32)
    box = np.empty((4, LANES), np.float32)
    n = base
    for k in range(first, last):
        number = np.int64(layer.chosen[k])
        for lane in range(0, BLOCK, LANES):
            block = layer.fields.ctypes.data + 4 * (number * (FIELDS * BLOCK) + lane)
            mask = place(block, view.ctypes.data, scratch.ctypes.data)
            if mask == 0:
                continue
            if ends.shape[0] == 0:
                mask &= pinhole_boxes(scratch.ctypes.data, view.ctypes.data, box.ctypes.data)
            else:
                mask &= rolling_boxes(scratch.ctypes.data, view.ctypes.data, ends.ctypes.data, box.ctypes.data,
                                      motion[6], motion[7])  # fmt: skip
            if mask == 0:
                continue
            take_features(block, layer.sh_rest, number, lane, view.ctypes.data, scratch.ctypes.data, False)
            build_records(scratch.ctypes.data, rows.ctypes.data, view.ctypes.data)
            n = emit(mask, rows, scratch, box, number * BLOCK + lane, n, output)
    return n - base
