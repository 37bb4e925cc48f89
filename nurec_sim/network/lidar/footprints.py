"""Footprints of returns on their surfaces: the anisotropic scale floor from the spacing between beams.

The paper bounds the lateral footprint of each Gaussian from below by the spacing of the beams at its range, after
Mip-Splatting's three-dimensional filter. Added to the covariance as there, the floor would thicken surfaces that are
seen at a grazing angle; here it is the shadow of the footprint, seen along the beam, that is bounded: an ellipse across
the beam is projected along it onto the surface. Such discs meet on the surface and are as thin as it is.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

FLOOR = 0.5
"""Standard deviation of a footprint by the spacing of beams: neighbours meet at 0.6 of their peak."""
LONGEST = 30.0
"""Footprints are at most so many times as long as the floor across the beam: rows on flat ground far away."""


def bounded(slope: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
    """Slopes of at most ``LONGEST``."""
    steep = slope.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    return slope * (LONGEST / steep).clamp(max=1.0)


def surface_axes(slope: Float[Tensor, "n 2"], sigma_m: Float[Tensor, "n 2"]) -> tuple[Tensor, Tensor]:
    """The footprint on a plane of an ellipse across the beam.

    Args:
        slope: the plane's normal is (slope h, slope v, 1) in the axes of the beam.
        sigma_m: standard deviations of the ellipse along h and v.

    Returns:
        Rotation [n,4] (wxyz, in the axes of the beam): its first two axes are those of the footprint, the third is the
        normal away from the sensor. Standard deviations [n,2] along the first two axes, metres.
    """
    p, q = slope.unbind(-1)
    long = torch.sqrt(1 + p * p + q * q)
    x, y, z = p / long, q / long, 1 / long
    # The rotation about an axis across the beam that takes d to the normal turns h and v to u and w.
    u = torch.stack([1 - x * x / (1 + z), -x * y / (1 + z), -x], dim=-1)
    w = torch.stack([-x * y / (1 + z), 1 - y * y / (1 + z), -y], dim=-1)
    one, zero = torch.ones_like(p), torch.zeros_like(p)
    on_h = torch.stack([one, zero, -p], dim=-1)
    on_v = torch.stack([zero, one, -q], dim=-1)
    sh, sv = (sigma_m**2).unbind(-1)
    hu, hw, vu, vw = (on_h * u).sum(-1), (on_h * w).sum(-1), (on_v * u).sum(-1), (on_v * w).sum(-1)
    uu, uw, ww = sh * hu * hu + sv * vu * vu, sh * hu * hw + sv * vu * vw, sh * hw * hw + sv * vw * vw
    # Eigenvectors of [[uu, uw], [uw, ww]]. The angle has no gradient: it is undefined where both axes are equal.
    angle = 0.5 * torch.atan2(2 * uw, uu - ww).detach()
    c, s = torch.cos(angle), torch.sin(angle)
    first = c * c * uu + 2 * c * s * uw + s * s * ww
    second = s * s * uu - 2 * c * s * uw + c * c * ww
    tilt = torch.stack([1 + z, -y, x, zero], dim=-1)
    tilt = tilt / tilt.norm(dim=-1, keepdim=True)
    half_c, half_s = torch.cos(angle / 2), torch.sin(angle / 2)
    # tilt times the turn by the angle about the normal.
    tw, tx, ty, _ = tilt.unbind(-1)
    quat = torch.stack([tw * half_c, tx * half_c + ty * half_s, ty * half_c - tx * half_s, tw * half_s], dim=-1)
    return quat, torch.stack([first, second], dim=-1).clamp(min=1e-12).sqrt()
