"""Kernel that carries gradients of a blended image back to records, macro tile by macro tile, as ``draw`` blended them.

Every pair of a record and a macro tile has a slot of its own for its sums, so that neither threads nor their number
change any result; ``backward_project`` adds the slots of a record up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from nurec_sim.render.cpu.backward.blend import (
    COLOUR_SUMS,
    COLOURS,
    S_FADE,
    STATE_PLANES,
    SUMS,
    back_affine_camera,
    back_affine_camera_near,
    back_affine_colours,
    back_moving_camera,
    back_moving_colours,
    back_moving_lidar,
    back_table_camera,
    back_table_colours,
    back_table_lidar,
    open_gradients,
)
from nurec_sim.render.cpu.blend.draw import RAY_BYTES, aligned, batch_scratch, prepare_batch, tile_geometry
from nurec_sim.render.cpu.blend.responses import CAMERA, LIDAR
from nurec_sim.render.cpu.blend.tiles import (
    ACROSS,
    AFFINE,
    BATCH,
    BLOCKS,
    CAMERA_BATCH,
    HIGH,
    LIST,
    RAYS,
    TABLE,
    WIDE,
)
from nurec_sim.render.cpu.kernel import f4, inner, keep_alive, kernel
from nurec_sim.render.cpu.records import MACRO, tile_count, tiles_of


@kernel
def number_slots(spans, starts, counts, first_slot):
    """The first slot of every record, a slot per macro tile of its span; returns how many there are.

    Args:
        spans: see ``records.Projected``.
        starts: [runs] first row of each run of records.
        counts: [runs] their lengths.
        first_slot: [n] int64 output.
    """
    slot = 0
    for run in range(len(starts)):
        for i in range(starts[run], starts[run] + counts[run]):
            first_slot[i] = slot
            slot += tile_count(spans, i)
    return slot


class RecordSlots(NamedTuple):
    """Where the sums of a record's gradients go: a slot for each macro tile of its span, row by row."""

    first: Int64[np.ndarray, " n"]
    """First slot of each record, see ``number_slots``."""
    sums: Float32[np.ndarray, "slots 16"]
    """See ``blend``; of COLOURS only those from S_FADE on, [slots,4]: slots lie all over the memory."""


@inner
def _carry_back(mode, output_kind, close, state, numbers, count, coefficients, rays, basis, sums, x0, y0, near):
    """Carry a block's gradients back with the code for a mode and an output kind; see ``backward.blend``."""
    if mode == AFFINE:
        if output_kind == COLOURS:
            return back_affine_colours(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)
        if close:
            return back_affine_camera_near(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)
        return back_affine_camera(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)
    if mode == TABLE:
        if output_kind == COLOURS:
            return back_table_colours(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)
        if output_kind == CAMERA:
            return back_table_camera(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)
        return back_table_lidar(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)
    if output_kind == COLOURS:
        return back_moving_colours(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)
    if output_kind == CAMERA:
        return back_moving_camera(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)
    return back_moving_lidar(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)


@inner
def _keep_sums(sums, lists, first, last, spans, slots, row, column):
    """Write a batch's sums to the slots of its records for the macro tile at a row and a column."""
    for j in range(first, last):
        i = np.uint64(lists[j])
        left, right, top, _ = tiles_of(spans, i)
        # Slots of a record are numbered row by row over its span of tiles.
        slot = np.uint64(slots.first[i] + (row - top) * (right - left + 1) + column - left)
        entry = np.uint64(j - first)
        if slots.sums.shape[1] == COLOUR_SUMS:
            for k in range(COLOUR_SUMS):
                slots.sums[slot, np.uint64(k)] = sums[entry, np.uint64(S_FADE + k)]
        else:
            for k in range(SUMS):
                slots.sums[slot, np.uint64(k)] = sums[entry, np.uint64(k)]


@kernel
def draw_tiles_back(rays, projected, binned, output_kind, tiles, planes, gradients, slots):
    """Carry gradients of the given macro tiles back to ``slots``.

    Args:
        rays: as ``draw.draw_tiles`` was given, like all up to ``planes``; the mode is AFFINE, TABLE or MOVING.
        projected: see rays.
        binned: see rays.
        output_kind: CAMERA, LIDAR, or COLOURS.
        tiles: numbers of the macro tiles to do.
        planes: [6,h,w] what ``draw.draw_tiles`` made.
        gradients: [6,h,w] gradients of ``planes``; 0 where there is no valid ray.
        slots: output, see ``RecordSlots``: all slots of the tiles' records are written.
    """
    state, sums = aligned(BLOCKS * STATE_PLANES * RAYS), aligned(BATCH * SUMS).reshape(BATCH, SUMS)
    turned, basis, coefficients, chosen, listed = batch_scratch()
    batch = BATCH if output_kind == LIDAR else CAMERA_BATCH
    row_bytes, plane_bytes = 4 * planes.shape[2], 4 * planes.shape[1] * planes.shape[2]
    block_bytes = 4 * STATE_PLANES * RAYS
    state_at, coefficients_at, chosen_at = state.ctypes.data, coefficients.ctypes.data, chosen.ctypes.data
    records_at, sums_at, lists = projected.records.ctypes.data, sums.ctypes.data, binned.lists
    for index in range(tiles.shape[0]):
        tile = np.int64(tiles[index])
        row, column, rays_at, basis_at, alive = tile_geometry(rays, tile, turned, basis)
        for block in range(BLOCKS):
            if (alive >> block) & 1:
                y, x = row * MACRO + block // ACROSS * HIGH, column * MACRO + block % ACROSS * WIDE
                offset = y * row_bytes + 4 * x
                open_gradients(
                    state_at + block * block_bytes, planes.ctypes.data + offset, gradients.ctypes.data + offset,
                    rays_at + block * RAY_BYTES if rays_at else 0, row_bytes, plane_bytes,
                )  # fmt: skip
        first, end = np.int64(binned.starts[tile]), np.int64(binned.starts[tile + 1])
        # Continue to the list's end even when all rays are opaque: slots that are not written hold another frame's
        # sums.
        while first < end:
            last = min(end, first + batch)
            # Sums of a batch are gathered over the tile's blocks and stored once per record.
            sums[:] = f4(0)
            if alive != 0:
                close = prepare_batch(
                    rays.mode, lists, first, last, end, records_at, alive, basis_at, coefficients, chosen, listed
                )
                for block in range(BLOCKS):
                    n = listed[block]
                    if n > 0:
                        more = _carry_back(
                            rays.mode, output_kind, close != 0, state_at + block * block_bytes,
                            chosen_at + block * LIST, n, coefficients_at, rays_at + block * RAY_BYTES, basis_at,
                            sums_at,
                            f4(block % ACROSS * WIDE) - f4(15.5), f4(block // ACROSS * HIGH) - f4(15.5), rays.near,
                        )  # fmt: skip
                        if more == 0:
                            alive &= ~(1 << block)
            _keep_sums(sums, lists, first, last, projected.spans, slots, row, column)
            first = last
    keep_alive(state)
    keep_alive(chosen)
    keep_alive(turned)
    keep_alive(coefficients)
    keep_alive(basis)
