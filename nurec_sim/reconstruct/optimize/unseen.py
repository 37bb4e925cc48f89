"""Which static Gaussians the images of a log hardly show; these get the colours of what is like them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from nurec_sim import sensors
from nurec_sim.reconstruct.optimize.adam import RGB
from nurec_sim.reconstruct.optimize.parameters import Parameters
from nurec_sim.reconstruct.optimize.views import TrainingView
from nurec_sim.reconstruct.unseen_colours import colours_by_likeness
from nurec_sim.render.cpu.backward.frame import SENSORS, Frame

WIDTH_PX = 480
"""Images are drawn at about this width to see what they show."""
LEAST_PX, SHOWN_PX = 1e-3, 0.3
"""Images hardly show a Gaussian if its shares of all their pixels add up to something in between: enough to change its
colour, and too little to determine it."""


def pixel_shares(parameters: Parameters, views: Sequence[TrainingView]) -> Float32[np.ndarray, " n"]:
    """Shares of each static Gaussian of all pixels of some images, added up, in pixels of the images' full size.

    Args:
        parameters: of the scene.
        views: the images.
    """
    pixels = np.zeros(parameters.static_count, np.float32)
    for view in views:
        reduction = max(1, round(view.camera.width_px / WIDTH_PX))
        width, height = view.camera.width_px // reduction, view.camera.height_px // reduction
        small = view.camera if reduction == 1 else sensors.scaled_camera(view.camera, width, height)
        frame = Frame(SENSORS.tables(small), view.world_from_camera, False)
        drawn = parameters.at(view.t_us)
        frame.draw_packed(drawn.packed)
        by_planes, world, shares = frame.empty_planes(), drawn.world, parameters.gradients
        # A colour is linear in those of the Gaussians, so the gradient of the sum of all pixels is the sum of shares.
        valid = frame.sensor.grid.valid
        by_planes[1:4, : valid.shape[0], : valid.shape[1]] = valid
        frame.draw_back(world.mean, world.quat, world.scale, world.opacity, by_planes, shares)
        pixels += shares.features[: len(pixels), 0] * np.float32(reduction**2)
        for array in shares:
            array.fill(0)
    return pixels


def colour_hardly_shown(parameters: Parameters, pixels: Float32[np.ndarray, " n"]) -> None:
    """Change the colours of the static Gaussians that images hardly show to those of what is like them.

    What no image shows keeps its colour, which the method has found by more than the Gaussians alone.

    Args:
        parameters: changed.
        pixels: see ``pixel_shares``.
    """
    some = np.flatnonzero(pixels > LEAST_PX)
    shown = pixels[some] > SHOWN_PX
    colours = colours_by_likeness(parameters.static_gaussians(some), shown)
    parameters.values[some[~shown], RGB : RGB + 3] = colours[~shown]
    parameters.values_changed()
