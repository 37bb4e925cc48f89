"""Square blocks of pixels that show one smooth surface in one colour, and that one footprint stands for.

Detail is where images have it: a plain wall needs fewer footprints than a tree. Blocks have edges of 1, 2, 4 or 8
pixels and start at multiples of their edge.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Int32, UInt8, UInt16

from nurec_sim.compute.kernels import kernel

EDGES = (2, 4, 8)
"""Edges of blocks, in pixels; single pixels are blocks as well."""
LEAST_TOLERANCE = 10
"""Differences of colour up to this (of 255) are noise: such blocks of two by two pixels are always taken as one."""
FLAT = 0.01
"""In a block, inverse depth deviates from that of a plane by this share at most."""
SLOPE = 0.15
"""In a block, inverse depth varies by this share at most: more is an edge of depth, or a surface along the ray."""
DEPTH_COST = 65.0
"""What a metre of depth from one end of a block to the other costs, in differences of colour: at least, not on top. The
road's edge is found by where Gaussians lie, so that few long ones on plain asphalt would give way to many on grass."""
NEVER = 0xFFFF
"""Cost of blocks that are not taken as one, whatever the tolerance."""


def block_costs(
    rgb: UInt8[np.ndarray, "h w 3"], inverse_depth: Float32[np.ndarray, "h w"], body: Int32[np.ndarray, "h w"]
) -> list[UInt16[np.ndarray, "rows columns"]]:
    """What is lost by taking each block as one, for each of ``EDGES``.

    The cost is the largest difference of a colour channel, times the number of blocks of two by two pixels in it, or
    that of its depth (``DEPTH_COST``) if that is more; it is never less than that of the blocks within it.

    Args:
        rgb: colours 0..255.
        inverse_depth: 1/m.
        body: the body that each pixel shows; negative where nothing is lifted.
    """
    costs: list[np.ndarray] = []
    for edge in EDGES:
        cost = _costs(rgb, inverse_depth, body, edge)
        if costs:
            rows, columns = cost.shape
            parts = costs[-1][: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2)
            cost = np.maximum(cost, parts.max(axis=(1, 3)))
        costs.append(cost)
    return costs


def tolerance_for(
    costs: Sequence[Sequence[UInt16[np.ndarray, "rows columns"]]],
    pixels: Sequence[int],
    share: Sequence[float],
    blocks: int,
) -> int:
    """The least tolerance with which no more blocks than wanted are left of all views, if there is one.

    Args:
        costs: of each view (``block_costs``).
        pixels: of each view, the number of pixels that show a body.
        share: of each view, which share of its blocks is left.
        blocks: how many blocks are wanted at most.
    """
    # Taking four blocks as one makes three fewer, whatever their edge.
    counts, left = np.zeros(NEVER + 1), 0.0
    for view, count, part in zip(costs, pixels, share, strict=True):
        left += part * count
        for cost in view:
            counts += part * np.bincount(cost.ravel(), minlength=NEVER + 1)
    enough = np.flatnonzero(left - 3 * np.cumsum(counts[:NEVER]) <= blocks)
    return max(LEAST_TOLERANCE, int(enough[0]) if len(enough) else NEVER - 1)


def chosen_blocks(
    costs: Sequence[UInt16[np.ndarray, "rows columns"]], body: Int32[np.ndarray, "h w"], tolerance: int
) -> tuple[Int32[np.ndarray, " n"], UInt8[np.ndarray, " n"]]:
    """First pixel (row by row) and edge of the largest blocks that cost no more than the tolerance.

    Args:
        costs: of one view (``block_costs``).
        body: as there; pixels with a body that are in no block are blocks of their own.
        tolerance: the largest cost.
    """
    height, width = body.shape
    covered = np.zeros(body.shape, bool)
    firsts, edges = [], []
    for edge, cost in zip(reversed(EDGES), reversed(costs), strict=True):
        row, column = np.nonzero((cost <= tolerance) & ~covered[::edge, ::edge][: cost.shape[0], : cost.shape[1]])
        firsts.append(row * edge * width + column * edge)
        edges.append(np.full(len(row), edge, np.uint8))
        covered |= painted(height, width, firsts[-1], edges[-1])
    firsts.append(np.flatnonzero((body >= 0) & ~covered))
    edges.append(np.ones(len(firsts[-1]), np.uint8))
    return np.concatenate(firsts).astype(np.int32), np.concatenate(edges)


@kernel
def painted(height, width, first, edge):
    """Pixels [height,width] of the blocks with these first pixels [n] and edges [n]."""
    mask = np.zeros((height, width), np.bool_)
    for i in range(len(first)):
        row, column = divmod(first[i], width)
        mask[row : row + edge[i], column : column + edge[i]] = True
    return mask


@kernel
def block_means(values, first, edge):
    """Means [n,c] over blocks, given by first pixels [n] and edges [n], of pictures [h,w,c]."""
    _, width, channels = values.shape
    means = np.zeros((len(first), channels))
    for i in range(len(first)):
        row, column = divmod(first[i], width)
        for r in range(row, row + edge[i]):
            for c in range(column, column + edge[i]):
                for k in range(channels):
                    means[i, k] += values[r, c, k]
        for k in range(channels):
            means[i, k] /= np.int64(edge[i]) * np.int64(edge[i])
    return means


@kernel
def block_maxima(values, first, edge):
    """Largest values [n] over blocks, given by first pixels [n] and edges [n], of a picture [h,w]."""
    width = values.shape[1]
    largest = np.empty(len(first), values.dtype)
    for i in range(len(first)):
        row, column = divmod(first[i], width)
        largest[i] = values[row, column]
        for r in range(row, row + edge[i]):
            for c in range(column, column + edge[i]):
                largest[i] = max(largest[i], values[r, c])
    return largest


@kernel
def _costs(rgb, inverse_depth, body, edge):
    """``block_costs`` of one edge, without regard to the blocks within."""
    rows, columns = body.shape[0] // edge, body.shape[1] // edge
    costs = np.full((rows, columns), NEVER, np.uint16)
    count, middle = edge * edge, (edge - 1) / 2
    spread = count * (count - 1) / 12  # sum of the squares of the pixels' columns, from the middle
    for row in range(rows):
        for column in range(columns):
            top, left = row * edge, column * edge
            if body[top, left] < 0:
                continue
            one, difference = True, 0
            total, slope_u, slope_v, least, most = 0.0, 0.0, 0.0, np.inf, 0.0
            for r in range(edge):
                for c in range(edge):
                    one = one and body[top + r, left + c] == body[top, left]
                    w = float(inverse_depth[top + r, left + c])
                    total += w
                    slope_u += w * (c - middle)
                    slope_v += w * (r - middle)
                    least, most = min(least, w), max(most, w)
            mean = total / count
            if not one or not most - least <= SLOPE * mean:  # nor where depth is NaN
                continue
            for r in range(edge):
                for c in range(edge):
                    plane = mean + (slope_u * (c - middle) + slope_v * (r - middle)) / spread
                    one = one and abs(inverse_depth[top + r, left + c] - plane) <= FLAT * mean
            if not one:
                continue
            for k in range(3):
                dark, light = 255, 0
                for r in range(edge):
                    for c in range(edge):
                        value = int(rgb[top + r, left + c, k])
                        dark, light = min(dark, value), max(light, value)
                difference = max(difference, light - dark)
            deep = DEPTH_COST * (1 / least - 1 / most)
            costs[row, column] = min(max(difference * (count // 4), deep), NEVER - 1)
    return costs
