"""Kernels that sort records by depth and hand them out to tiles of the ray grid; stable, so threads do not matter."""

from __future__ import annotations

import numpy as np

from nurec_sim.render.cpu.kernel import kernel

RADIX_BITS = 11


@kernel
def sort_by_depth(keys, starts, counts, order):
    """Indices of records in the order of their (positive) float32 keys; ties keep the order of the rows.

    ``starts`` and ``counts`` name the runs of valid rows; ``order`` takes the result. Radix sort over all 32 bits.
    """
    total = counts.sum()
    bits = keys.view(np.uint32)
    now, other = np.empty(total, np.uint64), np.empty(total, np.uint64)
    n = 0
    for run in range(len(starts)):
        for i in range(starts[run], starts[run] + counts[run]):
            now[n] = (np.uint64(bits[i]) << np.uint64(32)) | np.uint64(i)
            n += 1
    size = 1 << RADIX_BITS
    for step in range(3):
        shift = np.uint64(32 + step * RADIX_BITS)
        histogram = np.zeros(size + 1, np.int64)
        for i in range(total):
            histogram[np.int64((now[i] >> shift) & np.uint64(size - 1)) + 1] += 1
        for d in range(size):
            histogram[d + 1] += histogram[d]
        for i in range(total):
            digit = np.int64((now[i] >> shift) & np.uint64(size - 1))
            other[histogram[digit]] = now[i]
            histogram[digit] += 1
        now, other = other, now
    for i in range(total):
        order[i] = np.int32(now[i] & np.uint64(0xFFFFFFFF))
    return total


@kernel
def count_tiles(spans, order, first, last, columns, counts):
    """Add to ``counts`` [tiles] how many of ``order[first:last]`` touch each tile."""
    for j in range(first, last):
        i = order[j]
        for ty in range(spans[i, 2], spans[i, 3] + 1):
            for tx in range(spans[i, 0], spans[i, 1] + 1):
                counts[ty * columns + tx] += 1


@kernel
def fill_tiles(spans, order, first, last, columns, position, lists):
    """Append the records of ``order[first:last]`` to their tiles' lists at ``position`` [tiles], which moves on."""
    for j in range(first, last):
        i = order[j]
        for ty in range(spans[i, 2], spans[i, 3] + 1):
            for tx in range(spans[i, 0], spans[i, 1] + 1):
                t = ty * columns + tx
                lists[position[t]] = i
                position[t] += 1
