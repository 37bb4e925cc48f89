"""Kernels that sort records by depth and hand them out to macro tiles; stable, so threads do not matter."""

from __future__ import annotations

import numpy as np

from nurec_sim.render.cpu.kernel import kernel

RADIX_BITS = 11
DROPPED_BITS = 5
"""Low bits that the radix sort leaves to the final pass: 22 bits hold depths from 1e-3 to 1e4 times the nearest."""


@kernel
def sort_by_depth(keys, starts, counts, nearest, order, spare):
    """Record numbers in the order of their float32 keys; ties keep the order of the rows.

    Two passes of a radix sort over the leading bits leave keys that differ by less than 4e-6 in the order of their
    rows; an insertion sort over whole keys, which are nearly sorted then, finishes.

    Args:
        keys: positive depths.
        starts: [runs] first row of each run of valid rows.
        counts: [runs] their lengths.
        nearest: smallest possible key.
        order: [total] int32 output.
        spare: [2,total] uint64 scratch.

    Returns:
        Number of records.
    """
    bits = keys.view(np.uint32)
    low = np.array([nearest], np.float32).view(np.uint32)[0] >> np.uint32(DROPPED_BITS)
    size = 1 << RADIX_BITS
    top = np.uint32((1 << (2 * RADIX_BITS)) - 1)
    mask = np.uint32(size - 1)
    now, other = spare[0], spare[1]
    first, second = np.zeros(size + 1, np.int64), np.zeros(size + 1, np.int64)
    n = 0
    for run in range(len(starts)):
        for i in range(starts[run], starts[run] + counts[run]):
            value = bits[i] >> np.uint32(DROPPED_BITS)
            value = min(value - low if value > low else np.uint32(0), top)
            now[n] = (np.uint64(value) << np.uint64(32)) | np.uint64(i)
            first[np.int64(value & mask) + 1] += 1
            second[np.int64(value >> np.uint32(RADIX_BITS)) + 1] += 1
            n += 1
    for d in range(size):
        first[d + 1] += first[d]
        second[d + 1] += second[d]
    for i in range(n):
        digit = np.int64((now[i] >> np.uint64(32)) & np.uint64(mask))
        other[first[digit]] = now[i]
        first[digit] += 1
    for i in range(n):
        digit = np.int64(other[i] >> np.uint64(32 + RADIX_BITS))
        order[second[digit]] = np.int32(other[i] & np.uint64(0xFFFFFFFF))
        second[digit] += 1
    for i in range(1, n):
        row = order[i]
        key = bits[row]
        j = i
        while j > 0 and (bits[order[j - 1]] > key or (bits[order[j - 1]] == key and order[j - 1] > row)):
            order[j] = order[j - 1]
            j -= 1
        order[j] = row
    return n


@kernel
def count_tiles(spans, order, first, last, columns, counts):
    """Add to ``counts`` [tiles] how many of ``order[first:last]`` touch each macro tile."""
    for j in range(first, last):
        i = np.uint64(order[j])
        for ty in range(spans[i, 2], spans[i, 3] + 1):
            for tx in range(spans[i, 0], spans[i, 1] + 1):
                counts[np.uint64(ty * columns + tx)] += 1


@kernel
def fill_tiles(spans, order, first, last, columns, position, lists):
    """Append the records of ``order[first:last]`` to their tiles' lists at ``position`` [tiles], which moves on."""
    for j in range(first, last):
        i = np.uint64(order[j])
        for ty in range(spans[i, 2], spans[i, 3] + 1):
            for tx in range(spans[i, 0], spans[i, 1] + 1):
                t = np.uint64(ty * columns + tx)
                lists[position[t]] = np.int32(i)
                position[t] += 1
