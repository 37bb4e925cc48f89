"""Kernels that sort records by depth and hand them out to macro tiles; stable, so threads do not matter."""

from __future__ import annotations

import numpy as np

from nurec_sim.render.cpu.kernel import kernel

RADIX_BITS = 11
DROPPED_BITS = 5
"""Low bits that the radix sort leaves to the final pass. The 22 bits above them cover depths from the nearest possible
to 2^16 times that."""
SAMPLE = 64
"""One key in this many is sampled to divide the depths among threads."""


def depth_cuts(keys, starts, counts, parts):
    """Depths that divide records into parts of about equal number, estimated from every ``SAMPLE``-th record.

    Args:
        keys: [n] positive float32 depths.
        starts: [runs] first row of each run of valid rows.
        counts: [runs] their lengths.
        parts: number of parts.

    Returns:
        [parts + 1] uint64: the cuts as bit patterns of float32, from 0 to 2^32.
    """
    runs = [keys[first : first + count : SAMPLE] for first, count in zip(starts, counts, strict=True)]
    some = np.sort(np.concatenate(runs)).view(np.uint32)
    cuts = np.zeros(parts + 1, np.uint64)
    cuts[-1] = 1 << 32
    if len(some):
        cuts[1:-1] = some[len(some) * np.arange(1, parts) // parts]
    return cuts


@kernel
def sort_by_depth(keys, starts, counts, nearest, low_cut, high_cut, spans, order, sorted_spans, spare):
    """Put the records whose keys lie in [low_cut, high_cut) where they belong in the order of all keys.

    Two passes of a radix sort over the leading bits leave keys that differ by less than 4e-6 in the order of their
    rows; an insertion sort over whole keys, which are nearly sorted then, finishes. Ties keep the order of the rows.

    Args:
        keys: positive float32 depths.
        starts: [runs] first row of each run of valid rows.
        counts: [runs] their lengths.
        nearest: smallest possible key.
        low_cut: smallest key to sort, as bits (uint64).
        high_cut: one behind the largest.
        spans: [..,4] tiles of the records.
        order: [total] output: record numbers; only this range's part is written.
        sorted_spans: [total,4] output: their spans.
        spare: [2,total] uint64 scratch, of which only this range's part is used.
    """
    bits = keys.view(np.uint32)  # of positive floats, which sort as their bits do
    low = np.array([nearest], np.float32).view(np.uint32)[0] >> np.uint32(DROPPED_BITS)
    size = 1 << RADIX_BITS
    top = np.uint64((1 << (2 * RADIX_BITS)) - 1)
    mask = np.uint64(size - 1)
    # Positive float32 values sort as their bit patterns do, so the keys are treated as integers throughout.
    before = 0
    n = 0
    for run in range(len(starts)):
        for i in range(starts[run], starts[run] + counts[run]):
            key = np.uint64(bits[i])
            before += 1 if key < low_cut else 0
            n += 1 if low_cut <= key < high_cut else 0
    # Every range writes the rows that follow those of smaller keys, so that ranges can be sorted side by side.
    now, other = spare[0, before : before + n], spare[1, before : before + n]
    first, second = np.zeros(size + 1, np.int64), np.zeros(size + 1, np.int64)
    n = 0
    for run in range(len(starts)):
        for i in range(starts[run], starts[run] + counts[run]):
            key = np.uint64(bits[i])
            if low_cut <= key < high_cut:
                value = key >> np.uint64(DROPPED_BITS)
                value = min(value - low if value > low else np.uint64(0), top)
                # The row in the low half makes equal keys sort by row: the order does not depend on the threads.
                now[n] = (key << np.uint64(32)) | np.uint64(i)
                first[np.int64(value & mask) + 1] += 1
                second[np.int64(value >> np.uint64(RADIX_BITS)) + 1] += 1
                n += 1
    # Counts of digits become the first place of each digit.
    for d in range(size):
        first[d + 1] += first[d]
        second[d + 1] += second[d]
    for i in range(n):
        value = now[i] >> np.uint64(32 + DROPPED_BITS)
        digit = np.int64(min(value - low if value > low else np.uint64(0), top) & mask)
        other[first[digit]] = now[i]
        first[digit] += 1
    for i in range(n):
        value = other[i] >> np.uint64(32 + DROPPED_BITS)
        digit = np.int64(min(value - low if value > low else np.uint64(0), top) >> np.uint64(RADIX_BITS))
        now[second[digit]] = other[i]
        second[digit] += 1
    # Whole keys with their rows: nearly sorted, so the insertion sort is close to linear.
    for i in range(1, n):
        item = now[i]
        j = i
        while j > 0 and now[j - 1] > item:
            now[j] = now[j - 1]
            j -= 1
        now[j] = item
    for i in range(n):
        row = np.uint64(now[i] & np.uint64(0xFFFFFFFF))
        order[before + i] = np.int32(row)
        for k in range(4):
            sorted_spans[before + i, k] = spans[row, k]


@kernel
def count_tiles(spans, first, last, columns, counts):
    """Count the sorted records that touch each macro tile.

    Args:
        spans: [n,4] first and last column, first and last row of the records' macro tiles, front to back.
        first: first record to count.
        last: one behind the last.
        columns: macro tiles per row of them.
        counts: [tiles] int64, added to.
    """
    for j in range(first, last):
        for ty in range(spans[j, 2], spans[j, 3] + 1):
            for tx in range(spans[j, 0], spans[j, 1] + 1):
                counts[np.uint64(ty * columns + tx)] += 1


@kernel
def fill_tiles(spans, order, first, last, columns, position, lists):
    """Append sorted records to the lists of their macro tiles.

    Args:
        spans: see ``count_tiles``.
        order: [n] record numbers, front to back.
        first: first entry of ``order`` to append.
        last: one behind the last.
        columns: macro tiles per row of them.
        position: [tiles] int64: where in ``lists`` the next record of each tile goes; advanced.
        lists: [pairs] int32 output.
    """
    for j in range(first, last):
        record = order[j]
        for ty in range(spans[j, 2], spans[j, 3] + 1):
            for tx in range(spans[j, 0], spans[j, 1] + 1):
                t = np.uint64(ty * columns + tx)
                lists[position[t]] = record
                position[t] += 1
