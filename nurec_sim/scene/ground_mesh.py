"""The ground as a triangle mesh: a height grid from the road Gaussians, completed under the recorded path.

AlpaSim's physics places cars on ``mesh_ground.ply``. It has one height per cell: at bridges the level nearest to the
recorded path.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32

from nurec_sim.types import GaussianScene, Label

CELL_M = 0.5
REACH_M = 150.0  # maximum distance from the recorded path
LEVEL_M = (
    4.0  # points that differ in height from the path by more than this plus 15 % of their distance are on another level
)
CORRIDOR_M = 3.0  # half width of the guaranteed ground strip along the path
HOLE_CELLS = 8  # holes up to this many cells away from a known height are filled
MAX_CELLS = 4_000_000


@dataclass(frozen=True)
class Mesh:
    """Triangles, counter-clockwise from above."""

    vertices_m: Float64[np.ndarray, "v 3"]
    triangles: Int32[np.ndarray, "t 3"]


def ground_mesh(scene: GaussianScene) -> Mesh:
    """The ground of a scene, in the world; at least the corridor under the recorded path."""
    path = _path_points(scene)
    road = _near_path(scene.static.mean_m[scene.static.label == Label.ROAD].astype(np.float64), path)
    strip = _corridor(scene, path)
    everything = np.concatenate([road, strip])
    low = np.floor(everything[:, :2].min(axis=0) / CELL_M) * CELL_M - CELL_M
    extent = everything[:, :2].max(axis=0) - low + 2 * CELL_M
    # Coarser cells bound the memory of very long drives.
    cell_m = max(CELL_M, float(np.sqrt(extent.prod() / MAX_CELLS)))
    shape = int(np.ceil(extent[0] / cell_m)), int(np.ceil(extent[1] / cell_m))
    height = _cell_medians(road, low, cell_m, shape)
    under_path = _cell_medians(strip, low, cell_m, shape)
    height = _fill_holes(height)
    height = np.where(np.isnan(height), under_path, height)
    return _triangulate(height, low, cell_m)


def _path_points(scene: GaussianScene) -> Float64[np.ndarray, "p 3"]:
    """Ground points under the rig, at most a quarter of a cell apart."""
    knots = scene.ego.position_m
    steps = np.linalg.norm(np.diff(knots, axis=0), axis=1)
    counts = np.maximum(1, np.ceil(steps / (CELL_M / 2)).astype(int))
    pieces = [knots[:1]]
    for start, end, count in zip(knots[:-1], knots[1:], counts, strict=True):
        pieces.append(start + (end - start) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(pieces)


def _near_path(points: Float64[np.ndarray, "n 3"], path: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "k 3"]:
    """Points within reach of the path and on its level."""
    from scipy.spatial import KDTree

    if len(points) == 0:
        return points
    distance, nearest = KDTree(path[:, :2]).query(points[:, :2], distance_upper_bound=REACH_M)
    inside = np.isfinite(distance)
    points, distance, nearest = points[inside], distance[inside], nearest[inside]
    return points[np.abs(points[:, 2] - path[nearest, 2]) <= LEVEL_M + 0.15 * distance]


def _corridor(scene: GaussianScene, path: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "c 3"]:
    """A strip of ground points along the path and around its ends, tilted like the rig."""
    first, last = scene.ego.world_from_body[[0, -1]]
    offsets = np.arange(-CORRIDOR_M, CORRIDOR_M + CELL_M / 4, CELL_M / 2)
    heading = np.gradient(path[:, :2], axis=0) if len(path) > 1 else np.zeros((1, 2))
    length = np.linalg.norm(heading, axis=1, keepdims=True)
    # A standing car has no direction of motion; its x axis is used.
    heading = np.where(length > 1e-6, heading / np.maximum(length, 1e-6), first[:2, 0])
    left = np.column_stack([-heading[:, 1], heading[:, 0], np.zeros(len(path))])
    strip = (path[:, None] + offsets[None, :, None] * left[:, None]).reshape(-1, 3)
    x, y = np.meshgrid(offsets, offsets)
    patch = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    ends = [patch @ pose[:3, :3].T + pose[:3, 3] for pose in (first, last)]
    return np.concatenate([strip, *ends])


def _cell_medians(
    points: Float64[np.ndarray, "n 3"], low: Float64[np.ndarray, " 2"], cell_m: float, shape: tuple[int, int]
) -> Float64[np.ndarray, "nx ny"]:
    """Median height of the points in every cell, NaN where there is none."""
    height = np.full(shape, np.nan)
    if len(points) == 0:
        return height
    cell = np.floor((points[:, :2] - low) / cell_m).astype(np.int64)
    flat = np.ravel_multi_index((cell[:, 0], cell[:, 1]), shape)
    # Sorted by cell, then height: each cell's median is the mean of the one or two middle entries.
    order = np.lexsort((points[:, 2], flat))
    cells, start, count = np.unique(flat[order], return_index=True, return_counts=True)
    z = points[order, 2]
    height.ravel()[cells] = (z[start + (count - 1) // 2] + z[start + count // 2]) / 2
    return height


def _fill_holes(height: Float64[np.ndarray, "nx ny"]) -> Float64[np.ndarray, "nx ny"]:
    """Fills cells enclosed by known ones (morphological closing) with smoothly extrapolated heights."""
    from scipy import ndimage

    known: Bool[np.ndarray, "nx ny"] = ~np.isnan(height)
    if not known.any():
        return height
    # Padding keeps the erosion from eating into the grid's border.
    padded = np.pad(known, HOLE_CELLS)
    closed = ndimage.binary_closing(padded, iterations=HOLE_CELLS)[HOLE_CELLS:-HOLE_CELLS, HOLE_CELLS:-HOLE_CELLS]
    filled = np.where(known, height, 0.0)
    # Normalised convolution: a mean of the known heights weighted by nearness.
    weight = ndimage.gaussian_filter(known.astype(np.float64), HOLE_CELLS / 2)
    mean = ndimage.gaussian_filter(filled, HOLE_CELLS / 2) / np.maximum(weight, 1e-12)
    return np.where(known, height, np.where(closed & (weight > 1e-6), mean, np.nan))


def _triangulate(height: Float64[np.ndarray, "nx ny"], low: Float64[np.ndarray, " 2"], cell_m: float) -> Mesh:
    """Two triangles per known cell; a vertex takes the mean height of the known cells around it."""
    known = ~np.isnan(height)
    total = np.zeros((height.shape[0] + 1, height.shape[1] + 1))
    count = np.zeros_like(total)
    for dx in (0, 1):
        for dy in (0, 1):
            total[dx : dx + height.shape[0], dy : dy + height.shape[1]] += np.where(known, height, 0)
            count[dx : dx + height.shape[0], dy : dy + height.shape[1]] += known
    number = np.cumsum(count > 0).reshape(count.shape) - 1
    x, y = np.nonzero(count > 0)
    vertices = np.column_stack([low[0] + x * cell_m, low[1] + y * cell_m, total[x, y] / count[x, y]])
    i, j = np.nonzero(known)
    a, b, c, d = number[i, j], number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])]).astype(np.int32)
    return Mesh(vertices, triangles)


def encode_ply(mesh: Mesh) -> bytes:
    """A binary little-endian PLY of float vertices and triangles."""
    faces = np.empty(len(mesh.triangles), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, mesh.triangles
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment world frame, metres, z up\n"
        f"element vertex {len(mesh.vertices_m)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    vertices: Float32[np.ndarray, "v 3"] = mesh.vertices_m.astype("<f4")
    return header.encode("ascii") + vertices.tobytes() + faces.tobytes()
