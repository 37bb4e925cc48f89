"""Kernel that carries gradients of a blended image back to records, macro tile by macro tile, as ``draw`` blended them.

Every pair of a record and a macro tile has a slot of its own for its sums, so that neither threads nor their number
change any result; ``backward_project`` adds the slots of a record up.
"""

from __future__ import annotations

import numpy as np

from nurec_sim.render.cpu.backward.blend import (
    STATE_PLANES,
    SUMS,
    back_affine_camera,
    back_affine_camera_near,
    back_moving_camera,
    back_moving_lidar,
    back_table_camera,
    back_table_lidar,
    open_gradients,
)
from nurec_sim.render.cpu.blend.blocks import CAMERA, LIDAR, RAY_PLANES
from nurec_sim.render.cpu.blend.draw import aligned, prepare
from nurec_sim.render.cpu.blend.rays import moving_tile, pinhole_basis
from nurec_sim.render.cpu.blend.tiles import (
    ACROSS,
    AFFINE,
    BANDS,
    BASIS,
    BATCH,
    BLOCKS,
    CAMERA_BATCH,
    COEFFICIENTS,
    HIGH,
    LIST,
    RAYS,
    TABLE,
    WIDE,
)
from nurec_sim.render.cpu.kernel import f4, inner, keep_alive, kernel
from nurec_sim.render.cpu.records import MACRO, RECORD
from nurec_sim.render.cpu.simd import LANES, prefetch


@kernel
def number_slots(spans, starts, counts, first_slot):
    """The first slot of every record, a slot per macro tile of its span; returns how many there are.

    Args:
        spans: [n,4] first and last macro tile column, first and last row.
        starts: [runs] first row of each run of records.
        counts: [runs] their lengths.
        first_slot: [n] int64 output.
    """
    slot = 0
    for run in range(len(starts)):
        for i in range(starts[run], starts[run] + counts[run]):
            first_slot[i] = slot
            slot += (np.int64(spans[i, 1]) - spans[i, 0] + 1) * (np.int64(spans[i, 3]) - spans[i, 2] + 1)
    return slot


@inner
def _carry_back(way, kind, close, state, numbers, count, coefficients, rays, basis, sums, x0, y0, near):
    """Carry a block's gradients back the right way; see ``backward_blend``."""
    if way == AFFINE:
        if close:
            return back_affine_camera_near(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)
        return back_affine_camera(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)
    if way == TABLE:
        if kind == CAMERA:
            return back_table_camera(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)
        return back_table_lidar(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)
    if kind == CAMERA:
        return back_moving_camera(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)
    return back_moving_lidar(state, numbers, count, coefficients, rays, basis, sums, x0, y0, near)


@inner
def _keep_sums(sums, lists, first, last, spans, first_slot, row, column, slots):
    """Write a batch's sums to the slots of its records for this macro tile."""
    for j in range(first, last):
        i = np.uint64(lists[j])
        across = np.int64(spans[i, 1]) - spans[i, 0] + 1
        slot = np.uint64(first_slot[i] + (row - spans[i, 2]) * across + column - spans[i, 0])
        entry = np.uint64(j - first)
        for k in range(SUMS):
            slots[slot, np.uint64(k)] = sums[entry, np.uint64(k)]


@kernel
def draw_tiles_back(
    way, kind, tiles, starts, lists, records, spans, first_slot, intrinsics, table, line, bases, turns, places, motion,
    near, width, height, planes, gradients, slots,
):  # fmt: skip
    """Carry gradients of the given macro tiles back to ``slots``.

    Args:
        way: AFFINE, TABLE or MOVING.
        kind: CAMERA or LIDAR.
        tiles: numbers of the macro tiles to do.
        starts: see ``draw.draw_tiles``, as all up to ``planes`` that is not named here.
        lists: see starts.
        records: see starts.
        spans: [n,4] macro tiles of the records.
        first_slot: [n] see ``number_slots``.
        intrinsics: see starts.
        table: see starts.
        line: see starts.
        bases: see starts.
        turns: see starts.
        places: see starts.
        motion: see starts.
        near: near plane.
        width: columns of the grid.
        height: rows of the grid.
        planes: [6,h,w] what ``draw.draw_tiles`` made.
        gradients: [6,h,w] gradients of ``planes``; 0 where there is no valid ray.
        slots: [pairs,SUMS] output, all slots of the tiles' records.
    """
    state, rays = aligned(BLOCKS * STATE_PLANES * RAYS), aligned(BLOCKS * RAY_PLANES * RAYS)
    coefficients, basis = (
        aligned(COEFFICIENTS * BATCH).reshape(COEFFICIENTS, BATCH),
        np.zeros((BANDS, BASIS), np.float32),
    )
    sums = aligned(BATCH * SUMS).reshape(BATCH, SUMS)
    chosen, listed = np.empty((BLOCKS, LIST), np.uint8), np.zeros(BLOCKS, np.int64)
    batch = BATCH if kind == LIDAR else CAMERA_BATCH
    turned = rays.reshape(BLOCKS, RAY_PLANES, RAYS)
    columns = (width + MACRO - 1) // MACRO
    row_bytes, plane_bytes = 4 * planes.shape[2], 4 * planes.shape[1] * planes.shape[2]
    block_bytes, ray_bytes = 4 * STATE_PLANES * RAYS, 4 * RAY_PLANES * RAYS
    state_at, coefficients_at, basis_at = state.ctypes.data, coefficients.ctypes.data, basis.ctypes.data
    chosen_at, listed_at, lists_at = chosen.ctypes.data, listed.ctypes.data, lists.ctypes.data
    records_at, sums_at = records.ctypes.data, sums.ctypes.data
    for index in range(tiles.shape[0]):
        tile = np.int64(tiles[index])
        row, column = tile // columns, tile % columns
        wide, high = min(MACRO, width - column * MACRO), min(MACRO, height - row * MACRO)
        rays_at = np.int64(0)
        if way == TABLE:
            rays_at = table.ctypes.data + tile * (BLOCKS * ray_bytes)
            basis_at = bases.ctypes.data + tile * (4 * BANDS * BASIS)
        elif way == AFFINE:
            pinhole_basis(intrinsics, column, row, basis[0])
        else:
            moving_tile(table[tile], line[tile], turns, places, wide, high, motion, turned, basis)
            rays_at = rays.ctypes.data
        alive = 0
        for block in range(BLOCKS):
            if block % ACROSS * WIDE < wide and block // ACROSS * HIGH < high:
                alive |= 1 << block
                y, x = row * MACRO + block // ACROSS * HIGH, column * MACRO + block % ACROSS * WIDE
                offset = y * row_bytes + 4 * x
                open_gradients(
                    state_at + block * block_bytes, planes.ctypes.data + offset, gradients.ctypes.data + offset,
                    rays_at + block * ray_bytes if rays_at else 0, row_bytes, plane_bytes,
                )  # fmt: skip
        alive_now = alive
        first, end = np.int64(starts[tile]), np.int64(starts[tile + 1])
        while first < end:
            last = min(end, first + batch)
            sums[:] = f4(0)
            if alive_now != 0:
                for block in range(BLOCKS):
                    listed[block] = 0
                close = np.int64(0)
                for j in range(first, last, LANES):
                    for ahead in range(j + LANES, min(j + 2 * LANES, end)):
                        prefetch(records_at + np.int64(lists[ahead]) * (4 * RECORD))
                    close |= prepare(way, lists_at + 4 * j, records_at, min(last - j, LANES), alive_now, basis_at,
                                     coefficients_at, chosen_at, listed_at, j - first)  # fmt: skip
                for block in range(BLOCKS):
                    n = listed[block]
                    if n > 0:
                        more = _carry_back(
                            way, kind, close != 0, state_at + block * block_bytes, chosen_at + block * LIST, n,
                            coefficients_at, rays_at + block * ray_bytes, basis_at, sums_at,
                            f4(block % ACROSS * WIDE) - f4(15.5), f4(block // ACROSS * HIGH) - f4(15.5), near,
                        )  # fmt: skip
                        if more == 0:
                            alive_now &= ~(1 << block)
            _keep_sums(sums, lists, first, last, spans, first_slot, row, column, slots)
            first = last
    keep_alive(state)
    keep_alive(chosen)
    keep_alive(coefficients)
