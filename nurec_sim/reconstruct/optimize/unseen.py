"""Which static Gaussians the images of a log show; the others get the colours of what is like them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from nurec_sim import sensors
from nurec_sim.reconstruct.optimize.adam import RGB
from nurec_sim.reconstruct.optimize.parameters import Parameters
from nurec_sim.reconstruct.optimize.views import TrainingView
from nurec_sim.reconstruct.unseen_colours import colours_by_likeness
from nurec_sim.render.cpu.backward.frame import SENSORS, Frame

WIDTH_PX = 480
"""Images are drawn at about this width to see what they show."""
LEAST_PX = 1e-3
"""A Gaussian is shown by an image if its shares of all pixels add up to this much."""


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
    """Change the colours of the static Gaussians that are not seen to those of what is like them.

    Args:
        parameters: changed.
        seen: which static ones keep their colours; if none or all are, nothing changes.
    """
    static = parameters.static_count
    gaussians = parameters.static_gaussians(np.arange(static))
    parameters.values[:static, RGB : RGB + 3][~seen] = colours_by_likeness(gaussians, seen)[~seen]
    parameters.values_changed()
