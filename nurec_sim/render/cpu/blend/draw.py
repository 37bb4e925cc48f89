"""Kernel that blends macro tiles: records by batches, prepared for blocks of rays, front to back until opaque."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from nurec_sim.render.cpu.blend.binning import SortScratch, TileLists, sort_tile
from nurec_sim.render.cpu.blend.blocks import (
    ALL_FAR,
    CHECK_NEAR,
    MOST_PLANES,
    blend,
    open_block,
    write_block_6,
    write_block_9,
)
from nurec_sim.render.cpu.blend.rays import SensorRays, moving_tile, pinhole_basis, rolling_basis
from nurec_sim.render.cpu.blend.responses import CAMERA, NORMALS, RAY_PLANES
from nurec_sim.render.cpu.blend.tiles import (
    ACROSS,
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
    prepare,
)
from nurec_sim.render.cpu.kernel import f4, fixed, inner, kernel
from nurec_sim.render.cpu.pack import BLOCK, MEAN, NORMAL
from nurec_sim.render.cpu.records import MACRO, RECORD, Projected
from nurec_sim.render.cpu.simd import LANES, prefetch

LINE_BYTES = 64
"""Of a cache line."""
RAY_BYTES = 4 * RAY_PLANES * RAYS
"""Of a block's rays."""


def aligned(*shape: int) -> np.ndarray:
    """An uninitialised float32 array that starts on a cache line."""
    memory = np.empty(4 * math.prod(shape) + LINE_BYTES, np.uint8)
    skip = -memory.ctypes.data % LINE_BYTES
    return memory[skip : skip + 4 * math.prod(shape)].view(np.float32).reshape(shape)


class BatchScratch(NamedTuple):
    """Scratch of a thread that goes through the batches of macro tiles."""

    turned: Float32[np.ndarray, "32 5 32"]
    """A tile's rays in the reference frame (MOVING)."""
    basis: Float32[np.ndarray, "4 16"]
    """Its bases (all but TABLE)."""
    coefficients: Float32[np.ndarray, "21 128"]
    """See ``tiles``."""
    chosen: UInt8[np.ndarray, "32 list"]
    """Numbers within the batch of the records that each block sees."""
    listed: Int64[np.ndarray, " 32"]
    """How many they are."""

    @classmethod
    def empty(cls) -> BatchScratch:
        """New scratch."""
        return cls(
            aligned(BLOCKS, RAY_PLANES, RAYS),
            np.zeros((BANDS, BASIS), np.float32),
            aligned(COEFFICIENTS, BATCH),
            np.empty((BLOCKS, LIST), np.uint8),
            np.zeros(BLOCKS, np.int64),
        )


@inner
def prepare_batch(mode, lists, first, last, end, records_at, alive, basis_at, scratch):
    """Prepare the records ``lists[first:last]`` for the blocks that are still open; 1 if any is close, else 0.

    Args:
        mode: projection mode, ``fixed``.
        lists: see ``binning.TileLists``.
        first: first entry of the batch.
        last: one behind its last.
        end: one behind the tile's last.
        records_at: address of the records.
        alive: bit k is set while block k is still open (not all of its rays are opaque).
        basis_at: address of the tile's basis.
        scratch: see ``BatchScratch``; what follows ``basis`` is written.
    """
    for block in range(BLOCKS):
        scratch.listed[block] = 0
    lists_at, coefficients_at = lists.ctypes.data, scratch.coefficients.ctypes.data
    chosen_at, listed_at = scratch.chosen.ctypes.data, scratch.listed.ctypes.data
    close = np.int64(0)
    for j in range(first, last, LANES):
        for ahead in range(j + LANES, min(j + 2 * LANES, end)):
            # Records are read in the order of depth, which is random in memory: fetch the next group while this one is
            # prepared.
            prefetch(records_at + np.int64(lists[ahead]) * (4 * RECORD))
        close |= prepare(mode, lists_at + 4 * j, records_at, min(last - j, LANES), alive, basis_at, coefficients_at,
                         chosen_at, listed_at, j - first)  # fmt: skip
    return close


@inner
def tile_geometry(mode, rays, tile, scratch):
    """Describe a macro tile's rays.

    Args:
        mode: projection mode, ``fixed``.
        rays: see ``rays.SensorRays``.
        tile: number of the macro tile.
        scratch: see ``BatchScratch``; ``turned`` and ``basis`` are written.

    Returns:
        Its row and column, the addresses of its rays (0 where a formula gives them) and of its bases, and the blocks
        that lie in the grid, a bit each.
    """
    turned, basis = scratch.turned, scratch.basis
    columns = (rays.width + MACRO - 1) // MACRO
    row, column = tile // columns, tile % columns
    wide, high = min(MACRO, rays.width - column * MACRO), min(MACRO, rays.height - row * MACRO)
    rays_at, basis_at = np.int64(0), np.int64(basis.ctypes.data)
    if len(mode) == TABLE:
        rays_at = rays.table.ctypes.data + tile * (BLOCKS * RAY_BYTES)
        basis_at = rays.basis.ctypes.data + tile * (4 * BANDS * BASIS)
    elif len(mode) == MOVING:
        line_poses = (rays.turns, rays.places)
        moving_tile(rays.table[tile], rays.line[tile], line_poses, wide, high, rays.motion, turned, basis)
        rays_at = turned.ctypes.data
    else:
        pinhole_basis(rays.intrinsics, column, row, basis[0])
        if len(mode) == ROLLING:
            rolling_basis(rays.motion, row, basis[0])
    # Blocks that lie wholly outside of the grid are never blended.
    inside = 0
    for block in range(BLOCKS):
        if block % ACROSS * WIDE < wide and block // ACROSS * HIGH < high:
            inside |= 1 << block
    return row, column, rays_at, basis_at, inside


@kernel
def _draw_tiles(mode, output_kind, rays, projected, binned, normals, tiles, planes, counts, state, scratch, sorting):
    """Blend the given macro tiles into ``planes``.

    Args:
        mode: projection mode, ``fixed``.
        output_kind: CAMERA or NORMALS, ``fixed``.
        rays: see ``rays.SensorRays``.
        projected: see ``records.Projected``.
        binned: see ``binning.TileLists``.
        normals: [n,4] a normal per record (NORMALS).
        tiles: numbers of the macro tiles to do.
        planes: [6 or 9,h,w] output, sides rounded up to whole blocks: alpha, features, distance, tagged weight.
        counts: [1] int64, the number of responses evaluated is added.
        state: [BLOCKS,MOST_PLANES,RAYS] scratch, on a cache line.
        scratch: see ``BatchScratch``.
        sorting: see ``binning.SortScratch``.
    """
    count_planes = 9 if len(output_kind) == NORMALS else 6
    row_bytes, plane_bytes = 4 * planes.shape[2], 4 * planes.shape[1] * planes.shape[2]
    block_bytes = 4 * count_planes * RAYS
    state_at, chosen_at = state.ctypes.data, scratch.chosen.ctypes.data
    coefficients, coefficients_at = scratch.coefficients, scratch.coefficients.ctypes.data
    records_at, lists = projected.records.ctypes.data, binned.lists
    evaluations = 0
    for index in range(tiles.shape[0]):
        tile = np.int64(tiles[index])
        row, column, rays_at, basis_at, inside = tile_geometry(mode, rays, tile, scratch)
        for block in range(BLOCKS):
            open_block(state_at + block * block_bytes, count_planes, rays_at + block * RAY_BYTES if rays_at else 0)
        alive = inside
        sort_tile(binned, tile, sorting)
        first, end = np.int64(binned.starts[tile]), np.int64(binned.starts[tile + 1])
        # A tile is done when its list ends, or when all of its rays are opaque.
        while first < end and alive != 0:
            last = min(end, first + CAMERA_BATCH)
            close = prepare_batch(mode, lists, first, last, end, records_at, alive, basis_at, scratch)
            if len(output_kind) == NORMALS:
                # Normals are per record and view, so they are not part of a record; they become coefficients here.
                for k in range(first, last):
                    for c in range(3):
                        coefficients[C_NORMAL + c, k - first] = normals[np.uint64(lists[k]), c]
            for block in range(BLOCKS):
                n = scratch.listed[block]
                if n > 0:
                    evaluations += n * RAYS
                    block_at, numbers_at = state_at + block * block_bytes, chosen_at + block * LIST
                    block_rays_at = rays_at + block * RAY_BYTES
                    x0, y0 = f4(block % ACROSS * WIDE) - f4(15.5), f4(block // ACROSS * HIGH) - f4(15.5)
                    # Most batches of a pinhole are nowhere near its plane; the check would slow them down.
                    if len(mode) <= ROLLING and len(output_kind) == CAMERA and close == 0:
                        more = blend(mode, output_kind, ALL_FAR, block_at, numbers_at, n, coefficients_at,
                                     block_rays_at, basis_at, x0, y0, rays.near)  # fmt: skip
                    else:
                        more = blend(mode, output_kind, CHECK_NEAR, block_at, numbers_at, n, coefficients_at,
                                     block_rays_at, basis_at, x0, y0, rays.near)  # fmt: skip
                    if more == 0:
                        # All rays of the block are opaque: later batches are not prepared for it.
                        alive &= ~(1 << block)
            first = last
        for block in range(BLOCKS):
            if (inside >> block) & 1:
                y, x = row * MACRO + block // ACROSS * HIGH, column * MACRO + block % ACROSS * WIDE
                target = planes.ctypes.data + y * row_bytes + 4 * x
                if len(output_kind) == NORMALS:
                    write_block_9(state_at + block * block_bytes, target, row_bytes, plane_bytes)
                else:
                    write_block_6(state_at + block * block_bytes, target, row_bytes, plane_bytes)
    counts[0] += evaluations


def draw_tiles(
    mode: int, output_kind: int, rays: SensorRays, projected: Projected, binned: TileLists, normals: np.ndarray,
    tiles: Int64[np.ndarray, " t"], planes: Float32[np.ndarray, "p h w"], counts: Int64[np.ndarray, " 1"],
) -> None:  # fmt: skip
    """Blend macro tiles; see ``_draw_tiles``."""
    _draw_tiles(
        fixed(mode), fixed(output_kind), rays, projected, binned, normals, tiles, planes, counts,
        aligned(BLOCKS, MOST_PLANES, RAYS), BatchScratch.empty(), SortScratch.empty(binned, tiles),
    )  # fmt: skip


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
