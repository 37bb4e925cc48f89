"""The content of a scene at an instant: moving Gaussians in place, and colours seen from a view point."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence, Set

import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim import geometry
from nurec_sim.render.rays import RayGrid, actors_at, reference_pose
from nurec_sim.scene.harmonics import sh_basis
from nurec_sim.types import DynamicGaussians, Gaussians, GaussianScene, Matrix4, SensorRequest, Track

MIN_ALPHA = 1 / 255
"""Gaussians that are less opaque are not rendered."""
LARGEST = 1e12
"""Positions, scales and colours beyond this are treated as invalid."""


def visible_gaussians(
    scene: GaussianScene, request: SensorRequest, grid: RayGrid
) -> tuple[Gaussians, Int64[np.ndarray, " k"]]:
    """Both layers at the reference instant, coloured for the view, and the order of those that can be rendered."""
    world_from_sensor, t_us = reference_pose(request, grid.reference)
    actors = actors_at(request, grid.reference, {track.id for track in scene.tracks})
    eye = world_from_sensor[:3, 3]
    static = scene.static
    if static.sh_rest is not None:
        rgb = view_colour(static.rgb, static.sh_rest, static.mean_m - eye).astype(np.float32)
        static = dataclasses.replace(static, rgb=rgb, sh_rest=None)
    moving = moving_gaussians(scene.dynamic, scene.tracks, t_us, actors, eye, request.hidden)
    gaussians = Gaussians.concatenate([static, moving])
    rows = np.flatnonzero(drawable(gaussians))
    centre = geometry.transform_points(geometry.inverse(world_from_sensor), gaussians.mean_m[rows])
    depth = np.linalg.norm(centre, axis=-1) if grid.by_range else centre[:, 2]
    order = np.argsort(depth, kind="stable")
    return gaussians, rows[order[depth[order] >= grid.near_m]]


def drawable(gaussians: Gaussians) -> Bool[np.ndarray, " n"]:
    """Which Gaussians can be rendered at all: finite, with extent, at least 1/255 opaque."""
    columns = (gaussians.mean_m, gaussians.quat_wxyz, gaussians.scale_m, gaussians.rgb, gaussians.opacity[:, None])
    sound = np.all([(np.abs(column) <= LARGEST).all(axis=1) for column in columns], axis=0)  # NaN is not
    sound &= np.linalg.norm(gaussians.quat_wxyz.astype(np.float64), axis=1) > 1e-12
    if gaussians.sh_rest is not None:
        sound &= np.isfinite(gaussians.sh_rest).all(axis=(1, 2))
    return sound & (gaussians.scale_m > 0).all(axis=1) & (gaussians.opacity >= np.float32(MIN_ALPHA))


def facing_normals(gaussians: Gaussians, eye_m: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "n 3"]:
    """Normals turned to face a point; unknown ones, which are zero or not finite, become zero."""
    known = np.isfinite(gaussians.normal).all(axis=1) & np.isfinite(gaussians.mean_m).all(axis=1)
    normal = np.where(known[:, None], gaussians.normal, 0).astype(np.float64)
    away = np.sum(normal * np.where(known[:, None], gaussians.mean_m - eye_m, 0), axis=1, keepdims=True) > 0
    return np.where(away, -normal, normal)


def moving_gaussians(
    dynamic: DynamicGaussians,
    tracks: Sequence[Track],
    t_us: int,
    actors: Mapping[str, Matrix4],
    eye_m: Float64[np.ndarray, " 3"],
    hidden: Set[str] = frozenset(),
) -> Gaussians:
    """The dynamic layer at ``t_us`` (``types.DynamicGaussians``), only those that can still be seen.

    Args:
        dynamic: the layer.
        tracks: what ``dynamic.track`` indexes.
        t_us: instant.
        actors: requested ``world_from_box`` at the instant by track id; ids that no track has are ignored.
        eye_m: view point in the world. View-dependent colour is evaluated here, in the recorded frame of a
            re-posed actor, so the result has no ``sh_rest``.
        hidden: ids of tracks that are left out.

    Returns:
        Gaussians with their position, rotation and faded opacity of the instant.
    """
    alive, mean, fade = dynamic.at(t_us)
    opacity = dynamic.gaussians.opacity[alive] * fade
    seen = (opacity >= MIN_ALPHA) & drawable(dynamic.gaussians[alive])
    seen &= np.isfinite(dynamic.knot_m[alive]).all(axis=(1, 2))
    boxed = np.zeros(len(dynamic), bool) if dynamic.in_box is None else dynamic.in_box
    requested = {k: actors[track.id] for k, track in enumerate(tracks) if track.id in actors}
    # A box without a pose at the instant: its Gaussians have no place.
    gone = [k for k, track in enumerate(tracks) if k not in requested and not track.path.covers(t_us)]
    seen &= ~(boxed[alive] & np.isin(dynamic.track[alive], gone))
    seen &= ~np.isin(dynamic.track[alive], [k for k, track in enumerate(tracks) if track.id in hidden])
    alive, mean, opacity = alive[seen], mean[seen], opacity[seen]
    gaussians = dynamic.gaussians[alive]
    quat, normal = gaussians.quat_wxyz.astype(np.float64), gaussians.normal.astype(np.float64)
    eye = np.broadcast_to(np.asarray(eye_m, np.float64), mean.shape).copy()
    recorded_mean = mean.copy()
    owner, in_box = dynamic.track[alive], boxed[alive]
    for index in sorted(requested.keys() | set(owner[in_box].tolist())):
        recorded = tracks[index].path.at(t_us)
        world_from_box = requested.get(index, recorded)
        # Loose Gaussians are recorded in the world, so a new pose applies relative to the recorded one; those in the
        # box are given in its frame.
        for rigid, new_from_given in ((False, world_from_box @ geometry.inverse(recorded)), (True, world_from_box)):
            mine = np.flatnonzero((owner == index) & (in_box == rigid))
            if len(mine) == 0 or not (rigid or index in requested):
                continue
            turn = geometry.quat_from_matrix(new_from_given[:3, :3])
            mean[mine] = geometry.transform_points(new_from_given, mean[mine])
            quat[mine] = geometry.quat_multiply(np.broadcast_to(turn, (len(mine), 4)), quat[mine])
            normal[mine] = normal[mine] @ new_from_given[:3, :3].T
            # Colours belong to the recorded frame: the eye is moved back with the inverse motion.
            eye[mine] = geometry.transform_points(geometry.inverse(new_from_given), eye[mine])
    rgb = gaussians.rgb
    if gaussians.sh_rest is not None:
        rgb = view_colour(rgb, gaussians.sh_rest, recorded_mean - eye).astype(np.float32)
    return Gaussians(
        mean_m=mean.astype(np.float32),
        quat_wxyz=quat.astype(np.float32),
        scale_m=gaussians.scale_m,
        opacity=opacity.astype(np.float32),
        rgb=rgb,
        normal=normal.astype(np.float32),
        label=gaussians.label,
        intensity=gaussians.intensity,
        ray_drop=gaussians.ray_drop,
        falloff=gaussians.falloff,
    )


def seen_intensity(gaussians: Gaussians, eye_m: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " n"]:
    """Intensity of returns to an eye by incidence (``Gaussians.falloff``); as it is where the normal is unknown."""
    intensity = gaussians.intensity.astype(np.float64)
    if gaussians.falloff is None:
        return intensity
    away = gaussians.mean_m.astype(np.float64) - eye_m
    normal = np.nan_to_num(gaussians.normal.astype(np.float64))
    met = np.abs((away * normal).sum(axis=1)) / np.maximum(np.linalg.norm(away, axis=1), 1e-12)
    return intensity * np.where(normal.any(axis=1), 1 - gaussians.falloff * (1 - np.minimum(met, 1)), 1)


def view_colour(
    rgb: Float64[np.ndarray, "n 3"], sh_rest: Float64[np.ndarray, "n k 3"], eye_to_mean: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Colour of Gaussians seen along ``eye_to_mean`` (any length), not below 0."""
    length = np.linalg.norm(eye_to_mean, axis=-1, keepdims=True)
    basis = sh_basis(eye_to_mean / np.maximum(length, 1e-12), sh_rest.shape[1])
    return np.maximum(rgb + np.einsum("nk,nkc->nc", basis, sh_rest.astype(np.float64)), 0.0)
