"""Working views: camera frames resampled to plain pinhole pictures of modest size, with pose and shutter drift.

All kernels of the reconstruction then know one lens only. A frame's pose is the one at mid exposure; what the camera
moves during the exposure is kept as ``drift_m``, scaled by a shutter fraction that is linear in the pixel.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.compute.cores import in_order
from nurec_sim.reconstruct.lift.settings import ViewSettings
from nurec_sim.types import CameraModel, Clip, Shutter

BORDER, LEAST_WEIGHT = 0.2, 0.4
"""Part of an image's shorter side over which ``border_weight`` falls, and the weight at its border."""
LEAST_SKY_WEIGHT = 0.02
"""The same in the sky, where an edge shows most."""
STEEPEST = 1.4
"""Tiles end at this height above and below their middle, per metre of depth: at 54 degrees."""


@dataclass(frozen=True, eq=False)
class Tile:
    """A pinhole window into a camera: its size and matrix, how it is turned, and where its pixels lie in the image."""

    width: int
    height: int
    focal_px: float
    center_px: tuple[float, float]
    camera_from_tile: Float64[np.ndarray, "3 3"]
    reduction: int
    maps: tuple[np.ndarray, np.ndarray] | None
    valid: Bool[np.ndarray, "h w"]
    fraction: Float64[np.ndarray, " 3"]


@dataclass(frozen=True, eq=False)
class WorkingView:
    """One frame through one tile. ``rgb`` is display colour; pixels of ``key`` views are lifted."""

    camera_id: str
    frame: int
    t_us: int
    key: bool
    tile: Tile
    world_from_view: Float64[np.ndarray, "4 4"]
    drift_m: Float64[np.ndarray, " 3"]
    rgb: UInt8[np.ndarray, "h w 3"]

    @property
    def packed(self) -> Float64[np.ndarray, " 23"]:
        """Everything a kernel needs to project: f, cx, cy, w, h, view_from_world (12), drift (3), fraction (3)."""
        matrix = geometry.inverse(self.world_from_view)
        return self.packed_from(matrix)

    def packed_from(self, view_from_body: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, " 23"]:
        """As ``packed`` for points given in the frame of a body."""
        tile = self.tile
        return np.concatenate(
            [
                [tile.focal_px, *tile.center_px, tile.width, tile.height],
                view_from_body[:3, :3].ravel(),
                view_from_body[:3, 3],
                self.drift_m,
                tile.fraction,
            ]
        )


def tiles_of(camera: CameraModel, settings: ViewSettings) -> list[Tile]:
    """Cut a camera into pinhole tiles of at most ``max_field_deg``; one exact reduction if it is a plain pinhole."""
    reduction = settings.reduction_of(camera.width_px)
    lens = camera.ideal_pinhole
    if lens is not None and _square(camera):
        width, height = camera.width_px // reduction, camera.height_px // reduction
        center = (lens.cx_px / reduction, lens.cy_px / reduction)
        valid = np.ones((height, width), bool)
        tile = Tile(width, height, lens.fx_px / reduction, center, np.eye(3), reduction, None, valid, np.zeros(3))
        return [_with_fraction(tile, camera)]
    return [_resampled_tile(camera, reduction, *window) for window in _windows(camera, reduction, settings)]


def _windows(camera: CameraModel, reduction: int, settings: ViewSettings) -> list[tuple]:
    """Focal length, middle, size in pixels, and turn of the tiles of a camera that is no plain pinhole."""
    rays = _some_rays(camera)
    azimuth = np.arctan2(rays[:, 0], rays[:, 2])
    (left, right), count = _field(rays), tile_count(camera, settings)
    focal = _pixels_per_radian(camera) / reduction
    windows = []
    for k in range(count):
        a, b = left + (right - left) * k / count, left + (right - left) * (k + 1) / count
        half = np.tan((b - a) / 2 + 0.01)
        width = int(np.ceil(2 * half * focal))
        turn = np.array(
            [[np.cos((a + b) / 2), 0, np.sin((a + b) / 2)], [0, 1, 0], [-np.sin((a + b) / 2), 0, np.cos((a + b) / 2)]]
        )
        # Rows of a plane rise towards its sides, as seen from its middle.
        mine = rays[(azimuth > a) & (azimuth < b)] @ turn
        up, down = np.clip(np.percentile(mine[:, 1] / mine[:, 2], [0.1, 99.9]), -STEEPEST, STEEPEST)
        height = int(np.ceil((down - up) * focal))
        windows.append((focal, (width / 2, float(-up * focal)), (width, height), turn))
    return windows


def tile_count(camera: CameraModel, settings: ViewSettings) -> int:
    """Number of tiles that a camera is cut into."""
    if _square(camera):
        return 1
    left, right = _field(_some_rays(camera))
    return int(np.ceil((right - left) / np.radians(settings.max_field_deg)))


def _square(camera: CameraModel) -> bool:
    """Whether a camera is a plain pinhole with square pixels."""
    lens = camera.ideal_pinhole
    return lens is not None and abs(lens.fx_px - lens.fy_px) < 1e-3 * lens.fx_px


def _some_rays(camera: CameraModel) -> Float64[np.ndarray, "n 3"]:
    """Rays of every eighth pixel in both directions."""
    rays, seen = sensors.pixel_rays(sensors.scaled_camera(camera, camera.width_px // 8, camera.height_px // 8))
    return np.asarray(rays[seen])


def _field(rays: Float64[np.ndarray, "n 3"]) -> tuple[float, float]:
    """Azimuths of the left and the right end of a field of view, radians to the right."""
    left, right = np.percentile(np.arctan2(rays[:, 0], rays[:, 2]), [0.5, 99.5])
    return float(left), float(right)


def border_weight(height: int, width: int, least: float = LEAST_WEIGHT) -> Float32[np.ndarray, "h w"]:
    """1 in the middle of an image, less at its border.

    Where images of several cameras end on each other, their different vignettes would leave an edge.

    Args:
        height: of the image, in pixels.
        width: the same.
        least: the weight at the border.
    """
    rows, columns = (np.minimum(np.arange(n) + 0.5, n - np.arange(n) - 0.5) for n in (height, width))
    inside = np.minimum(rows[:, None], columns) / (BORDER * min(height, width))
    return np.clip(inside, least, 1).astype(np.float32)


def without_pixels(tile: Tile, mask: Bool[np.ndarray, "h w"]) -> Tile:
    """The tile without the pixels of a mask of the camera's size."""
    masked = _resample(mask.astype(np.uint8) * 255, tile)
    return dataclasses.replace(tile, valid=tile.valid & (masked == 0))


def _pixels_per_radian(camera: CameraModel) -> float:
    middle = np.array(
        [[camera.width_px / 2 - 8, camera.height_px / 2], [camera.width_px / 2 + 8, camera.height_px / 2]]
    )
    rays, _ = sensors.unproject(camera, middle)
    return 16.0 / float(np.arccos(np.clip(rays[0] @ rays[1], -1, 1)))


def _resampled_tile(
    camera: CameraModel,
    reduction: int,
    focal: float,
    center: tuple[float, float],
    size: tuple[int, int],
    camera_from_tile: np.ndarray,
) -> Tile:
    width, height = size
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(u - center[0]) / focal, (v - center[1]) / focal, np.ones_like(u)], axis=-1).reshape(-1, 3)
    uv, seen = sensors.project(camera, rays @ camera_from_tile.T)
    seen &= sensors.in_image(camera, uv)
    # cv2 counts pixel centres from 0, the lenses from 0.5.
    uv = np.where(seen[:, None], uv, -1e4) / reduction - 0.5
    maps = uv[:, 0].reshape(height, width).astype(np.float32), uv[:, 1].reshape(height, width).astype(np.float32)
    tile = Tile(
        width, height, focal, center, camera_from_tile, reduction, maps, seen.reshape(height, width), np.zeros(3)
    )
    return _with_fraction(tile, camera)


def _with_fraction(tile: Tile, camera: CameraModel) -> Tile:
    """Fit the shutter fraction, less a half, as a linear function of the tile's pixel."""
    if camera.shutter is Shutter.GLOBAL:
        return tile
    v, u = (a.ravel() + 0.5 for a in np.mgrid[0 : tile.height : 8, 0 : tile.width : 8])
    rays = np.column_stack(
        [(u - tile.center_px[0]) / tile.focal_px, (v - tile.center_px[1]) / tile.focal_px, u * 0 + 1]
    )
    uv, seen = sensors.project(camera, rays @ tile.camera_from_tile.T)
    seen &= sensors.in_image(camera, uv)
    target = sensors.shutter_fraction(camera, uv[seen]) - 0.5
    basis = np.column_stack([u, v, np.ones_like(u)])[seen]
    # Linear in the pixel is enough for kernels: exact for a pinhole tile along its rows, close to it for turned tiles.
    solution = np.linalg.lstsq(basis, target, rcond=None)[0]
    return dataclasses.replace(tile, fraction=solution)


def choose_frames(
    clip: Clip, cameras: Sequence[str], tiles: int, settings: ViewSettings
) -> list[tuple[str, int, bool]]:
    """(camera, frame, whether it is a key frame) in order of time, thinned evenly to the limits of the settings.

    The last frame of a camera is a key frame as the first is: what passes the car then, no other one shows.

    Args:
        clip: the driving log.
        cameras: ids of the cameras.
        tiles: number of tiles of all cameras together; every frame gives one view per tile.
        settings: ``max_frames`` and ``max_views``.
    """
    counts = {camera: len(clip.camera_times_us(camera)) for camera in cameras}
    total = sum(counts.values()) * tiles / max(len(cameras), 1)
    skip = max(1, int(np.ceil(total / settings.max_frames)))
    step = max(1, int(np.ceil(total / skip / settings.max_views)))
    chosen = []
    for camera in cameras:
        frames = range(0, counts[camera], skip)
        keys = set(np.round(np.linspace(0, len(frames) - 1, -(-len(frames) // step))).astype(int).tolist())
        chosen += [(camera, frame, number in keys) for number, frame in enumerate(frames)]
    return sorted(chosen, key=lambda row: (int(clip.camera_times_us(row[0])[row[1]].sum()), row))


def key_frames(clip: Clip, cameras: Sequence[str], settings: ViewSettings) -> list[tuple[str, int]]:
    """(camera, frame) of the key frames that ``read_views`` reads, in order of time."""
    tiles = sum(tile_count(clip.rig.cameras[camera], settings) for camera in cameras)
    return [(camera, frame) for camera, frame, key in choose_frames(clip, cameras, tiles, settings) if key]


def key_pixels(clip: Clip, cameras: Sequence[str], settings: ViewSettings) -> int:
    """Number of pixels of all key views together."""
    each = {camera: _tile_pixels(clip.rig.cameras[camera], settings) for camera in cameras}
    return sum(each[camera] for camera, _ in key_frames(clip, cameras, settings))


def _tile_pixels(camera: CameraModel, settings: ViewSettings) -> int:
    """Number of pixels of the tiles of a camera."""
    reduction = settings.reduction_of(camera.width_px)
    if _square(camera):
        return (camera.width_px // reduction) * (camera.height_px // reduction)
    return sum(width * height for _, _, (width, height), _ in _windows(camera, reduction, settings))


def read_views(
    clip: Clip,
    cameras: Sequence[str],
    ego_images: Mapping[str, UInt8[np.ndarray, "h w 4"]],
    settings: ViewSettings,
    progress: Callable[[float], None] = lambda fraction: None,
) -> list[WorkingView]:
    """Read and resample the chosen frames of the cameras.

    Args:
        clip: the driving log.
        cameras: ids of the cameras.
        ego_images: what cameras see of the ego vehicle; these pixels are not valid.
        settings: size of the views and how many.
        progress: called with the fraction of the frames that is read.
    """
    tiles = {}
    for camera in cameras:
        model = clip.rig.cameras[camera]
        ego = ego_images.get(camera)
        tiles[camera] = [
            tile if ego is None else without_pixels(tile, ego[..., 3] > 0) for tile in tiles_of(model, settings)
        ]
    frames = choose_frames(clip, cameras, sum(map(len, tiles.values())), settings)

    def read(chosen: tuple[str, int, bool]) -> list[WorkingView]:
        camera, frame, key = chosen
        image = clip.image(camera, frame)
        start_us, end_us = (int(t) for t in clip.camera_times_us(camera)[frame])
        pair = np.asarray(clip.world_from_camera(camera, frame), np.float64)
        world_from_camera = geometry.interpolate_pose_pair(pair, np.array(0.5))
        # Rotation during the exposure is neglected: kernels know one pose per view and a shift.
        travel = world_from_camera[:3, :3].T @ (pair[1, :3, 3] - pair[0, :3, 3])
        views = []
        for tile in tiles[camera]:
            pose = world_from_camera @ geometry.pose(tile.camera_from_tile, np.zeros(3))
            rgb = _resample(image, tile)
            drift = tile.camera_from_tile.T @ travel if tile.fraction.any() else np.zeros(3)
            views.append(WorkingView(camera, frame, (start_us + end_us) // 2, key, tile, pose, drift, rgb))
        return views

    views = []
    for done, found in enumerate(in_order(read, frames)):
        progress(done / len(frames))
        views += found
    return views


def _resample(image: UInt8[np.ndarray, "h w *c"], tile: Tile) -> UInt8[np.ndarray, "h w *c"]:
    k = tile.reduction
    height, width = image.shape[0] // k, image.shape[1] // k
    small = cv2.resize(image[: height * k, : width * k], (width, height), interpolation=cv2.INTER_AREA)
    if tile.maps is None:
        return small
    return cv2.remap(small, *tile.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
