"""Kernel that blends macro tiles: records by batches, prepared for blocks of rays, front to back until opaque."""

from __future__ import annotations

import numpy as np

from nurec_sim.render.cpu.blend.binning import longest_list, sort_tile
from nurec_sim.render.cpu.blend.blocks import (
    MOST_PLANES,
    blend_affine_camera,
    blend_affine_camera_near,
    blend_affine_normals,
    blend_moving_camera,
    blend_moving_normals,
    blend_table_camera,
    blend_table_normals,
    open_block,
    write_block_6,
    write_block_9,
)
from nurec_sim.render.cpu.blend.rays import moving_tile, pinhole_basis, rolling_basis
from nurec_sim.render.cpu.blend.responses import CAMERA, NORMALS, RAY_PLANES
from nurec_sim.render.cpu.blend.tiles import (
    ACROSS,
    AFFINE,
    BANDS,
    BASIS,
    BATCH,
    BLOCKS,
    C_NORMAL,
    CAMERA_BATCH,
    COEFFICIENTS,
    HIGH,
    LIST,
    MOVING,
    RAYS,
    ROLLING,
    TABLE,
    WIDE,
    prepare_affine,
    prepare_moving,
    prepare_rolling,
    prepare_table,
)
from nurec_sim.render.cpu.kernel import f4, inner, keep_alive, kernel
from nurec_sim.render.cpu.pack import BLOCK, MEAN, NORMAL
from nurec_sim.render.cpu.records import MACRO, RECORD
from nurec_sim.render.cpu.simd import LANES, prefetch

LINE_BYTES = 64
"""Of a cache line."""
RAY_BYTES = 4 * RAY_PLANES * RAYS
"""Of a block's rays."""


@inner
def aligned(count):
    """An uninitialised float32 array that starts on a cache line."""
    memory = np.empty(count + LINE_BYTES // 4, np.float32)
    skip = (-memory.ctypes.data % LINE_BYTES) // 4
    return memory[skip : skip + count]


@inner
def batch_scratch():
    """Scratch of a thread that goes through the batches of macro tiles.

    Returns:
        ``turned`` and ``basis`` for ``tile_geometry``; ``coefficients``, ``chosen`` and ``listed`` for
        ``prepare_batch``.
    """
    turned = aligned(BLOCKS * RAY_PLANES * RAYS).reshape(BLOCKS, RAY_PLANES, RAYS)
    basis = np.zeros((BANDS, BASIS), np.float32)
    coefficients = aligned(COEFFICIENTS * BATCH).reshape(COEFFICIENTS, BATCH)
    return turned, basis, coefficients, np.empty((BLOCKS, LIST), np.uint8), np.zeros(BLOCKS, np.int64)


@inner
def _prepare(mode, ids, records, count, alive, basis, coefficients, lists, counts, entry):
    """The preparation of a projection mode; see ``tiles``."""
    if mode == AFFINE:
        return prepare_affine(ids, records, count, alive, basis, coefficients, lists, counts, entry)
    if mode == ROLLING:
        return prepare_rolling(ids, records, count, alive, basis, coefficients, lists, counts, entry)
    if mode == TABLE:
        return prepare_table(ids, records, count, alive, basis, coefficients, lists, counts, entry)
    return prepare_moving(ids, records, count, alive, basis, coefficients, lists, counts, entry)


@inner
def prepare_batch(mode, lists, first, last, end, records_at, alive, basis_at, coefficients, chosen, listed):
    """Prepare the records ``lists[first:last]`` for the blocks that are still open; 1 if any is close, else 0.

    Args:
        mode: projection mode.
        lists: see ``binning.TileLists``.
        first: first entry of the batch.
        last: one behind its last.
        end: one behind the tile's last.
        records_at: address of the records.
        alive: bit k is set while block k is still open (not all of its rays are opaque).
        basis_at: address of the tile's basis.
        coefficients: [COEFFICIENTS,BATCH] output.
        chosen: [BLOCKS,LIST] output: numbers within the batch of the records that each block sees.
        listed: [BLOCKS] output: how many they are.
    """
    for block in range(BLOCKS):
        listed[block] = 0
    close = np.int64(0)
    for j in range(first, last, LANES):
        for ahead in range(j + LANES, min(j + 2 * LANES, end)):
            # Records are read in the order of depth, which is random in memory: fetch the next group while this one is
            # prepared.
            prefetch(records_at + np.int64(lists[ahead]) * (4 * RECORD))
        close |= _prepare(mode, lists.ctypes.data + 4 * j, records_at, min(last - j, LANES), alive, basis_at,
                          coefficients.ctypes.data, chosen.ctypes.data, listed.ctypes.data, j - first)  # fmt: skip
    return close


@inner
def tile_geometry(rays, tile, turned, basis):
    """Describe a macro tile's rays.

    Args:
        rays: see ``rays.SensorRays``.
        tile: number of the macro tile.
        turned: [BLOCKS,RAY_PLANES,RAYS] scratch: rays turned into the reference frame (MOVING).
        basis: [BANDS,BASIS] scratch: the tile's bases (all but TABLE).

    Returns:
        Its row and column, the addresses of its rays (0 where a formula gives them) and of its bases, and the blocks
        that lie in the grid, a bit each.
    """
    columns = (rays.width + MACRO - 1) // MACRO
    row, column = tile // columns, tile % columns
    wide, high = min(MACRO, rays.width - column * MACRO), min(MACRO, rays.height - row * MACRO)
    rays_at, basis_at = np.int64(0), np.int64(basis.ctypes.data)
    if rays.mode == TABLE:
        rays_at = rays.table.ctypes.data + tile * (BLOCKS * RAY_BYTES)
        basis_at = rays.basis.ctypes.data + tile * (4 * BANDS * BASIS)
    elif rays.mode == MOVING:
        line_poses = (rays.turns, rays.places)
        moving_tile(rays.table[tile], rays.line[tile], line_poses, wide, high, rays.motion, turned, basis)
        rays_at = turned.ctypes.data
    else:
        pinhole_basis(rays.intrinsics, column, row, basis[0])
        if rays.mode == ROLLING:
            rolling_basis(rays.motion, row, basis[0])
    # Blocks that lie wholly outside of the grid are never blended.
    inside = 0
    for block in range(BLOCKS):
        if block % ACROSS * WIDE < wide and block // ACROSS * HIGH < high:
            inside |= 1 << block
    return row, column, rays_at, basis_at, inside


@inner
def _blend_block(mode, output_kind, close, state, numbers, count, coefficients, rays, basis, x0, y0, near):
    """Blend a list into a block with the code for a mode and an output kind; see ``blocks``."""
    if mode == AFFINE or mode == ROLLING:
        if output_kind == NORMALS:
            return blend_affine_normals(state, numbers, count, coefficients, rays, basis, x0, y0, near)
        if close:
            return blend_affine_camera_near(state, numbers, count, coefficients, rays, basis, x0, y0, near)
        return blend_affine_camera(state, numbers, count, coefficients, rays, basis, x0, y0, near)
    if mode == TABLE:
        if output_kind == CAMERA:
            return blend_table_camera(state, numbers, count, coefficients, rays, basis, x0, y0, near)
        return blend_table_normals(state, numbers, count, coefficients, rays, basis, x0, y0, near)
    if output_kind == CAMERA:
        return blend_moving_camera(state, numbers, count, coefficients, rays, basis, x0, y0, near)
    return blend_moving_normals(state, numbers, count, coefficients, rays, basis, x0, y0, near)


@kernel
def draw_tiles(rays, projected, binned, normals, output_kind, tiles, planes, counts):
    """Blend the given macro tiles into ``planes``.

    Args:
        rays: see ``rays.SensorRays``.
        projected: see ``records.Projected``.
        binned: see ``binning.TileLists``.
        normals: [n,4] a normal per record (NORMALS).
        output_kind: CAMERA or NORMALS.
        tiles: numbers of the macro tiles to do.
        planes: [6 or 9,h,w] output, sides rounded up to whole blocks: alpha, features, distance, tagged weight.
        counts: [1] int64, the number of responses evaluated is added.
    """
    count_planes = 9 if output_kind == NORMALS else 6
    state = aligned(BLOCKS * MOST_PLANES * RAYS)
    turned, basis, coefficients, chosen, listed = batch_scratch()
    row_bytes, plane_bytes = 4 * planes.shape[2], 4 * planes.shape[1] * planes.shape[2]
    block_bytes = 4 * count_planes * RAYS
    state_at, coefficients_at, chosen_at = state.ctypes.data, coefficients.ctypes.data, chosen.ctypes.data
    records_at, lists = projected.records.ctypes.data, binned.lists
    evaluations = 0
    spare, starts = np.empty(longest_list(binned, tiles), np.uint64), np.empty((2, 2049), np.int64)
    for index in range(tiles.shape[0]):
        tile = np.int64(tiles[index])
        row, column, rays_at, basis_at, inside = tile_geometry(rays, tile, turned, basis)
        for block in range(BLOCKS):
            open_block(state_at + block * block_bytes, count_planes, rays_at + block * RAY_BYTES if rays_at else 0)
        alive = inside
        sort_tile(binned, tile, spare, starts)
        first, end = np.int64(binned.starts[tile]), np.int64(binned.starts[tile + 1])
        # A tile is done when its list ends, or when all of its rays are opaque.
        while first < end and alive != 0:
            last = min(end, first + CAMERA_BATCH)
            close = prepare_batch(
                rays.mode, lists, first, last, end, records_at, alive, basis_at, coefficients, chosen, listed
            )
            if output_kind == NORMALS:
                # Normals are per record and view, so they are not part of a record; they become coefficients here.
                for k in range(first, last):
                    for c in range(3):
                        coefficients[C_NORMAL + c, k - first] = normals[np.uint64(lists[k]), c]
            for block in range(BLOCKS):
                n = listed[block]
                if n > 0:
                    evaluations += n * RAYS
                    more = _blend_block(
                        rays.mode, output_kind, close != 0, state_at + block * block_bytes, chosen_at + block * LIST, n,
                        coefficients_at, rays_at + block * RAY_BYTES, basis_at,
                        f4(block % ACROSS * WIDE) - f4(15.5), f4(block // ACROSS * HIGH) - f4(15.5), rays.near,
                    )  # fmt: skip
                    if more == 0:
                        # All rays of the block are opaque: later batches are not prepared for it.
                        alive &= ~(1 << block)
            first = last
        for block in range(BLOCKS):
            if (inside >> block) & 1:
                y, x = row * MACRO + block // ACROSS * HIGH, column * MACRO + block % ACROSS * WIDE
                target = planes.ctypes.data + y * row_bytes + 4 * x
                if output_kind == NORMALS:
                    write_block_9(state_at + block * block_bytes, target, row_bytes, plane_bytes)
                else:
                    write_block_6(state_at + block * block_bytes, target, row_bytes, plane_bytes)
    keep_alive(state)
    keep_alive(chosen)
    keep_alive(turned)
    keep_alive(coefficients)
    keep_alive(basis)
    counts[0] += evaluations


@kernel
def record_normals(fields, sources, first, count, eye, normals):
    """Write the normals of a run of records, turned to face the eye.

    Args:
        fields: [blocks,22,256] the layer's Gaussians, see ``pack``.
        sources: [n] packed row of each record.
        first: first record of the run.
        count: how many.
        eye: [3] float64, the reference point in the world.
        normals: [n,4] output; the first three columns are written.
    """
    for n in range(first, first + count):
        block, lane = sources[n] // BLOCK, sources[n] % BLOCK
        # ``spec``: each normal is turned by the eye at the reference instant, the same for all rays.
        towards = 0.0
        for k in range(3):
            towards += fields[block, NORMAL + k, lane] * (fields[block, MEAN + k, lane] - eye[k])
        sign = f4(-1) if towards > 0 else f4(1)
        for k in range(3):
            normals[n, k] = sign * fields[block, NORMAL + k, lane]
