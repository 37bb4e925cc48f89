"""Gaussians moved along their rays after the depth of their pixels was corrected."""

from __future__ import annotations

import dataclasses

from jaxtyping import Float
from torch import Tensor

from nurec_sim.network.tensors import NetworkInputs, QueryGaussians


def with_changed_depth(
    gaussians: QueryGaussians, inputs: NetworkInputs, factor: Float[Tensor, "v h w"]
) -> QueryGaussians:
    """Gaussians (b = 1) moved along the rays of their pixels; sizes and motion grow with the distance.

    Args:
        gaussians: of the network.
        inputs: what they were decoded from.
        factor: multiplies every pixel's depth.
    """
    of_each = factor.reshape(-1)[gaussians.source][..., None]
    origin = inputs.rays.to(of_each.device).reshape(-1, 6)[gaussians.source, :3]
    motion = gaussians.motion_m
    # Scaling about the ray origin: a Gaussian keeps its size and motion in the image, so the picture does not change.
    return dataclasses.replace(
        gaussians,
        position_m=origin + (gaussians.position_m - origin) * of_each,
        scale_m=gaussians.scale_m * of_each,
        motion_m=None if motion is None else motion * of_each[..., None],
    )
