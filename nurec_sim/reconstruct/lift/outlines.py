"""Where the boxes of movers lie in a view, and where a ray meets the lower half of a vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32

from nurec_sim import geometry
from nurec_sim.reconstruct.lift.bodies import Surfels
from nurec_sim.reconstruct.lift.views import WorkingView

BESIDE_M = 0.2
"""Parts are looked for so far outside of a box: those that no beam met are no part of boxes found in sweeps."""
NEAREST_M = 0.5
"""Of boxes only what is farther away than this, along the axis of the camera, has an outline."""
SOLID = ("automobile", "heavy_truck", "bus", "trailer", "other_vehicle")
"""Labels of boxes whose lower half one cannot look through: that of a rider is mostly air."""
INSIDE_M, CLEARANCE_M = 0.15, 0.2
"""Bodies of vehicles begin so far inside their boxes, and so far above the underside."""

_CORNERS = geometry.BOX_CORNERS
_EDGES = np.array([(a, b) for a in range(8) for b in range(a) if np.count_nonzero(_CORNERS[a] != _CORNERS[b]) == 1])


class Outlines(NamedTuple):
    """Of the movers in one view."""

    body: Int32[np.ndarray, "h w"]
    """The mover in whose outline a pixel lies, the nearest of several; 0 in none."""
    nearest: Float32[np.ndarray, "h w"]
    """Inverse depth of that mover's nearest point, 1/m, or 0."""
    solid: Float32[np.ndarray, "h w"]
    """Inverse depth at which the ray meets the lower half of that mover, if it is a vehicle; else 0."""


def outlines_of(view: WorkingView, bodies: Sequence[Surfels], moving: Sequence[int]) -> Outlines:
    """The outlines of boxes in a view.

    Args:
        view: one view.
        bodies: the static world, then the actors.
        moving: which of them are movers.
    """
    found = Outlines(*(np.zeros(view.rgb.shape[:2], kind) for kind in (np.int32, np.float32, np.float32)))
    boxes = []
    for n in moving:
        if not bodies[n].present(view.t_us):
            continue
        view_from_box = geometry.inverse(view.world_from_view) @ bodies[n].world_from_body(view.t_us)
        size = np.array(bodies[n].box_size_m)
        corners = _in_front(geometry.transform_points(view_from_box, _CORNERS * (size + 2 * BESIDE_M)))
        if len(corners):
            uv = view.tile.focal_px * corners[:, :2] / corners[:, 2:] + view.tile.center_px
            hull = cv2.convexHull(np.rint(uv - 0.5).clip(-1e5, 1e5).astype(np.int32))
            boxes.append((corners[:, 2].min(), n, hull, view_from_box, size))
    # The nearest one last: it hides the others.
    boxes.sort(key=lambda box: -box[0])
    for near, n, hull, _, _ in boxes:
        cv2.fillConvexPoly(found.body, hull, n)
        cv2.fillConvexPoly(found.nearest, hull, 1 / near)
    for _, n, _, view_from_box, size in boxes:
        actor = bodies[n].actor
        if actor is not None and actor.track.label in SOLID:
            mine = found.body == n
            found.solid[mine] = _lower_half(view, view_from_box, size, mine)
    return found


def _in_front(corners: Float64[np.ndarray, "8 3"]) -> Float64[np.ndarray, "n 3"]:
    """Corners of the part of a box that lies beyond ``NEAREST_M``."""
    ends = corners[_EDGES]
    depth = ends[..., 2] - NEAREST_M
    cut = depth[:, 0] * depth[:, 1] < 0
    share = depth[cut, :1] / (depth[cut, :1] - depth[cut, 1:])
    return np.concatenate([corners[corners[:, 2] >= NEAREST_M], ends[cut, 0] + share * (ends[cut, 1] - ends[cut, 0])])


def _lower_half(
    view: WorkingView, view_from_box: Float64[np.ndarray, "4 4"], size_m: Float64[np.ndarray, " 3"],
    mask: Bool[np.ndarray, "h w"],
) -> Float64[np.ndarray, " mask"]:  # fmt: skip
    """Inverse depth, 1/m, at which the rays of masked pixels meet the lower half of a vehicle; 0 where they miss it."""
    row, column = np.nonzero(mask)
    u, v = ((number + 0.5 - middle) / view.tile.focal_px
            for number, middle in zip((column, row), view.tile.center_px, strict=True))  # fmt: skip
    box_from_view = geometry.inverse(view_from_box)
    start, step = box_from_view[:3, 3], np.stack([u, v, np.ones_like(u)], axis=1) @ box_from_view[:3, :3].T
    low = np.array([INSIDE_M, INSIDE_M, CLEARANCE_M]) - size_m / 2
    enter, leave = geometry.box_crossings(start, step, low, np.array([-low[0], -low[1], 0.0]))
    return np.where((enter < leave) & (enter > 0), 1 / np.maximum(enter, NEAREST_M), 0.0)
