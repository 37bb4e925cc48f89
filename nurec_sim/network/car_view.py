"""What a log says of every pixel's depth before anything is learned: the car's view, flat ground, and matches.

The released network is told of a camera by one token and has to learn from images how high it stands and how far things
are; a network that is trained for hours is better told. The car's frame is that of the rig when the first image was
taken: x forward, y left, z up, origin on the ground.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nurec_sim.network.plane_sweep import plane_sweep
from nurec_sim.network.tensors import SCENE_RESCALE, NetworkInputs

CHANNELS = 11
"""Origin (3, in the network's unit) and direction (3) of the ray; logarithm of flat ground's depth in that unit and
whether there is ground; the same of the matched depth (``plane_sweep``) and its confidence; and what both say
together."""
BEST_GUESS = 10
"""The last of these channels."""
UNSURE, SURE = 0.2, 0.5
"""Confidences below count as nothing, from the second on matches are believed."""
FARTHEST_GROUND_M = 40.0
"""Flat ground counts up to here; where the ray meets none, its depth is this too."""


def car_view(inputs: NetworkInputs) -> Float[Tensor, "b v h w 11"]:
    """The channels above, of every pixel of the inputs; matches once more only if ``inputs`` bring none.

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
    ground, there = _flat_ground(origin, direction, inputs.distance_to_depth_scale)
    matches = plane_sweep(inputs) if inputs.matches is None else inputs.matches
    belief = ((matches[..., 1:] - UNSURE) / (SURE - UNSURE)).clamp(0, 1)
    guess = torch.lerp(ground, matches[..., :1], belief)
    return torch.cat([origin * SCENE_RESCALE, direction, ground, there, matches, guess], dim=-1)


def _flat_ground(
    origin: Float[Tensor, "*n 3"], direction: Float[Tensor, "*n 3"], depth_scale: Float[Tensor, "*n 1"]
) -> tuple[Float[Tensor, "*n 1"], Float[Tensor, "*n 1"]]:
    """Logarithm of the depth of z = 0 in the network's unit, and 1 where the ray meets it near enough."""
    down = -direction[..., 2:]
    depth_m = origin[..., 2:] / down.clamp(min=1e-4) * depth_scale
    there = (down > 1e-3) & (depth_m > 0) & (depth_m < FARTHEST_GROUND_M)
    log_depth = torch.where(there, (depth_m * SCENE_RESCALE).clamp(min=0.05), FARTHEST_GROUND_M * SCENE_RESCALE).log()
    return log_depth, there.to(log_depth.dtype)
