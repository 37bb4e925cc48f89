"""Inputs of the LiDAR branch: what a range image and its planes say about every beam, as tensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nurec_sim.network.lidar.planes import fit_planes
from nurec_sim.network.lidar.range_image import RangeImage
from nurec_sim.render.torch_maths import quat_multiply

FEATURES = 17
SLOPE_SCALE = 3.0


@dataclass(frozen=True, eq=False)
class LidarInputs:
    """A range image as the branch reads it. Axes of a beam: h level to its left, v up, d along it.

    Attributes:
        features: of all beams, about -1 to 1 each; zeros without return but for the geometry of the scanner.
        chosen: returns that are decoded, the n of what follows, row by row.
        xyz_m: the returns, in the axes of the image.
        quat_wxyz: rotations that take x, y and z to h, v and d.
        range_m: distance from where the beam was fired.
        spacing_m: distance between beams at that range, along h and v.
        slope: of the surface: its normal away from the sensor is (slope h, slope v, 1).
        intensity: 0..1, 0 where unknown.
        full_turn: whether the last column adjoins the first.
    """

    features: Float[Tensor, "17 rows columns"]
    chosen: Bool[Tensor, "rows columns"]
    xyz_m: Float[Tensor, "n 3"]
    quat_wxyz: Float[Tensor, "n 4"]
    range_m: Float[Tensor, " n"]
    spacing_m: Float[Tensor, "n 2"]
    slope: Float[Tensor, "n 2"]
    intensity: Float[Tensor, " n"]
    full_turn: bool


def lidar_inputs(image: RangeImage, chosen: Bool[np.ndarray, "rows columns"] | None = None) -> LidarInputs:
    """The inputs for a range image.

    Args:
        image: the sweep; the encoder sees all of it.
        chosen: returns that are decoded; all if None.
    """
    returned, planes = image.returned, fit_planes(image)
    chosen = returned if chosen is None else returned & chosen
    ray = np.where(returned[..., None], image.xyz_m - image.eye_m[None], 0).astype(np.float32)
    reach = np.linalg.norm(ray, axis=-1)
    flat = np.zeros_like(reach) + image.elevation_rad[:, None].astype(np.float32)
    known = np.isfinite(image.intensity) & returned
    intensity = np.where(known, image.intensity, 0).astype(np.float32)
    row_step = np.broadcast_to(image.row_step_rad[:, None].astype(np.float32), reach.shape)
    far = np.log(np.maximum(reach, 0.3) / 20.0)
    shown = [
        np.ones_like(reach),
        far / 2,
        np.clip(ray[..., 2] / 5.0, -1, 2),
        intensity,
        known,
        np.tanh(planes[..., 0] / SLOPE_SCALE),
        np.tanh(planes[..., 1] / SLOPE_SCALE),
        -0.5 * np.log1p(planes[..., 0] ** 2 + planes[..., 1] ** 2) / 2,
        np.tanh(planes[..., 2] / 0.1),
        np.tanh(planes[..., 3] / 0.1),
        planes[..., 4],
        *(np.tanh(10 * planes[..., 5 + k]) for k in range(4)),
    ]
    scanner = [4 * flat, np.log(row_step / np.radians(0.4)) / 2]
    features = np.stack([np.where(returned, each, 0) for each in shown] + scanner).astype(np.float32)
    ray, reach = ray[chosen], reach[chosen]
    elevation = np.arcsin(np.clip(ray[:, 2] / np.maximum(reach, 1e-6), -1, 1))
    azimuth = np.arctan2(ray[:, 1], ray[:, 0])
    across = image.column_step_rad * np.cos(elevation)
    spacing = reach[:, None] * np.stack([across, row_step[chosen]], axis=-1)
    slope = planes[chosen][:, :2]
    return LidarInputs(
        torch.from_numpy(features),
        torch.from_numpy(chosen.copy()),
        _tensor(image.xyz_m[chosen]),
        _tensor(_beam_quat(azimuth, elevation)),
        _tensor(reach),
        _tensor(spacing),
        _tensor(slope),
        _tensor(intensity[chosen]),
        image.full_turn,
    )


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


def _beam_quat(azimuth_rad: np.ndarray, elevation_rad: np.ndarray) -> np.ndarray:
    """Rotations that take x, y, z to h, v, d of beams: first to y, z, x, then up, then around."""
    a, e = azimuth_rad.astype(np.float64) / 2, elevation_rad.astype(np.float64) / 2
    zero = np.zeros_like(a)
    around = torch.from_numpy(np.stack([np.cos(a), zero, zero, np.sin(a)], axis=-1))
    up = torch.from_numpy(np.stack([np.cos(e), zero, -np.sin(e), zero], axis=-1))
    return quat_multiply(quat_multiply(around, up), torch.full((1, 4), 0.5, dtype=torch.float64)).numpy()
