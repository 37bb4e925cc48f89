"""Ray casting: first hits of rays, images without OpenGL, and echo intensities of a LiDAR."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32

from nurec_sim.types import Matrix4
from nurec_sim.world.model.assemble import Town
from nurec_sim.world.sense.faces import Seen

REACH_M = 1400.0
# Geom groups to be hit: without decals (3), which have no depth.
_VISIBLE = np.array([1, 1, 1, 0, 0, 0], np.uint8)


def cast(
    town: Town,
    data: Any,
    origin: Float64[np.ndarray, " 3"],
    direction: Float64[np.ndarray, "n 3"],
    reach_m: float = REACH_M,
) -> tuple[Int32[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """First hits of rays from one point.

    Args:
        town: the compiled town.
        data: MuJoCo state with the poses of the instant.
        origin: common origin of the rays [3], in the world (m).
        direction: unit directions in the world.
        reach_m: geoms farther away than this are ignored.

    Returns:
        Per ray the geom id (-1 no hit), the distance in metres (0 no hit), and the unit normal towards the origin (0 no
        hit).
    """
    count = len(direction)
    geom, distance, normal = np.empty(count, np.int32), np.empty(count), np.empty((count, 3))
    rays = np.ascontiguousarray(direction, np.float64).ravel()
    origin = np.ascontiguousarray(origin, np.float64)
    # Static geoms are included, and no body is excluded (1, -1).
    mujoco.mj_multiRay(
        town.model, data, origin, rays, _VISIBLE, 1, -1, geom, distance, normal.reshape(-1), count, reach_m
    )
    missed = geom < 0
    distance[missed] = 0.0
    normal[missed] = 0.0
    # Leaves and other open surfaces are hit from behind too.
    away = np.einsum("nc,nc->n", normal, direction) > 0
    normal[away] *= -1
    return geom, distance, normal


def look(
    town: Town,
    data: Any,
    rays: Float64[np.ndarray, "h w 3"],
    valid: Bool[np.ndarray, "h w"],
    world_from_sensor: Matrix4,
    seen: Seen,
) -> None:
    """Fills in the view of a grid of rays: plain material colours, shaded by the sun, before the rendered sky.

    Unlike OpenGL images these have no textures, shadows or anti-aliasing; geometry is exact.

    Args:
        town: the compiled town.
        data: MuJoCo state with the poses of the instant.
        rays: unit rays in the sensor's frame.
        valid: which rays exist; the others are left as they are.
        world_from_sensor: pose of the sensor.
        seen: result, of the same size as the grid.
    """
    direction = rays[valid] @ world_from_sensor[:3, :3].T
    geom, distance, normal = cast(town, data, world_from_sensor[:3, 3], direction)
    light = _light(town, normal)
    lit = np.clip(town.geom_rgb[geom] * light * 255, 0, 255).astype(np.uint8)
    sky = town.sky.colour(np.where(valid[..., None], rays, (0.0, 0.0, 1.0)) @ world_from_sensor[:3, :3].T)
    seen.rgb[valid] = np.where((geom >= 0)[:, None], lit, sky[valid])
    seen.geom[valid], seen.range_m[valid] = geom, distance
    seen.normal[valid] = normal @ world_from_sensor[:3, :3]


def _light(town: Town, normal: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Light (0..1) on surfaces: ambient, plus each directional light by its cosine (Lambert)."""
    model = town.model
    light = np.asarray(model.vis.headlight.ambient, np.float64)[None]
    for direction, diffuse in zip(model.light_dir, model.light_diffuse, strict=True):
        light = light + np.clip(normal @ -direction, 0, 1)[:, None] * diffuse
    return light


def reflected(reflectivity: Float64[np.ndarray, "*n"], cosine: Float64[np.ndarray, "*n"]) -> Float32[np.ndarray, "*n"]:
    """Echo intensity 0..1: the reflectivity, falling to a quarter of it at grazing incidence."""
    return (reflectivity * (0.25 + 0.75 * np.clip(cosine, 0, 1))).astype(np.float32)
