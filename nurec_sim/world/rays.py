"""Ray casting: what a ray meets, images without OpenGL, and the beams of a spinning LiDAR."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float32, Float64, Int32

from nurec_sim import sensors
from nurec_sim.types import CameraModel, LidarModel
from nurec_sim.world.build import FAR_M, Street
from nurec_sim.world.render import View

_VISIBLE = np.array([1, 1, 1, 0, 0, 0], np.uint8)


def cast(
    street: Street,
    data: Any,
    origin: Float64[np.ndarray, " 3"],
    direction: Float64[np.ndarray, "n 3"],
    reach_m: float = FAR_M,
) -> tuple[Int32[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """What rays of unit ``direction`` from one point meet first: geom id (-1 nothing), distance (0), normal (0)."""
    count = len(direction)
    geom, distance, normal = np.empty(count, np.int32), np.empty(count), np.empty((count, 3))
    rays = np.ascontiguousarray(direction, np.float64).ravel()
    origin = np.ascontiguousarray(origin, np.float64)
    mujoco.mj_multiRay(
        street.model, data, origin, rays, _VISIBLE, 1, -1, geom, distance, normal.reshape(-1), count, reach_m
    )
    missed = geom < 0
    distance[missed] = 0.0
    normal[missed] = 0.0
    return geom, distance, normal


def view(street: Street, data: Any, camera: CameraModel, world_from_camera: Float64[np.ndarray, "4 4"]) -> View:
    """An image by one ray per pixel: plain colours of the materials, shaded by the sun, before the same sky.

    Returns what ``render.GlPainter.view`` returns, without textures, shadows or smoothed edges.
    """
    rays, valid = sensors.pixel_rays(camera)
    height, width = valid.shape
    direction = rays.reshape(-1, 3) @ world_from_camera[:3, :3].T
    geom, distance, normal = cast(street, data, world_from_camera[:3, 3], direction)
    hit = geom >= 0
    # The renderer lights front faces only, and rays may report the normal of either side.
    normal = np.where(np.sum(normal * direction, axis=1, keepdims=True) > 0, -normal, normal)
    fill = np.array([-street.sun[0], -street.sun[1], 0.8])
    light = np.array([0.48, 0.50, 0.54]) + 0.72 * np.clip(normal @ street.sun, 0, 1)[:, None]
    light = light + 0.16 * np.clip(normal @ (fill / np.linalg.norm(fill)), 0, 1)[:, None]
    lit = np.clip(street.geom_rgb[geom] * light * 255, 0, 255).astype(np.uint8)
    sky = street.sky.colour(direction.reshape(height, width, 3)).reshape(-1, 3)
    rgb = np.where(hit[:, None], lit, sky).reshape(height, width, 3)
    depth = (distance * rays.reshape(-1, 3)[:, 2]).astype(np.float32)
    return np.ascontiguousarray(rgb), geom.reshape(height, width), depth.reshape(height, width)


def fire_column(
    street: Street,
    data: Any,
    lidar: LidarModel,
    world_from_lidar: Float64[np.ndarray, "4 4"],
    beams: Float64[np.ndarray, "rows 3"],
) -> tuple[Float64[np.ndarray, " rows"], Float32[np.ndarray, " rows"], Int32[np.ndarray, " rows"]]:
    """One column of a LiDAR fired at one instant: range (0 where nothing returned), intensity and geom id.

    Intensity is the surface's reflectivity, lowered to a quarter as the beam grazes it.
    """
    direction = beams @ world_from_lidar[:3, :3].T
    geom, distance, normal = cast(street, data, world_from_lidar[:3, 3], direction, lidar.range_m[1])
    # mj_multiRay leaves out whole geoms by their distance, so a large one still answers beyond the reach.
    returned = (geom >= 0) & (distance >= lidar.range_m[0]) & (distance <= lidar.range_m[1])
    facing = np.abs(np.sum(normal * direction, axis=1))
    intensity = np.where(returned, street.geom_reflectivity[geom] * (0.25 + 0.75 * facing), 0.0)
    return np.where(returned, distance, 0.0), intensity.astype(np.float32), np.where(returned, geom, -1)
