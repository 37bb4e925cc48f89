"""The ray grid of any sensor: one unit ray, one firing time and one validity per pixel or beam; float64 NumPy.

A camera's grid has a ray per pixel centre; a spinning LiDAR's has rows of beams by columns of firings. From there
on, a renderer treats both alike.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim import geometry, sensors
from nurec_sim.types import CameraModel, LidarModel, Matrix4, SensorRequest, Shutter

NEAR_M = 0.2
"""Gaussians whose centre lies closer than this, and closer hits, are not rendered (LiDARs: their own minimal range)."""


@dataclass(frozen=True, eq=False)
class RayGrid:
    """Rays of a sensor in its own frame; a camera's that are not valid point along z.

    ``fraction`` is the place of each ray's instant in the exposure, 0 at its start and 1 at its end; ``reference``
    the fraction at which Gaussians are sorted, culled and, where they move, placed: the middle, or the one instant of
    all rays (a global shutter, a LiDAR of one column). ``by_range`` is whether Gaussians are ordered by the distance
    of their centre (LiDARs, and lenses that see sideways) or by its z (``Lens.perspective``).
    """

    direction: Float64[np.ndarray, "h w 3"]
    valid: Bool[np.ndarray, "h w"]
    fraction: Float64[np.ndarray, "h w"]
    reference: float
    by_range: bool
    near_m: float


def ray_grid(sensor: CameraModel | LidarModel) -> RayGrid:
    """The rays of a camera (pixel centres) or a LiDAR (rows x columns of beams)."""
    if isinstance(sensor, LidarModel):
        direction = np.asarray(sensors.beam_directions(sensor), np.float64)
        fraction = np.broadcast_to(sensors.column_fraction(sensor), direction.shape[:2])
        valid = ~sensors.blocked_beams(sensor)
        return RayGrid(direction, valid, fraction, reference_fraction(fraction), True, max(NEAR_M, sensor.range_m[0]))
    direction, valid = sensors.pixel_rays(sensor)
    shared, by_column = line_fractions(sensor)
    fraction = np.broadcast_to(shared if by_column else shared[:, None], valid.shape)
    direction = np.where(valid[..., None], direction, (0.0, 0.0, 1.0))
    by_range = not sensor.lens.perspective
    return RayGrid(direction, valid, fraction, reference_fraction(shared), by_range, NEAR_M)


def line_fractions(camera: CameraModel) -> tuple[Float64[np.ndarray, " lines"], bool]:
    """When within the exposure each row, or each column, is taken, and whether it is columns."""
    by_column = camera.shutter in (Shutter.LEFT_TO_RIGHT, Shutter.RIGHT_TO_LEFT)
    line = np.arange(camera.width_px if by_column else camera.height_px) + 0.5
    return np.asarray(sensors.shutter_fraction(camera, np.stack([line, line], axis=-1))), by_column


def reference_fraction(fraction: Float64[np.ndarray, "*n"]) -> float:
    """``RayGrid.reference`` of rays fired at the given fractions."""
    first = float(fraction.flat[0])
    return first if (fraction == first).all() else 0.5


def reference_pose(request: SensorRequest, reference: float) -> tuple[Matrix4, int]:
    """``world_from_sensor`` and time in microseconds at the fraction ``reference`` of the exposure."""
    pose = geometry.interpolate_pose_pair(np.asarray(request.world_from_sensor, np.float64), np.array(reference))
    return pose, request.start_us + int(round(reference * (request.end_us - request.start_us)))


def actors_at(request: SensorRequest, reference: float, known: Container[str]) -> dict[str, Matrix4]:
    """``world_from_box`` of the request's actors that are known and not hidden, at a fraction of the exposure."""
    names = [name for name in request.actors if name in known and name not in request.hidden]
    pairs = np.array([request.actors[name] for name in names], np.float64)
    return dict(zip(names, geometry.interpolate_pose_pairs(pairs, reference), strict=True))


def world_rays(
    request: SensorRequest, grid: RayGrid
) -> tuple[Float64[np.ndarray, "h w 3"], Float64[np.ndarray, "h w 3"]]:
    """Origins and directions in the world, each ray from the pose at its own instant."""
    shape = grid.fraction.shape
    # Few instants, many rays: a pose per instant, then one per ray.
    fractions, index = np.unique(grid.fraction, return_inverse=True)
    poses = geometry.interpolate_pose_pair(np.asarray(request.world_from_sensor, np.float64), fractions)
    poses = poses[index.reshape(-1)]
    direction = np.einsum("nij,nj->ni", poses[:, :3, :3], grid.direction.reshape(-1, 3))
    return poses[:, :3, 3].reshape(*shape, 3), direction.reshape(*shape, 3)
