"""The renderer's contract as readable float64 NumPy; every back end is tested against it.

Rays come from ``rays``: one per pixel through lens and windshield or one per beam, each from the pose of its instant. A
ray (unit direction d from o) meets a Gaussian (mean m, rotation R, standard deviations S, opacity p) with

    o' = S^-1 R^T (o - m),  d' = S^-1 R^T d / |S^-1 R^T d|,  q = |d' x o'|^2,  alpha = min(p, 0.99) exp(-q / 2)

at the distance t = -(d' . o') / |S^-1 R^T d| where the response along the ray is largest (3DGUT). There is no blur, so
a Gaussian smaller than a pixel can fall between rays. A hit counts when alpha >= 1/255 and t >= near. Gaussians whose
centre lies nearer than the near plane are culled; those with values that are not finite or beyond 1e12, or without
extent, are not rendered; standard deviations below 1e-5 m count as that. Order: front to back by centre at the
reference instant (``rays.RayGrid.by_range``); back ends may swap centres whose depths differ by less than float32
resolves. Each hit weighs alpha times the transmittance before it. A ray ends with the hit that brings its
transmittance to 1e-4 or below, back ends may continue, what follows weighs 1e-4 at most; a LiDAR's beam, which only
reports what it meets first, ends at 1e-2.

Outputs of a ray: ``alpha`` is the sum of the weights; ``depth`` the weighted mean of t, times the ray's z in the
camera; ``half`` the t at which the transmittance first falls to a half or below, 0 where it does not: the range of a
LiDAR, which reports the surface it meets and no mean of two; ``label`` that of the largest single weight (back ends may
take another that is within 1/16384 of it); ``normal`` the weighted mean of the Gaussians' normals, each turned to face
the eye at the reference instant, in the world, of unit length. Where alpha < 0.5 there is no surface: depth and normal
are 0 and the label is ``SKY``. The colour gets (1 - alpha) of the sky, then the camera's affine correction, is clipped
to 0..1 and rounded half up to 8 bits. Pixels without a valid ray are black. A moving actor is static during an
exposure, where it is at the reference instant; its Gaussians fade at the ends of their lives (``layers``).

Where a Gaussian lies in the image is needed to skip what a ray cannot meet, never for its response;
``unscented.unscented_projection`` states it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim import geometry
from nurec_sim.render.layers import MIN_ALPHA, facing_normals, seen_intensity, visible_gaussians
from nurec_sim.render.rays import ray_grid, reference_pose, world_rays
from nurec_sim.types import (
    CameraFrame,
    CameraModel,
    Gaussians,
    GaussianScene,
    Label,
    LidarFilter,
    LidarFrame,
    LidarModel,
    SensorRequest,
)

MAX_OPACITY = 0.99
MIN_TRANSMITTANCE, LIDAR_MIN_TRANSMITTANCE = 1e-4, 1e-2
MIN_SCALE_M = 1e-5
SURFACE_ALPHA = 0.5
"""Below this alpha a pixel has no depth and no normal and is labelled SKY."""
PAIRS_AT_ONCE = 1 << 22
"""Pairs of a ray and a Gaussian that are evaluated together; bounds the memory, changes no result."""

Values = Float64[np.ndarray, " n"]
Vectors = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True)
class RaySums:
    """What blending leaves per ray: ``features`` and ``distance`` are weighted sums, not yet divided by ``alpha``."""

    features: Float64[np.ndarray, "*rays c"]
    distance: Float64[np.ndarray, "*rays"]
    half: Float64[np.ndarray, "*rays"]
    alpha: Float64[np.ndarray, "*rays"]
    label: Int64[np.ndarray, "*rays"]


def render_camera(
    scene: GaussianScene, request: SensorRequest, apply_isp: bool = True, pixels: Int64[np.ndarray, " k"] | None = None
) -> CameraFrame:
    """A camera frame; see the module for what it contains.

    Args:
        scene: the world.
        request: a camera's.
        apply_isp: whether ``scene.isp`` of the camera is applied to a request that asks for it.
        pixels: flat indices (row * width + column) of the pixels to render; the frame is then one row of them.
    """
    assert isinstance(request.sensor, CameraModel)
    grid = ray_grid(request.sensor)
    gaussians, order = visible_gaussians(scene, request, grid)
    eye = reference_pose(request, grid.reference)[0][:3, 3]
    features = np.concatenate([gaussians.rgb, facing_normals(gaussians, eye)], axis=1)
    origin, direction = world_rays(request, grid)
    ray, valid = grid.direction, grid.valid
    if pixels is not None:
        origin, direction, ray, valid = (
            a.reshape(-1, *a.shape[2:])[pixels][None] for a in (origin, direction, ray, valid)
        )
    sums = blend_rays(gaussians, features, order, origin, direction, grid.near_m, valid)
    corrected = apply_isp and request.apply_isp
    isp = scene.response(request.sensor.id, request.middle_us) if corrected else None
    colour = finish_colour(sums.features[..., :3], sums.alpha, sky_colour(scene.sky, direction), isp)
    surface = sums.alpha >= SURFACE_ALPHA
    depth = np.maximum(sums.distance / np.maximum(sums.alpha, MIN_ALPHA) * ray[..., 2], 0)
    return CameraFrame(
        camera=request.sensor,
        start_us=request.start_us,
        end_us=request.end_us,
        rgb=np.where(valid[..., None], to_uint8(colour), 0).astype(np.uint8),
        depth_m=np.where(surface, depth, 0).astype(np.float32),
        alpha=sums.alpha.astype(np.float32),
        label=np.where(surface, sums.label, Label.SKY).astype(np.uint8),
        normal=np.where(surface[..., None], unit(sums.features[..., 3:]), 0).astype(np.float32),
    )


def render_lidar(
    scene: GaussianScene,
    request: SensorRequest,
    filter: LidarFilter | None = None,
    beams: Int64[np.ndarray, " k"] | None = None,
) -> LidarFrame:
    """A sweep; see ``sweep_frame`` for which beams return and what. Each column fires from its own pose.

    Args:
        scene: the world.
        request: a LiDAR's.
        filter: which beams return; ``LidarFilter()`` if None.
        beams: flat indices (row * columns + column) of the beams to fire; all if None.
    """
    grid = ray_grid(request.sensor)
    gaussians, order = visible_gaussians(scene, request, grid)
    known = np.isfinite(gaussians.intensity)
    drop = np.zeros(len(gaussians)) if gaussians.ray_drop is None else np.clip(np.nan_to_num(gaussians.ray_drop), 0, 1)
    intensity = seen_intensity(gaussians, reference_pose(request, grid.reference)[0][:3, 3])
    features = np.stack([np.where(known, intensity, 0), known, drop], axis=-1).astype(np.float64)
    origin, direction = world_rays(request, grid)
    fired = grid.valid.copy()
    if beams is not None:
        fired[:] = False
        fired.reshape(-1)[beams] = True
    sums = blend_rays(
        gaussians, features, order, origin, direction, grid.near_m, fired, min_transmittance=LIDAR_MIN_TRANSMITTANCE
    )
    return sweep_frame(request, sums, origin, direction, filter or LidarFilter())


def sweep_frame(
    request: SensorRequest,
    sums: RaySums,
    origin: Float64[np.ndarray, "h w 3"],
    direction: Float64[np.ndarray, "h w 3"],
    filter: LidarFilter,
) -> LidarFrame:
    """The returns of a grid of blended beams, as points in the sensor frame at the end of the sweep.

    The range is where half of the beam has been stopped; beams of which less is stopped (opacity thresholds below a
    half) get the weighted mean. Features are intensity, whether it is known, and ray drop: intensity is the weighted
    mean over the Gaussians whose intensity is known, clipped to 0..1, 0 where none is; the probability of a drop the
    weighted mean of all. A beam returns if its alpha exceeds the opacity threshold, its drop probability does not
    exceed its threshold, its range lies within the sensor's, and is not farther from the weighted mean than the
    distance threshold.

    Args:
        request: a LiDAR's.
        sums: of its beams, features as above.
        origin: where the beams start, in the world (m).
        direction: their unit directions in the world.
        filter: which beams return.
    """
    assert isinstance(request.sensor, LidarModel)
    mean = sums.distance / np.maximum(sums.alpha, MIN_ALPHA)
    distance = np.where(sums.half > 0, sums.half, mean)
    nearest, farthest = request.sensor.range_m
    returns = (sums.alpha > filter.opacity_threshold) & (distance >= nearest) & (distance <= farthest)
    returns &= sums.features[..., 2] <= filter.raydrop_threshold * sums.alpha
    if filter.distance_threshold_m is not None:
        returns &= np.abs(distance - mean) <= filter.distance_threshold_m
    intensity = np.clip(sums.features[..., 0] / np.maximum(sums.features[..., 1], 1e-12), 0, 1)
    world = origin[returns] + direction[returns] * distance[returns, None]
    return LidarFrame(
        lidar=request.sensor,
        start_us=request.start_us,
        end_us=request.end_us,
        xyz_m=geometry.transform_points(geometry.inverse(request.world_from_sensor[1]), world).astype(np.float32),
        range_m=distance[returns].astype(np.float32),
        intensity=intensity[returns].astype(np.float32),
        beam=np.flatnonzero(returns).astype(np.int32),
    )


def blend_rays(
    gaussians: Gaussians,
    features: Float64[np.ndarray, "n c"],
    order: Int64[np.ndarray, " k"],
    origin: Float64[np.ndarray, "*rays 3"],
    direction: Float64[np.ndarray, "*rays 3"],
    near_m: float,
    valid: Bool[np.ndarray, "*rays"] | None = None,
    min_transmittance: float = MIN_TRANSMITTANCE,
) -> RaySums:
    """Blend Gaussians along rays.

    Args:
        gaussians: the world.
        features: what is summed along a ray, a row per Gaussian.
        order: rows of the Gaussians to blend, front to back.
        origin: where the rays start.
        direction: their unit directions.
        near_m: hits nearer than this do not count.
        valid: rays to blend; all others meet nothing. All if None.
        min_transmittance: where a ray ends.
    """
    shape = direction.shape[:-1]
    count = int(np.prod(shape))
    chosen = np.arange(count) if valid is None else np.flatnonzero(valid)
    mean = gaussians.mean_m[order].astype(np.float64)
    scale = np.maximum(gaussians.scale_m[order].astype(np.float64), MIN_SCALE_M)
    # S^-1 R^T: from the world to the axes and units in which the Gaussian is a unit sphere.
    canonical = np.swapaxes(geometry.matrix_from_quat(gaussians.quat_wxyz[order]), 1, 2) / scale[:, :, None]
    opacity = np.minimum(gaussians.opacity[order].astype(np.float64), MAX_OPACITY)
    reach_m = scale.max(axis=1) * np.sqrt(np.maximum(2 * np.log(opacity / MIN_ALPHA), 0))

    sums, label = np.zeros((count, features.shape[1] + 3)), np.full(count, int(Label.SKY))
    step = max(1, PAIRS_AT_ONCE // max(len(order), 1))
    for start in range(0, len(chosen), step):
        rays = chosen[start : start + step]
        o, d = origin.reshape(-1, 3)[rays], direction.reshape(-1, 3)[rays]
        # A cheap exact bound first: the full response only for pairs that can reach 1/255.
        ray, row = np.nonzero(lines_near(o, d, mean, reach_m))
        alpha, t = response(o[ray], d[ray], mean[row], canonical[row], opacity[row])
        hit = (alpha >= MIN_ALPHA) & (t >= near_m)
        if not hit.any():
            continue
        ray, row, alpha, t = ray[hit], order[row[hit]], alpha[hit], t[hit]
        weight, before, after = composite(ray, alpha, min_transmittance)
        # The hit that takes the transmittance through one half; at most one per ray.
        half = np.where((before > 0.5) & (after <= 0.5), t, 0)
        columns = np.column_stack([weight[:, None] * features[row], weight, weight * t, half])
        for c, column in enumerate(columns.T):
            sums[rays, c] = np.bincount(ray, column, minlength=len(rays))
        # The largest weight of each ray; ties go to the nearer one, because lexsort is stable.
        first = np.unique(ray, return_index=True)[1]
        heaviest = np.lexsort((-weight, ray))[first]
        label[rays[ray[first]]] = gaussians.label[row[heaviest]]
    alpha, distance, half = np.moveaxis(sums[:, -3:], 1, 0).reshape(3, *shape)
    return RaySums(sums[:, :-3].reshape(*shape, -1), distance, half, alpha, label.reshape(shape))


def composite(ray: Int64[np.ndarray, " n"], alpha: Values, min_transmittance: float) -> tuple[Values, Values, Values]:
    """Weights of hits, and the transmittance before and after each.

    Args:
        ray: to which ray each hit belongs, rising.
        alpha: of the hits, front to back within a ray.
        min_transmittance: hits behind this weigh nothing.
    """
    place = np.arange(len(ray)) - np.searchsorted(ray, ray)
    # A table of rays by hits: the running product along a row is the transmittance after each hit.
    clear = np.ones((ray[-1] + 1, place.max() + 2))
    clear[ray, place + 1] = 1 - alpha
    transmittance = np.cumprod(clear, axis=1)
    before, after = transmittance[ray, place], transmittance[ray, place + 1]
    return np.where(before > min_transmittance, alpha * before, 0.0), before, after


def response(
    origin: Vectors, direction: Vectors, mean: Vectors, canonical: Float64[np.ndarray, "n 3 3"], opacity: Values
) -> tuple[Values, Values]:
    """Alpha and distance at which rays meet Gaussians, pair by pair; the formula at the top of the module.

    Args:
        origin: where the rays start (m).
        direction: their unit directions.
        mean: centres of the Gaussians (m).
        canonical: S^-1 R^T of the Gaussians (1/m).
        opacity: 0..0.99.

    Returns:
        Alpha, and the distance of the largest response (m), negative behind the origin.
    """
    o = np.einsum("nij,nj->ni", canonical, origin - mean)
    d = np.einsum("nij,nj->ni", canonical, direction)
    length = np.linalg.norm(d, axis=-1)
    d = d / length[:, None]
    q = np.sum(np.cross(d, o) ** 2, axis=-1)
    return opacity * np.exp(-q / 2), -np.sum(d * o, axis=-1) / length


def lines_near(
    origin: Float64[np.ndarray, "r 3"],
    direction: Float64[np.ndarray, "r 3"],
    mean: Float64[np.ndarray, "n 3"],
    reach_m: Float64[np.ndarray, " n"],
) -> Bool[np.ndarray, "r n"]:
    """Which lines pass a Gaussian within its reach.

    Args:
        origin: points on the lines (m).
        direction: their unit directions.
        mean: centres of the Gaussians (m).
        reach_m: distance at which a Gaussian's largest axis has faded to 1/255.
    """
    middle = origin.mean(axis=0)  # squares of large coordinates would lose the small distances between them
    o, m = origin - middle, mean - middle
    along = direction @ m.T - np.sum(direction * o, axis=1, keepdims=True)
    # |o - m|^2 less the square of its part along the line is the squared distance of the line.
    squared = np.sum(o**2, axis=1, keepdims=True) - 2 * o @ m.T + np.sum(m**2, axis=1)
    return squared - along**2 <= reach_m**2 + 1e-9 * (squared + 1)


def unit(vectors: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
    """Vectors of unit length; those that vanish stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-6, vectors / np.maximum(length, 1e-6), 0)


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
    colour: Float64[np.ndarray, "*n 3"],
    alpha: Float64[np.ndarray, "*n"],
    sky: Float64[np.ndarray, "*n 3"],
    isp: Float64[np.ndarray, "3 4"] | None,
) -> Float64[np.ndarray, "*n 3"]:
    """The sky behind the Gaussians, then the camera's affine colour correction.

    Args:
        colour: blended colours.
        alpha: opacity of what has been blended.
        sky: colours of the sky behind.
        isp: matrix and offset, columns 0 to 2 and 3; none if None.
    """
    colour = colour + (1 - alpha)[..., None] * sky
    return colour if isp is None else colour @ isp[:, :3].T + isp[:, 3]


def to_uint8(colour: Float64[np.ndarray, "*n 3"]) -> np.ndarray:
    """0..1 to 0..255, rounded half up, clipped."""
    return np.floor(np.clip(colour, 0, 1) * 255 + 0.5).astype(np.uint8)
