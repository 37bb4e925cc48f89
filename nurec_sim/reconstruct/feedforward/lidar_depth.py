"""Predicted depth, image by image, fitted to the log's LiDAR sweeps.

The network knows distances only as well as its training did; sweeps know them to centimetres, at a few pixels. One
factor per image, and optionally a slope over inverse depth, take the prediction to the measurements.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from torch import Tensor

from nurec_sim import geometry, sensors
from nurec_sim.errors import ReconstructError
from nurec_sim.network.tensors import QueryGaussians
from nurec_sim.reconstruct.feedforward.chunks import ChunkInputs, ContextImage
from nurec_sim.types import Clip, Track

MAX_TIME_US = 150_000
"""Sweeps farther in time from an image than this say nothing about it."""
SWEEPS_PER_IMAGE = 2
"""Nearest sweeps of every LiDAR that are compared with an image."""
MIN_POINTS = 50
"""Images that see fewer measured points take the factor of others."""
MIN_AFFINE_POINTS = 200
MIN_AFFINE_SPREAD = 1.5
"""A slope needs points over a range of depths: their 90th percentile over their 10th."""
MAX_BEND = 3.0
"""A slope may change the factor over the measured range at most so much."""
MIN_RANGE_M = 1.0
BODY_MARGIN_M = 0.3
CONE_MARGIN_RAD = 0.1
BOX_MARGIN_M = 0.1
EDGE_RATIO = 1.25
"""Where the four pixels around a point differ by more than this, the point may belong to either side of an edge."""
HIDDEN_RATIO = 1.1
"""A point is hidden if one so much nearer shows beside or above it."""
ABSOLUTE_STEPS, TUKEY_STEPS = 20, 10

Values = Float64[np.ndarray, " n"]
Points = tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, " n"]]
Kind = Literal["scale", "affine"]


@dataclass(frozen=True)
class ImageFit:
    """What was fitted to one image: ``fitted = depth / (1 / scale + slope_per_m * depth)``.

    Attributes:
        camera: id of the camera.
        frame: index of the image in the log.
        points: measured points that the image sees.
        taken_from: whose points gave the factor: the image's ``own``, its ``camera``'s other images, the whole
            ``chunk``, or ``none`` (the factor is 1).
        scale: factor on small depths.
        slope_per_m: change of inverse depth; 0 for a plain factor.
        range_m: predicted depths between which the slope was measured; outside, the factor is that of the nearer end.
        error_before: median of ``|predicted - measured| / measured`` over the points, None without any.
        error_after: the same of the fitted depth, over the same points.
    """

    camera: str
    frame: int
    points: int
    taken_from: Literal["own", "camera", "chunk", "none"]
    scale: float
    slope_per_m: float
    range_m: tuple[float, float]
    error_before: float | None
    error_after: float | None

    def factor(self, depth_m: Values) -> Values:
        """By how much each predicted depth has to be multiplied."""
        return 1 / (1 / self.scale + self.slope_per_m * np.clip(depth_m, *self.range_m))


@dataclass(frozen=True)
class DepthFit:
    """The fits of all images of a chunk, in their order; the errors are medians over all points."""

    kind: Kind
    images: tuple[ImageFit, ...]
    error_before: float | None
    error_after: float | None

    def apply(self, gaussians: QueryGaussians, chunk: ChunkInputs) -> QueryGaussians:
        """Gaussians moved along the rays of their pixels to the fitted depth; sizes and motion grow with distance."""
        inputs, source = chunk.tensors.to(gaussians.source.device), gaussians.source
        _, _, height, width, _ = inputs.rgb.shape
        origin = inputs.rays.reshape(-1, 6)[source, :3]
        ray_m = gaussians.position_m - origin
        depth_m = torch.linalg.norm(ray_m, dim=-1) * inputs.distance_to_depth_scale.reshape(-1)[source]
        factor = self._factor(source // (height * width), depth_m)[..., None]
        motion = gaussians.motion_m
        return dataclasses.replace(
            gaussians,
            position_m=origin + ray_m * factor,
            scale_m=gaussians.scale_m * factor,
            motion_m=None if motion is None else motion * factor[..., None],
        )

    def _factor(self, image: Tensor, depth_m: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
        """As ``ImageFit.factor``, for points of several images."""
        rows = [(1 / fit.scale, fit.slope_per_m, *fit.range_m) for fit in self.images]
        inverse, slope, near, far = depth_m.new_tensor(rows)[image].unbind(-1)
        return 1 / (inverse + slope * depth_m.clamp(near, far))

    def report(self) -> dict[str, Any]:
        """The fits as plain JSON, for the provenance of a scene."""
        return {
            "kind": self.kind,
            "points": sum(fit.points for fit in self.images),
            "median_relative_error": {"before": self.error_before, "after": self.error_after},
            "images_without_own_points": sum(fit.taken_from != "own" for fit in self.images),
            "images": [{**dataclasses.asdict(fit), "range_m": list(fit.range_m)} for fit in self.images],
        }


def fit_depth(
    clip: Clip,
    chunk: ChunkInputs,
    depth_m: Float32[np.ndarray, "v h w"],
    hold_out_sweeps: set[int],
    kind: Kind,
) -> DepthFit:
    """Fit the predicted depth of every image of a chunk to the sweeps around its time.

    Args:
        clip: the log.
        chunk: the images.
        depth_m: predicted z-depth of the images, metres.
        hold_out_sweeps: sweeps that must not be read, by index, of every LiDAR.
        kind: a factor per image, or a factor and a slope over inverse depth (where the points allow one).

    Raises:
        ReconstructError: the log has no sweeps, or all of them are held out.
    """
    times = {
        lidar: [(int(start + end) // 2, i) for i, (start, end) in enumerate(clip.sweep_times_us(lidar))]
        for lidar in clip.rig.lidars
    }
    kept = {lidar: [item for item in sweeps if item[1] not in hold_out_sweeps] for lidar, sweeps in times.items()}
    if not any(kept.values()):
        count = sum(map(len, times.values()))
        raise ReconstructError(
            f"lidar_depth={kind!r} needs LiDAR sweeps: clip {clip.id!r} has {count}, of which all are held out"
            if count
            else f"lidar_depth={kind!r} needs LiDAR sweeps, and clip {clip.id!r} has none; use lidar_depth='off'"
        )
    # In the order of time, images that share a sweep come one after the other.
    read = functools.lru_cache(maxsize=4 * SWEEPS_PER_IMAGE)(functools.partial(_sweep_points, clip))
    pairs: list[tuple[Values, Values]] = [(np.zeros(0), np.zeros(0))] * len(chunk.images)
    for index in sorted(range(len(chunk.images)), key=lambda i: chunk.images[i].centre_t_us):
        image = chunk.images[index]
        xyz = _points_around(clip.tracks, kept, read, image.centre_t_us)
        uv, measured = _visible(image, xyz)
        pairs[index] = _compared(depth_m[index], ~chunk.ego[index], uv, measured)
    return _fit_images(chunk.images, pairs, kind)


# ------------------------------------------------------------------------------------------------------- the points


def _sweep_points(clip: Clip, lidar: str, index: int) -> Points:
    """Points of a sweep in the world, without the recording car, and when each was measured."""
    sweep = clip.sweep(lidar, index)
    near = np.linalg.norm(sweep.xyz_m, axis=1) < MIN_RANGE_M
    xyz = sweep.xyz_world_m
    body = clip.rig.body
    in_rig = geometry.transform_points(geometry.inverse(clip.ego.at(sweep.t_us)), xyz)
    on_body = geometry.points_in_box(in_rig - body.center_m, body.size_m, BODY_MARGIN_M)
    keep = np.isfinite(xyz).all(axis=1) & ~near & ~on_body
    return xyz[keep], sweep.point_t_us[keep]


def _points_around(
    tracks: Sequence[Track], kept: dict[str, list[tuple[int, int]]], read: Callable[[str, int], Points], t_us: int
) -> Float64[np.ndarray, "n 3"]:
    """Points of the sweeps nearest in time, where they were in the world at ``t_us``."""
    parts = [np.zeros((0, 3))]
    for lidar, sweeps in kept.items():
        near = sorted((abs(middle - t_us), i) for middle, i in sweeps if abs(middle - t_us) <= MAX_TIME_US)
        for _, index in near[:SWEEPS_PER_IMAGE]:
            xyz, point_t_us = read(lidar, index)
            parts.append(_carried(tracks, xyz, point_t_us, t_us))
    return np.concatenate(parts)


def _carried(
    tracks: Sequence[Track], xyz: Float64[np.ndarray, "n 3"], point_t_us: Int64[np.ndarray, " n"], t_us: int
) -> Float64[np.ndarray, "n 3"]:
    """Points in labelled boxes move along to ``t_us``; those of boxes that are not known then are left out."""
    xyz, keep, free = xyz.copy(), np.ones(len(xyz), bool), np.ones(len(xyz), bool)
    for track in tracks:
        path, reach = track.path, np.linalg.norm(track.size_m) / 2 + BOX_MARGIN_M
        low, high = path.position_m.min(axis=0) - reach, path.position_m.max(axis=0) + reach
        known = (point_t_us >= path.start_us) & (point_t_us <= path.end_us)
        near = np.flatnonzero(free & known & np.all((xyz > low) & (xyz < high), axis=1))
        box_from_world = geometry.inverse(path.at(point_t_us[near]))
        in_box = np.einsum("nij,nj->ni", box_from_world[:, :3, :3], xyz[near]) + box_from_world[:, :3, 3]
        inside = geometry.points_in_box(in_box, track.size_m, BOX_MARGIN_M)
        xyz[near[inside]] = geometry.transform_points(path.at(t_us), in_box[inside])
        keep[near[inside]] = path.covers(t_us)
        free[near[inside]] = False
    return xyz[keep]


def _visible(image: ContextImage, xyz: Float64[np.ndarray, "n 3"]) -> tuple[Float64[np.ndarray, "n 2"], Values]:
    """Pixels and z-depths of the world points that an image sees: inside it, and not behind other points."""
    camera = image.camera
    xyz = xyz[_ahead(image, xyz)]
    uv, valid, fraction = sensors.project_rolling(camera, image.world_from_camera, xyz)
    seen = np.flatnonzero(valid & sensors.in_image(camera, uv))
    uv, poses = uv[seen], geometry.interpolate_pose_pair(image.world_from_camera, fraction[seen])
    depth = np.einsum("nj,nj->n", poses[:, :3, 2], xyz[seen] - poses[:, :3, 3])
    uv, depth = uv[depth > MIN_RANGE_M / 2], depth[depth > MIN_RANGE_M / 2]
    column, row = np.floor(uv).astype(np.int64).T
    nearest = np.full((camera.height_px, camera.width_px), np.inf)
    np.minimum.at(nearest, (row, column), depth)
    # Sweeps are sparse and what hides a point may lie some pixels away. Below a point of the road is always nearer
    # road, which hides nothing; so only what lies beside and above counts: things that stand up.
    reach = max(1, round(camera.width_px / 100))
    nearest = cv2.erode(
        nearest, np.ones((reach + 1, 2 * reach + 1), np.uint8), anchor=(reach, reach), borderValue=np.inf
    )
    free = depth <= HIDDEN_RATIO * nearest[row, column]
    return uv[free], depth[free]


def _ahead(image: ContextImage, xyz: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Points within the cone around all rays of an image: most points of a sweep need no exact projection."""
    rays, valid = sensors.pixel_rays(image.camera)
    widest = np.arccos(np.clip(rays[..., 2][valid].min(initial=1.0), -1.0, 1.0)) + CONE_MARGIN_RAD
    origin, axis = image.world_from_camera[0, :3, 3], image.world_from_camera[0, :3, 2]
    offset = xyz - origin
    along = np.einsum("nj,j->n", offset, axis)
    return along >= np.cos(min(widest, np.pi)) * np.sqrt(np.einsum("nj,nj->n", offset, offset))


def _compared(
    depth_m: Float32[np.ndarray, "h w"], use: Bool[np.ndarray, "h w"], uv: Float64[np.ndarray, "n 2"], measured: Values
) -> tuple[Values, Values]:
    """Predicted and measured depth of the points whose prediction is sure: not at an edge, not on a masked pixel."""
    height, width = depth_m.shape
    place = np.clip(uv - 0.5, 0, (width - 1, height - 1))
    column, row = np.minimum(np.floor(place).astype(np.int64), (width - 2, height - 2)).T
    across, down = (place - np.stack([column, row], axis=1)).T
    corners = np.stack([depth_m[row + i, column + j].astype(np.float64) for i in (0, 1) for j in (0, 1)])
    sure = np.isfinite(corners).all(axis=0) & (corners > 0).all(axis=0)
    sure &= np.stack([use[row + i, column + j] for i in (0, 1) for j in (0, 1)]).all(axis=0)
    corners = np.where(sure, corners, 1.0)
    sure &= corners.max(axis=0) <= EDGE_RATIO * corners.min(axis=0)
    # Inverse depth is linear over the image of a plane.
    weights = np.stack([(1 - down) * (1 - across), (1 - down) * across, down * (1 - across), down * across])
    return 1 / np.sum(weights / corners, axis=0)[sure], measured[sure]


# --------------------------------------------------------------------------------------------------------- the fits


def _fit_images(images: Sequence[ContextImage], pairs: Sequence[tuple[Values, Values]], kind: Kind) -> DepthFit:
    """Fits from (predicted, measured) depths; images with too few points take what others found."""
    own = {i: _scale(*pair) for i, pair in enumerate(pairs) if len(pair[0]) >= MIN_POINTS}
    fits = []
    for index, (image, (predicted, measured)) in enumerate(zip(images, pairs, strict=True)):
        same = [scale for i, scale in own.items() if images[i].camera.id == image.camera.id]
        slope, range_m = 0.0, (0.0, 0.0)
        taken_from: Literal["own", "camera", "chunk", "none"] = "none"
        scale = 1.0
        if index in own:
            taken_from, scale = "own", own[index]
            if kind == "affine":
                scale, slope, range_m = _affine(predicted, measured, scale)
        elif own:
            taken_from = "camera" if same else "chunk"
            scale = float(np.exp(np.median(np.log(same or list(own.values())))))
        fit = ImageFit(image.camera.id, image.frame, len(predicted), taken_from, scale, slope, range_m, None, None)
        before, after = _errors([fit], [(predicted, measured)])
        fits.append(dataclasses.replace(fit, error_before=before, error_after=after))
    return DepthFit(kind, tuple(fits), *_errors(fits, pairs))


def _errors(fits: Sequence[ImageFit], pairs: Sequence[tuple[Values, Values]]) -> tuple[float | None, float | None]:
    """Median relative error of depth before and after the fits, None without points."""
    before = np.concatenate([np.abs(p / m - 1) for p, m in pairs])
    after = np.concatenate([np.abs(fit.factor(p) * p / m - 1) for fit, (p, m) in zip(fits, pairs, strict=True)])
    return (float(np.median(before)), float(np.median(after))) if len(before) else (None, None)


def _scale(predicted: Values, measured: Values) -> float:
    """The factor from predicted to measured depth: the median ratio, then the mean of those that agree with it."""
    ratio = np.log(measured / predicted)
    centre = float(np.median(ratio))
    for _ in range(TUKEY_STEPS):
        weight = _tukey(ratio - centre)
        centre = float(np.sum(weight * ratio) / np.sum(weight))
    return float(np.exp(centre))


def _affine(predicted: Values, measured: Values, scale: float) -> tuple[float, float, tuple[float, float]]:
    """Scale, slope and range of ``1 / measured = 1 / (scale * predicted) + slope``; slope 0 if the points give none.

    Errors are relative to the measured depth. Least absolute errors first, which outliers cannot drag away, then
    weighted least squares of what agrees.
    """
    low, near, far, high = np.percentile(predicted, (2, 10, 90, 98))
    plain = scale, 0.0, (0.0, 0.0)
    if len(predicted) < MIN_AFFINE_POINTS or far < MIN_AFFINE_SPREAD * near:
        return plain
    ratio = measured / predicted
    inverse, slope = 1 / scale, 0.0
    for step in range(ABSOLUTE_STEPS + TUKEY_STEPS):
        error = inverse * ratio + slope * measured - 1
        weight = 1 / np.maximum(np.abs(error), 1e-4) if step < ABSOLUTE_STEPS else _tukey(error)
        # Plain sums instead of a matrix product: the same bytes at any number of threads.
        a, b, c = (float(np.sum(weight * term)) for term in (ratio * ratio, ratio * measured, measured * measured))
        x, y = float(np.sum(weight * ratio)), float(np.sum(weight * measured))
        determinant = a * c - b * b
        if determinant <= 1e-9 * a * c:
            return plain
        inverse, slope = (x * c - y * b) / determinant, (a * y - b * x) / determinant
    # Positive and rising depths: a positive inverse at both ends of the range, and a positive factor at depth 0.
    ends = inverse + slope * low, inverse + slope * high
    if inverse <= 0 or min(ends) <= 0 or max(ends) > MAX_BEND * min(ends):
        return plain
    return 1 / inverse, slope, (float(low), float(high))


def _tukey(error: Values) -> Values:
    """Tukey's weights: 1 for small errors down to 0 from 4.7 standard deviations (of the median deviation) on."""
    spread = max(1.4826 * float(np.median(np.abs(error))), 1e-4)
    return np.maximum(1 - (error / (4.685 * spread)) ** 2, 0.0) ** 2
