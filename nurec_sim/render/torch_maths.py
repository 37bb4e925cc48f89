"""The few formulas of ``geometry`` and ``layers`` that gradients must pass through, in torch."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nurec_sim.scene.harmonics import sh_functions


def quat_multiply(a: Float[Tensor, "*n 4"], b: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4"]:
    """Product of quaternions (wxyz)."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def quat_from_matrix(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, " 4"]:
    """The unit quaternion (wxyz) of a rotation, by its largest component."""
    m = rotation
    squares = torch.stack(
        [
            1 + m[0, 0] + m[1, 1] + m[2, 2],
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
        ]
    )
    # Products 4 q q^T of the quaternion with itself: the row of the largest component divides best.
    wx, wy, wz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    w2, x2, y2, z2 = squares
    rows = [[w2, wx, wy, wz], [wx, x2, xy, xz], [wy, xy, y2, yz], [wz, xz, yz, z2]]
    quat = torch.stack(rows[int(squares.argmax())])
    return quat / quat.norm()


def view_colour(
    rgb: Float[Tensor, "n 3"], sh_rest: Float[Tensor, "n k 3"], eye_to_mean: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """``layers.view_colour``: colours seen along ``eye_to_mean``, not below 0."""
    direction = eye_to_mean / eye_to_mean.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    basis = sh_basis(direction, sh_rest.shape[1])
    return (rgb + (basis[:, None, :] @ sh_rest)[:, 0]).clamp(min=0)


def sh_basis(direction: Float[Tensor, "n 3"], k: int) -> Float[Tensor, "n k"]:
    """``harmonics.sh_basis``: real spherical harmonics of degree 1 and up at unit directions."""
    x, y, z = direction.unbind(-1)
    return torch.stack(sh_functions(x, y, z, k), dim=-1)
