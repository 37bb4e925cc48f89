"""Geometric priors of every pixel from the log itself: its ray as seen from the car, flat ground, and matches.

The released network learns of a camera only through one token, and has to infer from images how high it is mounted and
how far things are; a network that is trained for hours gets both as input. The car's frame is that of the rig when the
first image was taken: x forward, y left, z up, origin on the ground.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nurec_sim.network.stereo import plane_sweep as sweep
from nurec_sim.network.stereo.flat_ground import flat_ground, rays_from_car
from nurec_sim.network.tensors import SCENE_RESCALE, NetworkInputs

CHANNELS = 8 + sweep.CHANNELS
"""Origin (3, in the network's unit) and direction (3) of the ray; logarithm of flat ground's depth in that unit and
whether there is ground; and the channels of ``plane_sweep``."""
GROUND_DEPTH, MATCHED_DEPTH = 6, 8
"""The channels with log depths: of flat ground, and of the match, whose cost includes the ground."""


def car_view(inputs: NetworkInputs) -> Float[Tensor, "b v h w 12"]:
    """The channels above, of every pixel of the inputs; matching runs only if ``inputs.matches`` is None.

    Raises:
        ValueError: the inputs lack ``rig_from_scene``.
    """
    origin, direction = rays_from_car(inputs)
    ground_m, there = flat_ground(inputs)
    # Logarithms, as the depth head decodes log depth: errors are then relative, and the match can replace a prediction
    # directly.
    ground = torch.stack([(ground_m * SCENE_RESCALE).log(), there.to(ground_m.dtype)], dim=-1)
    matches = sweep.plane_sweep(inputs) if inputs.matches is None else inputs.matches
    return torch.cat([origin * SCENE_RESCALE, direction, ground, matches], dim=-1)
