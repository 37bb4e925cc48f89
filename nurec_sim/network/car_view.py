"""What a log says of every pixel's depth before anything is learned: the car's view, flat ground, and matches.

The released network is told of a camera by one token and has to learn from images how high it stands and how far things
are; a network that is trained for hours is better told. The car's frame is that of the rig when the first image was
taken: x forward, y left, z up, origin on the ground.
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
whether there is ground; and what matching says (``plane_sweep``)."""
GROUND_DEPTH, MATCHED_DEPTH = 6, 8
"""The channels with the logarithms: of flat ground, and of the match, which knows of the ground too."""


def car_view(inputs: NetworkInputs) -> Float[Tensor, "b v h w 12"]:
    """The channels above, of every pixel of the inputs; matches once more only if ``inputs`` bring none.

    Raises:
        ValueError: the inputs do not say where the car is.
    """
    origin, direction = rays_from_car(inputs)
    ground_m, there = flat_ground(inputs)
    ground = torch.stack([(ground_m * SCENE_RESCALE).log(), there.to(ground_m.dtype)], dim=-1)
    matches = sweep.plane_sweep(inputs) if inputs.matches is None else inputs.matches
    return torch.cat([origin * SCENE_RESCALE, direction, ground, matches], dim=-1)
