"""View-dependent colour: real spherical harmonics in the order and with the signs of 3DGS files."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim.geometry import released_cubemap_directions

SH_C0 = 0.28209479177387814
"""The constant function of degree 0: colour = 0.5 + SH_C0 * f_dc."""


def sh_basis(direction: Float64[np.ndarray, "n 3"], k: int) -> Float64[np.ndarray, "n k"]:
    """Real spherical harmonics of degree 1 and up at unit directions, in the order and with the signs of 3DGS files.

    Args:
        direction: unit vectors in the world.
        k: 3, 8 or 15 functions (degree 1, 2 or 3).
    """
    x, y, z = np.moveaxis(np.asarray(direction, np.float64), -1, 0)
    return np.stack(sh_functions(x, y, z, k), axis=-1)


def sh_functions(x: Any, y: Any, z: Any, k: int) -> list[Any]:
    """The functions of ``sh_basis``, for arrays or tensors.

    Args:
        x: first component of unit vectors, of any shape.
        y: second component.
        z: third component.
        k: 3, 8 or 15 functions (degree 1, 2 or 3).

    Returns:
        k arrays or tensors of the components' shape.
    """
    # Real orthonormal spherical harmonics, order m = -l..l within each degree l, with the Condon-Shortley phase.
    xx, yy, zz = x * x, y * y, z * z
    basis = [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if k > 3:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if k > 8:
        basis += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return basis


def rotate_harmonics(
    sh_rest: Float32[np.ndarray, "n k 3"], rotation: Float64[np.ndarray, "3 3"]
) -> Float32[np.ndarray, "n k 3"]:
    """Rotated coefficients: the colour along d moves to ``rotation @ d``."""
    k = sh_rest.shape[1]
    direction = released_cubemap_directions(4).reshape(-1, 3)  # 96 directions, more than the 15 functions
    # Rotation maps each degree to itself; the matrix follows from new(d) = old(R^T d), by least squares.
    turned = np.linalg.lstsq(sh_basis(direction, k), sh_basis(direction @ rotation, k))[0]
    return np.einsum("jk,nkc->njc", turned, sh_rest).astype(np.float32)
