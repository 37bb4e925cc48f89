"""Colours of what no image shows: those of the Gaussians that are most like it and that an image does show.

LiDAR measures surfaces outside of all images and behind what the images show. Seen from beside the driven path they
come into view, and ``lift`` knows no more of their colour than their intensity.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.spatial import cKDTree

from nurec_sim import sensors
from nurec_sim.reconstruct.optimize.adam import RGB
from nurec_sim.reconstruct.optimize.parameters import Parameters
from nurec_sim.reconstruct.optimize.views import TrainingView
from nurec_sim.render.cpu.backward.frame import SENSORS, Frame
from nurec_sim.types import Gaussians, Label

WIDTH_PX = 480
"""Images are drawn at about this width to see what they show."""
LEAST_PX = 1e-3
"""A Gaussian is shown by an image if its shares of all pixels add up to this much."""
NEIGHBOURS = 8
MOST_SEEN = 20_000
"""The scene is thinned to so many Gaussians to learn from, evenly: with ten times as many the colours are no better."""
INEXACT = 0.5
"""A neighbour may be so much farther than the nearest one, as a share; looking for the very nearest takes ten times as
long."""
ACROSS_M, UP_M = 10.0, 1.0
"""Distances along and across the ground that count like one standard deviation of the intensity, and like a surface
that is level instead of upright: what is as high above the ground is alike over a long way along a street."""


def shown_by(parameters: Parameters, views: Sequence[TrainingView]) -> Bool[np.ndarray, " n"]:
    """Which static Gaussians take part in any pixel of some images."""
    seen = np.zeros(parameters.static_count, bool)
    for view in views:
        reduction = max(1, round(view.camera.width_px / WIDTH_PX))
        width, height = view.camera.width_px // reduction, view.camera.height_px // reduction
        small = view.camera if reduction == 1 else sensors.scaled_camera(view.camera, width, height)
        frame = Frame(SENSORS.tables(small), view.world_from_camera, False)
        drawn = parameters.at(view.t_us)
        frame.draw_packed(drawn.packed)
        by_planes, world, shares = frame.empty_planes(), drawn.world, parameters.gradients
        # A colour is linear in those of the Gaussians; their shares of it are never negative.
        valid = frame.sensor.grid.valid
        by_planes[1:4, : valid.shape[0], : valid.shape[1]] = valid
        frame.draw_back(world.mean, world.quat, world.scale, world.opacity, by_planes, shares)
        seen |= shares.features[: len(seen), 0] > LEAST_PX
        for array in shares:
            array.fill(0)
    return seen


def colour_unseen(parameters: Parameters, seen: Bool[np.ndarray, " n"]) -> None:
    """Change the colours of the static Gaussians that are not seen to the mean of those of similar ones, by likeness.

    Args:
        parameters: changed.
        seen: which static ones keep their colours; if none or all are, nothing changes.
    """
    static, values = parameters.static_count, parameters.values
    known, unknown = np.flatnonzero(seen), np.flatnonzero(~seen)
    if not len(known) or not len(unknown):
        return
    features = _features(parameters.static_gaussians(np.arange(static)))
    known = known[:: -(-len(known) // MOST_SEEN)]
    count = min(NEIGHBOURS, len(known))
    tree, ranks = cKDTree(features[known]), np.arange(1, count + 1)
    distance, nearest = tree.query(features[unknown], k=ranks, eps=INEXACT, workers=-1)
    weight = 1 / (distance + 1e-3) ** 2
    weight /= weight.sum(axis=1, keepdims=True)
    rgb: Float32[np.ndarray, "k c 3"] = values[known[nearest], RGB : RGB + 3]
    values[unknown, RGB : RGB + 3] = np.einsum("kc,kci->ki", weight, rgb)
    parameters.values_changed()


def _features(gaussians: Gaussians) -> Float64[np.ndarray, "n 6"]:
    """What tells whether Gaussians are alike: place, whether they are level, intensity, and whether they are road."""
    intensity = gaussians.intensity.astype(np.float64)
    known = np.isfinite(intensity)
    level, spread = (intensity[known].mean(), intensity[known].std()) if known.any() else (0.0, 0.0)
    place = gaussians.mean_m.astype(np.float64) / (ACROSS_M, ACROSS_M, UP_M)
    bright = np.where(known, (intensity - level) / max(spread, 1e-6), 0.0)
    # Like an outlier of the intensity: road is coloured by road.
    road = 3.0 * (gaussians.label == Label.ROAD)
    return np.column_stack([place, np.abs(gaussians.normal[:, 2]), bright, road])
