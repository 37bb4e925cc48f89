"""Rays of every pixel of a context image, and the pinhole that represents its camera in the encoder."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64
from scipy import ndimage

from nurec_sim import geometry, sensors
from nurec_sim.errors import ReconstructError
from nurec_sim.types import CameraModel, Shutter

SMALLEST_RAY_Z = 0.05
"""Pixels more than 87 degrees off the axis have no useful z-depth."""
WIDEST_HALF_FIELD_RAD = np.radians(80.0)
"""A pinhole approximates wider cameras badly, and 90 degrees not at all."""


def camera_rays(camera: CameraModel) -> tuple[Float64[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Unit rays in the camera frame, and which pixels see the world in front of the camera.

    The others (outside of the lens's field, or looking sideways) take the ray of the nearest pixel that does, so that
    what the network is given is finite everywhere.

    Raises:
        ReconstructError: no pixel sees anything.
    """
    rays, valid = sensors.pixel_rays(camera)
    usable = valid & (np.nan_to_num(rays[..., 2]) >= SMALLEST_RAY_Z)
    if usable.all():
        return rays, usable
    if not usable.any():
        raise ReconstructError(f"camera {camera.id!r}: its lens sees nothing in front of the camera")
    rows, columns = ndimage.distance_transform_edt(~usable, return_distances=False, return_indices=True)
    return rays[rows, columns], usable


def scene_rays(
    camera: CameraModel, rays: Float64[np.ndarray, "h w 3"], scene_from_camera: Float64[np.ndarray, "2 4 4"]
) -> Float64[np.ndarray, "h w 6"]:
    """Origin and unit direction of every pixel in the scene frame, at the instant when its line was exposed.

    Args:
        camera: the cropped camera.
        rays: its ``camera_rays``.
        scene_from_camera: poses when its first and its last line were exposed.
    """
    by_columns = camera.shutter in (Shutter.LEFT_TO_RIGHT, Shutter.RIGHT_TO_LEFT)
    if by_columns:
        rays = rays.swapaxes(0, 1)
    # The exposure time depends on the line only: one pose per line instead of one per pixel.
    lines = np.arange(len(rays)) + 0.5
    fractions = sensors.shutter_fraction(camera, np.stack([lines, lines], axis=1))
    poses = geometry.interpolate_pose_pair(scene_from_camera, fractions)  # [lines, 4, 4]
    directions = rays @ poses[:, :3, :3].swapaxes(1, 2)
    origins = np.broadcast_to(poses[:, None, :3, 3], rays.shape)
    result = np.concatenate([origins, directions], axis=-1)
    return result.swapaxes(0, 1) if by_columns else result


def pinhole_field_rad(camera: CameraModel) -> tuple[float, float]:
    """Horizontal and vertical field of view of a pinhole like the camera.

    Its focal length puts the nearer of the two image edges, seen along the row of the principal point, at the angle at
    which the lens sees it; the vertical field follows from the same focal length.
    """
    width, height = camera.width_px, camera.height_px
    u = np.linspace(0, width, width + 1)
    row, valid = sensors.unproject(camera, np.stack([u, np.full_like(u, camera.lens.cy_px)], axis=1))
    if not valid.any():
        raise ReconstructError(f"camera {camera.id!r}: its lens sees nothing along the row of its principal point")
    # Where the lens does not reach the edge, its last ray is used instead.
    angle = np.arctan2(row[valid, 0], row[valid, 2])
    half = float(np.clip(min(-angle[0], angle[-1]), 0.01, WIDEST_HALF_FIELD_RAD))
    focal_px = width / 2 / np.tan(half)
    return 2 * half, 2 * float(np.arctan(height / 2 / focal_px))
