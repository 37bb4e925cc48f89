"""Predicted depth, image by image, fitted to the log's LiDAR sweeps.

The network's distances are only as accurate as its training; sweeps measure them to centimetres, at a few pixels. One
factor per image takes the prediction to the measurements, optionally with a slope over inverse depth, or with a field
of factors (``lidar.field``) that follows them across the image.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64

from nurec_sim.network.depth_change import with_changed_depth
from nurec_sim.network.tensors import QueryGaussians
from nurec_sim.reconstruct.feedforward.chunks import ChunkInputs, ContextImage
from nurec_sim.reconstruct.feedforward.lidar.field import field_factor
from nurec_sim.reconstruct.feedforward.lidar.points import (
    STANDING_SWEEPS,
    STANDING_TIME_US,
    Seen,
    Values,
    visible_points,
)
from nurec_sim.types import Clip

MIN_POINTS = 50
"""Images that see fewer measured points take the factor of others."""
MIN_AFFINE_POINTS = 200
MIN_AFFINE_SPREAD = 1.5
"""A slope needs points over a range of depths: their 90th percentile over their 10th."""
MAX_BEND = 3.0
"""Largest ratio by which a slope may change the factor over the measured range."""
EDGE_RATIO = 1.25
"""Where the four pixels around a point differ by more than this, the point may belong to either side of an edge."""
ABSOLUTE_STEPS, TUKEY_STEPS = 20, 10

Kind = Literal["scale", "affine", "local"]


@dataclass(frozen=True)
class ImageFit:
    """What was fitted to one image: ``fitted = depth / (1 / scale + slope_per_m * depth)``, before any local factors.

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
        error_after: the same of the fitted depth, local factors included.
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

    def factor(self, depth_m: np.ndarray) -> np.ndarray:
        """By how much each predicted depth has to be multiplied, whatever the shape of the array."""
        return 1 / (1 / self.scale + self.slope_per_m * np.clip(depth_m, *self.range_m))


@dataclass(frozen=True, eq=False)
class DepthFit:
    """The fits of all images of a chunk, in their order.

    ``factor`` is what every pixel's depth is multiplied by; the errors are medians over all points.
    """

    kind: Kind
    images: tuple[ImageFit, ...]
    factor: Float32[np.ndarray, "v h w"]
    error_before: float | None
    error_after: float | None

    def apply(self, gaussians: QueryGaussians, chunk: ChunkInputs) -> QueryGaussians:
        """Gaussians moved along the rays of their pixels to the fitted depth; sizes and motion grow with distance."""
        factor = torch.from_numpy(self.factor).to(gaussians.source.device)
        return with_changed_depth(gaussians, chunk.tensors, factor)

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
    is_static: Bool[np.ndarray, "v h w"] | None = None,
) -> DepthFit:
    """Fit the predicted depth of every image of a chunk to the sweeps around its time.

    Args:
        clip: the log.
        chunk: the images.
        depth_m: predicted z-depth of the images, metres.
        hold_out_sweeps: sweeps that must not be read, by index, of every LiDAR.
        kind: a factor per image; a factor and a slope over inverse depth (where the points allow one); or a factor and
            local ones.
        is_static: pixels of static surfaces, to which local factors also come from sweeps farther in time.

    Raises:
        ReconstructError: the log has no sweeps, or all of them are held out.
    """
    seen = visible_points(clip, chunk, hold_out_sweeps)
    pairs = [_compared(*each) for each in zip(depth_m, ~chunk.ego, seen, strict=True)]
    fits = _fit_images(chunk.images, pairs, kind)
    factor = np.stack([fit.factor(depth) for fit, depth in zip(fits, depth_m, strict=True)])
    if kind == "local":
        rough_m, use = factor * depth_m, ~chunk.ego
        if is_static is None:
            factor *= _local_factors(rough_m, use, seen)
        else:
            # Static surfaces stay where they are, so sweeps from farther in time measure them too.
            more = visible_points(clip, chunk, hold_out_sweeps, STANDING_TIME_US, STANDING_SWEEPS)
            static = _local_factors(rough_m, use & is_static, more)
            factor *= np.where(is_static, static, _local_factors(rough_m, use & ~is_static, seen))
    after = [_compared(*each) for each in zip(factor * depth_m, ~chunk.ego, seen, strict=True)]
    fits = [
        dataclasses.replace(fit, error_before=_error([before]), error_after=_error([fitted]))
        for fit, before, fitted in zip(fits, pairs, after, strict=True)
    ]
    return DepthFit(kind, tuple(fits), factor.astype(np.float32), _error(pairs), _error(after))


def _local_factors(
    depth_m: Float64[np.ndarray, "v h w"], use: Bool[np.ndarray, "v h w"], seen: Sequence[Seen]
) -> Float64[np.ndarray, "v h w"]:
    """``field_factor`` of every image."""
    images = zip(depth_m, use, seen, strict=True)
    return np.stack([field_factor(depth, compared, *points) for depth, compared, points in images])


def _compared(
    depth_m: Float32[np.ndarray, "h w"] | Float64[np.ndarray, "h w"], use: Bool[np.ndarray, "h w"], seen: Seen
) -> tuple[Values, Values]:
    """Predicted and measured depth of the points whose prediction is sure: not at an edge, not on a masked pixel."""
    uv, measured = seen
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


def _fit_images(images: Sequence[ContextImage], pairs: Sequence[tuple[Values, Values]], kind: Kind) -> list[ImageFit]:
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
            # The camera's other images share its calibration errors, so they are the better guess than other cameras.
            scale = float(np.exp(np.median(np.log(same or list(own.values())))))
        fits.append(
            ImageFit(image.camera.id, image.frame, len(predicted), taken_from, scale, slope, range_m, None, None)
        )
    return fits


def _error(pairs: Sequence[tuple[Values, Values]]) -> float | None:
    """Median relative error of (predicted, measured) depths, None without points."""
    error = np.concatenate([np.abs(predicted / measured - 1) for predicted, measured in pairs])
    return float(np.median(error)) if len(error) else None


def _scale(predicted: Values, measured: Values) -> float:
    """The factor from predicted to measured depth: the median ratio, then the mean of those that agree with it."""
    # Log ratios: a factor of 2 and one of 1/2 are equally wrong.
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
        # 1 / measured = inverse / predicted + slope, multiplied by measured: linear in both unknowns, with relative
        # errors.
        error = inverse * ratio + slope * measured - 1
        # Weights 1 / |e| turn least squares into least absolute errors, step by step.
        weight = 1 / np.maximum(np.abs(error), 1e-4) if step < ABSOLUTE_STEPS else _tukey(error)
        # Plain sums instead of a matrix product: the same bytes at any number of threads.
        a, b, c = (float(np.sum(weight * term)) for term in (ratio * ratio, ratio * measured, measured * measured))
        x, y = float(np.sum(weight * ratio)), float(np.sum(weight * measured))
        # The 2 x 2 normal equations by Cramer's rule; nearly singular if all points have about one depth.
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
