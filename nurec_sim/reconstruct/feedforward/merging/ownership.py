"""Which chunk owns a static Gaussian: the one whose cameras saw its place from nearest (paper section 3.4).

A Gaussian g of chunk i stays iff ``D_gi <= min_j D_gj + tolerance``. D_gi is the distance of its centre to the nearest
camera of chunk i that sees it, infinite where none does; a camera's position is the one at the end of its exposure.
"Sees" means that the lens, whatever its kind and its field of view, projects the point into the image, in the row that
is exposed just then; without occlusion and without a range limit.

This is the paper's rule. The release tests a pyramid through two corners of the image, which has no meaning for fields
of view of 180 degrees and more; it gives points outside of all pyramids a finite distance, smaller for their own chunk;
and it requires the own chunk to be nearest or second nearest. With infinite distances the first comes by itself:
what no chunk sees stays in its own, and what only others see is dropped.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from nurec_sim import geometry, sensors
from nurec_sim.compute.cores import usable_cores
from nurec_sim.reconstruct.feedforward.chunks import ChunkLayers, ContextImage
from nurec_sim.render.cpu.pack import morton_order
from nurec_sim.types import CameraModel, Lens, Shutter, Windshield

BLOCK = 8192
"""Neighbouring points that are handled together; a block passes over most images as a whole."""
GRID = 33
"""Pixels per axis, from border to border, at which the field of view of an image is measured."""
FIELD_MARGIN_RAD = 0.02
"""Widens the cone around a field of view, which was measured at a few pixels only."""

Progress = Callable[[float], None]
Points = Float32[np.ndarray, "n 3"] | Float64[np.ndarray, "n 3"]


def owned(
    chunks: Sequence[ChunkLayers], tolerance_m: float, progress: Progress = lambda fraction: None
) -> list[Bool[np.ndarray, " n"]]:
    """Which static Gaussians of each chunk stay when all chunks become one scene.

    Args:
        chunks: layers in the world, with the images that they come from.
        tolerance_m: how much farther than the nearest chunk an owner may be.
        progress: called with the fraction that is done.

    Returns:
        per chunk a mask [n] over its static Gaussians; all True for a single chunk.
    """
    masks = []
    total = max(1, sum(len(chunk.static) for chunk in chunks))
    done = 0
    for number, chunk in enumerate(chunks):
        others = [image for other, chunk_j in enumerate(chunks) if other != number for image in chunk_j.images]
        mean_m = chunk.static.mean_m
        if others and len(mean_m):
            own_m = nearest_view_m(chunk.images, mean_m)
            # Only who is nearer by more than the tolerance counts, so no other view needs to be looked at.
            # D_gi <= min_j D_gj + delta fails iff some other chunk has D_gj < D_gi - delta (paper, equation of section
            # 3.4).
            nearer_m = nearest_view_m(others, mean_m, own_m - tolerance_m)
            masks.append(~np.isfinite(nearer_m))
        else:
            masks.append(np.ones(len(mean_m), bool))
        done += len(mean_m)
        progress(done / total)
    return masks


def nearest_view_m(
    images: Sequence[ContextImage], points: Points, below_m: Float64[np.ndarray, " n"] | None = None
) -> Float64[np.ndarray, " n"]:
    """Distance of world points to the nearest camera centre (end of exposure) among the images that see them.

    Args:
        images: the images.
        points: points in the world [n,3], metres.
        below_m: only distances smaller than this are of interest, per point; all if None.

    Returns:
        metres [n], infinite where no image sees the point (from nearer than ``below_m``).
    """
    limit = np.full(len(points), np.inf) if below_m is None else np.asarray(below_m, np.float64)
    result = np.full(len(points), np.inf)
    if not images or not len(points):
        return result
    cones = _Cones.around(images)
    order = morton_order(points)
    # Morton order makes blocks compact, so that one cone test excludes an image for thousands of points.
    blocks = [order[first : first + BLOCK] for first in range(0, len(order), BLOCK)]

    def search(rows: np.ndarray) -> None:
        result[rows] = _nearest_of_block(images, cones, np.asarray(points[rows], np.float64), limit[rows])

    with ThreadPoolExecutor(usable_cores()) as pool:
        list(pool.map(search, blocks))
    return result


def sees(image: ContextImage, points: Points) -> Bool[np.ndarray, " n"]:
    """Which world points [n,3] an image shows, were nothing in the way; see ``sensors.project_rolling``."""
    camera, (start, end) = image.camera, image.world_from_camera
    early = _shown(camera, start, points)
    if camera.shutter is Shutter.GLOBAL or np.array_equal(start, end):
        return early
    # A point in the image at both ends of the exposure is met by the moving row in between. Only for points that cross
    # the border of the image does it matter when their row is exposed.
    late = _shown(camera, end, points)
    seen = early & late
    crossing = np.flatnonzero(early != late)
    uv_px, valid, _ = sensors.project_rolling(camera, image.world_from_camera, points[crossing])
    seen[crossing] = valid & sensors.in_image(camera, uv_px)
    return seen


def _shown(camera: CameraModel, world_from_camera: Float64[np.ndarray, "4 4"], points: Points) -> np.ndarray:
    """Which points lie in the image of a camera at rest."""
    uv_px, valid = sensors.project(camera, geometry.transform_points(geometry.inverse(world_from_camera), points))
    return valid & sensors.in_image(camera, uv_px)


@dataclass(frozen=True, eq=False)
class _Cones:
    """Cones that hold all that images may see, as cheap first tests.

    ``slack_m`` is how far a camera moves during its exposure; ``cosine`` is that of the half angle, which includes how
    far it turns.
    """

    centre: Float64[np.ndarray, "k 3"]
    axis: Float64[np.ndarray, "k 3"]
    cosine: Float64[np.ndarray, " k"]
    slack_m: Float64[np.ndarray, " k"]

    @classmethod
    def around(cls, images: Sequence[ContextImage]) -> _Cones:
        poses = np.stack([image.world_from_camera for image in images])
        axis = poses[:, :, :3, 2]
        turn = np.arccos(np.clip(np.sum(axis[:, 0] * axis[:, 1], axis=1), -1, 1))
        cameras = [image.camera for image in images]
        field = np.array([_half_field_rad(c.lens, c.windshield, c.width_px, c.height_px) for c in cameras])
        return cls(
            centre=poses[:, 1, :3, 3],
            axis=axis[:, 1],
            cosine=np.cos(np.minimum(field + turn, np.pi)),
            slack_m=np.linalg.norm(poses[:, 1, :3, 3] - poses[:, 0, :3, 3], axis=1),
        )


@functools.lru_cache(maxsize=64)
def _half_field_rad(lens: Lens, glass: Windshield | None, width: int, height: int) -> float:
    """An angle off the optical axis beyond which an image shows nothing."""
    columns, rows = np.meshgrid(np.linspace(0, width, GRID), np.linspace(0, height, GRID))
    camera = CameraModel("", width, height, lens, np.eye(4), windshield=glass)
    rays, valid = sensors.unproject(camera, np.stack([columns, rows], axis=-1).reshape(-1, 2))
    if valid.all():
        return float(np.arccos(np.clip(rays[:, 2].min(), -1, 1))) + FIELD_MARGIN_RAD
    # The lens ends inside the image: between two pixels of the grid.
    return lens.max_angle_rad + FIELD_MARGIN_RAD if glass is None else np.pi


def _nearest_of_block(
    images: Sequence[ContextImage],
    cones: _Cones,
    points: Float64[np.ndarray, "n 3"],
    below_m: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, " n"]:
    """``nearest_view_m`` of a few points that are near each other."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = float(np.linalg.norm(points - middle, axis=1).max())
    offset = middle - cones.centre
    gap = np.linalg.norm(offset, axis=1)
    # Whatever a point of the block does to these two sides, it does it by less than the radius.
    ahead = np.sum(offset * cones.axis, axis=1) + radius
    possible = ahead >= cones.cosine * gap - 2 * cones.slack_m - radius
    least = gap - radius
    best, found = below_m.copy(), np.full(len(points), np.inf)
    for k in np.flatnonzero(possible)[np.argsort(gap[possible], kind="stable")]:
        if least[k] >= best.max():
            break
        towards = points - cones.centre[k]
        distance = np.sqrt(np.einsum("nc,nc->n", towards, towards))
        near = distance < best
        near &= towards @ cones.axis[k] >= cones.cosine[k] * distance - 2 * cones.slack_m[k]
        rows = np.flatnonzero(near)
        rows = rows[sees(images[k], points[rows])] if len(rows) else rows
        best[rows] = found[rows] = distance[rows]
    return found
