"""Depth of neighbouring views fused: each view's own is noisy, and what several of them agree on is not.

Visibility-based fusion (Merrell et al. 2007): at each pixel the own depth competes with what the neighbours show there.
The depth that most of them support wins, and becomes the mean of its supporters. A nearer surface hides what lies
behind it, so a farther depth also needs neighbours that look through the near one. A depth that neighbours show
nothing like is disputed: it is as likely to be wrong as theirs.

What is left of the noise of a view's own depth tears surfaces: seen from elsewhere, neighbouring pixels lie apart. So
depths are smoothed along surfaces after the first round; the rounds after it make views agree again. A view without
neighbours keeps its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Int32

from nurec_sim.compute.cores import in_order
from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.lift.depth import NO_SURFACE
from nurec_sim.reconstruct.lift.lifting import stacked
from nurec_sim.reconstruct.lift.smooth_surfaces import smooth_surfaces
from nurec_sim.reconstruct.lift.splat import project_point, world_point
from nurec_sim.reconstruct.lift.views import WorkingView

NEIGHBOURS = 8
"""Views whose depth is compared with a view's own."""
NEAREST_M, FARTHEST_M = 0.25, 10.0
"""Distances of the neighbours."""
FACING = 0.7
"""Least cosine between the directions of neighbours."""
AGREE = 0.05
"""Two depths support each other within this share of the inverse depth, plus ``tolerance``."""
FARTHEST = 1e-3
"""1/m; pixels at infinity are taken to the neighbours at this inverse depth."""


def fused_depths(
    views: Sequence[WorkingView],
    depths: Sequence[Float32[np.ndarray, "h w"]],
    fixed: Sequence[Bool[np.ndarray, "h w"]],
    surfaces: Sequence[Bool[np.ndarray, "h w"]],
    tolerance: float,
    rounds: int,
) -> tuple[list[Float32[np.ndarray, "h w"]], list[Bool[np.ndarray, "h w"]]]:
    """Inverse depths of all views after fusing them ``rounds`` times, and smoothing them once between.

    Args:
        views: working views.
        depths: their inverse depths, 1/m; 0 is infinitely far, NaN takes no part.
        fixed: pixels that keep their depth: it is measured, or that of the sky. They support others.
        surfaces: pixels that do not look like the sky: they become no farther than a surface can be.
        tolerance: 1/m, see ``AGREE``.
        rounds: each spreads agreement to the neighbours of neighbours.

    Returns:
        The inverse depths, and which pixels are disputed in the last round: neighbours show something there, but none
        of them supports what became of it.
    """
    around, everyone = nearest_views(views), range(len(views))
    packed = np.stack([view.packed for view in views]) if views else np.zeros((0, 23))
    poses = [view.world_from_view for view in views]
    numbers = [_numbered(~kept & (depth >= 0)) for depth, kept in zip(depths, fixed, strict=True)]

    def shown(k: int, points: Sequence[np.ndarray], seen: Float32[np.ndarray, "n open"]) -> np.ndarray:
        for row, n in enumerate(around[k]):
            warp(points[n], packed[k], numbers[k], seen[row])
        return seen

    def one(k: int) -> tuple[np.ndarray, np.ndarray]:
        near = around[k]
        if not near:
            return before[k], disputed[k]
        return fuse(
            before[k], numbers[k], shown(k, points, measured[k].copy()), packed[k], poses[k], packed[near],
            stacked([before[n] for n in near]), surfaces[k], tolerance,
        )  # fmt: skip

    def smoothed(k: int) -> np.ndarray:
        return smooth_surfaces(before[k], fixed[k]) if around[k] else before[k]

    def points_where(masks: Sequence[np.ndarray]) -> list[np.ndarray]:
        return list(in_order(lambda k: points_of(packed[k], poses[k], before[k], masks[k]), everyone))

    before, disputed = list(depths), [np.zeros(depth.shape, bool) for depth in depths]
    if not rounds:
        return before, disputed
    # What is measured stays, so its points are taken to the neighbours only once.
    points = points_where(fixed)
    nothing = [np.full((len(near), number.max(initial=-1) + 1), np.nan, np.float32)
               for near, number in zip(around, numbers, strict=True)]  # fmt: skip
    measured = list(in_order(lambda k: shown(k, points, nothing[k]), everyone))
    for done in range(rounds):
        if done == 1:
            before = list(in_order(smoothed, everyone))
        points = points_where([number >= 0 for number in numbers])
        fused = list(in_order(one, everyone))
        before, disputed = [depth for depth, _ in fused], [mask for _, mask in fused]
    return before, disputed


def _numbered(mask: Bool[np.ndarray, "h w"]) -> Int32[np.ndarray, "h w"]:
    """The pixels of a mask numbered row by row; -1 elsewhere."""
    return np.where(mask, np.cumsum(mask).reshape(mask.shape) - 1, -1).astype(np.int32)


def nearest_views(views: Sequence[WorkingView]) -> list[list[int]]:
    """For each view the nearest others that look the same way, ``NEIGHBOURS`` at most."""
    place = np.array([view.world_from_view[:3, 3] for view in views]).reshape(-1, 3)
    ahead = np.array([view.world_from_view[:3, 2] for view in views]).reshape(-1, 3)
    found = []
    for k in range(len(views)):
        far = np.linalg.norm(place - place[k], axis=1)
        good = (far > NEAREST_M) & (far < FARTHEST_M) & (ahead @ ahead[k] > FACING)
        order = np.argsort(far, kind="stable")
        found.append(order[good[order]][:NEIGHBOURS].tolist())
    return found


@kernel
def points_of(view, world_from_view, depth, mask):
    """World points [n,3] of a view's pixels in a mask.

    Args:
        view: [23] packed projection (``WorkingView.packed``).
        world_from_view: [4,4] its pose.
        depth: [h,w] its inverse depth, 1/m; pixels without one, NaN, are left out.
        mask: [h,w].
    """
    points, count = np.empty((mask.sum(), 3)), 0
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            w = depth[row, column]
            if mask[row, column] and w >= 0.0:
                x, y, z = world_point(view, world_from_view, column + 0.5, row + 0.5, max(w, FARTHEST))
                points[count, 0], points[count, 1], points[count, 2] = x, y, z
                count += 1
    return points[:count].copy()


@kernel
def warp(points, other, numbers, shown):
    """What a view shows of points: the nearest ones, in the pixels they fall in.

    Args:
        points: [n,3] world.
        other: [23] packed projection of the view.
        numbers: [h,w] of the pixels that are asked about, negative for others.
        shown: [open] inverse depth in these pixels, 1/m; NaN where nothing falls. Changed.
    """
    (height, width), others = numbers.shape, other.reshape(1, -1)
    for i in range(len(points)):
        u, v, far = project_point(others, 0, points[i, 0], points[i, 1], points[i, 2])
        if far <= 0.3 or u < 0 or v < 0 or u >= width or v >= height:
            continue
        number = numbers[int(v), int(u)]
        if number >= 0 and not shown[number] >= 1.0 / far:
            shown[number] = 1.0 / far


@kernel
def fuse(own, numbers, candidates, view, world_from_view, others, other_depths, surfaces, tolerance):
    """The fused inverse depth [h,w] of a view, and which of its pixels [h,w] are disputed.

    Args:
        own: [h,w] its inverse depth, 1/m; 0 is infinitely far.
        numbers: [h,w] of the pixels that are fused, negative for others.
        candidates: [n,open] what the neighbours show there (``warp``).
        view: [23] packed projection of the view.
        world_from_view: [4,4] its pose.
        others: [n,23] packed projections of the neighbours.
        other_depths: [n,h',w'] their inverse depths.
        surfaces: [h,w] pixels that do not become sky.
        tolerance: 1/m, see ``AGREE``.
    """
    result, some = own.copy(), np.empty(len(candidates) + 1, np.float32)
    disputed = np.zeros(own.shape, np.bool_)
    for row in range(own.shape[0]):
        for column in range(own.shape[1]):
            number = numbers[row, column]
            if number < 0:
                continue
            some[0], count = own[row, column], 1
            least = NO_SURFACE if surfaces[row, column] else 0.0
            for n in range(len(candidates)):
                if candidates[n, number] >= least:
                    some[count] = candidates[n, number]
                    count += 1
            best, support, own_support = 0, 0, 0
            for i in range(count):
                near, reach = 0, tolerance + AGREE * some[i]
                for j in range(count):
                    near += abs(some[j] - some[i]) < reach
                if i == 0:
                    own_support = near
                if near > support:
                    best, support = i, near
            if some[best] < some[0] - tolerance - AGREE * some[0]:
                x, y, z = world_point(view, world_from_view, column + 0.5, row + 0.5, some[0])
                agree, through = 0, 0
                for n in range(len(others)):
                    u, v, far = project_point(others, n, x, y, z)
                    if far <= 0.3 or u < 0 or v < 0 or u >= others[n, 3] or v >= others[n, 4]:
                        continue
                    there, here = other_depths[n, int(v), int(u)], 1.0 / far
                    agree += abs(there - here) < tolerance + AGREE * here
                    through += there <= here - tolerance - AGREE * here
                if through <= agree:
                    best, support = 0, own_support
            disputed[row, column] = support == 1 and count > 1
            if support > 1:
                total, reach = 0.0, tolerance + AGREE * some[best]
                for j in range(count):
                    if abs(some[j] - some[best]) < reach:
                        total += some[j]
                result[row, column] = total / support
    return result, disputed
