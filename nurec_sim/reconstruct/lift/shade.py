"""Ground that a mover shades: what an image shows there is not the colour of the ground, but tells the shadow's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.compute.kernels import kernel
from nurec_sim.types import Track, Trajectory

MOVES_M = 1.0
"""Shadows of what moves less stay with the ground; it may hide the world behind it from all images."""
REACH_M, SHADED_WEIGHT = 1.0, 0.1
"""So far beside a box pixels of the ground count this little in its colours: under a high sun or an overcast sky
shadows lie within. They do count: where a car follows another, no image may show the ground between them otherwise, and
the little that shines through the car ahead would colour it."""
ABOVE_M, BELOW_M = 0.1, 0.4
"""The ground lies between these, above and below the underside of the box."""

SHADOW_REACH_M = 3.0
"""Shadows are looked for so far beside a box."""
LONGEST_M = 40.0
"""Boxes with a longer side are no vehicles: they have no shadow, and grids stay small."""
TURN = np.radians(15.0)
"""A mover that turns has a shadow for every so much of it."""
CELL_M = 0.1
SHADOW_ABOVE_M = 0.06
"""A shadow lies so high over its ground. Gaussians are blended in the order of their centres, those of the ground are
up to a few decimetres long, and what lies this high covers ground that lies as much farther away from the eye."""
LEAST_PIXELS = 3.0
"""A cell is worth so many pixels without a shadow."""
FLATTEST = 0.02
"""Rays are taken for this steep at least, metres per metre."""


def moves(path: Trajectory) -> bool:
    """Whether it leads farther than ``MOVES_M``, along one axis of the world."""
    return bool(np.ptp(path.position_m, axis=0).max() > MOVES_M)


class Ground(NamedTuple):
    """The ground around the box of a mover while its heading hardly changes: the sun stands still."""

    number: int
    """Of the track."""
    track: Track
    window_us: tuple[int, int] | None
    """None: the whole path."""
    first: int
    """Number of its first cell among those of all."""

    @property
    def shape(self) -> tuple[int, int]:
        """Cells along and across the box; cell 0, 0 is behind it and to its right."""
        along, across = (int(np.ceil((side + 2 * SHADOW_REACH_M) / CELL_M)) for side in self.track.size_m[:2])
        return along, across

    def covers(self, t_us: int) -> bool:
        """Whether the mover is there at a time."""
        inside = self.window_us is None or self.window_us[0] <= t_us < self.window_us[1]
        return inside and self.track.path.covers(t_us)


class Shades:
    """The ground around the boxes of movers: grids, and what images show in their cells.

    Args:
        tracks: of the scene; those that do not move, or are longer than ``LONGEST_M``, have no grid.
    """

    def __init__(self, tracks: Sequence[Track]) -> None:
        self.grounds: list[Ground] = []
        count = 0
        for number, track in enumerate(tracks):
            if not moves(track.path) or max(track.size_m) > LONGEST_M:
                continue
            for window_us in headings(track.path):
                self.grounds.append(Ground(number, track, window_us, count))
                count += int(np.prod(self.grounds[-1].shape))
        self.sums = np.zeros((count, 4))
        """Of each cell: products of shown and wanted colours, squares of shown ones, weights, and heights over the
        underside of the box; all weighted."""

    def sums_of(self, ground: Ground) -> Float64[np.ndarray, "x y 4"]:
        """The sums of one grid."""
        return self.sums[ground.first : ground.first + int(np.prod(ground.shape))].reshape(*ground.shape, 4)

    def boxes(self, t_us: int) -> Float64[np.ndarray, "k 18"]:
        """Boxes of movers that are there at a time: rows of ``find_shaded``."""
        rows = []
        for ground in self.grounds:
            if ground.covers(t_us):
                box_from_world = geometry.inverse(ground.track.path.at(t_us))
                length, width, height = ground.track.size_m
                sides = length / 2, width / 2, -height / 2
                rows.append([*box_from_world[:3].ravel(), *sides, ground.first, *ground.shape])
        return np.array(rows, np.float64).reshape(-1, 18)


def headings(path: Trajectory) -> list[tuple[int, int] | None]:
    """Windows of a path in which its heading changes by less than ``TURN``; None for one that it never changes by more.

    The last one ends behind the path.
    """
    yaw = np.unwrap(geometry.yaw_of(path.world_from_body))
    ends, low, high = [path.start_us], yaw[0], yaw[0]
    for t_us, angle in zip(path.t_us.tolist(), yaw, strict=True):
        low, high = min(low, angle), max(high, angle)
        if high - low > TURN:
            ends.append(t_us)
            low = high = angle
    return list(zip(ends, [*ends[1:], path.end_us + 1], strict=True)) if len(ends) > 1 else [None]


@kernel
def find_shaded(first, last, direction, turn, eye, planes, clear, behind, boxes, sums, weight, error, cell, shade):
    """What pixels of some rows show of the ground around boxes; they tell less of its colours than others.

    Their weights become smaller, and their errors those of ground in the shadow as it is known so far.

    Args:
        first: first row.
        last: one behind the last.
        direction: [h,w,3] unit rays of the pixels.
        turn: [3,3] from their frame to the world.
        eye: [3] where they start, metres.
        planes: what ``draw`` returned: opacity, colours, and distance times opacity.
        clear: see ``image_errors``, as the next one.
        behind: [3,h,w] the sky's colours.
        boxes: [k,18] see ``Shades.boxes``: box_from_world, half the length and width of the box, its underside, and
            the number of its first cell and of its cells along and across it.
        sums: [cells,4] see ``Shades.sums``.
        weight: [h,w] changed.
        error: [3,h,w] colours that the picture lacks; changed.
        cell: [h,w] int32, output: the cell that a pixel shows, -1 for none.
        shade: [4,h,w] output where there is a cell: what ``Shades.sums`` adds up.
    """
    point, ray = np.empty(3), np.empty(3)
    for v in range(first, last):
        for u in range(weight.shape[1]):
            cell[v, u] = -1
            if weight[v, u] == 0 or planes[0, v, u] < 0.5:
                continue
            distance = planes[4, v, u] / planes[0, v, u]
            for r in range(3):
                ray[r] = 0.0
                for c in range(3):
                    ray[r] += turn[r, c] * direction[v, u, c]
                point[r] = eye[r] + distance * ray[r]
            nearest, height = SHADOW_REACH_M, 0.0
            for box in boxes:
                z = box[8] * point[0] + box[9] * point[1] + box[10] * point[2] + box[11] - box[14]
                if not -BELOW_M < z < ABOVE_M:
                    continue
                x = box[0] * point[0] + box[1] * point[1] + box[2] * point[2] + box[3]
                y = box[4] * point[0] + box[5] * point[1] + box[6] * point[2] + box[7]
                beside = max(abs(x) - box[12], abs(y) - box[13])
                if beside >= nearest:
                    continue
                nearest, height = beside, z
                # Where the ray passes through the plane of the shadow.
                down = max(FLATTEST, -(box[8] * ray[0] + box[9] * ray[1] + box[10] * ray[2]))
                step = SHADOW_ABOVE_M / down
                x += box[12] + SHADOW_REACH_M - step * (box[0] * ray[0] + box[1] * ray[1] + box[2] * ray[2])
                y += box[13] + SHADOW_REACH_M - step * (box[4] * ray[0] + box[5] * ray[1] + box[6] * ray[2])
                i, j = int(np.floor(x / CELL_M)), int(np.floor(y / CELL_M))
                inside = 0 <= i < box[16] and 0 <= j < box[17]
                cell[v, u] = int(box[15] + i * box[17] + j) if inside else -1
            if cell[v, u] >= 0:
                shown, lacks = 0.0, 0.0
                for c in range(3):
                    shown += planes[1 + c, v, u] + clear[v, u] * behind[c, v, u]
                    lacks += error[c, v, u]
                shade[0, v, u] = weight[v, u] * shown * (shown + lacks)
                shade[1, v, u] = weight[v, u] * shown * shown
                shade[2, v, u] = weight[v, u]
                shade[3, v, u] = weight[v, u] * height
                lit, known = LEAST_PIXELS * shown * shown + 1e-9, sums[cell[v, u]]
                left = (known[0] + lit) / (known[1] + lit)
                for c in range(3):
                    error[c, v, u] += max(0.0, 1 - left) * (planes[1 + c, v, u] + clear[v, u] * behind[c, v, u])
            if nearest < REACH_M:
                weight[v, u] *= SHADED_WEIGHT


@kernel
def add_shaded(cell, shade, sums):
    """Add what the pixels of an image show to the sums of their cells; see ``find_shaded``."""
    for v in range(cell.shape[0]):
        for u in range(cell.shape[1]):
            if cell[v, u] >= 0:
                for k in range(4):
                    sums[cell[v, u], k] += shade[k, v, u]
