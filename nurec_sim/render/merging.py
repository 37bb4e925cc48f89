"""Merging Gaussians four to one by their moments, and the visible error of the result; float64 NumPy.

A merged Gaussian has the mean and the covariance of those it replaces, weighted with their *mass*: opacity times area,
the product of the two largest standard deviations. Its opacity is such that, seen along its smallest axis, it covers
as much as they do together; where that takes more than ``MAX_OPACITY`` it becomes wider instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from nurec_sim import geometry
from nurec_sim.render.cpu.pack import MAX_OPACITY
from nurec_sim.types import Gaussians

GROUP = 4
MIN_OPACITY = 1.001 / 255
CHUNK = 2048
"""Groups that are processed at once: their temporary arrays stay in the cache."""

COLOUR_WEIGHT, NORMAL_WEIGHT, LABEL_WEIGHT = 12.0, 1.5, 4.0
"""What differences of colour (0..1), normal and label weigh in grouping, against one standard deviation of distance."""

MOST_DIFFERENT = 1e6
"""Features are clipped to this; their squares must fit float32."""

NEIGHBOURS = 64
BASE_CONTRAST = 0.05
"""Contrast of a Gaussian to what is behind it where all its neighbours have one colour."""
BACKDROP = 0.3
"""Contrast of a surface to what is behind it."""
ORDER_SHARE = 0.3
"""Which part of a Gaussian's contrast to its neighbours shows when merging changes the order of their depths."""

GRID = np.linspace(-3, 3, 6)
GRID_X, GRID_Y = (axis.ravel() for axis in np.meshgrid(GRID, GRID))
GRID_CELL = float((GRID[1] - GRID[0]) ** 2)
UNIT_FALL = np.exp(-(GRID_X**2 + GRID_Y**2) / 2)
"""A standard normal falloff over the points at which a group and its merged Gaussian are compared."""


@dataclass(frozen=True, eq=False)
class Surfels:
    """Gaussians, and the quantities that merging needs.

    ``contrast2`` is the squared contrast to their neighbours, ``error_m2`` the area in square
    metres that is wrong when they are rendered instead of those they replace.
    """

    gaussians: Gaussians
    covariance: Float64[np.ndarray, "n 3 3"]
    axis: Float64[np.ndarray, "n 3"]
    area: Float64[np.ndarray, " n"]
    contrast2: Float64[np.ndarray, " n"]
    error_m2: Float64[np.ndarray, " n"]

    def rows(self, order: Int64[np.ndarray, " m"]) -> Surfels:
        """Some of them, in this order."""
        return Surfels(self.gaussians[order], *(getattr(self, name)[order] for name in _ARRAYS))


_ARRAYS = ("covariance", "axis", "area", "contrast2", "error_m2")


def as_surfels(gaussians: Gaussians, contrast2: Float64[np.ndarray, " n"]) -> Surfels:
    """Surfels of unmerged Gaussians, without error."""
    scale = gaussians.scale_m.astype(np.float64)
    rotation = geometry.matrix_from_quat(gaussians.quat_wxyz)
    spread = rotation * scale[:, None]
    axis = np.take_along_axis(rotation, scale.argmin(axis=1)[:, None, None], axis=2)[..., 0]
    area = np.sort(scale, axis=1)[:, 1:].prod(axis=1)
    return Surfels(gaussians, spread @ spread.transpose(0, 2, 1), axis, area, contrast2, np.zeros(len(scale)))


def local_contrast(gaussians: Gaussians) -> Float64[np.ndarray, " n"]:
    """Squared contrast of Gaussians, which are sorted by place, to what is around them and behind.

    Of runs of ``NEIGHBOURS``: the variance of their colours (mean of the channels), and what shines through all of
    them, taken to cover a flat patch evenly, of a background that differs by ``BACKDROP``.
    """
    n = len(gaussians)
    rows = np.minimum(np.arange(-(-n // NEIGHBOURS) * NEIGHBOURS), n - 1).reshape(-1, NEIGHBOURS)
    mass = (gaussians.opacity * np.sort(gaussians.scale_m, axis=1)[:, 1:].prod(axis=1)).astype(np.float64)
    total = np.maximum(mass[rows].sum(axis=1), 1e-30)
    weight = mass[rows] / total[:, None]
    colour, place = gaussians.rgb[rows].astype(np.float64), gaussians.mean_m[rows].astype(np.float64)
    colour -= np.einsum("rk,rkc->rc", weight, colour)[:, None]
    place -= place.mean(axis=1, keepdims=True)
    # The two larger variances: neighbours lie on a surface, whose thickness does not count.
    spread = np.linalg.eigvalsh(np.einsum("rki,rkj->rij", place, place) / NEIGHBOURS)[:, 1:].clip(min=0)
    patch = 12 * np.sqrt(spread.prod(axis=1))  # area of an even rectangle of this spread
    # An unnormalised 2D Gaussian of unit opacity has the integral 2 pi times its area.
    layers = 2 * np.pi * total / np.maximum(patch, 1e-30)
    contrast2 = np.einsum("rk,rkc->r", weight, colour**2) / 3 + (BACKDROP * np.exp(-layers)) ** 2
    return np.repeat(contrast2, NEIGHBOURS)[:n]


def grouped(surfels: Surfels, span: int) -> Int64[np.ndarray, "groups 4"]:
    """Groups of ``GROUP`` similar rows within every ``span`` rows; -1 fills up the last group.

    Each span is halved again and again at the median of the feature that spreads widest in it.
    """
    n = len(surfels.area)
    spans = -(-n // span)
    padded = np.arange(spans * span).reshape(spans, span)
    features = _features(surfels, padded.clip(max=n - 1), padded < n)
    step = max(1, 65536 // span)
    parts = [_halved(features[k : k + step], padded[k : k + step]) for k in range(0, spans, step)]
    rows = np.concatenate([np.zeros((0, GROUP), np.int64), *parts])
    rows = np.where(rows < n, rows, -1)
    return rows[(rows >= 0).any(axis=1)]


def _features(
    surfels: Surfels, rows: Int64[np.ndarray, "s k"], real: Bool[np.ndarray, "s k"]
) -> Float32[np.ndarray, "s k f"]:
    """What Gaussians are grouped by; infinite where there is none."""
    g, axis = surfels.gaussians, surfels.axis
    size = np.sqrt(surfels.area)
    # Distances in units of the neighbourhood's typical standard deviation.
    typical = np.median(size[rows], axis=1)
    mean = (g.mean_m[rows] - g.mean_m[rows[:, :1]].astype(np.float64)) / typical[:, None, None]
    # Products of the axis with itself: the same for an axis and its opposite. Five of the six; the trace is 1.
    turned = NORMAL_WEIGHT * np.stack(
        [axis[:, i] * axis[:, j] for i, j in ((0, 1), (1, 2), (2, 0), (0, 0), (2, 2))], -1
    )
    own = np.concatenate(
        [COLOUR_WEIGHT * g.rgb, turned, np.log(size)[:, None], LABEL_WEIGHT * g.label[:, None]], axis=1
    ).astype(np.float32)
    features = np.concatenate([mean.astype(np.float32), own[rows]], axis=2).clip(-MOST_DIFFERENT, MOST_DIFFERENT)
    features[~real] = np.inf
    return features


def _halved(features: Float32[np.ndarray, "s k f"], rows: Int64[np.ndarray, "s k"]) -> Int64[np.ndarray, "groups 4"]:
    spans, count, width = features.shape
    features, rows = features.reshape(-1, width), rows.reshape(-1)
    while count > GROUP:
        parts = features.reshape(-1, count, width)
        real = np.isfinite(parts[..., :1])
        number = np.maximum(real.sum(axis=1), 1)
        present = np.where(real, parts, 0)
        mean = present.sum(axis=1) / number
        # Variance per feature of the rows that are there.
        spread = np.einsum("skf,skf->sf", present, present) / number - mean**2
        key = np.take_along_axis(parts, spread.argmax(axis=1)[:, None, None], axis=2)[..., 0]
        order = (np.argsort(key, axis=1, kind="stable") + np.arange(len(parts))[:, None] * count).reshape(-1)
        features, rows = features[order], rows[order]
        count //= 2
    return rows.reshape(-1, GROUP)


def merge(surfels: Surfels, groups: Int64[np.ndarray, "groups 4"]) -> Surfels:
    """One surfel per group of rows (-1: none), which every group has at least one of."""
    parts = [_merge_chunk(surfels, groups[k : k + CHUNK]) for k in range(0, len(groups), CHUNK)]
    if not parts:
        return surfels
    gaussians = Gaussians.concatenate([part.gaussians for part in parts])
    return Surfels(gaussians, *(np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS))


def _merge_chunk(surfels: Surfels, groups: Int64[np.ndarray, "g 4"]) -> Surfels:
    """``merge`` of a few groups."""
    present, rows = groups >= 0, np.maximum(groups, 0)
    g = surfels.gaussians[rows]
    opacity = np.where(present, np.minimum(g.opacity, MAX_OPACITY), 0).astype(np.float64)
    mass = opacity * surfels.area[rows]
    weight = mass / mass.sum(axis=1, keepdims=True)
    centre = g.mean_m.astype(np.float64)
    mean = np.einsum("gk,gkc->gc", weight, centre)
    offset = centre - mean[:, None]
    child = surfels.covariance[rows]
    # Law of total covariance: mean of the covariances plus covariance of the means.
    covariance = np.einsum("gk,gkij->gij", weight, child) + np.einsum("gk,gki,gkj->gij", weight, offset, offset)
    variance, axes = np.linalg.eigh(covariance)
    sigma = np.sqrt(np.maximum(variance, 1e-12))
    # A rotation, not a reflection: the sign of an eigenvector is free.
    axes[:, :, 0] *= np.where(np.linalg.det(axes) < 0, -1, 1)[:, None]

    alphas = _profiles(opacity, offset, child, sigma, axes)
    # Layers in any order let through the product of their transmittances.
    alpha = 1 - (1 - alphas).prod(axis=1)
    wanted = alpha.sum(axis=1) / UNIT_FALL.sum()
    covered = np.clip(wanted, MIN_OPACITY, MAX_OPACITY)
    # Coverage is proportional to opacity times area, so each side grows by the square root.
    growth = np.sqrt(np.maximum(wanted / MAX_OPACITY, 1))
    drawn = covered[:, None] * UNIT_FALL ** (1 / growth[:, None] ** 2)

    rgb = np.einsum("gk,gkc->gc", weight, g.rgb.astype(np.float64))
    label, same_label = _heaviest(g.label, mass)
    share = alphas / np.maximum(alphas.sum(axis=1, keepdims=True), 1e-12)
    # Which of them shows where they overlap depends on the view, so a colour counts in full, not its mean.
    tint2 = ((g.rgb - rgb[:, None]) ** 2).mean(axis=2)
    contrast2 = np.einsum("gk,gk->g", weight, surfels.contrast2[rows])
    wrong = alpha**2 * np.einsum("gkp,gk->gp", share, tint2) + (alpha - drawn) ** 2 * (
        contrast2[:, None] + BASE_CONTRAST**2
    )
    wrong += alpha**2 * (ORDER_SHARE * contrast2 + (1 - same_label) ** 2)[:, None]
    # Squared colour error integrated over the plane; the grid is in standard deviations.
    error_m2 = wrong.sum(axis=1) * (GRID_CELL * sigma[:, 1] * sigma[:, 2])
    # Errors of earlier levels add up.
    error_m2 += np.where(present, surfels.error_m2[rows], 0).sum(axis=1)

    sigma[:, 1:] *= growth[:, None]
    spread = axes * sigma[:, None]
    merged = Gaussians(
        mean_m=mean.astype(np.float32),
        quat_wxyz=geometry.quat_from_matrix(axes).astype(np.float32),
        scale_m=sigma.astype(np.float32),
        opacity=covered.astype(np.float32),
        rgb=rgb.astype(np.float32),
        normal=_mean_normal(g.normal, weight),
        label=label,
        intensity=_mean_intensity(g.intensity, weight),
        sh_rest=None if g.sh_rest is None else np.einsum("gk,gkjc->gjc", weight, g.sh_rest).astype(np.float32),
        ray_drop=None if g.ray_drop is None else np.einsum("gk,gk->g", weight, g.ray_drop).astype(np.float32),
        falloff=None if g.falloff is None else np.einsum("gk,gk->g", weight, g.falloff).astype(np.float32),
    )
    area = sigma[:, 1] * sigma[:, 2]
    return Surfels(merged, spread @ spread.transpose(0, 2, 1), axes[:, :, 0], area, contrast2, error_m2)


def _profiles(
    opacity: Float64[np.ndarray, "g 4"],
    offset: Float64[np.ndarray, "g 4 3"],
    covariance: Float64[np.ndarray, "g 4 3 3"],
    sigma: Float64[np.ndarray, "g 3"],
    axes: Float64[np.ndarray, "g 3 3"],
) -> Float64[np.ndarray, "g 4 points"]:
    """Alpha of each Gaussian of a group over the grid, seen along the smallest axis of the merged one.

    The grid is in units of the merged one's two larger standard deviations. The response along parallel rays is the
    marginal of the Gaussian: its 2 x 2 covariance in the plane.
    """
    plane = axes[:, :, 1:] / sigma[:, None, 1:]
    x, y = np.moveaxis(np.einsum("gkc,gci->gki", offset, plane), -1, 0)
    flat = np.einsum("gci,gkcd,gdj->gkij", plane, covariance, plane, optimize=True)
    xx, xy, yy = flat[..., 0, 0], flat[..., 0, 1], flat[..., 1, 1]
    inverse = 1 / np.maximum(xx * yy - xy * xy, 1e-12)
    a, b, c = yy * inverse, -xy * inverse, xx * inverse
    # The exponent is a quadratic polynomial in the grid's coordinates: one product of matrices for all points.
    terms = np.stack(
        [a * x * x + 2 * b * x * y + c * y * y, -2 * (a * x + b * y), -2 * (b * x + c * y), a, 2 * b, c], axis=-1
    )
    basis = np.stack([np.ones_like(GRID_X), GRID_X, GRID_Y, GRID_X**2, GRID_X * GRID_Y, GRID_Y**2])
    return opacity[..., None] * np.exp(-0.5 * np.maximum(terms @ basis, 0))


def _heaviest(label: np.ndarray, mass: Float64[np.ndarray, "g 4"]) -> tuple[np.ndarray, Float64[np.ndarray, " g"]]:
    """Label of the Gaussian of largest mass, and the part of the mass that has it."""
    best = np.take_along_axis(label, mass.argmax(axis=1)[:, None], axis=1)
    return best[:, 0], (mass * (label == best)).sum(axis=1) / mass.sum(axis=1)


def _mean_normal(
    normal: Float32[np.ndarray, "g 4 3"], weight: Float64[np.ndarray, "g 4"]
) -> Float32[np.ndarray, "g 3"]:
    """Weighted mean direction of the known normals; zero where there are none."""
    total = np.einsum("gk,gkc->gc", weight, np.nan_to_num(normal.astype(np.float64)))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-6, total / np.maximum(length, 1e-6), 0).astype(np.float32)


def _mean_intensity(
    intensity: Float32[np.ndarray, "g 4"], weight: Float64[np.ndarray, "g 4"]
) -> Float32[np.ndarray, " g"]:
    """Weighted mean of the known intensities; NaN where there are none."""
    known = np.isfinite(intensity) * weight
    total = known.sum(axis=1)
    mean = (known * np.where(np.isfinite(intensity), intensity, 0)).sum(axis=1) / np.maximum(total, 1e-30)
    return np.where(total > 0, mean, np.nan).astype(np.float32)
