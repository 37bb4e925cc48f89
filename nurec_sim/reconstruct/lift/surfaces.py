"""Local surface of a point cloud: normals and spacing from neighbours, and Gaussians as thin discs along it."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from nurec_sim import geometry
from nurec_sim.compute.cores import in_order
from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.lift.cloud import Cloud
from nurec_sim.reconstruct.lift.principal_axes import principal_axes
from nurec_sim.types import Gaussians, Label

NEIGHBOURS, FOURTH = 20, 4
PLANE_RATIO = 0.15
"""First over second variance below which neighbours lie on a plane, and points are moved onto it."""
LINE_RATIO = 0.02
"""Second over first variance below which neighbours lie on one scan line and do not determine the surface."""
CELL_M, NOISE_SIGMAS = 0.15, 2.0
"""Planes are looked for in cubes of three cells: noise of 3 cm hides them from the nearest points, 6 cm apart."""
DISC_SIGMA = 0.45
"""Standard deviation of a disc per metre of the spacing of scattered points."""
LATTICE_SIGMA = 0.63
"""The same on a square lattice, whose widest gaps are where four discs meet, at 1.12 standard deviations: discs of
opacity 0.95 then hide 94 % of what is behind. Beams sample planes in rows and columns, so on these it is a lattice,
too."""
PIXEL_SIGMA = 0.6
"""The same for footprints of pixels, whose lattice shears where the surface is curved."""
SCATTERED = 0.7
"""Spacing of scattered points by the distance of the fourth neighbour, which on a square lattice is the spacing."""
MOST_SPACING, MOST_CLOSED = 3.0, 2.0
"""Bounds of the spacing, in edges of a point's voxel: of any point, and of discs that close a plane. Wider ones would
reach far over its edges."""
MOST_STRETCH, MOST_STRETCH_OF_GROUND = 5.0, 30.0
"""Length over width of a footprint at most. The ground and other level surfaces are known to be flat; from a camera at
1.65 m they are stretched by 15 at 25 m."""
THINNEST_M = 0.003
"""Thicker discs would catch grazing LiDAR beams far in front of the ground."""


def surface_of(cloud: Cloud, chunk: int = 16_384) -> tuple[Cloud, np.ndarray, np.ndarray, np.ndarray]:
    """The cloud on its local planes, unit normals that face the sensor, spacing of points and sigma of their discs (m).

    Sweeps of a moving car disagree by centimetres, so that walls are thick; a grazing beam would end at their near
    side. Planes are looked for in cells that are wider than this (``CellPlanes``). Elsewhere the normal is the
    direction of least variance of the nearest points. Where these lie on a line (one scan ring), the surface is taken
    to contain the line and to face the sensor as well as it can.

    Discs on planes are so wide that they hide what is behind; from where the sensor was, beams between the points are
    as good as none, but a view from beside its path sees through them. Discs of foliage and edges are smaller.
    """
    from scipy.spatial import cKDTree

    n = len(cloud)
    to_eye = cloud.eye_m - cloud.xyz_m
    to_eye /= np.maximum(np.linalg.norm(to_eye, axis=1, keepdims=True), 1e-9)
    edge = cloud.spacing_m.astype(np.float32)
    if n < 4:
        return cloud, to_eye.astype(np.float32), edge.copy(), DISC_SIGMA * edge
    k = min(NEIGHBOURS, n - 1)
    tree = cKDTree(cloud.xyz_m)
    fourth = np.zeros(n, np.float32)
    normals, height, flat = CellPlanes.of(cloud.xyz_m).normals_and_heights()
    on_plane = flat.copy()

    def fit(part: Int64[np.ndarray, " m"]) -> None:
        distance, index = tree.query(cloud.xyz_m[part], k=1 + (min(FOURTH, k) if flat[part[0]] else k))
        # The fourth neighbour, not the first: its distance is steadier where sampling is uneven.
        fourth[part] = distance[:, min(FOURTH, k)]
        if not flat[part[0]]:
            normals[part], height[part], on_plane[part] = _nearest_planes(cloud, part, distance, index, to_eye[part])

    for _ in in_order(fit, [rows[i : i + chunk] for rows in (np.flatnonzero(~flat), np.flatnonzero(flat))
                            for i in range(0, len(rows), chunk)]):  # fmt: skip
        pass
    xyz = cloud.xyz_m + height[:, None] * normals
    flip = np.sum(normals * to_eye, axis=1) < 0
    normals[flip] *= -1
    spacing = np.clip(np.where(on_plane, fourth, np.float32(SCATTERED) * fourth), edge, MOST_SPACING * edge)
    closed = LATTICE_SIGMA * np.minimum(spacing, MOST_CLOSED * edge)
    sigma = np.where(on_plane, closed, DISC_SIGMA * spacing)
    return dataclasses.replace(cloud, xyz_m=xyz), normals.astype(np.float32), spacing, sigma


def _nearest_planes(
    cloud: Cloud,
    part: Int64[np.ndarray, " m"],
    distance: Float64[np.ndarray, "m k"],
    index: Int64[np.ndarray, "m k"],
    to_eye: Float64[np.ndarray, "m 3"],
) -> tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """Unit normals of some points by their nearest ones, how far the planes of these lie along them, whether any."""
    # Neighbours across a gap belong to another surface.
    reach = np.maximum(4 * distance[:, 3], 4 * cloud.spacing_m[part])
    mean, covariance = _moments(cloud.xyz_m, part, index, distance, reach)
    # Principal axes of the neighbourhood, variances ascending: the first axis is the normal of a plane.
    variance, axes = principal_axes(covariance)
    normal, along = axes[:, :, 0], axes[:, :, 2]
    line = variance[:, 1] < LINE_RATIO * variance[:, 2]
    # The direction to the sensor without its part along the line.
    facing = to_eye - np.sum(to_eye * along, axis=1, keepdims=True) * along
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-9)
    normal = np.where(line[:, None], facing, normal)
    plane = ~line & (variance[:, 0] < PLANE_RATIO * variance[:, 1])
    # Projection onto the local plane through the neighbours' mean; only where they are clearly flat.
    return normal, np.where(plane, np.sum(normal * mean, axis=1), 0.0), plane


@dataclass(frozen=True)
class CellPlanes:
    """Planes through the points of cells of ``CELL_M`` and of their 26 neighbours.

    ``plane`` is the plane of the cell of each point, -1 for none; ``sigma_m`` the standard deviation of the points
    across it.
    """

    xyz_m: Float64[np.ndarray, "n 3"]
    plane: Int64[np.ndarray, " n"]
    centre_m: Float64[np.ndarray, "planes 3"]
    normal: Float64[np.ndarray, "planes 3"]
    sigma_m: Float64[np.ndarray, " planes"]

    @classmethod
    def of(cls, xyz_m: Float64[np.ndarray, "n 3"]) -> CellPlanes:
        """The planes of a cloud."""
        # Small numbers: sums of large squares would lose the digits that variances are made of.
        origin = xyz_m.mean(axis=0)
        local = xyz_m - origin
        index = np.floor((local - local.min(axis=0)) / CELL_M).astype(np.int64) + 1
        keys, cell = np.unique((index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2], return_inverse=True)
        rows, columns = np.triu_indices(3)
        values = [np.ones(len(local)), *local.T, *(local[:, rows] * local[:, columns]).T]
        own = np.stack([np.bincount(cell, each, len(keys)) for each in values], axis=1)
        total = np.zeros_like(own)
        for x, y, z in itertools.product((-1, 0, 1), repeat=3):
            _add_beside(keys, (x << 42) + (y << 21) + z, own, total)
        enough = np.flatnonzero(total[:, 0] > NEIGHBOURS)
        mean = total[enough] / total[enough, :1]
        centre, covariance = mean[:, 1:4], np.empty((len(enough), 3, 3))
        covariance[:, rows, columns] = mean[:, 4:] - centre[:, rows] * centre[:, columns]
        covariance[:, columns, rows] = covariance[:, rows, columns]
        variance, axes = principal_axes(covariance)
        plane = (variance[:, 0] < PLANE_RATIO * variance[:, 1]) & (variance[:, 1] > LINE_RATIO * variance[:, 2])
        found = np.full(len(keys), -1)
        found[enough[plane]] = np.arange(np.count_nonzero(plane))
        sigma = np.sqrt(np.maximum(variance[plane, 0], 0))
        return cls(xyz_m, found[cell], centre[plane] + origin, axes[plane, :, 0], sigma)

    def normals_and_heights(
        self,
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """For each point: the normal of its cell's plane, how far this lies along it, and whether the point is on it.

        Normal and distance are 0 where it is on none. Points farther from the plane than ``NOISE_SIGMAS`` standard
        deviations are not on it: a pole before a wall.
        """
        normals, heights, on = np.zeros(self.xyz_m.shape), np.zeros(len(self.xyz_m)), self.plane >= 0
        plane = self.plane[on]
        height = np.sum(self.normal[plane] * (self.centre_m[plane] - self.xyz_m[on]), axis=1)
        near = np.abs(height) < NOISE_SIGMAS * self.sigma_m[plane]
        on[on] = near
        normals[on], heights[on] = self.normal[plane[near]], height[near]
        return normals, heights, on


@kernel
def _add_beside(keys, step, own, total):
    """Add the rows [n,c] of the cells ``keys + step``, where there are such, to those of ``keys``, which ascend."""
    place = 0
    for i in range(len(keys)):
        while place < len(keys) and keys[place] < keys[i] + step:
            place += 1
        if place < len(keys) and keys[place] == keys[i] + step:
            for c in range(own.shape[1]):
                total[i, c] += own[place, c]


@kernel
def _moments(xyz, part, index, distance, reach):
    """Mean [m,3], seen from each point of a part, and covariance [m,3,3] of its neighbours nearer than ``reach``.

    Args:
        xyz: [n,3] all points, metres.
        part: [m] the points asked for.
        index: [m,k] their neighbours.
        distance: [m,k] how far these are away, metres.
        reach: [m] metres.
    """
    m, k = index.shape
    mean, covariance, offset = np.zeros((m, 3)), np.zeros((m, 3, 3)), np.empty((k, 3))
    for i in range(m):
        count = 0
        for j in range(k):
            if distance[i, j] < reach[i]:
                for a in range(3):
                    offset[count, a] = xyz[index[i, j], a] - xyz[part[i], a]
                    mean[i, a] += offset[count, a]
                count += 1
        for a in range(3):
            mean[i, a] /= count
        for j in range(count):
            for a in range(3):
                for b in range(a + 1):
                    covariance[i, a, b] += (offset[j, a] - mean[i, a]) * (offset[j, b] - mean[i, b])
        for a in range(3):
            for b in range(a + 1):
                covariance[i, a, b] /= count
                covariance[i, b, a] = covariance[i, a, b]
    return mean, covariance


def rotation_onto(normal: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3 3"]:
    """Rotations whose third axis is the given unit normal."""
    normal = np.asarray(normal, np.float64)
    helper = np.where(np.abs(normal[:, 2:3]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(helper, normal)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normal, first), normal], axis=-1)


def discs(
    xyz_m: Float64[np.ndarray, "n 3"],
    normal: Float32[np.ndarray, "n 3"],
    sigma_m: Float32[np.ndarray, " n"],
    rgb: Float32[np.ndarray, "n 3"],
    intensity: Float32[np.ndarray, " n"],
    label: UInt8[np.ndarray, " n"],
    opacity: float,
) -> Gaussians:
    """Gaussians as round discs in the surface, one per point, thin along the normal.

    Args:
        xyz_m: centres, metres.
        normal: unit normals.
        sigma_m: standard deviations of the discs along the surface, metres.
        rgb: colours 0..1; clipped.
        intensity: LiDAR intensity; NaN where unknown.
        label: ``Label`` of each point.
        opacity: of all of them.
    """
    across = np.asarray(sigma_m, np.float64)
    scale = np.column_stack([across, across, np.maximum(0.05 * across, THINNEST_M)])
    return _gaussians(xyz_m, rotation_onto(normal), scale, normal, rgb, intensity, label, opacity)


def footprints(
    xyz_m: Float64[np.ndarray, "n 3"],
    normal: Float64[np.ndarray, "n 3"],
    ray: Float64[np.ndarray, "n 3"],
    pixel_m: Float64[np.ndarray, " n"],
    rgb: Float32[np.ndarray, "n 3"],
    intensity: Float32[np.ndarray, " n"],
    label: UInt8[np.ndarray, " n"],
    opacity: float,
    stretch_limit: float | Float64[np.ndarray, " n"] = MOST_STRETCH,
) -> Gaussians:
    """Gaussians as the shadows of pixels on the surface: one pixel wide across the ray, stretched along its slope.

    Args:
        xyz_m: points, metres.
        normal: unit normals.
        ray: unit directions from the camera.
        pixel_m: width of a pixel at the point's depth, metres.
        rgb: colours 0..1; clipped.
        intensity: LiDAR intensity; NaN where unknown.
        label: ``Label`` of each point.
        opacity: of all of them.
        stretch_limit: bound of the stretch, which is 1 / cosine of the incidence: a surface of uncertain slope would
            reach far into free space.
    """
    facing = np.abs(np.sum(normal * ray, axis=1))
    # First axis: along the slope, where the footprint is stretched; second: across it.
    across = np.cross(normal, ray)
    size = np.linalg.norm(across, axis=1, keepdims=True)
    fallback = rotation_onto(normal)[:, :, 0]
    across = np.where(size > 1e-3, across / np.maximum(size, 1e-9), fallback)
    along = np.cross(across, normal)
    rotation = np.stack([along, across, normal], axis=-1)
    sigma = pixel_m * PIXEL_SIGMA
    stretch = np.minimum(1 / np.maximum(facing, 1e-3), stretch_limit)
    scale = np.column_stack([sigma * stretch, sigma, np.minimum(np.maximum(0.1 * sigma, THINNEST_M), sigma)])
    return _gaussians(xyz_m, rotation, scale, normal, rgb, intensity, label, opacity)


def _gaussians(xyz_m, rotation, scale, normal, rgb, intensity, label, opacity) -> Gaussians:
    n = len(xyz_m)
    quat = geometry.quat_from_matrix(rotation) if n else np.zeros((0, 4))
    return Gaussians(
        np.asarray(xyz_m, np.float32),
        quat.astype(np.float32),
        scale.astype(np.float32),
        np.full(n, opacity, np.float32),
        np.clip(rgb, 0, 1).astype(np.float32),
        np.asarray(normal, np.float32),
        np.asarray(label, np.uint8) if n else np.full(0, Label.OTHER, np.uint8),
        np.asarray(intensity, np.float32),
    )
