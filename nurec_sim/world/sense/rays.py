"""Ray casting: what a ray meets, images without OpenGL, and the beams of a spinning LiDAR."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32

from nurec_sim.world.model.assemble import Town
from nurec_sim.world.sense.faces import Seen

REACH_M = 1400.0
_VISIBLE = np.array([1, 1, 1, 0, 0, 0], np.uint8)


def cast(
    town: Town,
    data: Any,
    origin: Float64[np.ndarray, " 3"],
    direction: Float64[np.ndarray, "n 3"],
    reach_m: float = REACH_M,
) -> tuple[Int32[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """What rays of unit ``direction`` from one point meet first: geom id (-1 nothing), distance (0), normal (0).

    Normals point towards the origin of the rays.
    """
    count = len(direction)
    geom, distance, normal = np.empty(count, np.int32), np.empty(count), np.empty((count, 3))
    rays = np.ascontiguousarray(direction, np.float64).ravel()
    origin = np.ascontiguousarray(origin, np.float64)
    mujoco.mj_multiRay(
        town.model, data, origin, rays, _VISIBLE, 1, -1, geom, distance, normal.reshape(-1), count, reach_m
    )
    missed = geom < 0
    distance[missed] = 0.0
    normal[missed] = 0.0
    away = np.einsum("nc,nc->n", normal, direction) > 0
    normal[away] *= -1
    return geom, distance, normal


def look(
    town: Town,
    data: Any,
    rays: Float64[np.ndarray, "h w 3"],
    valid: Bool[np.ndarray, "h w"],
    world_from_sensor: Float64[np.ndarray, "4 4"],
    seen: Seen,
) -> None:
    """Fills in what a grid of rays sees: plain colours of the materials, shaded by the sun, before the same sky.

    Unlike drawn images these have no textures, shadows or smoothed edges; geometry is exact.
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
    """Light (0..1) on surfaces by the lamps of the model: ambient, and every directional one by its cosine."""
    model = town.model
    light = np.asarray(model.vis.headlight.ambient, np.float64)[None]
    for direction, diffuse in zip(model.light_dir, model.light_diffuse, strict=True):
        light = light + np.clip(normal @ -direction, 0, 1)[:, None] * diffuse
    return light


def reflected(reflectivity: Float64[np.ndarray, "*n"], cosine: Float64[np.ndarray, "*n"]) -> Float32[np.ndarray, "*n"]:
    """Intensity 0..1 of a laser's echo: the surface's reflectivity, lowered to a quarter as the beam grazes it."""
    return (reflectivity * (0.25 + 0.75 * np.clip(cosine, 0, 1))).astype(np.float32)
