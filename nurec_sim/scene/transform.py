"""Gaussians transformed to another frame, and concatenated regardless of their harmonics' degrees."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.scene.harmonics import rotate_harmonics
from nurec_sim.types import Gaussians

UP_AXES: Mapping[str, tuple[tuple[int, int, int], ...]] = {
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "y": ((0, 0, -1), (-1, 0, 0), (0, 1, 0)),
    "-y": ((0, 0, 1), (-1, 0, 0), (0, -1, 0)),
    "x": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "-x": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
}
"""world_from_file by the up axis of the file. The world's x is the usual forward axis of such files: +z if y points
down (COLMAP, most trained 3DGS files), -z if y points up (OpenGL)."""


def world_from_up(up: str) -> Float64[np.ndarray, "3 3"]:
    """The rotation from a file whose axis ``up`` points up to the world.

    Raises:
        ArchiveError: no such axis.
    """
    if up not in UP_AXES:
        raise ArchiveError(f"up must be one of {list(UP_AXES)}, got {up!r}")
    return np.array(UP_AXES[up], np.float64)


def transformed(gaussians: Gaussians, a_from_b: Float64[np.ndarray, "4 4"]) -> Gaussians:
    """Transforms Gaussians from frame b to frame a, including their view-dependent colours.

    Args:
        gaussians: in frame b.
        a_from_b: affine. Shapes are always exact; view-dependent colours follow the nearest rotation or reflection,
            which is exact unless ``a_from_b`` scales anisotropically.
    """
    matrix = np.asarray(a_from_b, np.float64)
    linear = matrix[:3, :3]
    # Polar decomposition: of all orthogonal matrices, left @ right is the nearest to ``linear``.
    left, stretch, right = np.linalg.svd(linear)
    turn = left @ right
    mean = geometry.transform_points(matrix, gaussians.mean_m)
    if np.ptp(stretch) <= 1e-6 * stretch.max() and np.linalg.det(turn) > 0:
        quat = geometry.quat_multiply(geometry.quat_from_matrix(turn)[None], gaussians.quat_wxyz)
        scale = gaussians.scale_m * stretch.mean()
    else:
        quat, scale = _stretched(gaussians, linear)
    rest = gaussians.sh_rest
    with np.errstate(over="ignore"):
        return dataclasses.replace(
            gaussians,
            mean_m=mean.astype(np.float32),
            quat_wxyz=(geometry.quat_normalize(quat) if len(quat) else quat).astype(np.float32),
            scale_m=scale.astype(np.float32),
            normal=(gaussians.normal @ turn.T).astype(np.float32),
            sh_rest=None if rest is None else rotate_harmonics(rest, turn),
        )


def _stretched(
    gaussians: Gaussians, linear: Float64[np.ndarray, "3 3"]
) -> tuple[Float64[np.ndarray, "n 4"], Float64[np.ndarray, "n 3"]]:
    """Rotations and standard deviations of Gaussians after a linear map, by principal axes."""
    axes = geometry.matrix_from_quat(gaussians.quat_wxyz) * gaussians.scale_m[:, None].astype(np.float64)
    # Covariance A S S^T A^T = (A S)(A S)^T: its axes are the left singular vectors of A S, S = R diag(scale).
    rotation, scale, _ = np.linalg.svd(linear @ axes)
    # Flipping an axis leaves the ellipsoid unchanged and makes a reflection a rotation.
    rotation[:, :, 2] *= np.sign(np.linalg.det(rotation))[:, None]
    return geometry.quat_from_matrix(rotation), scale


def joined(parts: Sequence[Gaussians]) -> Gaussians:
    """Concatenates parts; missing coefficients of harmonics are zero."""
    k = max((0 if part.sh_rest is None else part.sh_rest.shape[1] for part in parts), default=0)
    return Gaussians.concatenate([with_harmonics(part, k) if k else part for part in parts])


def with_harmonics(gaussians: Gaussians, k: int) -> Gaussians:
    """The same colours with k coefficients per channel, no fewer than there are."""
    rest = np.zeros((len(gaussians), k, 3), np.float32)
    if gaussians.sh_rest is not None:
        rest[:, : gaussians.sh_rest.shape[1]] = gaussians.sh_rest
    return dataclasses.replace(gaussians, sh_rest=rest)
