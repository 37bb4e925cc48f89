"""The depth of flat ground under the car, known from the log: the rig's origin lies on the ground."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nurec_sim.network.tensors import NetworkInputs

FARTHEST_GROUND_M = 40.0
"""Flat ground counts up to here."""
LEAST_DOWN = 1e-3
"""Rays must point down by more than this share of their length to meet the ground."""


def rays_from_car(inputs: NetworkInputs) -> tuple[Float[Tensor, "b v h w 3"], Float[Tensor, "b v h w 3"]]:
    """Origins (metres) and directions of the pixels' rays in the frame of the rig when the first image was taken.

    Raises:
        ValueError: the inputs lack ``rig_from_scene``.
    """
    if inputs.rig_from_scene is None:
        raise ValueError("this profile needs inputs with rig_from_scene, the scene frame as seen from the car")
    pose = inputs.rig_from_scene[:, None, None, None]

    def turned(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
        # Axis by axis: matrix products may round differently with another number of threads, and small ones are slow.
        return [pose[..., k, 0] * x + pose[..., k, 1] * y + pose[..., k, 2] * z for k in range(3)]

    origin, direction = turned(*inputs.rays[..., :3].unbind(-1)), turned(*inputs.rays[..., 3:].unbind(-1))
    return torch.stack(origin, dim=-1) + pose[..., :3, 3], torch.stack(direction, dim=-1)


def flat_ground(inputs: NetworkInputs) -> tuple[Float[Tensor, "b v h w"], Bool[Tensor, "b v h w"]]:
    """z-depth of z = 0 in metres, and where rays meet it near enough; elsewhere it is ``FARTHEST_GROUND_M``.

    Raises:
        ValueError: the inputs lack ``rig_from_scene``.
    """
    origin, direction = rays_from_car(inputs)
    down = -direction[..., 2]
    # The ray meets z = 0 at distance height / down; times its z in the camera that is the depth.
    depth_m = origin[..., 2] / down.clamp(min=1e-4) * inputs.distance_to_depth_scale[..., 0]
    there = (down > LEAST_DOWN) & (depth_m > 0) & (depth_m < FARTHEST_GROUND_M)
    return torch.where(there, depth_m.clamp(min=1e-3), FARTHEST_GROUND_M), there
