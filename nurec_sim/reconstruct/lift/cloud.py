"""Points of one rigid body, thinned: one for each voxel, the mean of all that lie in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim.compute.kernels import kernel
from nurec_sim.types.rows import rows_of


@dataclass(frozen=True)
class Cloud:
    """Thinned points of one rigid body, in the world or in the box frame.

    ``spacing_m`` is the edge of the voxel that each point represents, ``eye_m`` the mean position of the sensor that
    saw it; ``intensity`` is NaN where no sweep recorded one.
    """

    xyz_m: Float64[np.ndarray, "n 3"]
    eye_m: Float64[np.ndarray, "n 3"]
    spacing_m: Float32[np.ndarray, " n"]
    intensity: Float32[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.xyz_m)

    def __getitem__(self, index: np.ndarray | slice) -> Cloud:
        return Cloud(*rows_of((getattr(self, name) for name in CLOUD_FIELDS), index))

    @classmethod
    def concatenate(cls, parts: Sequence[Cloud]) -> Cloud:
        """All points one after the other."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in CLOUD_FIELDS))

    @classmethod
    def empty(cls) -> Cloud:
        """No points."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.float32), np.zeros(0, np.float32))


CLOUD_FIELDS = ("xyz_m", "eye_m", "spacing_m", "intensity")


class Voxels:
    """Running voxel means."""

    def __init__(self) -> None:
        self.keys: list[np.ndarray] = []
        self.sums: list[np.ndarray] = []
        self.pending = 0

    def add(self, key: np.ndarray, sums: np.ndarray) -> None:
        """Add what ``voxel_sums`` returns."""
        self.keys.append(key)
        self.sums.append(sums)
        self.pending += len(key)
        if self.pending > 3_000_000:
            self._merge()

    def _merge(self) -> None:
        if len(self.keys) > 1:
            key, sums = _sum_by_key(np.concatenate(self.keys), self.sums)
            self.keys, self.sums = [key], [sums]
        self.pending = 0

    def cloud(self) -> Cloud:
        """The means."""
        self._merge()
        if not self.keys:
            return Cloud.empty()
        sums = self.sums[0]
        mean = sums / sums[:, 9:10]
        with np.errstate(invalid="ignore", divide="ignore"):
            intensity = np.where(sums[:, 8] > 0, sums[:, 7] / sums[:, 8], np.nan)
        return Cloud(mean[:, :3], mean[:, 3:6], mean[:, 6].astype(np.float32), intensity.astype(np.float32))


def unthinned(xyz: np.ndarray, eye: np.ndarray, edge: np.ndarray, intensity: np.ndarray) -> Cloud:
    """All points; arguments as for ``voxel_sums``."""
    return Cloud(xyz, eye, edge.astype(np.float32), intensity.astype(np.float32))


def thinned(cloud: Cloud) -> Cloud:
    """One point per voxel of the cloud's own spacing."""
    voxels = Voxels()
    voxels.add(*voxel_sums(cloud.xyz_m, cloud.eye_m, cloud.spacing_m.astype(np.float64), cloud.intensity))
    return voxels.cloud()


def voxel_sums(
    xyz: np.ndarray, eye: np.ndarray, edge: np.ndarray, intensity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Keys of the voxels that hold points, ascending, and sums over the points in each.

    Args:
        xyz: [n,3] points, metres.
        eye: [n,3] where the sensor was, in the same frame.
        edge: [n] voxel edge of each point in metres, a power of two times a constant.
        intensity: [n] NaN where unknown.

    Returns:
        Keys [m], and [m,10]: point, eye, edge, intensity, points with intensity, points.
    """
    level = np.clip(np.round(np.log2(edge / 0.001)).astype(np.int64), 0, 31)
    key = _keys(xyz, edge, level)
    order = np.argsort(key, kind="stable")
    return _sums_in_order(key, order, xyz, eye, edge, intensity)


@kernel
def _keys(xyz, edge, level):
    """Number of each point's voxel. One int64 (5 bits of level, 19 per axis) sorts far faster than rows of four."""
    key = np.empty(len(xyz), np.int64)
    for i in range(len(xyz)):
        number = level[i]
        for k in range(3):
            number = (number << 19) | (np.int64(np.floor(xyz[i, k] / edge[i])) + (1 << 18))
        key[i] = number
    return key


@kernel
def _sums_in_order(key, order, xyz, eye, edge, intensity):
    """Keys and sums of ``voxel_sums`` of points in the order of their keys."""
    count = 0
    for j in range(len(order)):
        count += j == 0 or key[order[j]] != key[order[j - 1]]
    keys, sums = np.empty(count, np.int64), np.zeros((count, 10))
    place = -1
    for j in range(len(order)):
        i = order[j]
        if place < 0 or key[i] != keys[place]:
            place += 1
            keys[place] = key[i]
        for k in range(3):
            sums[place, k] += xyz[i, k]
            sums[place, 3 + k] += eye[i, k]
        sums[place, 6] += edge[i]
        if np.isfinite(intensity[i]):
            sums[place, 7] += intensity[i]
            sums[place, 8] += 1
        sums[place, 9] += 1
    return keys, sums


def _sum_by_key(key: np.ndarray, parts: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Distinct keys, ascending, and the sums of the rows of each; the rows of all parts follow each other."""
    order = np.argsort(key, kind="stable")
    in_order_of_key = key[order]
    first = np.ones(len(key), bool)
    first[1:] = in_order_of_key[1:] != in_order_of_key[:-1]
    place = np.empty(len(key), np.int64)
    place[order] = np.cumsum(first) - 1
    keys = in_order_of_key[first]
    sums = np.zeros((len(keys), parts[0].shape[1]))
    start = 0
    for rows in parts:
        _add_rows(place[start : start + len(rows)], rows, sums)
        start += len(rows)
    return keys, sums


@kernel
def _add_rows(place, rows, sums):
    """Add each row to ``sums[place]``, one after the other."""
    for i in range(len(place)):
        for c in range(rows.shape[1]):
            sums[place[i], c] += rows[i, c]
