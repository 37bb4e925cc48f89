"""Cameras as a whole: lens, windshield, shutter and size.

Pixels have their origin at the corner of the image, centres at +0.5. Results that are not valid hold NaN.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim import geometry
from nurec_sim.compute.turns import rest
from nurec_sim.lenses.base import missing_members
from nurec_sim.sensors import windshield
from nurec_sim.types import CameraModel, Lens, Shutter, Windshield

ROLLING_ITERATIONS = 10
KEPT_PIXELS = 1 << 22
"""Rays of images up to this size are cached."""
PIXELS_AT_ONCE = 1 << 14
"""Pixels per strip: a few milliseconds of work, with temporaries that fit into the CPU caches."""

Points2 = Float64[np.ndarray, "n 2"]
Points3 = Float64[np.ndarray, "n 3"]
Mask = Bool[np.ndarray, " n"]


def project(camera: CameraModel, xyz_camera: Points3) -> tuple[Points2, Mask]:
    """Pixels of points in the camera frame.

    Returns:
        uv_px [n,2], and valid [n]: in front of the camera and inside the field where the lens is one-to-one. Pixels
        are not cut at the image border (see ``in_image``).
    """
    xyz = np.asarray(xyz_camera, np.float64).reshape(-1, 3)
    finite: Mask = np.asarray(np.isfinite(xyz).all(axis=1))
    # Lenses may assume finite input; the replaced points are marked invalid below.
    xyz = np.where(finite[:, None], xyz, 0.0)
    valid = finite
    if camera.windshield is not None:
        xyz, passed = windshield.into_car(camera.windshield, xyz)
        valid = valid & passed
    uv, seen = camera.lens.project(xyz)
    valid = valid & seen
    uv[~valid] = np.nan
    return uv, valid


def unproject(camera: CameraModel, uv_px: Points2) -> tuple[Points3, Mask]:
    """Unit rays, in the camera frame and outside of the windshield, of pixels; inverse of ``project``.

    Returns:
        ray_camera [n,3], and valid [n].
    """
    uv = np.asarray(uv_px, np.float64).reshape(-1, 2)
    finite: Mask = np.asarray(np.isfinite(uv).all(axis=1))
    rays, valid = camera.lens.unproject(np.where(finite[:, None], uv, 0.0))
    valid = valid & finite
    if camera.windshield is not None:
        rays, passed = windshield.out_of_car(camera.windshield, rays)
        valid = valid & passed
    rays[~valid] = np.nan
    return rays, valid


def pixel_rays(camera: CameraModel) -> tuple[Float64[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Unit rays through all pixel centres, and which are valid; read-only, cached for recent cameras of usual size."""
    make = _kept_pixel_rays if _is_usual(camera) else _pixel_rays
    return make(camera.lens, camera.windshield, camera.width_px, camera.height_px)


def pixel_ray_strips(
    camera: CameraModel,
) -> Iterator[tuple[slice, Float64[np.ndarray, "r w 3"], Bool[np.ndarray, "r w"]]]:
    """``pixel_rays`` in strips of rows, each with its row slice, for images too large for memory in double precision.

    Raises:
        CancelledError, DeadlinePassedError: see ``compute.turns.rest``.
    """
    if _is_usual(camera):
        yield slice(0, camera.height_px), *pixel_rays(camera)
    else:
        yield from _strips(camera)


def _is_usual(camera: CameraModel) -> bool:
    return camera.width_px * camera.height_px <= KEPT_PIXELS


def _strips(camera: CameraModel) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    width, height = camera.width_px, camera.height_px
    step = max(1, PIXELS_AT_ONCE // width)
    for first in range(0, height, step):
        rest()
        last = min(first + step, height)
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(first, last) + 0.5)
        strip, seen = unproject(camera, np.stack([columns, rows], axis=-1).reshape(-1, 2))
        yield slice(first, last), strip.reshape(-1, width, 3), seen.reshape(-1, width)


def _pixel_rays(lens: Lens, glass: Windshield | None, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    camera = CameraModel("", width, height, lens, np.eye(4), windshield=glass)
    rays, valid = np.empty((height, width, 3)), np.empty((height, width), bool)
    for place, strip, seen in _strips(camera):
        rays[place], valid[place] = strip, seen
    rays.setflags(write=False)
    valid.setflags(write=False)
    return rays, valid


_kept_pixel_rays = functools.lru_cache(maxsize=8)(_pixel_rays)


def in_image(camera: CameraModel, uv_px: Points2) -> Mask:
    """Which pixels lie inside the image."""
    uv = np.asarray(uv_px, np.float64)
    return np.all((uv >= 0) & (uv < (camera.width_px, camera.height_px)), axis=-1)


def shutter_fraction(camera: CameraModel, uv_px: Points2) -> Float64[np.ndarray, " n"]:
    """When within the exposure each pixel is taken: 0 at its start, 1 at its end; 0 everywhere if global.

    A whole row (or column) shares one instant: floor(v) / (height - 1) from top to bottom, mirrored or transposed for
    the other directions. Pixels outside the image count as those at its border.
    """
    uv = np.asarray(uv_px, np.float64)
    if camera.shutter is Shutter.GLOBAL:
        return np.zeros(len(uv))
    if camera.shutter in (Shutter.TOP_TO_BOTTOM, Shutter.BOTTOM_TO_TOP):
        line, count = uv[:, 1], camera.height_px
    else:
        line, count = uv[:, 0], camera.width_px
    index = np.clip(np.floor(np.nan_to_num(line)), 0, count - 1)
    fraction = index / max(count - 1, 1)
    if camera.shutter in (Shutter.BOTTOM_TO_TOP, Shutter.RIGHT_TO_LEFT):
        fraction = 1.0 - fraction
    return fraction


def project_rolling(
    camera: CameraModel, world_from_camera: Float64[np.ndarray, "2 4 4"], xyz_world: Points3
) -> tuple[Points2, Mask, Float64[np.ndarray, " n"]]:
    """Pixels of world points seen by a camera that moves during its exposure.

    Args:
        camera: the camera.
        world_from_camera: poses at the start and the end of the exposure.
        xyz_world: points [n,3].

    Returns:
        uv_px [n,2], valid [n], and the shutter fraction [n] at which each point is seen. The row that sees a point
        depends on the pose and the pose on the row: a fixed point, started from the start pose, or from the end pose
        for points that only that one sees.
    """
    points = np.asarray(xyz_world, np.float64).reshape(-1, 3)
    pair = np.asarray(world_from_camera, np.float64)
    camera_from_world = geometry.inverse(pair)
    uv, valid = project(camera, geometry.transform_points(camera_from_world[0], points))
    fraction = shutter_fraction(camera, uv)
    if camera.shutter is Shutter.GLOBAL or np.array_equal(pair[0], pair[1]):
        return uv, valid, fraction
    late, late_valid = project(camera, geometry.transform_points(camera_from_world[1], points))
    only_late = late_valid & ~valid
    # Start the fixed point where the point is visible at all.
    fraction[only_late] = shutter_fraction(camera, late[only_late])
    moving = np.flatnonzero(valid | late_valid)
    for _ in range(ROLLING_ITERATIONS):
        if len(moving) == 0:
            break
        poses = geometry.inverse(geometry.interpolate_pose_pair(pair, fraction[moving]))
        seen = np.einsum("nij,nj->ni", poses[:, :3, :3], points[moving]) + poses[:, :3, 3]
        uv[moving], valid[moving] = project(camera, seen)
        previous = fraction[moving]
        fraction[moving] = shutter_fraction(camera, uv[moving])
        # Fractions are quantised to rows, so the fixed point is reached exactly.
        moving = moving[valid[moving] & (fraction[moving] != previous)]
    return uv, valid, fraction


def scaled_camera(camera: CameraModel, width_px: int, height_px: int) -> CameraModel:
    """The same camera with another number of pixels over the same field of view.

    Raises:
        ValueError: a size is not positive.
    """
    if width_px < 1 or height_px < 1:
        raise ValueError(f"camera {camera.id!r}: an image needs at least 1 x 1 pixels, got {width_px} x {height_px}")
    if (width_px, height_px) == (camera.width_px, camera.height_px):
        return camera
    sx, sy = width_px / camera.width_px, height_px / camera.height_px
    return dataclasses.replace(camera, width_px=width_px, height_px=height_px, lens=camera.lens.scaled(sx, sy))


def check_camera(camera: CameraModel) -> None:
    """Check that a camera can be used.

    Raises:
        ValueError: what is wrong with it: size, pose, or what the lens's ``check`` refuses.
    """
    name = f"camera {camera.id!r}"
    if camera.width_px < 1 or camera.height_px < 1:
        raise ValueError(f"{name}: an image needs at least 1 x 1 pixels, got {camera.width_px} x {camera.height_px}")
    check_pose(f"{name}: rig_from_camera", camera.rig_from_camera)
    if missing := missing_members(type(camera.lens)):
        raise ValueError(f"{name}: the lens, a {type(camera.lens).__name__}, lacks {', '.join(missing)}")
    try:
        camera.lens.check()
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    if camera.windshield is not None:
        windshield.check_windshield(name, camera.windshield)


def check_pose(name: str, pose: np.ndarray) -> None:
    """Check that a matrix is a rigid transform.

    Raises:
        ValueError: it is not 4x4, not finite, or its 3x3 part is not a rotation.
    """
    matrix = np.asarray(pose, np.float64)
    if matrix.shape != (4, 4):
        raise ValueError(f"{name} must be 4 x 4, got {' x '.join(map(str, matrix.shape)) or 'a number'}")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{name} must be finite")
    # Huge values go first: their squares would overflow.
    if np.abs(matrix[:3, :3]).max() > 2 or not geometry.is_rotation(matrix[:3, :3]):
        raise ValueError(f"{name} has a 3 x 3 part that is not a rotation: {matrix[:3, :3].tolist()}")
    if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
        raise ValueError(f"{name} must end in the row 0 0 0 1, got {matrix[3].tolist()}")
