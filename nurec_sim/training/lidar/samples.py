"""Samples: a sector of a place's input sweep, and part of it seen from another pose."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from torch import Tensor

from nurec_sim import geometry, sensors
from nurec_sim.network.lidar.inputs import LidarInputs, lidar_inputs
from nurec_sim.network.lidar.range_image import RangeImage
from nurec_sim.training.lidar.config import ScanSettings
from nurec_sim.training.lidar.places import Scans
from nurec_sim.types import Label, LidarModel

SEEN_M, SEEN_SHARE = 0.3, 0.01
"""A surface was seen if the input's ranges around its direction enclose its distance, up to this."""


@dataclass(frozen=True, eq=False)
class ScanSample:
    """What one step needs; all poses and points are in the axes of the input sweep at its middle.

    Attributes:
        inputs: of the branch.
        label: true class of each return of the input: 0 other, 1 road, 2 movable.
        lidar: the beams to render, and their poses at the start and the end of the sweep.
        poses: see ``lidar``.
        range_m: true range of these beams, 0 where they meet nothing.
        intensity: true intensity.
        lost: whether they do not return.
        seen: whether they meet a surface that the input has seen.
    """

    inputs: LidarInputs
    label: Int64[Tensor, " n"]
    lidar: LidarModel
    poses: Float[Tensor, "2 4 4"]
    range_m: Float32[Tensor, "rows columns"]
    intensity: Float32[Tensor, "rows columns"]
    lost: Bool[Tensor, "rows columns"]
    seen: Bool[Tensor, "rows columns"]


def scan_sample(scans: Scans, settings: ScanSettings, rng: np.random.Generator) -> ScanSample:
    """A sample of a place, by a random sector and target."""
    columns = _sector(scans.lidar, settings.sector_deg, rng)
    target = int(rng.integers(1, len(scans.range_m)))
    skip = round(len(columns) * (1 - settings.target_share) / 2)
    middle = columns[skip : len(columns) - skip]
    lidar = part_of(scans.lidar, columns)
    own = poses_of(scans.lidar, scans.world_from_lidar[0])
    image_from_world = geometry.inverse(geometry.interpolate_pose_pair(scans.world_from_lidar[0], np.array([0.5]))[0])
    fired = image_from_world @ own[columns]
    true_m = scans.range_m[0][:, columns]
    measured = np.where(true_m > 0, np.maximum(true_m + scans.noise_m[:, columns], 0.3), 0)
    returned = (true_m > 0) & ~scans.lost[0][:, columns]
    image = RangeImage.over(
        lidar, points(lidar, fired, measured), fired[:, :3, 3], returned, scans.intensity[0][:, columns]
    )
    label = scans.label[0][:, columns][returned]
    asked = part_of(scans.lidar, middle)
    # The poses of the sector's own first and last column.
    there = image_from_world @ poses_of(scans.lidar, scans.world_from_lidar[target])[middle]
    ranges = scans.range_m[target][:, middle]
    seen = (ranges > 0) & _seen(lidar, fired, true_m, points(asked, there, ranges))
    return ScanSample(
        lidar_inputs(image),
        torch.from_numpy(np.select([label == Label.ROAD, label == Label.MOVABLE], [1, 2], 0)),
        asked,
        torch.from_numpy(there[[0, -1]]),
        *(torch.from_numpy(np.ascontiguousarray(values)) for values in (
            ranges, scans.intensity[target][:, middle], scans.lost[target][:, middle], seen)),
    )  # fmt: skip


def _sector(lidar: LidarModel, sector_deg: float, rng: np.random.Generator) -> Int64[np.ndarray, " k"]:
    """Neighbouring columns: a sector of a full turn, anywhere but over the seam, where time jumps."""
    count = len(lidar.azimuth_rad)
    step = abs(float(lidar.azimuth_rad[1] - lidar.azimuth_rad[0]))
    wide = min(round(np.radians(sector_deg) / step), count)
    return int(rng.integers(count - wide + 1)) + np.arange(wide)


def part_of(lidar: LidarModel, columns: Int64[np.ndarray, " k"]) -> LidarModel:
    """Some columns of a LiDAR."""
    return dataclasses.replace(lidar, azimuth_rad=lidar.azimuth_rad[columns])


def poses_of(lidar: LidarModel, pair: Float64[np.ndarray, "2 4 4"]) -> Float64[np.ndarray, "columns 4 4"]:
    """Pose of each column from those at the start and the end of the sweep."""
    return geometry.interpolate_pose_pair(pair, sensors.column_fraction(lidar))


def points(
    lidar: LidarModel, pose: Float64[np.ndarray, "columns 4 4"], range_m: Float32[np.ndarray, "rows columns"]
) -> Float32[np.ndarray, "rows columns 3"]:
    """Points at a range along each beam."""
    ray = sensors.beam_directions(lidar) * range_m[..., None]
    return (np.einsum("cij,rcj->rci", pose[:, :3, :3], ray) + pose[:, :3, 3]).astype(np.float32)


def _seen(
    lidar: LidarModel, pose: Float64[np.ndarray, "columns 4 4"], range_m: Float32[np.ndarray, "rows columns"],
    xyz: Float32[np.ndarray, "r c 3"],
) -> Bool[np.ndarray, "r c"]:  # fmt: skip
    """Whether the ranges of a sweep around the direction of each point enclose its distance."""
    flat = xyz.reshape(-1, 3).astype(np.float64)
    half = pose[len(pose) // 2]
    _, column, _ = sensors.beam_coordinates(lidar, geometry.transform_points(geometry.inverse(half), flat))
    near = geometry.inverse(pose)[np.clip(np.rint(column), 0, len(pose) - 1).astype(np.int64)]
    local = np.einsum("nij,nj->ni", near[:, :3, :3], flat) + near[:, :3, 3]
    row, column, valid = sensors.beam_coordinates(lidar, local)
    row, column = (
        np.clip(np.rint(k), 0, n - 1).astype(np.int64) for k, n in zip((row, column), range_m.shape, strict=True)
    )
    missing = np.where(range_m > 0, range_m, np.nan)
    edged = np.pad(missing, 1, constant_values=np.nan)
    around = np.stack([edged[row + i, column + k] for i in range(3) for k in range(3)])
    far = np.linalg.norm(local, axis=1)
    margin = SEEN_M + SEEN_SHARE * far
    low, high = np.fmin.reduce(around), np.fmax.reduce(around)
    with np.errstate(invalid="ignore"):
        seen = valid & (low - margin < far) & (far < high + margin)
    return seen.reshape(xyz.shape[:2])
