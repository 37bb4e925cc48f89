"""Kernels that hand records out to macro tiles and sort the list of each by depth; threads do not change the order."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int32, Int64, UInt64

from nurec_sim.render.cpu.kernel import inner, kernel
from nurec_sim.render.cpu.records import tiles_of

FEW, MANY = 48, 2048
"""Lists of up to ``FEW`` records are sorted by insertion alone, those of more than ``MANY`` by digits of 11 bits, those
in between by digits of 8."""
LOW_HALF = 0xFFFFFFFF


class TileLists(NamedTuple):
    """Which records each macro tile may see."""

    starts: Int64[np.ndarray, " tiles+1"]
    """Where each tile's list starts."""
    items: UInt64[np.ndarray, " pairs"]
    """Depths (the bits of positive float32) and, in the low half, numbers of records; tile after tile, in any order."""
    lists: Int32[np.ndarray, " pairs"]
    """Numbers of records, front to back; written by ``sort_tile``. LANES more entries than used."""


class SortScratch(NamedTuple):
    """Scratch of ``sort_tile``."""

    spare: UInt64[np.ndarray, " most"]
    """As long as the longest list."""
    starts: Int64[np.ndarray, "2 2049"]

    @classmethod
    def empty(cls, binned: TileLists, tiles: Int64[np.ndarray, " t"]) -> SortScratch:
        """New scratch for some macro tiles."""
        most = int((binned.starts[tiles + 1] - binned.starts[tiles]).max(initial=0))
        return cls(np.empty(most, np.uint64), np.empty((2, MANY + 1), np.int64))


@kernel
def count_tiles(spans, first, last, columns, counts):
    """Count the records that touch each macro tile.

    Args:
        spans: see ``records.Projected``.
        first: first record to count.
        last: one behind the last.
        columns: macro tiles per row of them.
        counts: [tiles] int64, added to.
    """
    for i in range(np.uint64(first), np.uint64(last)):
        left, right, top, bottom = tiles_of(spans, i)
        for ty in range(top, bottom + 1):
            for tx in range(left, right + 1):
                counts[np.uint64(ty * columns + tx)] += 1


@kernel
def fill_tiles(spans, keys, first, last, columns, position, items):
    """Append records to the lists of their macro tiles.

    Args:
        spans: see ``records.Projected``, like the next one.
        keys: see spans.
        first: first record to append.
        last: one behind the last.
        columns: macro tiles per row of them.
        position: [tiles] int64: where in ``items`` the next record of each tile goes; advanced.
        items: see ``TileLists``; output.
    """
    # Positive float32 values sort as their bit patterns do.
    bits = keys.view(np.uint32)
    for i in range(np.uint64(first), np.uint64(last)):
        left, right, top, bottom = tiles_of(spans, i)
        item = (np.uint64(bits[i]) << np.uint64(32)) | np.uint64(i)
        for ty in range(top, bottom + 1):
            for tx in range(left, right + 1):
                t = np.uint64(ty * columns + tx)
                items[np.uint64(position[t])] = item
                position[t] += 1


@inner
def sort_tile(binned, tile, scratch):
    """Sort the list of a macro tile by depth; equal depths by the number of the record, whatever thread wrote it.

    Two passes of a radix sort over the leading bits, of those in which the tile's depths differ, leave a nearly sorted
    list; an insertion sort over whole items finishes.

    Args:
        binned: see ``TileLists``; the tile's ``lists`` are written, its ``items`` changed.
        tile: number of the macro tile.
        scratch: see ``SortScratch``.
    """
    spare, starts = scratch.spare, scratch.starts
    begin, end = np.uint64(binned.starts[tile]), np.uint64(binned.starts[tile + 1])
    now = binned.items[begin:end]
    n = len(now)
    if n > FEW:
        digit_bits = np.uint64(11 if n > MANY else 8)
        low, high = now[0], now[0]
        for j in range(n):
            low, high = min(low, now[j]), max(high, now[j])
        low >>= np.uint64(32)
        differ, drop = (high >> np.uint64(32)) - low, np.uint64(32)
        while differ >> np.uint64(2 * digit_bits):
            differ >>= np.uint64(1)
            drop += np.uint64(1)
        low <<= np.uint64(32)
        mask = (np.uint64(1) << digit_bits) - np.uint64(1)
        starts[:, : np.int64(mask) + 2] = 0
        for j in range(n):
            value = (now[j] - low) >> drop
            starts[0, (value & mask) + np.uint64(1)] += 1
            starts[1, (value >> digit_bits) + np.uint64(1)] += 1
        # Counts of digits become the first place of each digit.
        for d in range(np.int64(mask)):
            starts[0, d + 1] += starts[0, d]
            starts[1, d + 1] += starts[1, d]
        for j in range(n):
            digit = ((now[j] - low) >> drop) & mask
            spare[np.uint64(starts[0, digit])] = now[j]
            starts[0, digit] += 1
        for j in range(n):
            digit = ((spare[j] - low) >> drop) >> digit_bits
            now[np.uint64(starts[1, digit])] = spare[j]
            starts[1, digit] += 1
    for j in range(1, n):
        item = now[j]
        i = j
        while i > 0 and now[i - 1] > item:
            now[i] = now[i - 1]
            i -= 1
        now[i] = item
    for j in range(n):
        binned.lists[begin + np.uint64(j)] = np.int32(now[j] & np.uint64(LOW_HALF))
