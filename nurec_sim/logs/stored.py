"""Images and sweeps of our own clip folders: JPEG or PNG, and integer millimetres in .npz files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import LIMITS
from nurec_sim.logs.clip import ImageRecord
from nurec_sim.logs.points import unpacked_points
from nurec_sim.logs.storage import Storage
from nurec_sim.logs.sweeps import SweepRecord
from nurec_sim.types import Matrix4, SweepPoints


@dataclass(frozen=True)
class ImageFiles:
    """Images of a folder or zip file, one file each: what sources (``types.LogSource``) of such logs have in common.

    Attributes:
        storage: the folder or zip file.
        images: records of each camera's frames.
        sweeps: records of each LiDAR's sweeps.
    """

    storage: Storage
    images: Mapping[str, Sequence[ImageRecord]]
    sweeps: Mapping[str, Sequence[SweepRecord]]

    def image(self, camera_id: str, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """One RGB frame."""
        return self.storage.read_image(self.images[camera_id][index].file)

    def encoded_image(self, camera_id: str, index: int) -> bytes:
        """The JPEG or PNG file of one frame."""
        return self.storage.read(self.images[camera_id][index].file)

    def float_rows(self, lidar_id: str, index: int, columns: int) -> Float32[np.ndarray, "n columns"]:
        """A sweep file of little-endian float32 records.

        Raises:
            ClipError: it is missing, or does not hold whole records.
        """
        file = self.sweeps[lidar_id][index].file
        data = self.storage.read(file)
        if len(data) % (4 * columns):
            raise ClipError(f"{file} must hold {4 * columns} bytes for each point, got {len(data)} bytes")
        return np.frombuffer(data, "<f4").reshape(-1, columns)

    def ego_mask(self, camera_id: str) -> None:
        """None: unknown."""
        return None


@dataclass(frozen=True)
class StoredFiles(ImageFiles):
    """The files of a clip folder as a ``types.LogSource``.

    Attributes:
        intensity_scale: per LiDAR, the divisor that maps stored intensities to 0..1.
        lidar_from_file: rotation from the axes of sweep files to ours (x forward).
    """

    intensity_scale: Mapping[str, float]
    lidar_from_file: Matrix4 = field(default_factory=lambda: np.eye(4))

    def sweep(self, lidar_id: str, index: int) -> SweepPoints:
        """The points of one sweep."""
        arrays = _checked_arrays(self.storage, self.sweeps[lidar_id][index].file)
        xyz_m = unpacked_points(arrays["dxyz_mm"], self.lidar_from_file)
        intensity = arrays.get("intensity")
        if intensity is not None:
            intensity = np.clip(intensity / self.intensity_scale[lidar_id], 0.0, 1.0).astype(np.float32)
        return SweepPoints(xyz_m, intensity, arrays.get("dt_us"))


def encode_points(xyz_m: Float64[np.ndarray, "n 3"]) -> np.ndarray:
    """Points as integer millimetres, delta-encoded per coordinate (``dxyz_mm``, int32)."""
    millimetres = np.rint(np.asarray(xyz_m, np.float64) * 1000.0).astype(np.int64).T
    # Neighbouring points are close, so differences are small numbers, which deflate compresses well.
    return np.diff(millimetres, axis=1, prepend=0).astype(np.int32)


def _checked_arrays(storage: Storage, file: str) -> dict[str, np.ndarray]:
    arrays = storage.read_arrays(file)
    points = arrays.get("dxyz_mm")
    if points is None or points.ndim != 2 or points.shape[0] != 3 or points.dtype.kind not in "iu":
        found = "nothing" if points is None else f"{points.dtype} {points.shape}"
        raise ClipError(f"{storage.path.name}: {file} needs whole numbers dxyz_mm [3,n], got {found}")
    if points.shape[1] > LIMITS.sweep_points:
        raise ClipError(
            f"{storage.path.name}: {file} has {points.shape[1]:,} points; a sweep may have {LIMITS.sweep_points:,}"
        )
    for name in ("intensity", "dt_us"):
        if name in arrays and arrays[name].shape != points.shape[1:]:
            raise ClipError(
                f"{storage.path.name}: {file} has {points.shape[1]} points but {name} of shape {arrays[name].shape}"
            )
    return arrays
