"""Ground that a mover shades: what an image shows there is not the colour of the ground."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.compute.kernels import kernel
from nurec_sim.types import Track, Trajectory

MOVES_M = 1.0
"""Shadows of what moves less stay with the ground; it may hide the world behind it from all images."""
REACH_M = 1.0
"""Shadows are looked for so far beside a box: under a high sun or an overcast sky they lie within."""
ABOVE_M, BELOW_M = 0.1, 0.4
"""The ground lies between these, above and below the underside of the box."""


def moves(path: Trajectory) -> bool:
    """Whether it leads farther than ``MOVES_M``, along one axis of the world."""
    return bool(np.ptp(path.position_m, axis=0).max() > MOVES_M)


def movers(tracks: Sequence[Track]) -> list[Track]:
    """Those that move."""
    return [track for track in tracks if moves(track.path)]


def shading_boxes(tracks: Sequence[Track], t_us: int) -> Float64[np.ndarray, "k 15"]:
    """Boxes of movers that are there at a time: rows of ``unweigh_shaded``."""
    rows = []
    for track in tracks:
        if track.path.covers(t_us):
            box_from_world = geometry.inverse(track.path.at(t_us))
            length, width, height = track.size_m
            rows.append([*box_from_world[:3].ravel(), length / 2 + REACH_M, width / 2 + REACH_M, -height / 2])
    return np.array(rows, np.float64).reshape(-1, 15)


@kernel
def unweigh_shaded(first, last, direction, turn, eye, planes, boxes, weight):
    """Weights of 0 for pixels of some rows that show ground beneath or beside a box.

    Args:
        first: first row.
        last: one behind the last.
        direction: [h,w,3] unit rays of the pixels.
        turn: [3,3] from their frame to the world.
        eye: [3] where they start, metres.
        planes: what ``draw`` returned: opacity, colours, and distance times opacity.
        boxes: [k,15] see ``shading_boxes``: box_from_world, half the length and width of its reach, and its underside.
        weight: [h,w] changed.
    """
    point = np.empty(3)
    for v in range(first, last):
        for u in range(weight.shape[1]):
            if weight[v, u] == 0 or planes[0, v, u] < 0.5:
                continue
            distance = planes[4, v, u] / planes[0, v, u]
            for r in range(3):
                point[r] = eye[r]
                for c in range(3):
                    point[r] += distance * turn[r, c] * direction[v, u, c]
            for box in boxes:
                z = box[8] * point[0] + box[9] * point[1] + box[10] * point[2] + box[11] - box[14]
                if not -BELOW_M < z < ABOVE_M:
                    continue
                x = box[0] * point[0] + box[1] * point[1] + box[2] * point[2] + box[3]
                y = box[4] * point[0] + box[5] * point[1] + box[6] * point[2] + box[7]
                if abs(x) < box[12] and abs(y) < box[13]:
                    weight[v, u] = 0
                    break
