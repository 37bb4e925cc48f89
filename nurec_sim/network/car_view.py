"""What a log knows of every pixel beside its colour: where its ray goes as seen from the car, and where flat ground is.

The released network is told of a camera by one token and has to learn from images how high it stands; a network that is
trained for hours is better told. The car's frame is that of the rig when the first image was taken: x forward, y left,
z up, origin on the ground.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nurec_sim.network.tensors import SCENE_RESCALE, NetworkInputs

CHANNELS = 8
"""Origin (3, in the network's unit), direction (3), logarithm of the ground's depth in that unit, and whether there is
ground."""
FARTHEST_GROUND_M = 40.0
"""Flat ground counts up to here; where the ray meets none, its depth is this too."""


def car_view(inputs: NetworkInputs) -> Float[Tensor, "b v h w 8"]:
    """The channels above, of every pixel of the inputs.

    Raises:
        ValueError: the inputs do not say where the car is.
    """
    if inputs.rig_from_scene is None:
        raise ValueError("this profile needs inputs with rig_from_scene, the scene frame as seen from the car")
    turn = inputs.rig_from_scene[:, None, None, None, :3, :3]
    shift = inputs.rig_from_scene[:, None, None, None, :3, 3]

    def turned(vectors: Tensor) -> Tensor:
        # Not a matrix product: those may round differently with another number of threads.
        return (turn * vectors[..., None, :]).sum(-1)

    origin, direction = turned(inputs.rays[..., :3]) + shift, turned(inputs.rays[..., 3:])
    down = -direction[..., 2:]
    distance = origin[..., 2:] / down.clamp(min=1e-4)
    depth_m = distance * inputs.distance_to_depth_scale
    there = (down > 1e-3) & (depth_m > 0) & (depth_m < FARTHEST_GROUND_M)
    log_depth = torch.where(there, (depth_m * SCENE_RESCALE).clamp(min=0.05), FARTHEST_GROUND_M * SCENE_RESCALE).log()
    return torch.cat([origin * SCENE_RESCALE, direction, log_depth, there.to(log_depth.dtype)], dim=-1)
