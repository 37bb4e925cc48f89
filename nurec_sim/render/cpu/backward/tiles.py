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
    S_FADE,
    STATE_PLANES,
    SUMS,
    carry_back,
    open_gradients,
)
from nurec_sim.render.cpu.blend.binning import TileLists
from nurec_sim.render.cpu.blend.blocks import ALL_FAR, CHECK_NEAR
from nurec_sim.render.cpu.blend.draw import RAY_BYTES, BatchScratch, aligned, prepare_batch, tile_geometry
from nurec_sim.render.cpu.blend.rays import SensorRays
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
    WIDE,
)
from nurec_sim.render.cpu.kernel import f4, fixed, inner, kernel
from nurec_sim.render.cpu.records import MACRO, Projected, tile_count, tiles_of


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
def _draw_tiles_back(mode, output_kind, rays, projected, binned, tiles, planes, gradients, slots, state, sums, scratch):
    """Carry gradients of the given macro tiles back to ``slots``.

    Args:
        mode: AFFINE, TABLE or MOVING, ``fixed``.
        output_kind: CAMERA, LIDAR, or COLOURS, ``fixed``.
        rays: as ``draw.draw_tiles`` was given, like the next two.
        projected: see rays.
        binned: see rays.
        tiles: numbers of the macro tiles to do.
        planes: [6,h,w] what ``draw.draw_tiles`` made.
        gradients: [6,h,w] gradients of ``planes``; 0 where there is no valid ray.
        slots: output, see ``RecordSlots``: all slots of the tiles' records are written.
        state: [BLOCKS,STATE_PLANES,RAYS] scratch, on a cache line.
        sums: [BATCH,SUMS] scratch, on a cache line.
        scratch: see ``draw.BatchScratch``.
    """
    batch = BATCH if len(output_kind) == LIDAR else CAMERA_BATCH
    row_bytes, plane_bytes = 4 * planes.shape[2], 4 * planes.shape[1] * planes.shape[2]
    block_bytes = 4 * STATE_PLANES * RAYS
    state_at, coefficients_at = state.ctypes.data, scratch.coefficients.ctypes.data
    chosen_at, listed = scratch.chosen.ctypes.data, scratch.listed
    records_at, sums_at, lists = projected.records.ctypes.data, sums.ctypes.data, binned.lists
    for index in range(tiles.shape[0]):
        tile = np.int64(tiles[index])
        row, column, rays_at, basis_at, alive = tile_geometry(mode, rays, tile, scratch)
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
                close = prepare_batch(mode, lists, first, last, end, records_at, alive, basis_at, scratch)
                for block in range(BLOCKS):
                    n = listed[block]
                    if n > 0:
                        block_at, numbers_at = state_at + block * block_bytes, chosen_at + block * LIST
                        block_rays_at = rays_at + block * RAY_BYTES
                        x0, y0 = f4(block % ACROSS * WIDE) - f4(15.5), f4(block // ACROSS * HIGH) - f4(15.5)
                        if len(mode) == AFFINE and len(output_kind) == CAMERA and close == 0:
                            more = carry_back(mode, output_kind, ALL_FAR, block_at, numbers_at, n, coefficients_at,
                                              block_rays_at, basis_at, sums_at, x0, y0, rays.near)  # fmt: skip
                        else:
                            more = carry_back(mode, output_kind, CHECK_NEAR, block_at, numbers_at, n, coefficients_at,
                                              block_rays_at, basis_at, sums_at, x0, y0, rays.near)  # fmt: skip
                        if more == 0:
                            alive &= ~(1 << block)
            _keep_sums(sums, lists, first, last, projected.spans, slots, row, column)
            first = last


def draw_tiles_back(
    mode: int, output_kind: int, rays: SensorRays, projected: Projected, binned: TileLists,
    tiles: Int64[np.ndarray, " t"], planes: Float32[np.ndarray, "6 h w"], gradients: Float32[np.ndarray, "6 h w"],
    slots: RecordSlots,
) -> None:  # fmt: skip
    """Carry gradients of macro tiles back; see ``_draw_tiles_back``."""
    _draw_tiles_back(
        fixed(mode), fixed(output_kind), rays, projected, binned, tiles, planes, gradients, slots,
        aligned(BLOCKS, STATE_PLANES, RAYS), aligned(BATCH, SUMS), BatchScratch.empty(),
    )  # fmt: skip
