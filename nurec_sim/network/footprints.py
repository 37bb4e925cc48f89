"""Gaussians that start as the footprints of their pixels on the surface, for our own profiles.

The released network has to learn from images how wide a pixel is at its depth and how a surface is oriented; a network
that is trained for hours is given both, and predicts only how a Gaussian differs from its pixel's footprint.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional

from nurec_sim.network.encoder import quaternion_xyzw
from nurec_sim.network.tensors import ContextMaps, NetworkInputs

SHARE = 0.55
"""Standard deviation across the view, in pixels at the point's distance: the sharpest pictures without holes."""
STEEPEST = 6.0
"""Footprints are stretched along the view by the slope of the surface, by this factor at most."""
THICKNESS = 0.5
"""Across the surface, as a share of the width."""
LARGEST_CHANGE = 2.5
"""Of the logarithm of a footprint's axes, either way."""
LARGEST_M = 2.0


@dataclass(frozen=True)
class Footprints:
    """Axes (metres) and orientation of the footprints of some pixels, b clips and n Gaussians."""

    scale_m: Float[Tensor, "b n 3"]
    quat_wxyz: Float[Tensor, "b n 4"]

    def changed(
        self, log_scale: Float[Tensor, "b n 3"], turn: Float[Tensor, "b n 4"]
    ) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 4"]]:
        """Axes times exp of these log factors, and the orientation turned in the footprint's own frame."""
        # Relative and bounded: at 0 the footprint itself comes out, and no output can blow a Gaussian up.
        factor = log_scale.clamp(-LARGEST_CHANGE, LARGEST_CHANGE).exp()
        return (self.scale_m * factor).clamp(max=LARGEST_M), product(self.quat_wxyz, functional.normalize(turn, dim=-1))


@torch.no_grad()
def footprints(
    inputs: NetworkInputs, context: ContextMaps, source: Int64[Tensor, "b n"], spacing: Float[Tensor, " n"]
) -> Footprints:
    """Footprints of pixels on the surfaces that the heads predict there; nothing is differentiated.

    Args:
        inputs: their rays tell how far apart pixels are.
        context: depths and normals.
        source: flat (v, h, w) index of each Gaussian's pixel.
        spacing: pixels from one Gaussian to the next.
    """
    direction, distance = inputs.rays[..., 3:], context.depth_m / inputs.distance_to_depth_scale[..., 0]
    # Geometric mean of the angles to the next pixel to the right and below: the angle of a square of the same area.
    apart = torch.stack([_difference(direction, axis) for axis in (2, 3)]).prod(0).sqrt()

    def at_source(values: Tensor) -> Tensor:
        flat = values.flatten(1, 3)
        index = source.reshape(*source.shape, *[1] * (flat.ndim - 2)).expand(-1, -1, *flat.shape[2:])
        return flat.gather(1, index)

    ray, normal = at_source(direction), at_source(context.normal)
    # A visible surface faces the camera: normals that point away are flipped.
    towards = -(ray * normal).sum(-1, keepdim=True)
    normal, slant = torch.where(towards < 0, -normal, normal), towards.abs()
    # Along the view on the surface; looked at straight on, any direction will do.
    along = ray + slant * normal
    other = torch.linalg.cross(normal, ray.new_tensor([0.6, 0.8, 0.0]).expand_as(ray))
    along = functional.normalize(torch.where(slant > 0.999, other, along), dim=-1)
    across = torch.linalg.cross(normal, along)
    # Angle times distance is a pixel's width across the view; on a slanted surface it is 1 / cos as long along it.
    width = (SHARE * spacing * at_source(distance * apart))[..., None]
    stretch = 1 / slant.clamp(min=1 / STEEPEST)
    scale = torch.cat([width * stretch, width, width * THICKNESS], dim=-1)
    quat_xyzw = quaternion_xyzw(torch.stack([along, across, normal], dim=-1))
    return Footprints(scale, torch.cat([quat_xyzw[..., 3:], quat_xyzw[..., :3]], dim=-1))


def product(a: Float[Tensor, "*n 4"], b: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4"]:
    """Quaternions (w, x, y, z) multiplied: first ``b``, then ``a``."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    real = aw * bw - (av * bv).sum(-1, keepdim=True)
    return torch.cat([real, aw * bv + bw * av + torch.linalg.cross(av, bv)], dim=-1)


def _difference(direction: Float[Tensor, "b v h w 3"], axis: int) -> Float[Tensor, "b v h w"]:
    """Angle to the next pixel along an axis, radians; that of the last one is repeated."""
    count = direction.shape[axis]
    apart = (direction.narrow(axis, 1, count - 1) - direction.narrow(axis, 0, count - 1)).norm(dim=-1)
    return torch.cat([apart, apart.narrow(axis, count - 2, 1)], dim=axis)
