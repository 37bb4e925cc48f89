"""Which views the depth of a view is matched with: those that look the same way from elsewhere, and other cameras.

Fields of view of a car's cameras overlap at their borders, though their axes are 50 degrees and more apart. Beyond the
LiDAR's field only such pairs tell the depth there, and where it is wrong, each camera sees the other's surfaces amiss.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from nurec_sim import geometry
from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.lift.splat import project_point, world_point
from nurec_sim.reconstruct.lift.views import WorkingView

ALIKE, OPPOSITE = 0.9, -0.5
"""Least cosine between the directions of views that look the same way, and of views that can show the same at all."""
NEAREST_M, FARTHEST_M = 0.25, 8.0
"""How far views are apart: a short baseline does not resolve depth, a long one changes what is seen."""
BESIDE, LEAST_SHARED = 3, 0.03
"""Views of other cameras at most, and the share of a view's pixels that each of them shows at least."""
SHARED_AT_M = 15.0
"""Two views share what both would show at this distance."""
GRID = 12
"""Pixels along either edge of a view that are looked for in another one."""
DARKEST, BRIGHTEST, ENOUGH = 8, 245, 100
"""Colours, of 255, that tell a gain, and of how many pixels at least."""


def neighbours_of(views: Sequence[WorkingView], k: int, count: int) -> list[int]:
    """Views to match view k against: alike in direction and time, 0.25 to 8 m away and best about 1.5 m."""
    mine = views[k]
    scored = []
    for n, other in enumerate(views):
        move = other.world_from_view[:3, 3] - mine.world_from_view[:3, 3]
        base = float(np.linalg.norm(move))
        facing = float(other.world_from_view[:3, 2] @ mine.world_from_view[:3, 2])
        if n == k or not NEAREST_M < base < FARTHEST_M or facing < ALIKE:
            continue
        ahead = float(move @ mine.world_from_view[:3, 2])
        # A short baseline does not resolve depth, a long one changes the appearance; ties go to views from farther
        # back, whose images contain this one's surroundings.
        score = abs(np.log(base / 1.5)) + 2 * (1 - facing) + 0.3 * abs(other.t_us - mine.t_us) / 1e6
        scored.append((score + (0.05 if ahead > 0 else 0.0), n))
    return [n for _, n in sorted(scored)[:count]]


def views_beside(views: Sequence[WorkingView], k: int) -> list[int]:
    """Views of other cameras that look elsewhere, but show some of what view k shows; those that show most first.

    Of each camera, and each window into it, that is the view nearest in time.
    """
    mine, nearest = views[k], dict[tuple[str, bytes], tuple[int, int]]()
    for n, other in enumerate(views):
        window, apart = (other.camera_id, other.tile.camera_from_tile.tobytes()), (abs(other.t_us - mine.t_us), n)
        # Most views of a long log are too late to be looked at closer.
        if other.camera_id == mine.camera_id or apart > nearest.get(window, apart):
            continue
        base = float(np.linalg.norm(other.world_from_view[:3, 3] - mine.world_from_view[:3, 3]))
        facing = float(other.world_from_view[:3, 2] @ mine.world_from_view[:3, 2])
        if NEAREST_M < base < FARTHEST_M and OPPOSITE < facing < ALIKE:
            nearest[window] = apart
    points = _some_points(mine)
    shared = sorted((-_share(points, views[n]), n) for _, n in nearest.values())
    return [n for share, n in shared[:BESIDE] if -share >= LEAST_SHARED]


def _some_points(view: WorkingView) -> Float64[np.ndarray, "n 3"]:
    """World points that a view shows at ``SHARED_AT_M``, evenly over its pixels."""
    tile, steps = view.tile, (np.arange(GRID) + 0.5) / GRID
    u, v = (each.ravel() for each in np.meshgrid(steps * tile.width, steps * tile.height))
    valid = tile.valid[v.astype(int), u.astype(int)]
    x, y = (u[valid] - tile.center_px[0]) / tile.focal_px, (v[valid] - tile.center_px[1]) / tile.focal_px
    rays = np.column_stack([x, y, np.ones_like(x)]) / np.sqrt(x * x + y * y + 1)[:, None]
    return geometry.transform_points(view.world_from_view, SHARED_AT_M * rays)


def _share(points: Float64[np.ndarray, "n 3"], view: WorkingView) -> float:
    """Share of points that a view shows."""
    packed, shown = view.packed.reshape(1, -1), 0
    for x, y, z in points:
        u, v, far = project_point(packed, 0, x, y, z)
        if far > 0 and 0 <= u < view.tile.width and 0 <= v < view.tile.height:
            shown += bool(view.tile.valid[int(v), int(u)])
    return shown / max(len(points), 1)


def in_colours_of(
    view: WorkingView, other: WorkingView, measured: Float32[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """The picture of another camera's view as bright as a view, by a gain per channel from measured pixels of both.

    Matching compares colours, too; exposures of a car's cameras differ by up to three times.

    Args:
        view: the view.
        other: of another camera.
        measured: inverse depth of the view's pixels that is measured, 1/m; 0 where there is none.
    """
    packed = other.packed.reshape(1, -1)
    both = _shared_colours(view.packed, view.world_from_view, view.rgb, measured, packed, other.rgb)
    good = ((both > DARKEST) & (both < BRIGHTEST)).all(axis=(1, 2))
    if np.count_nonzero(good) < ENOUGH:
        return other.rgb
    gain = np.exp(np.median(np.log(both[good, 0]) - np.log(both[good, 1]), axis=0))
    return np.clip(np.rint(gain * other.rgb), 0, 255).astype(np.uint8)


@kernel
def _shared_colours(view, world_from_view, rgb, measured, other, other_rgb):
    """Colours [n,2,3] (0..255) of the measured pixels of a view in it and in another one."""
    height, width = measured.shape
    found, count = np.empty((height * width, 2, 3), np.float32), 0
    for row in range(height):
        for column in range(width):
            if not measured[row, column] > 0:
                continue
            x, y, z = world_point(view, world_from_view, column + 0.5, row + 0.5, measured[row, column])
            u, v, far = project_point(other, 0, x, y, z)
            if far <= 0 or u < 0 or v < 0 or u >= other[0, 3] or v >= other[0, 4]:
                continue
            for c in range(3):
                found[count, 0, c], found[count, 1, c] = rgb[row, column, c], other_rgb[int(v), int(u), c]
            count += 1
    return found[:count].copy()
