"""Colours of what no image shows: those of the Gaussians that are most like it and that an image does show.

LiDAR measures surfaces outside of all images and behind what the images show. Seen from beside the driven path they
come into view, and a log says no more of their colour than their intensity.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.spatial import cKDTree

from nurec_sim.compute.cores import usable_cores
from nurec_sim.compute.kernels import kernel
from nurec_sim.types import Gaussians, Label

NEIGHBOURS = 32
"""Of fewer, single ones show as specks."""
MOST_SEEN = 20_000
"""The scene is thinned to so many Gaussians to learn from, evenly: with ten times as many the colours are no better."""
CELL = 0.1
"""Gaussians that share a cell of this width along every feature (1 m along and across the ground, 0.1 m of height)
share their neighbours, which are found once; how much each neighbour weighs is up to each Gaussian."""
CELL_BITS = (16, 16, 14, 4, 11, 2)
"""Cells are numbered by so many bits along each feature: 65 km along and across the ground, 1.6 km of height."""
ACROSS_M, UP_M = 10.0, 1.0
"""Distances along and across the ground that count like one standard deviation of the intensity, and like a surface
that is level instead of upright: what is as high above the ground is alike over a long way along a street."""
SMOOTHED, THINNED = 5, 10
"""Intensities of what is not seen are medians of so many nearest ones, of every tenth Gaussian: single returns differ
by the laser and the angle as much as by the surface, and would give a road the colours of all of them side by side."""


def colours_by_likeness(gaussians: Gaussians, seen: Bool[np.ndarray, " n"]) -> Float32[np.ndarray, "n 3"]:
    """The colours of Gaussians; those that are not seen get the mean of those of similar ones, weighted by likeness.

    Args:
        gaussians: in the world.
        seen: which of them keep their colours; if none or all are, all do.
    """
    rgb: Float32[np.ndarray, "n 3"] = gaussians.rgb.copy()
    known, unknown = np.flatnonzero(seen), np.flatnonzero(~seen)
    if not len(known) or not len(unknown):
        return rgb
    smooth = replace(gaussians, intensity=_smoothed(gaussians, unknown))
    known = known[:: -(-len(known) // MOST_SEEN)]
    from_features, features = _features(smooth, known), _features(smooth, unknown)
    centre, cell = _cells(features)
    ranks = np.arange(1, min(NEIGHBOURS, len(known)) + 1)
    # Searches take half as long in a tree like this as in a balanced one, and find the same.
    tree = cKDTree(from_features, leafsize=32, balanced_tree=False, compact_nodes=False)
    _, nearest = tree.query(centre, k=ranks, workers=usable_cores())
    rgb[unknown] = _mixed(features, nearest, cell, from_features, gaussians.rgb[known])
    return rgb


def _cells(features: Float64[np.ndarray, "m 6"]) -> tuple[Float64[np.ndarray, "k 6"], Int64[np.ndarray, " m"]]:
    """Centres of the cells that hold something, and the index of the cell of each row."""
    along = np.rint(features / CELL).astype(np.int64)
    number = np.zeros(len(along), np.int64)
    for column, bits in zip(along.T, CELL_BITS, strict=True):
        number = number << bits | column & (1 << bits) - 1
    _, first, cell = np.unique(number, return_index=True, return_inverse=True)
    return along[first] * CELL, cell


@kernel
def _mixed(features, nearest, cell, from_features, rgb):
    """Means [m,3] of the colours [l,3] of the neighbours of cells [k,c], by likeness of the features [m,6], [l,6]."""
    mixed = np.empty((len(features), 3), np.float32)
    for i in range(len(features)):
        total = red = green = blue = 0.0
        for j in nearest[cell[i]]:
            square = 0.0
            for k in range(features.shape[1]):
                apart = features[i, k] - from_features[j, k]
                square += apart * apart
            weight = 1 / (math.sqrt(square) + 1e-3) ** 2
            total += weight
            red += weight * rgb[j, 0]
            green += weight * rgb[j, 1]
            blue += weight * rgb[j, 2]
        mixed[i] = red / total, green / total, blue / total
    return mixed


def _smoothed(gaussians: Gaussians, some: Int64[np.ndarray, " m"]) -> Float32[np.ndarray, " n"]:
    """The intensities, those of some Gaussians replaced by the median of their surroundings."""
    smooth = gaussians.intensity.copy()
    known = np.flatnonzero(np.isfinite(smooth))[::THINNED]
    some = some[np.isfinite(smooth[some])]
    if len(some):
        tree = cKDTree(gaussians.mean_m[known], balanced_tree=False)
        ranks = np.arange(1, min(SMOOTHED, len(known)) + 1)
        _, nearest = tree.query(gaussians.mean_m[some], k=ranks, workers=usable_cores())
        smooth[some] = np.median(gaussians.intensity[known[nearest]], axis=1)
    return smooth


def _features(gaussians: Gaussians, some: Int64[np.ndarray, " m"]) -> Float64[np.ndarray, "m 6"]:
    """What tells whether Gaussians are alike: place, whether they are level, intensity, and whether they are road."""
    everywhere = gaussians.intensity[np.isfinite(gaussians.intensity)].astype(np.float64)
    level, spread = (everywhere.mean(), everywhere.std()) if len(everywhere) else (0.0, 0.0)
    intensity = gaussians.intensity[some].astype(np.float64)
    place = gaussians.mean_m[some].astype(np.float64) / (ACROSS_M, ACROSS_M, UP_M)
    bright = np.where(np.isfinite(intensity), (intensity - level) / max(spread, 1e-6), 0.0)
    # Like an outlier of the intensity: road is coloured by road.
    road = 3.0 * (gaussians.label[some] == Label.ROAD)
    return np.column_stack([place, np.abs(gaussians.normal[some, 2]), bright, road])
