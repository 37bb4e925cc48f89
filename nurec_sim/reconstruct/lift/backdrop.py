"""A coarse layer close behind the surfaces that views show, which is seen through gaps between pixels only.

Neighbouring pixels of a surface may come from several views, whose depths differ by a few per cent. Where they meet,
one view leaves a strip to the other whose own pixels lie elsewhere, and the sky shows through: white dots in crowns,
which grow beside the path. So each block of pixels gets a Gaussian a little farther than its farthest pixels, in their
colour, if all views that look there show something nearer all around it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from nurec_sim import geometry
from nurec_sim.compute.cores import in_order
from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.lift import colour, lifting
from nurec_sim.reconstruct.lift.blocks import block_means
from nurec_sim.reconstruct.lift.footprints import parts_of
from nurec_sim.reconstruct.lift.ground import Ground
from nurec_sim.reconstruct.lift.lifting import Lifted
from nurec_sim.reconstruct.lift.pictures import DepthPicture
from nurec_sim.reconstruct.lift.splat import project_point
from nurec_sim.reconstruct.lift.views import WorkingView

EDGE = 4
"""Edge of the blocks, in pixels: gaps are one or two pixels wide."""
BEHIND = 1.05
"""Depth of the backdrop of a block, over that of its farthest pixel: more than depths of views differ."""
FARTHEST = 1.05
"""Pixels whose depth is that of the farthest one but for this factor give the colour."""
HIDING = 1.01
"""A pixel hides a point if it is nearer by this factor at least."""
AROUND = 0.6
"""How far around its centre a backdrop must be hidden, in widths of its block."""
SEEN = 20
"""For each view that does not hide it a backdrop needs so many that do."""
NEARER = 0.9
"""Views nearer than this share of the own depth have backdrops of their own, and smaller ones."""


def backdrop(
    views: Sequence[WorkingView],
    pictures: Sequence[DepthPicture],
    rgb: Sequence[UInt8[np.ndarray, "h w 3"]],
    ground: Ground,
    max_depth_m: float,
) -> Lifted:
    """Blocks of pixels of the static world, moved to where they lie behind what all views show.

    There are none below the ground, whose pixels leave no gaps (``body_gaussians``).

    Args:
        views: working views.
        pictures: their dense depth, in the same order.
        rgb: their canonical colours, 0..255, in the same order.
        ground: of the static world.
        max_depth_m: what is farther has no backdrop.
    """
    parts = in_order(lambda k: _behind(k, views[k], pictures[k], rgb[k], max_depth_m), range(len(views)))
    every = Lifted.concatenate([Lifted.empty(), *parts])
    every = every[ground.above(every.xyz_m) > 0]
    packed, depths = colour.packed_views(views), lifting.stacked([picture.inverse_depth for picture in pictures])

    def stays(part: slice) -> np.ndarray:
        some = every[part]
        return hidden(some.xyz_m, AROUND * some.pixel_m, some.depth_m, packed, depths)

    return every[np.concatenate([np.zeros(0, bool), *in_order(stays, parts_of(len(every)))])]


def _behind(
    k: int, view: WorkingView, picture: DepthPicture, rgb: UInt8[np.ndarray, "h w 3"], max_depth_m: float
) -> Lifted:
    """Backdrops of the blocks of the k-th view in which every pixel shows the static world."""
    depth, tile = picture.inverse_depth, view.tile
    static = (depth > 1 / max_depth_m) & tile.valid & (picture.body == 0)
    row, column = np.nonzero(_in_blocks(static).all(axis=2))
    inverse, colours = _in_blocks(depth)[row, column], _in_blocks(rgb)[row, column]
    farthest = inverse.min(axis=1)
    counts = inverse < FARTHEST * farthest[:, None]
    mean = (colours * counts[..., None]).sum(axis=1) / counts.sum(axis=1)[:, None]
    moved = np.zeros_like(depth)
    for r in range(EDGE):
        for c in range(EDGE):
            moved[row * EDGE + r, column * EDGE + c] = farthest / BEHIND
    first = (row * EDGE * depth.shape[1] + column * EDGE).astype(np.int32)
    edge = np.full(len(first), EDGE, np.uint8)
    xyz, ray = (block_means(each, first, edge) for each in (lifting.points_of(view, moved), lifting.rays_of(view)))
    ray = geometry.rotate_vectors(view.world_from_view[:3, :3], ray)
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-9)
    z = BEHIND / farthest.astype(np.float64)
    return Lifted(xyz, -ray, ray, z, EDGE * z / tile.focal_px, mean.astype(np.float32),
                  np.full(len(first), -1, np.int32), np.full(len(first), k, np.int32), first, edge)  # fmt: skip


def _in_blocks(picture: np.ndarray) -> np.ndarray:
    """A picture [h,w,...] as [rows,columns,pixels,...] of its whole blocks."""
    rows, columns = picture.shape[0] // EDGE, picture.shape[1] // EDGE
    blocks = picture[: rows * EDGE, : columns * EDGE].reshape(rows, EDGE, columns, EDGE, *picture.shape[2:])
    return blocks.swapaxes(1, 2).reshape(rows, columns, EDGE * EDGE, *picture.shape[2:])


@kernel
def hidden(xyz, around_m, depth, packed, inverse_depth):
    """Which points [n] all views hide that look there, with what is around them, but for one in ``SEEN`` of them.

    Nor does a view look there from much nearer, whose own backdrop is finer.

    Args:
        xyz: [n,3] points in the world, metres.
        around_m: [n] how far around them must be hidden.
        depth: [n] in their own view, metres.
        packed: [k,23] projections into the views.
        inverse_depth: [k,h,w] of the views, 1/m.
    """
    stays = np.zeros(len(xyz), np.bool_)
    for i in range(len(xyz)):
        hiding, seeing, nearer = 0, 0, False
        for k in range(len(packed)):
            u, v, z = project_point(packed, k, xyz[i, 0], xyz[i, 1], xyz[i, 2])
            if z <= 0.3 or u < 0 or v < 0 or u >= packed[k, 3] or v >= packed[k, 4]:
                continue
            nearer = z < NEARER * depth[i]
            if nearer:
                break
            hides, step = True, around_m[i] / z * packed[k, 0] / 2
            for a in range(-2, 3):
                for b in range(-2, 3):
                    x, y = u + a * step, v + b * step
                    if 0 <= x < packed[k, 3] and 0 <= y < packed[k, 4]:
                        hides = hides and not inverse_depth[k, int(y), int(x)] * z < HIDING
            hiding += hides
            seeing += not hides
        stays[i] = not nearer and SEEN * seeing <= hiding
    return stays
