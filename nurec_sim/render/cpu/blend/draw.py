"""Kernel that blends macro tiles: records by batches, prepared for blocks of rays, front to back until opaque."""

from __future__ import annotations

import numpy as np

from nurec_sim.render.cpu.blend.blocks import (
    CAMERA,
    LIDAR,
    MOST_PLANES,
    NORMALS,
    RAY_PLANES,
    blend_affine_camera,
    blend_affine_camera_near,
    blend_affine_normals,
    blend_moving_camera,
    blend_moving_lidar,
    blend_moving_normals,
    blend_table_camera,
    blend_table_lidar,
    blend_table_normals,
    open_block,
    write_block_6,
    write_block_9,
)
from nurec_sim.render.cpu.blend.rays import moving_tile, pinhole_basis, rolling_basis
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


@inner
def aligned(count):
    """An uninitialised float32 array that starts on a cache line."""
    memory = np.empty(count + LINE_BYTES // 4, np.float32)
    skip = (-memory.ctypes.data % LINE_BYTES) // 4
    return memory[skip : skip + count]


@inner
def prepare(way, ids, records, count, alive, basis, coefficients, lists, counts, entry):
    """The preparation of a way; see ``tiles``."""
    if way == AFFINE:
        return prepare_affine(ids, records, count, alive, basis, coefficients, lists, counts, entry)
    if way == ROLLING:
        return prepare_rolling(ids, records, count, alive, basis, coefficients, lists, counts, entry)
    if way == TABLE:
        return prepare_table(ids, records, count, alive, basis, coefficients, lists, counts, entry)
    return prepare_moving(ids, records, count, alive, basis, coefficients, lists, counts, entry)


@inner
def blend_block(way, kind, close, state, numbers, count, coefficients, rays, basis, x0, y0, near):
    """Blend a list into a block the right way; see ``blend``."""
    if way == AFFINE or way == ROLLING:
        if kind == NORMALS:
            return blend_affine_normals(state, numbers, count, coefficients, rays, basis, x0, y0, near)
        if close:
            return blend_affine_camera_near(state, numbers, count, coefficients, rays, basis, x0, y0, near)
        return blend_affine_camera(state, numbers, count, coefficients, rays, basis, x0, y0, near)
    if way == TABLE:
        if kind == CAMERA:
            return blend_table_camera(state, numbers, count, coefficients, rays, basis, x0, y0, near)
        if kind == NORMALS:
            return blend_table_normals(state, numbers, count, coefficients, rays, basis, x0, y0, near)
        return blend_table_lidar(state, numbers, count, coefficients, rays, basis, x0, y0, near)
    if kind == CAMERA:
        return blend_moving_camera(state, numbers, count, coefficients, rays, basis, x0, y0, near)
    if kind == NORMALS:
        return blend_moving_normals(state, numbers, count, coefficients, rays, basis, x0, y0, near)
    return blend_moving_lidar(state, numbers, count, coefficients, rays, basis, x0, y0, near)


@kernel
def draw_tiles(
    way, kind, tiles, starts, lists, records, normals, intrinsics, table, line, bases, turns, places, motion,
    near, width, height, planes, counts,
):  # fmt: skip
    """Blend the given macro tiles into ``planes``.

    Args:
        way: AFFINE, ROLLING (pinholes), TABLE or MOVING (everything else, at one pose or several).
        kind: CAMERA, NORMALS or LIDAR.
        tiles: numbers of the macro tiles to do.
        starts: [tiles+1] where each tile's list starts.
        lists: record numbers front to back, tile after tile; LANES more entries than used.
        records: see ``records``.
        normals: [n,4] a normal per record (NORMALS).
        intrinsics: fx, fy, cx, cy (pinholes).
        table: see ``rays.RayTiles``, as line and bases (TABLE, MOVING).
        line: see table.
        bases: see table.
        turns: [lines,9] rotation of each line into the reference frame (MOVING).
        places: [lines] where each line's origin lies on the sensor's way (MOVING).
        motion: see ``rays.rolling_basis``; its velocity for MOVING, too.
        near: near plane.
        width: columns of the grid.
        height: rows of the grid.
        planes: [6 or 9,h,w] output, sides rounded up to whole blocks: alpha, features, distance, tagged weight or half.
        counts: [1] int64, the number of responses evaluated is added.
    """
    count_planes = 9 if kind == NORMALS else 6
    state, rays = aligned(BLOCKS * MOST_PLANES * RAYS), aligned(BLOCKS * RAY_PLANES * RAYS)
    coefficients, basis = (
        aligned(COEFFICIENTS * BATCH).reshape(COEFFICIENTS, BATCH),
        np.zeros((BANDS, BASIS), np.float32),
    )
    batch = BATCH if kind == LIDAR else CAMERA_BATCH
    chosen, listed = np.empty((BLOCKS, LIST), np.uint8), np.zeros(BLOCKS, np.int64)
    turned = rays.reshape(BLOCKS, RAY_PLANES, RAYS)
    columns = (width + MACRO - 1) // MACRO
    row_bytes, plane_bytes = 4 * planes.shape[2], 4 * planes.shape[1] * planes.shape[2]
    block_bytes, ray_bytes = 4 * count_planes * RAYS, 4 * RAY_PLANES * RAYS
    state_at, coefficients_at, basis_at = state.ctypes.data, coefficients.ctypes.data, basis.ctypes.data
    chosen_at, listed_at, lists_at, records_at = (
        chosen.ctypes.data,
        listed.ctypes.data,
        lists.ctypes.data,
        records.ctypes.data,
    )
    evaluations = 0
    for index in range(tiles.shape[0]):
        tile = np.int64(tiles[index])
        row, column = tile // columns, tile % columns
        wide, high = min(MACRO, width - column * MACRO), min(MACRO, height - row * MACRO)
        rays_at = np.int64(0)
        if way == TABLE:
            rays_at = table.ctypes.data + tile * (BLOCKS * ray_bytes)
            basis_at = bases.ctypes.data + tile * (4 * BANDS * BASIS)
        elif way == MOVING:
            moving_tile(table[tile], line[tile], turns, places, wide, high, motion, turned, basis)
            rays_at = rays.ctypes.data
        else:
            pinhole_basis(intrinsics, column, row, basis[0])
            if way == ROLLING:
                rolling_basis(motion, row, basis[0])
        alive = 0
        for block in range(BLOCKS):
            open_block(state_at + block * block_bytes, count_planes, rays_at + block * ray_bytes if rays_at else 0)
            if block % ACROSS * WIDE < wide and block // ACROSS * HIGH < high:
                alive |= 1 << block
        alive_now = alive
        j, end = np.int64(starts[tile]), np.int64(starts[tile + 1])
        while j < end and alive_now != 0:
            batch_end = min(end, j + batch)
            for block in range(BLOCKS):
                listed[block] = 0
            entry = 0
            first = j
            close = np.int64(0)
            while j < batch_end:
                for ahead in range(j + LANES, min(j + 2 * LANES, end)):
                    prefetch(records_at + np.int64(lists[ahead]) * (4 * RECORD))
                some_count = min(batch_end - j, LANES)
                close |= prepare(way, lists_at + 4 * j, records_at, some_count, alive_now, basis_at,
                                 coefficients_at, chosen_at, listed_at, entry)  # fmt: skip
                entry += LANES
                j += LANES
            if kind == NORMALS:
                for k in range(first, batch_end):
                    for c in range(3):
                        coefficients[C_NORMAL + c, k - first] = normals[np.uint64(lists[k]), c]
            j = batch_end
            for block in range(BLOCKS):
                n = listed[block]
                if n > 0:
                    evaluations += n * RAYS
                    more = blend_block(
                        way, kind, close != 0, state_at + block * block_bytes, chosen_at + block * LIST, n,
                        coefficients_at, rays_at + block * ray_bytes, basis_at, f4(block % ACROSS * WIDE) - f4(15.5),
                        f4(block // ACROSS * HIGH) - f4(15.5), near,
                    )  # fmt: skip
                    if more == 0:
                        alive_now &= ~(1 << block)
        for block in range(BLOCKS):
            if (alive >> block) & 1:
                y, x = row * MACRO + block // ACROSS * HIGH, column * MACRO + block % ACROSS * WIDE
                target = planes.ctypes.data + y * row_bytes + 4 * x
                if kind == NORMALS:
                    write_block_9(state_at + block * block_bytes, target, row_bytes, plane_bytes)
                else:
                    write_block_6(state_at + block * block_bytes, target, row_bytes, plane_bytes)
    keep_alive(state)
    keep_alive(chosen)
    keep_alive(rays)
    keep_alive(coefficients)
    counts[0] += evaluations


@kernel
def record_normals(fields, sources, first, count, eye, normals):
    """Write the normals of records ``first`` .. ``first + count - 1``, turned to the eye (float64 [3])."""
    for n in range(first, first + count):
        block, lane = sources[n] // BLOCK, sources[n] % BLOCK
        towards = 0.0
        for k in range(3):
            towards += fields[block, NORMAL + k, lane] * (fields[block, MEAN + k, lane] - eye[k])
        sign = f4(-1) if towards > 0 else f4(1)
        for k in range(3):
            normals[n, k] = sign * fields[block, NORMAL + k, lane]
