"""The network's cubemaps: the direction of each texel, and colours looked up by direction.

Scene axes x right, y down, z forward. Faces +X, -X, -Y (top), +Y (bottom), +Z, -Z; every face is the picture seen from
the middle of the cube, u to the right and v down, both 0..1 from edge to edge. The four side faces are upright; the top
face has +z at its lower edge, the bottom face at its upper edge. (OpenGL's cube map table with the sign of y changed;
it is the released model's, by its outputs.)
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional


def directions(
    size: int, device: torch.device | str | None = None, dtype: torch.dtype = torch.float32
) -> Float[Tensor, "6 size size 3"]:
    """Unit rays through the centres of the texels."""
    return _rays((2 * torch.arange(size, device=device, dtype=torch.float64) + 1) / size - 1).to(dtype)


def coordinates(
    direction: Float[Tensor, "*n 3"],
) -> tuple[Int64[Tensor, "*n"], Float[Tensor, "*n"], Float[Tensor, "*n"]]:
    """Face index, column u and row v (0..1) where directions, of any length but zero, meet the cube."""
    x, y, z = direction.unbind(-1)
    longest, axis = direction.abs().max(dim=-1)
    along_x, along_y, along_z = axis == 0, axis == 1, axis == 2
    sign = torch.where(along_x, x, torch.where(along_y, y, z)).sign()
    # The third and the fourth face look up and down, and down is +y; elsewhere the positive axis comes first.
    face = 2 * axis + (torch.where(along_y, -sign, sign) < 0)
    u = torch.where(along_x, -sign * z, torch.where(along_z, sign * x, x)) / longest
    v = torch.where(along_y, -sign * z, y) / longest
    return face, (u + 1) / 2, (v + 1) / 2


def texels(direction: Float[Tensor, "*n 3"], size: int) -> Int64[Tensor, "*n"]:
    """Flat (face, row, column) index of the texel that each direction hits."""
    face, u, v = coordinates(direction)
    column, row = (torch.clamp((c * size).long(), 0, size - 1) for c in (u, v))
    return (face * size + row) * size + column


def sample(cubemap: Float[Tensor, "6 s s c"], direction: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n c"]:
    """Values in given directions, bilinear within each face and held beyond its outermost texel centres.

    No filtering across faces, as ``grid_sample`` does with border padding and ``align_corners=False`` (released model).
    """
    size = cubemap.shape[1]
    face, u, v = coordinates(direction)
    # Texel centres lie at (k + 0.5) / size.
    column, row = (torch.clamp(c * size - 0.5, 0, size - 1) for c in (u, v))
    return _bilinear(cubemap, face, column, row)


def sample_seamless(cubemap: Float[Tensor, "6 s s c"], direction: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n c"]:
    """Values in given directions, bilinear across the edges of the faces too."""
    size = cubemap.shape[1]
    face, u, v = coordinates(direction)
    return _bilinear(framed(cubemap), face, u * size + 0.5, v * size + 0.5)


def framed(cubemap: Float[Tensor, "6 s s c"]) -> Float[Tensor, "6 s+2 s+2 c"]:
    """Every face with one more texel on each side, looked up on its neighbours."""
    size = cubemap.shape[1]
    centre = (2 * torch.arange(-1, size + 1, device=cubemap.device, dtype=torch.float64) + 1) / size - 1
    wider = functional.pad(cubemap, (0, 0, 1, 1, 1, 1))
    # Places beyond the edge lie in the face's plane; their directions belong to the neighbouring faces.
    rays = _rays(centre)
    for side in (0, -1):
        wider[:, side] = sample(cubemap, rays[:, side])
        wider[:, :, side] = sample(cubemap, rays[:, :, side])
    return wider


def _rays(centre: Float[Tensor, " n"]) -> Float[Tensor, "6 n n 3"]:
    """Unit rays through a grid of places on every face, -1..1 from edge to edge, beyond it in the face's plane."""
    v, u = torch.meshgrid(centre, centre, indexing="ij")
    one = torch.ones_like(u)
    faces = [(one, v, -u), (-one, v, u), (u, -one, v), (u, one, -v), (u, v, one), (-u, v, -one)]
    return functional.normalize(torch.stack([torch.stack(face, dim=-1) for face in faces]), dim=-1)


def _bilinear(faces: Float[Tensor, "6 n n c"], face: Tensor, column: Tensor, row: Tensor) -> Float[Tensor, "*n c"]:
    """Values at places given in texels, 0 at the first centre and at most n - 1."""
    column, row = column.to(faces.dtype), row.to(faces.dtype)
    left, top = column.long(), row.long()
    right, bottom = (torch.clamp(i + 1, max=faces.shape[1] - 1) for i in (left, top))
    across, down = (column - left)[..., None], (row - top)[..., None]
    upper = torch.lerp(faces[face, top, left], faces[face, top, right], across)
    lower = torch.lerp(faces[face, bottom, left], faces[face, bottom, right], across)
    return torch.lerp(upper, lower, down)
