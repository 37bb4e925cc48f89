"""The renderer's contract as readable float64 NumPy; every back end is tested against it.

A ray (unit direction d from o) meets a Gaussian (mean m, rotation R, standard deviations S, opacity p) with

    o' = S^-1 R^T (o - m),  d' = S^-1 R^T d / |S^-1 R^T d|,  q = |d' x o'|^2,  alpha = min(0.99, p exp(-q / 2))

at the distance t = -(d' . o') / |S^-1 R^T d| where the response along the ray is largest (3DGUT). There is no blur, so
a Gaussian smaller than a pixel can fall between rays. A hit counts when alpha >= 1/255 and t >= near. Gaussians whose
centre lies nearer than the near plane are culled. They are blended front to back in the order of their centres at the
reference instant (``rays.RayGrid.by_range``); back ends may swap centres whose depths differ by less than float32
resolves. The Gaussian that would bring the transmittance to 1e-4 or below is dropped and ends the ray.

Outputs: ``alpha`` is the sum of the weights; ``depth`` the weighted mean of t, times the ray's z in the camera, 0
where alpha < 0.5; ``half`` the t at which the transmittance first falls to a half, 0 where it does not: the range of a
LiDAR, which reports the surface it meets and no mean of two; ``label`` that of the largest single weight, ``SKY`` where
alpha < 0.5. The colour gets (1 - alpha) of the sky, then the camera's affine correction, is clipped to 0..1 and rounded
half up to 8 bits. Pixels without a valid ray are black. A moving actor stands still during an exposure, where it is at
the reference instant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.render.layers import moving_gaussians, view_colour
from nurec_sim.render.rays import RayGrid, ray_grid, reference_pose, world_rays
from nurec_sim.types import (
    CameraFrame,
    CameraModel,
    Gaussians,
    GaussianScene,
    Label,
    LidarFrame,
    LidarModel,
    SensorRequest,
)

MAX_ALPHA = 0.99
MIN_ALPHA = 1 / 255
MIN_TRANSMITTANCE = 1e-4
SURFACE_ALPHA = 0.5
"""Below this alpha a pixel has no depth and is labelled SKY."""


@dataclass(frozen=True)
class RaySums:
    """What blending leaves per ray: ``features`` and ``distance`` are weighted sums, not yet divided by ``alpha``."""

    features: Float64[np.ndarray, "h w c"]
    distance: Float64[np.ndarray, "h w"]
    half: Float64[np.ndarray, "h w"]
    alpha: Float64[np.ndarray, "h w"]
    label: np.ndarray


def render_camera(scene: GaussianScene, request: SensorRequest, apply_isp: bool = True) -> CameraFrame:
    """A camera frame; see the module for what it contains."""
    assert isinstance(request.sensor, CameraModel)
    grid = ray_grid(request.sensor)
    gaussians, order = visible_gaussians(scene, request, grid)
    origin, direction = world_rays(request, grid)
    sums = blend_rays(gaussians, gaussians.rgb, order, origin, direction, grid)
    isp = scene.isp.get(request.sensor.id) if apply_isp else None
    colour = finish_colour(sums.features, sums.alpha, sky_colour(scene.sky, direction), isp)
    surface = sums.alpha >= SURFACE_ALPHA
    mean_distance = sums.distance / np.maximum(sums.alpha, MIN_ALPHA)
    return CameraFrame(
        camera=request.sensor,
        start_us=request.start_us,
        end_us=request.end_us,
        rgb=np.where(grid.valid[..., None], to_uint8(colour), 0).astype(np.uint8),
        depth_m=np.where(surface, np.maximum(mean_distance * grid.direction[..., 2], 0), 0).astype(np.float32),
        alpha=sums.alpha.astype(np.float32),
        label=np.where(surface, sums.label, Label.SKY).astype(np.uint8),
    )


def render_lidar(scene: GaussianScene, request: SensorRequest, opacity_threshold: float = SURFACE_ALPHA) -> LidarFrame:
    """A sweep: beams whose alpha exceeds the threshold, if within the sensor's range.

    The range is where half of the beam has been stopped; beams of which less is stopped (thresholds below a half) get
    the weighted mean distance. Each column fires from its own pose; points are given in the sensor frame at the end of
    the sweep. Intensity is the weighted mean over the Gaussians whose intensity is known, 0 where none is.
    """
    grid = ray_grid(request.sensor)
    gaussians, order = visible_gaussians(scene, request, grid)
    known = np.isfinite(gaussians.intensity)
    features = np.stack([np.where(known, gaussians.intensity, 0), known], axis=-1)
    origin, direction = world_rays(request, grid)
    sums = blend_rays(gaussians, features, order, origin, direction, grid)
    distance = beam_range(sums.half, sums.distance, sums.alpha)
    intensity = sums.features[..., 0] / np.maximum(sums.features[..., 1], 1e-12)
    return sweep_frame(request, sums.alpha, distance, intensity, origin, direction, opacity_threshold)


def beam_range(
    half: Float64[np.ndarray, "h w"], distance: Float64[np.ndarray, "h w"], alpha: Float64[np.ndarray, "h w"]
) -> Float64[np.ndarray, "h w"]:
    """Range of LiDAR beams from the sums of blending."""
    return np.where(half > 0, half, distance / np.maximum(alpha, MIN_ALPHA))


def sweep_frame(
    request: SensorRequest,
    alpha: Float64[np.ndarray, "h w"],
    distance: Float64[np.ndarray, "h w"],
    intensity: Float64[np.ndarray, "h w"],
    origin: Float64[np.ndarray, "h w 3"],
    direction: Float64[np.ndarray, "h w 3"],
    opacity_threshold: float,
) -> LidarFrame:
    """The returns of a grid of beams, as points in the sensor frame at the end of the sweep."""
    assert isinstance(request.sensor, LidarModel)
    nearest, farthest = request.sensor.range_m
    beam = np.flatnonzero((alpha > opacity_threshold) & (distance >= nearest) & (distance <= farthest))
    distance = distance.reshape(-1)[beam]
    world = origin.reshape(-1, 3)[beam] + direction.reshape(-1, 3)[beam] * distance[:, None]
    return LidarFrame(
        lidar=request.sensor,
        start_us=request.start_us,
        end_us=request.end_us,
        xyz_m=geometry.transform_points(geometry.inverse(request.world_from_sensor[1]), world).astype(np.float32),
        range_m=distance.astype(np.float32),
        intensity=intensity.reshape(-1)[beam].astype(np.float32),
        beam=beam.astype(np.int32),
    )


def visible_gaussians(scene: GaussianScene, request: SensorRequest, grid: RayGrid) -> tuple[Gaussians, np.ndarray]:
    """Both layers at the reference instant, coloured for the view, and the order of those in front."""
    world_from_sensor, t_us = reference_pose(request, grid.reference)
    actors = {
        name: geometry.interpolate_pose_pair(np.asarray(pair, np.float64), np.array(grid.reference))
        for name, pair in request.actors.items()
    }
    eye = world_from_sensor[:3, 3]
    static = scene.static
    if static.sh_rest is not None:
        rgb = view_colour(static.rgb, static.sh_rest, static.mean_m - eye).astype(np.float32)
        static = Gaussians(static.mean_m, static.quat_wxyz, static.scale_m, static.opacity, rgb, static.normal,
                           static.label, static.intensity)  # fmt: skip
    moving = moving_gaussians(scene.dynamic, scene.tracks, t_us, actors, eye)
    gaussians = Gaussians.concatenate([static, moving])
    centre = geometry.transform_points(geometry.inverse(world_from_sensor), gaussians.mean_m)
    depth = np.linalg.norm(centre, axis=-1) if grid.by_range else centre[:, 2]
    order = np.argsort(depth, kind="stable")
    return gaussians, order[depth[order] >= grid.near_m]


def blend_rays(
    gaussians: Gaussians,
    features: Float64[np.ndarray, "n c"],
    order: np.ndarray,
    origin: Float64[np.ndarray, "h w 3"],
    direction: Float64[np.ndarray, "h w 3"],
    grid: RayGrid,
) -> RaySums:
    """Blend Gaussians front to back along every ray."""
    shape = direction.shape[:2]
    transmittance, live = np.ones(shape), grid.valid.copy()
    sums, distance, alpha_sum = np.zeros((*shape, features.shape[1])), np.zeros(shape), np.zeros(shape)
    half = np.zeros(shape)
    best, label = np.zeros(shape), np.full(shape, int(Label.SKY))
    rotation = geometry.matrix_from_quat(gaussians.quat_wxyz)
    for i in order:
        canonical = (rotation[i] / gaussians.scale_m[i].astype(np.float64)).T
        o = (origin - gaussians.mean_m[i]) @ canonical.T
        d = direction @ canonical.T
        length = np.linalg.norm(d, axis=-1)
        d = d / length[..., None]
        q = np.sum(np.cross(d, o) ** 2, axis=-1)
        t = -np.sum(d * o, axis=-1) / length
        alpha = np.minimum(MAX_ALPHA, gaussians.opacity[i] * np.exp(-q / 2))
        hit = live & (alpha >= MIN_ALPHA) & (t >= grid.near_m)
        ends = hit & (transmittance * (1 - alpha) <= MIN_TRANSMITTANCE)
        weight = np.where(hit & ~ends, alpha * transmittance, 0.0)
        live &= ~ends
        half = np.where((transmittance > 0.5) & (transmittance - weight <= 0.5), t, half)
        transmittance -= weight
        sums += weight[..., None] * features[i]
        distance += weight * t
        alpha_sum += weight
        label = np.where(weight > best, gaussians.label[i], label)
        best = np.maximum(best, weight)
    return RaySums(sums, distance, half, alpha_sum, label)


def sky_colour(
    sky: Float64[np.ndarray, "6 s s 3"], direction: Float64[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n 3"]:
    """Bilinear lookup of a cubemap; texels beyond a face's edge are those of its edge."""
    size = sky.shape[1]
    face, s, t = geometry.cubemap_coordinates(direction)
    x, y = np.clip(s * size - 0.5, 0, size - 1), np.clip(t * size - 0.5, 0, size - 1)
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    x1, y1 = np.minimum(x0 + 1, size - 1), np.minimum(y0 + 1, size - 1)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    top = sky[face, y0, x0] * (1 - fx) + sky[face, y0, x1] * fx
    bottom = sky[face, y1, x0] * (1 - fx) + sky[face, y1, x1] * fx
    return top * (1 - fy) + bottom * fy


def finish_colour(
    colour: Float64[np.ndarray, "h w 3"],
    alpha: Float64[np.ndarray, "h w"],
    sky: Float64[np.ndarray, "h w 3"],
    isp: Float64[np.ndarray, "3 4"] | None,
) -> Float64[np.ndarray, "h w 3"]:
    """The sky behind the Gaussians, then the camera's affine colour correction."""
    colour = colour + (1 - alpha)[..., None] * sky
    return colour if isp is None else colour @ isp[:, :3].T + isp[:, 3]


def to_uint8(colour: Float64[np.ndarray, "h w 3"]) -> np.ndarray:
    """0..1 to 0..255, rounded half up, clipped."""
    return np.floor(np.clip(colour, 0, 1) * 255 + 0.5).astype(np.uint8)
