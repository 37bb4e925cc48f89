"""Ray casting: what a ray meets, images without OpenGL, and the beams of a spinning LiDAR."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32

from nurec_sim.world.build import FAR_M, Street
from nurec_sim.world.faces import Seen

_VISIBLE = np.array([1, 1, 1, 0, 0, 0], np.uint8)


def cast(
    street: Street,
    data: Any,
    origin: Float64[np.ndarray, " 3"],
    direction: Float64[np.ndarray, "n 3"],
    reach_m: float = FAR_M,
) -> tuple[Int32[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """What rays of unit ``direction`` from one point meet first: geom id (-1 nothing), distance (0), normal (0).

    Normals point towards the origin of the rays.
    """
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
    away = np.einsum("nc,nc->n", normal, direction) > 0
    normal[away] *= -1
    return geom, distance, normal


def look(
    street: Street,
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
    geom, distance, normal = cast(street, data, world_from_sensor[:3, 3], direction)
    fill = np.array([-street.sun[0], -street.sun[1], 0.8])
    light = np.array([0.48, 0.50, 0.54]) + 0.72 * np.clip(normal @ street.sun, 0, 1)[:, None]
    light = light + 0.16 * np.clip(normal @ (fill / np.linalg.norm(fill)), 0, 1)[:, None]
    lit = np.clip(street.geom_rgb[geom] * light * 255, 0, 255).astype(np.uint8)
    sky = street.sky.colour(np.where(valid[..., None], rays, (0.0, 0.0, 1.0)) @ world_from_sensor[:3, :3].T)
    seen.rgb[valid] = np.where((geom >= 0)[:, None], lit, sky[valid])
    seen.geom[valid], seen.range_m[valid] = geom, distance
    seen.normal[valid] = normal @ world_from_sensor[:3, :3]


def reflected(reflectivity: Float64[np.ndarray, "*n"], cosine: Float64[np.ndarray, "*n"]) -> Float32[np.ndarray, "*n"]:
    """Intensity 0..1 of a laser's echo: the surface's reflectivity, lowered to a quarter as the beam grazes it."""
    return (reflectivity * (0.25 + 0.75 * np.clip(cosine, 0, 1))).astype(np.float32)
