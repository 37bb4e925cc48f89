"""Regions of a recorded image defined by the log alone, hence the same for every reconstruction.

Actors are the outlines of labelled boxes of movable objects. Range is known around the points of the sweep nearest in
time.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim import geometry, sensors
from nurec_sim.types import MOVABLE_LABELS, CameraModel, Clip, SensorRequest

RANGES_M = (0.0, 10.0, 20.0, 40.0, 80.0)
"""Borders of the range bins."""
NEAREST_SWEEP_US = 100_000
"""Maximum time between an image and a sweep."""
AROUND_PX = 2
"""Neighbourhood of a LiDAR point, in pixels, that counts as at its range."""
HIDDEN = 1.15
"""A point farther by this factor than another within ``CELL_PX`` is visible to the LiDAR but occluded in the camera."""
CELL_PX = 12
FARTHEST_PX = 1 << 20
"""Corners of outlines end so far outside of an image."""


def range_name(index: int) -> str:
    """Name of a bin of ``RANGES_M``."""
    return f"{RANGES_M[index]:g}-{RANGES_M[index + 1]:g} m"


@dataclass(frozen=True)
class SeenPoints:
    """LiDAR points in an image: pixel (column, row) and range bin."""

    pixel: Int64[np.ndarray, "n 2"]
    bin: Int64[np.ndarray, " n"]


def actor_mask(clip: Clip, request: SensorRequest, size_px: tuple[int, int] | None = None) -> Bool[np.ndarray, "h w"]:
    """Pixels inside the outlines of labelled boxes of movable objects.

    ``size_px`` is the width and height of the mask; the camera's own if None.
    """
    camera = _camera(request)
    width, height = size_px or (camera.width_px, camera.height_px)
    mask = np.zeros((height, width), np.uint8)
    for track in clip.tracks:
        if track.label not in MOVABLE_LABELS or not track.path.covers(request.start_us):
            continue
        corners = geometry.transform_points(
            track.path.at(request.start_us), geometry.BOX_CORNERS * np.asarray(track.size_m)
        )
        uv, valid, _ = sensors.project_rolling(camera, request.world_from_sensor, corners)
        # A box with a corner behind the camera or outside the lens's valid field has no convex image outline.
        if valid.all():
            # Polynomials of lenses reach any pixel for rays far outside of the image.
            corners_px = np.clip(uv * (width / camera.width_px, height / camera.height_px), -FARTHEST_PX, FARTHEST_PX)
            cv2.fillConvexPoly(mask, cv2.convexHull(corners_px.astype(np.int32)), 1)
    return mask.astype(bool)


def seen_points(clip: Clip, request: SensorRequest) -> SeenPoints:
    """Points of the nearest sweeps visible in the camera: not occluded, and not on movable objects."""
    camera = _camera(request)
    clouds = [cloud for lidar in clip.rig.lidars if (cloud := _nearest_cloud(clip, lidar, request)) is not None]
    xyz = np.concatenate(clouds) if clouds else np.zeros((0, 3))
    uv, valid, _ = sensors.project_rolling(camera, request.world_from_sensor, xyz)
    valid &= sensors.in_image(camera, uv)
    pixel = np.floor(uv[valid]).astype(np.int64)
    distance = np.linalg.norm(xyz[valid] - request.world_from_sensor[0, :3, 3], axis=1)
    keep = (distance < RANGES_M[-1]) & ~_hidden(pixel, distance, camera)
    if len(pixel):
        keep &= ~actor_mask(clip, request)[pixel[:, 1], pixel[:, 0]]
    return SeenPoints(pixel[keep], np.digitize(distance[keep], RANGES_M) - 1)


def _camera(request: SensorRequest) -> CameraModel:
    assert isinstance(request.sensor, CameraModel)
    return request.sensor


def _nearest_cloud(clip: Clip, lidar: str, request: SensorRequest) -> Float64[np.ndarray, "n 3"] | None:
    middle = clip.sweep_times_us(lidar).sum(axis=1) // 2
    gap = np.abs(middle - request.middle_us)
    if not len(gap) or gap.min() > NEAREST_SWEEP_US:
        return None
    return clip.sweep(lidar, int(gap.argmin())).xyz_world_m


def _hidden(
    pixel: Int64[np.ndarray, "n 2"], distance_m: Float64[np.ndarray, " n"], camera: CameraModel
) -> Bool[np.ndarray, " n"]:
    """Points occluded in the camera: with a baseline between the sensors, beams pass beside the occluder."""
    nearest = np.full((camera.height_px // CELL_PX + 1, camera.width_px // CELL_PX + 1), np.inf)
    cell = pixel // CELL_PX
    np.minimum.at(nearest, (cell[:, 1], cell[:, 0]), distance_m)
    return distance_m > HIDDEN * nearest[cell[:, 1], cell[:, 0]]
