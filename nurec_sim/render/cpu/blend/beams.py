"""Kernel that blends the macro tiles of a LiDAR: record by record, into the few beams that its own cells hold.

On a scanner's grid of degrees by tenths of degrees most records meet one beam or two. Lists for blocks of 32 rays,
which pay for cameras, would weigh hundreds of records in vain for each beam; here a record is weighed in the *patches*
of 8 x 2 beams that its span overlaps, from the state of a tile that stays in the first-level cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float32, Int64
from llvmlite import ir

from nurec_sim.render.cpu.blend.binning import SortScratch, TileLists, sort_tile
from nurec_sim.render.cpu.blend.blocks import FEATURES, PLANES, open_block, write_block_6
from nurec_sim.render.cpu.blend.draw import RAY_BYTES, aligned
from nurec_sim.render.cpu.blend.rays import SensorRays, turn_rays
from nurec_sim.render.cpu.blend.responses import (
    LIDAR,
    LIDAR_MIN_TRANSMITTANCE,
    RAY_PLANES,
    Bundle,
    RayGroup,
    T,
    hits_of,
    still_open,
)
from nurec_sim.render.cpu.blend.tiles import (
    ACROSS,
    BLOCKS,
    C_DRIFT,
    C_FADE,
    C_FLAT,
    HIGH,
    MOVING,
    RAYS,
    TABLE,
    WIDE,
)
from nurec_sim.render.cpu.kernel import fixed, inner, kernel
from nurec_sim.render.cpu.records import FADE, FEATURE, FLAT, MACRO, RECORD, WROW, XROW, YROW, Projected, lowest_bit
from nurec_sim.render.cpu.simd import LANES, Lanes, prefetch, vector_kernel

WIDE_BITS, LOW_BITS = 3, 1
PATCH = 1 << (WIDE_BITS + LOW_BITS)
"""Beams of a patch: half of a block, as wide as this and 2 rows high."""
AHEAD = 8
"""Records that are fetched before they are needed: in the order of depth they lie anywhere in memory."""
PLANES_LIDAR = PLANES[LIDAR]
STATE_BYTES = 4 * PLANES_LIDAR * RAYS
"""Of a block's sums."""


@vector_kernel("niiiif")
def blend_patch(
    v: Lanes, mode: int, state: ir.Value, rays: ir.Value, record: ir.Value, drift: ir.Value, near: ir.Value
) -> ir.Value:
    """Blend a record into a patch; returns 1 while any of its beams still has transmittance.

    Args:
        v: vectors.
        mode: TABLE or MOVING.
        state: address of the patch's sums, in planes of 32.
        rays: address of the patch's rays, in planes of 32.
        record: address of the record.
        drift: address of its rows times the sensor's velocity; only read for MOVING.
        near: near plane.
    """
    group = RayGroup(v, 0, [4 * LANES * k for k in range(PATCH // LANES)], v.number(0), Bundle([]))
    places = {C_FLAT: FLAT, C_FADE: FADE}

    def coefficient(row: int) -> Any:
        if row >= C_DRIFT:
            return v.broadcast(drift, 4 * (row - C_DRIFT))
        return v.broadcast(record, 4 * places.get(row, row))

    meeting, alpha, hit = hits_of(v, mode, LIDAR, group, coefficient, rays, rays, near)
    distance = hit.where(meeting.distance, 0)  # no NaN from a miss
    sums = [group.plane(state, plane) for plane in range(PLANES[LIDAR])]
    before = sums[T]
    # Beams end one by one, as in ``spec``.
    hit = hit & (before > LIDAR_MIN_TRANSMITTANCE)
    weight = hit.where(alpha * before, 0)
    after = before - weight
    result = [after]
    for k, plane in enumerate(sums[FEATURES:-2]):
        result.append(plane + weight * v.broadcast(record, 4 * (FEATURE + k)))
    result.append(sums[-2] + weight * distance)
    # An echo comes from the surface that stops half of the beam, not from the mean of several.
    crossing = (before > 0.5) & (after <= 0.5)
    result.append(crossing.where(distance, sums[-1]))
    for number, values in enumerate(result):
        group.keep(values, state, number)
    return still_open(after.parts, LIDAR)


_STILL, _MOVING = fixed(TABLE), fixed(MOVING)
# Rows of a record stand where coefficients have theirs, so most of them need no translation.
assert (XROW, YROW, WROW) == (0, 3, 6)


@inner
def _patches(spans, record, row, column):
    """The patches of a macro tile that a record's span overlaps: bit 4 r + c for row r and column c of them."""
    left = max(np.int64(spans[record, 0]) - column * MACRO, 0) >> WIDE_BITS
    right = min(np.int64(spans[record, 1]) - column * MACRO, MACRO - 1) >> WIDE_BITS
    top = max(np.int64(spans[record, 2]) - row * MACRO, 0) >> LOW_BITS
    bottom = min(np.int64(spans[record, 3]) - row * MACRO, MACRO - 1) >> LOW_BITS
    across = (np.uint64(2) << np.uint64(right)) - (np.uint64(1) << np.uint64(left))
    all_rows = across * np.uint64(0x1111111111111111)
    kept = np.uint64(0xFFFFFFFFFFFFFFFF)
    return all_rows & (kept << np.uint64(4 * top)) & (kept >> np.uint64(60 - 4 * bottom))


@inner
def _drift(records, number, motion, drift):
    """The rows of a record times the sensor's velocity."""
    i = np.uint64(number)
    for k in range(3):
        drift[k] = records[i, 3 * k] * motion[0] + records[i, 3 * k + 1] * motion[1] + records[i, 3 * k + 2] * motion[2]


@kernel
def _draw_beams(rays, projected, binned, tiles, planes, counts, state, turned, drift, sorting):
    """Blend the given macro tiles of a LiDAR into ``planes``.

    Args:
        rays: see ``rays.SensorRays``; the mode is TABLE or MOVING.
        projected: see ``records.Projected``.
        binned: see ``binning.TileLists``.
        tiles: numbers of the macro tiles to do.
        planes: [6,h,w] output, sides rounded up to whole blocks: alpha, features, distance, half distance.
        counts: [1] int64, the number of responses evaluated is added.
        state: [BLOCKS,PLANES_LIDAR,RAYS] scratch, on a cache line.
        turned: [BLOCKS,RAY_PLANES,RAYS] scratch, on a cache line.
        drift: [3] float32 scratch.
        sorting: see ``binning.SortScratch``.
    """
    row_bytes, plane_bytes = 4 * planes.shape[2], 4 * planes.shape[1] * planes.shape[2]
    columns = (rays.width + MACRO - 1) // MACRO
    state_at, records_at, spans = state.ctypes.data, projected.records.ctypes.data, projected.spans
    spans_at, drift_at = spans.ctypes.data, drift.ctypes.data
    moving = rays.mode == MOVING
    evaluations = 0
    for index in range(tiles.shape[0]):
        tile = np.int64(tiles[index])
        row, column = tile // columns, tile % columns
        rays_at = np.int64(rays.table.ctypes.data) + tile * (BLOCKS * RAY_BYTES)
        if moving:
            turn_rays(rays.table[tile], rays.line[tile], (rays.turns, rays.places), turned)
            rays_at = np.int64(turned.ctypes.data)
        for block in range(BLOCKS):
            open_block(state_at + block * STATE_BYTES, PLANES_LIDAR, rays_at + block * RAY_BYTES)
        sort_tile(binned, tile, sorting)
        first, end = np.int64(binned.starts[tile]), np.int64(binned.starts[tile + 1])
        # A bit for each patch that is not yet opaque.
        alive = np.uint64(0xFFFFFFFFFFFFFFFF)
        for j in range(first, end):
            if j + AHEAD < end:
                ahead = np.int64(binned.lists[j + AHEAD])
                prefetch(records_at + ahead * (4 * RECORD))
                prefetch(spans_at + ahead * 8)
            number = np.uint64(binned.lists[j])
            left = _patches(spans, number, row, column) & alive
            if left == 0:
                continue
            record_at = records_at + np.int64(number) * (4 * RECORD)
            if moving:
                _drift(projected.records, number, rays.motion, drift)
            while left != 0:
                patch = np.int64(lowest_bit(np.int64(left)))
                left &= left - np.uint64(1)
                evaluations += PATCH
                block = (patch >> 3 << 2) | (patch & 3)
                half = (patch >> 2) & 1
                where = state_at + block * STATE_BYTES + half * (4 * PATCH)
                ray_at = rays_at + block * RAY_BYTES + half * (4 * PATCH)
                if moving:
                    more = blend_patch(_MOVING, where, ray_at, record_at, drift_at, rays.near)
                else:
                    more = blend_patch(_STILL, where, ray_at, record_at, drift_at, rays.near)
                alive &= ~(np.uint64(1 - more) << np.uint64(patch))
            if alive == 0:
                break
        wide, high = min(MACRO, rays.width - column * MACRO), min(MACRO, rays.height - row * MACRO)
        for block in range(BLOCKS):
            bx, by = block % ACROSS * WIDE, block // ACROSS * HIGH
            if bx < wide and by < high:
                target = planes.ctypes.data + (row * MACRO + by) * row_bytes + 4 * (column * MACRO + bx)
                write_block_6(state_at + block * STATE_BYTES, target, row_bytes, plane_bytes)
    counts[0] += evaluations


def draw_beams(
    rays: SensorRays, projected: Projected, binned: TileLists, tiles: Int64[np.ndarray, " t"],
    planes: Float32[np.ndarray, "6 h w"], counts: Int64[np.ndarray, " 1"],
) -> None:  # fmt: skip
    """Blend macro tiles of a LiDAR; see ``_draw_beams``."""
    _draw_beams(
        rays, projected, binned, tiles, planes, counts, aligned(BLOCKS, PLANES_LIDAR, RAYS),
        aligned(BLOCKS, RAY_PLANES, RAYS), np.zeros(3, np.float32), SortScratch.empty(binned, tiles),
    )  # fmt: skip
