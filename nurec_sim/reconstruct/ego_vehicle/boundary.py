"""The boundary of the ego vehicle in an image: one row per column, found by dynamic programming.

A boundary costs what it contradicts, ``SLOPE`` times its steps, and earns ``EDGE`` where it lies on an edge that stays
at its place while the car drives.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim.reconstruct.ego_vehicle.evidence import WINDOW_PX

PRIOR, SLOPE = 0.01, 1.2
"""Cost of a vehicle pixel without evidence, and of a step of the boundary by one row; a contradiction costs one."""
EDGE = 20.0
"""What a column earns whose boundary lies on a full edge."""
ACROSS = 2.0
"""What an edge across the motion costs per pixel if it is left to the street, where the same line would move."""
DENT = 0.08
"""Dents of the boundary that are closed are narrower than this part of the image."""
WIDE_DENT, SPEAKS, AS_STRONG, NEAR_PX = 0.25, 0.05, 0.9, 2
"""The same of dents that an edge cuts off which is as strong as the one at their bottom, by this share of it and within
so many rows, and whose pixels hardly speak for the street: edges of what the paint mirrors stay at their places."""
FOOT, FOOT_PX = 0.25, 6
"""An edge reaches as far as this part of its strength at the boundary, and at most so many rows."""
SMALLEST_SHARE = 0.01
"""Share of the image that the vehicle fills below the boundary, at least; less is not believed."""
LEAST_EVIDENCE, CONTRADICTED = 0.05, 0.4
"""Mean evidence over the vehicle's pixels, at least, and the part of it that may speak for the street."""
HANGING_SHARE = 0.003, 0.15
"""Share of the image that what hangs into it from above fills, at least and at most: a sky at night fills more."""
CLOSED = 0.45
"""Mean edge along the boundary of what hangs into the image, times its dark part, at least: crowns of trees move."""

Map = Float64[np.ndarray, "h w"]


def vehicle_below(ego: Map, street: Map, edges: Map, near: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The vehicle that fills an image from its lower edge.

    Args:
        ego: evidence for the vehicle, 0..1.
        street: evidence for the street, 0..1.
        edges: edges that stay, 0..1; along the motion, where lines of the street stay too, 0.5 at most.
        near: ground before the camera; the vehicle is within.
    """
    height, width = ego.shape
    # Windows that touch the vehicle are evidence for it: it begins half a window within.
    half, none = WINDOW_PX // 2, np.zeros((1, width))
    contradicted = ego + ACROSS * np.where(near, np.maximum(2 * edges - 1, 0), 0)
    above = np.vstack([np.zeros((half + 1, width)), np.cumsum(contradicted, axis=0)[: height - half]])
    below = np.vstack([np.cumsum((street + PRIOR)[::-1], axis=0)[::-1], none])
    cost = above + below - EDGE * np.vstack([edges, none])
    cost[np.arange(height + 1)[:, None] < _first_row(near)] = np.inf
    mask = _outwards(_closed(_least_cost(cost), street, edges), edges)
    labels, count, area = _parts(mask)
    of_ego, of_street = (np.bincount(labels.ravel(), weights=w.ravel(), minlength=count) for w in (ego, street))
    good = (area >= SMALLEST_SHARE * mask.size) & (of_ego >= LEAST_EVIDENCE * area)
    good &= of_street <= CONTRADICTED * of_ego
    good[0] = False
    return good[labels]


def vehicle_above(
    bright: Bool[np.ndarray, "h w"], edges: Map, near: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """What hangs into an image from above: the housing of a camera, a roof rack.

    Args:
        bright: pixels too bright for it.
        edges: edges that stay, 0..1, negative where it is brighter above than below.
        near: ground before the camera; what hangs is above.
    """
    height, width = bright.shape
    none = np.zeros((1, width))
    cost = np.vstack([none, np.cumsum(bright + PRIOR, axis=0)])
    edges = np.maximum(edges, 0)
    cost[1:] -= EDGE * edges
    cost[np.arange(height + 1)[:, None] > _first_row(near)] = np.inf
    # Seen upside down it is a vehicle below.
    rows, turned = _least_cost(cost[::-1]), edges[::-1]
    mask = np.arange(height)[:, None] >= rows
    labels, count, area = _parts(mask)
    contradicted = np.bincount(labels.ravel(), weights=bright[::-1].ravel(), minlength=count)
    columns = np.nonzero(rows < height)[0]
    part, edge = labels[rows[columns], columns], turned[rows[columns], columns]
    closed = np.bincount(part, weights=edge, minlength=count) / np.maximum(np.bincount(part, minlength=count), 1)
    good = (area >= HANGING_SHARE[0] * mask.size) & (area <= HANGING_SHARE[1] * mask.size)
    good &= closed * (1 - contradicted / area) >= CLOSED
    good[0] = False
    believed = np.where(good[labels].any(axis=0), rows, height)
    return _outwards(believed, turned)[::-1]


def _first_row(near: Bool[np.ndarray, "h w"]) -> Int64[np.ndarray, " w"]:
    return np.where(near.any(axis=0), near.argmax(axis=0), len(near))


def _parts(mask: Bool[np.ndarray, "h w"]) -> tuple[np.ndarray, int, np.ndarray]:
    """Labels of the connected parts of a mask, their number and areas; 0 is what is not masked."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return labels, count, stats[:, cv2.CC_STAT_AREA]


def _least_cost(cost: Float64[np.ndarray, "h1 w"]) -> Int64[np.ndarray, " w"]:
    """The row of every column, of h + 1, whose costs and steps sum to the least."""
    count, width = cost.shape
    rows = np.arange(count)
    # The best predecessor of each row under |step| * SLOPE, from prefix minima in both directions.
    total, chosen = cost[:, 0], np.zeros((width, count), int)
    for column in range(1, width):
        down, from_above = _running_minimum(total - SLOPE * rows)
        up, from_below = _running_minimum((total + SLOPE * rows)[::-1])
        up, from_below = up[::-1] - SLOPE * rows, count - 1 - from_below[::-1]
        above = down + SLOPE * rows
        chosen[column] = np.where(above <= up, from_above, from_below)
        total = np.minimum(above, up) + cost[:, column]
    boundary = np.empty(width, int)
    boundary[-1] = total.argmin()
    for column in range(width - 1, 0, -1):
        boundary[column - 1] = chosen[column][boundary[column]]
    return boundary


def _running_minimum(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimum of all values up to each one, and where it lies."""
    least = np.minimum.accumulate(values)
    return least, np.maximum.accumulate(np.where(values <= least, np.arange(len(values)), 0))


def _closed(rows: Int64[np.ndarray, " w"], street: Map, edges: Map) -> Int64[np.ndarray, " w"]:
    """The boundary without dents narrower than ``DENT``, or than ``WIDE_DENT`` if they look like the vehicle."""
    height, width = street.shape
    rows = _without_dents(rows, height, DENT)
    wide = _without_dents(rows, height, WIDE_DENT)
    columns, around = np.arange(width), cv2.dilate(edges, np.ones((2 * NEAR_PX + 1, 1)))
    above = np.vstack([np.zeros(width), np.cumsum(street, axis=0)])
    dents = cv2.connectedComponents((wide < rows).astype(np.uint8)[None])[1][0]
    cut, bottom = (around[np.minimum(each, height - 1), columns] for each in (wide, rows))
    speaks, area, cut, bottom = (
        np.bincount(dents, each) for each in (above[rows, columns] - above[wide, columns], rows - wide, cut, bottom)
    )
    good = (speaks <= SPEAKS * area) & (cut >= AS_STRONG * bottom)
    return np.where(good[dents], wide, rows)


def _without_dents(rows: Int64[np.ndarray, " w"], height: int, part: float) -> Int64[np.ndarray, " w"]:
    """The boundary without dents narrower than a part of its length, seen along its slope: a car's side is slanted."""
    width, columns = 2 * round(part * len(rows) / 2) + 1, np.arange(len(rows))
    slope = np.polyfit(columns, rows, 1)[0]
    heights = (height - rows + slope * columns)[None].astype(np.float32)
    closed = cv2.morphologyEx(heights, cv2.MORPH_CLOSE, np.ones((1, width)))[0] - slope * columns
    return np.clip(height - np.rint(closed).astype(int), 0, rows)


def _outwards(rows: Int64[np.ndarray, " w"], edges: Map) -> Bool[np.ndarray, "h w"]:
    """Pixels at and below a boundary and the blur of its edge: mixed with the street, they show neither."""
    height, width = edges.shape
    columns = np.arange(width)
    least = FOOT * edges[np.minimum(rows, height - 1), columns]
    for _ in range(FOOT_PX):
        further = (rows > 0) & (rows < height) & (least > 0)
        further &= edges[np.maximum(rows - 1, 0), columns] >= least
        rows = rows - further
    return np.arange(height)[:, None] >= rows
