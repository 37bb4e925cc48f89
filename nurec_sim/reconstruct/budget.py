"""Fewer Gaussians: those that share a voxel become one with their moments, in voxels just large enough for a budget.

Each Gaussian counts with its *mass*, opacity times area (the product of its two largest standard deviations), so that
large opaque ones dominate; the release weights all equally. A merged Gaussian has its members' mean and covariance. Its
opacity conserves the optical depth that they lay over the plane, ``2 pi area Li2(opacity)`` each (the integral of
``-ln(1 - opacity exp(-r^2 / 2))``; Li2 is the dilogarithm). What it cannot hold where surfaces are opaque makes it
wider, or gaps would open between it and its neighbours; but only so much, as layers seen again by frame after frame
hide each other. Labels never mix. What is alone in its voxel stays as it is.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import spence

from nurec_sim import geometry
from nurec_sim.compute.cores import usable_cores
from nurec_sim.types import Gaussians

FIRST_VOXEL_M = 0.1
FILL = 0.9
"""At least this part of a budget is used."""
DOUBLINGS, BISECTIONS = 30, 20
CLOSE_ENOUGH = 1.001
"""Voxel sizes nearer than this factor are not told apart."""
MIN_SCALE_M = 1e-3
MAX_OPACITY = 0.999
MAX_GROWTH = 1.5
"""How much wider than its members' spread a merged Gaussian becomes at most (the best from a half to an eighth of the
Gaussians of the log that shipped with version 0.1.0, where it is worth 4 dB)."""
AXIS_BITS = 19
"""Voxels per axis, as a power of two; what is further out shares the outermost ones (at 0.1 m: 26 km away)."""
GROUPS_AT_ONCE = 1 << 12
"""Their temporary arrays stay in the cache."""

OPACITIES = np.linspace(0.0, MAX_OPACITY, 4096)
DEPTHS = spence(1 - OPACITIES)
"""Li2 of them: optical depth over the plane, in units of 2 pi area."""


def reduce_to_budget(gaussians: Gaussians, budget: int | None) -> tuple[Gaussians, float | None]:
    """At most ``budget`` Gaussians that look like the given ones.

    The size of the voxels is found by counting alone: doubled or halved from ``FIRST_VOXEL_M`` on until it encloses the
    budget, then bisected until the count is within ``FILL`` and 1 of it.

    Args:
        gaussians: finite, with unit quaternions and positive scales.
        budget: the most that may be left, at least 1; None for any number.

    Returns:
        the Gaussians, and the voxel size in metres; the same object and None if the budget holds already.

    Raises:
        ValueError: the budget is below 1, or there are more labels far apart than it allows.
    """
    if budget is not None and budget < 1:
        raise ValueError(f"a budget must allow at least 1 Gaussian, got {budget}")
    if budget is None or len(gaussians) <= budget:
        return gaussians, None
    voxel_m = voxel_for_budget(gaussians, budget)
    return merge_voxels(gaussians, voxel_m), voxel_m


def voxel_for_budget(gaussians: Gaussians, budget: int) -> float:
    """A voxel size in metres that leaves between ``FILL`` and 1 of a budget, or as near below as sizes allow.

    Raises:
        ValueError: there are more labels than the budget allows.
    """
    too_small, large_enough = 0.0, 0.0
    voxel_m = FIRST_VOXEL_M
    for _ in range(DOUBLINGS + BISECTIONS):
        count = _count(voxel_keys(gaussians, voxel_m))
        if count > budget:
            too_small = voxel_m
        else:
            large_enough = voxel_m
            if count >= FILL * budget:
                break
        if not large_enough:
            voxel_m = 2 * too_small
        elif not too_small:
            voxel_m = large_enough / 2
        elif large_enough < CLOSE_ENOUGH * too_small:
            break
        else:
            # Bisection in the logarithm: counts fall about as a power of the voxel size.
            voxel_m = float(np.sqrt(too_small * large_enough))
    if not large_enough:
        raise ValueError(f"a budget of {budget} is less than the number of labels, {len(np.unique(gaussians.label))}")
    return large_enough


def voxel_keys(gaussians: Gaussians, voxel_m: float) -> Int64[np.ndarray, " n"]:
    """A number per Gaussian, equal for those of one label in one voxel: ``round(mean / voxel_m)``, packed."""
    cells = np.rint(gaussians.mean_m / np.float64(voxel_m))
    half = 1 << (AXIS_BITS - 1)
    # Centred on the scene: world coordinates may be far from the origin, and 19 bits per axis must cover the middle.
    middle = np.rint(np.median(gaussians.mean_m[::64], axis=0) / np.float64(voxel_m))
    cells = np.clip(cells - middle, -half, half - 1).astype(np.int64) + half
    key = gaussians.label.astype(np.int64)
    for axis in range(3):
        key = (key << AXIS_BITS) | cells[:, axis]
    return key


def _count(keys: Int64[np.ndarray, " n"]) -> int:
    ordered = np.sort(keys)
    return int(np.count_nonzero(ordered[1:] != ordered[:-1])) + 1


def merge_voxels(gaussians: Gaussians, voxel_m: float) -> Gaussians:
    """One Gaussian for all of one label in one voxel, in the order of the voxels; see the top of this file."""
    keys = voxel_keys(gaussians, voxel_m)
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    starts = np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1]))
    sizes = np.diff(np.append(starts, len(keys)))
    result = gaussians[order[starts]]
    crowded = np.flatnonzero(sizes > 1)

    def merge_groups(groups: np.ndarray) -> None:
        inside = np.repeat(np.arange(len(groups)), sizes[groups])
        begins = np.cumsum(sizes[groups]) - sizes[groups]
        members = order[np.arange(len(inside)) + np.repeat(starts[groups] - begins, sizes[groups])]
        for name, values in _merged(gaussians[members], inside, begins).items():
            getattr(result, name)[groups] = values

    with ThreadPoolExecutor(usable_cores()) as pool:
        list(pool.map(merge_groups, [crowded[k : k + GROUPS_AT_ONCE] for k in range(0, len(crowded), GROUPS_AT_ONCE)]))
    return result


def _merged(part: Gaussians, inside: Int64[np.ndarray, " m"], begins: Int64[np.ndarray, " g"]) -> dict[str, Any]:
    """Fields of the Gaussians that groups merge to; ``inside`` is each member's group, ``begins`` its first member."""

    def total(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values, begins, axis=0)

    def mean(values: np.ndarray) -> np.ndarray:
        """Weighted; of any shape."""
        flat = values.reshape(len(values), -1).astype(np.float64)
        return total(weight[:, None] * flat).reshape(-1, *values.shape[1:])

    scale = part.scale_m.astype(np.float64)
    area = np.sort(scale, axis=1)[:, 1:].prod(axis=1)
    opacity = np.minimum(part.opacity.astype(np.float64), MAX_OPACITY)
    mass = np.maximum(opacity * area, 1e-30)
    weight = mass / total(mass)[inside]

    centre = part.mean_m.astype(np.float64)
    # Sums of small numbers: far from the origin the spread inside a voxel would drown in rounding.
    origin = centre[begins]
    shift = mean(centre - origin[inside])
    offset = centre - (origin + shift)[inside]
    spread = geometry.matrix_from_quat(part.quat_wxyz) * scale[:, None]
    # Moment matching: E[Sigma_i + d d^T], the Gaussian of least KL divergence from the mixture.
    covariance = mean(spread @ spread.transpose(0, 2, 1) + offset[:, :, None] * offset[:, None, :])
    variance, axes = np.linalg.eigh(covariance)
    # eigh may return a reflection; flipping one axis makes it a rotation.
    axes[:, :, 0] *= np.where(np.linalg.det(axes) < 0, -1, 1)[:, None]
    sigma = np.sqrt(np.maximum(variance, MIN_SCALE_M**2))

    # scipy's spence(z) is Li2(1 - z); the common factor 2 pi cancels against the merged Gaussian's own area.
    depth = total(spence(1 - opacity) * area) / (sigma[:, 1] * sigma[:, 2])
    # DEPTHS[-1] is the most that one Gaussian of this area can hold; more needs area in proportion, so width by its
    # root.
    growth = np.sqrt(np.clip(depth / DEPTHS[-1], 1.0, MAX_GROWTH**2))
    sigma[:, 1:] *= growth[:, None]
    direction = mean(np.nan_to_num(part.normal))
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    fields = {
        "mean_m": origin + shift,
        "quat_wxyz": geometry.quat_from_matrix(axes),
        "scale_m": sigma,
        "opacity": np.interp(depth / growth**2, DEPTHS, OPACITIES),
        "rgb": mean(part.rgb),
        "normal": np.where(length > 1e-6, direction / np.maximum(length, 1e-6), 0.0),
        "intensity": _mean_of_known(part.intensity, weight, begins),
    }
    for name in ("sh_rest", "ray_drop", "falloff"):
        values = getattr(part, name)
        if values is not None:
            fields[name] = mean(values)
    return fields


def _mean_of_known(
    values: np.ndarray, weight: Float64[np.ndarray, " m"], begins: Int64[np.ndarray, " g"]
) -> Float64[np.ndarray, " g"]:
    """Weighted means of what is not NaN; NaN where nothing is known."""
    known = np.isfinite(values)
    share = np.add.reduceat(known * weight, begins)
    total = np.add.reduceat(np.where(known, values, 0) * weight, begins)
    return np.where(share > 0, total / np.where(share > 0, share, 1), np.nan)
