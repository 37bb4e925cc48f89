"""Parts of movers that no beam met: pixels whose depth is of the world behind a mover, but which show the mover.

Beams pass beside a leg and between the spokes of a wheel, so the depth there is that of the wall and the road behind:
each image would paint a leg on the wall, and the rider would have none. But a mover moves on. What other images show at
the same point of the wall, where no mover is near, is the wall; a pixel that looks like none of them shows the mover.

Near cars reach out of the field of view of a scanner, downwards most often, and often no other image shows the road
there. But one cannot look through the lower half of a vehicle: what lies behind it is the vehicle's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8

from nurec_sim.compute.cores import in_order
from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.lift.bodies import Surfels
from nurec_sim.reconstruct.lift.fusion import AGREE, points_of
from nurec_sim.reconstruct.lift.outlines import outlines_of
from nurec_sim.reconstruct.lift.pictures import DepthPicture
from nurec_sim.reconstruct.lift.shade import moves
from nurec_sim.reconstruct.lift.splat import project_point
from nurec_sim.reconstruct.lift.views import WorkingView

NEIGHBOURS = 8
"""Other images of the camera, the nearest in time, that are asked."""
MARGIN_PX = 8
"""So near to a mover other images are not asked: its thin parts may be there, and its shadow."""
DIFFERS = 30
"""Levels of 255 by which a pixel differs from all of them, in one channel at least."""
GRID_PX, FEWEST = 8, 100
"""Exposures of two images are compared at every so many pixels in each direction, if so many show the same."""
DARKEST, BRIGHTEST = 10, 245
"""Channels outside of these levels tell nothing about exposure."""


def with_thin_parts(
    views: Sequence[WorkingView], bodies: Sequence[Surfels], pictures: Sequence[DepthPicture], tolerance: float
) -> list[DepthPicture]:
    """The pictures with parts of movers that no beam met given to these, as far away as their nearest pixel.

    Args:
        views: key views.
        bodies: the static world, then the actors; ``DepthPicture.body`` indexes them.
        pictures: of the views.
        tolerance: inverse depths of one surface differ by less than this, 1/m, and a share of themselves.
    """
    moving = [n for n, body in enumerate(bodies) if body.actor and moves(body.actor.path)]
    if not moving:
        return list(pictures)
    outlines = list(in_order(lambda view: outlines_of(view, bodies, moving), views))
    world = [_shows_world(picture, each.body) for picture, each in zip(pictures, outlines, strict=True)]

    def one(k: int) -> DepthPicture:
        outline, nearest, solid = outlines[k]
        behind = (pictures[k].body == 0) & (pictures[k].inverse_depth < nearest) & views[k].tile.valid
        if not behind.any():
            return pictures[k]
        others = [n for n in range(len(views)) if n != k and _look_alike(views[n], views[k])]
        others = sorted(others, key=lambda n: abs(views[n].t_us - views[k].t_us))[:NEIGHBOURS]
        differs = np.zeros(behind.shape, bool)
        differs[behind] = _differs(k, others, behind, views, pictures, world, tolerance)
        hidden = behind & (pictures[k].inverse_depth < solid)
        return _given_to_movers(pictures[k], np.where(behind, outline, 0), differs | hidden)

    return list(in_order(one, range(len(views))))


def _look_alike(view: WorkingView, other: WorkingView) -> bool:
    """Whether they are of one camera and, where its images are cut into several tiles, of the same one."""
    turns = view.tile.camera_from_tile, other.tile.camera_from_tile
    return view.camera_id == other.camera_id and np.array_equal(*turns)


def _shows_world(picture: DepthPicture, outline: Int32[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels of a picture that show the static world, away from the pixels of movers in their outlines."""
    window = np.ones((2 * MARGIN_PX + 1, 2 * MARGIN_PX + 1), np.uint8)
    movers = (picture.body > 0) & (outline > 0)
    near = (outline > 0) & (cv2.dilate(movers.astype(np.uint8), window) > 0)
    return (picture.body == 0) & (picture.inverse_depth >= 0) & ~near


def _differs(
    k: int,
    others: Sequence[int],
    asked: Bool[np.ndarray, "h w"],
    views: Sequence[WorkingView],
    pictures: Sequence[DepthPicture],
    world: Sequence[Bool[np.ndarray, "h w"]],
    tolerance: float,
) -> Bool[np.ndarray, " asked"]:
    """Which of the asked pixels of the k-th view look otherwise than in all others that show their points."""
    view, grid = views[k], np.zeros(asked.shape, bool)
    grid[::GRID_PX, ::GRID_PX] = world[k][::GRID_PX, ::GRID_PX]
    points, even = (
        points_of(view.packed, view.world_from_view, pictures[k].inverse_depth, mask) for mask in (asked, grid)
    )
    rgb, least = view.rgb[asked].astype(np.float32), np.full(len(points), np.inf, np.float32)
    for n in others:
        other = views[n].packed, pictures[n].inverse_depth, world[n], tolerance
        gain = _gain(view.rgb[grid], views[n].rgb, _places(even, *other))
        _lower_differences(rgb, _places(points, *other), gain, views[n].rgb, least)
    return np.isfinite(least) & (least > DIFFERS)


def _gain(
    rgb: UInt8[np.ndarray, "n 3"], picture: UInt8[np.ndarray, "h w 3"], places: Int32[np.ndarray, " n"]
) -> Float32[np.ndarray, " 3"]:
    """By how much brighter each channel of some pixels is than in another picture that shows them in these places."""
    shown = places >= 0
    pair = np.stack([rgb[shown], picture.reshape(-1, 3)[places[shown]]]).astype(np.float32)
    told = ((pair > DARKEST) & (pair < BRIGHTEST)).all(axis=(0, 2))
    if np.count_nonzero(told) < FEWEST:
        return np.ones(3, np.float32)
    return np.median(pair[0, told] / pair[1, told], axis=0).astype(np.float32)


@kernel
def _places(points, view, inverse_depth, world, tolerance):
    """Where a view shows points [n,3] of the world: the index [n] of a pixel, row by row; -1 where it does not.

    Args:
        points: metres; not a number where there is none.
        view: [23] packed projection.
        inverse_depth: [h,w] of the view, 1/m.
        world: [h,w] pixels that show the world.
        tolerance: see ``with_thin_parts``.
    """
    (height, width), views = inverse_depth.shape, view.reshape(1, -1)
    places = np.full(len(points), -1, np.int32)
    for i in range(len(points)):
        u, v, far = project_point(views, 0, points[i, 0], points[i, 1], points[i, 2])
        # With a pixel around it.
        if far > 0.3 and 1 <= u < width - 1 and 1 <= v < height - 1 and world[int(v), int(u)]:
            if abs(inverse_depth[int(v), int(u)] - 1 / far) < tolerance + AGREE / far:
                places[i] = int(v) * width + int(u)
    return places


@kernel
def _lower_differences(rgb, places, gain, picture, least):
    """Lower ``least`` [n] to the difference of colours [n,3] from the nearest of the 3 x 3 pixels around their places.

    Depth and poses are wrong by a pixel. The difference is that of the channel that differs most, in levels of 255.
    """
    width = picture.shape[1]
    for i in range(len(places)):
        if places[i] < 0:
            continue
        row, column = places[i] // width, places[i] % width
        for v in range(row - 1, row + 2):
            for u in range(column - 1, column + 2):
                most = np.float32(0)
                for c in range(3):
                    most = max(most, abs(rgb[i, c] - gain[c] * picture[v, u, c]))
                least[i] = min(least[i], most)


def _given_to_movers(
    picture: DepthPicture, behind: Int32[np.ndarray, "h w"], differs: Bool[np.ndarray, "h w"]
) -> DepthPicture:
    """The picture in which pixels that differ from the world belong to the mover that they are connected to.

    Args:
        picture: of one view.
        behind: the mover in whose outline, and behind which, a pixel shows the world; 0 elsewhere.
        differs: pixels that do not show the world.
    """
    closed = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0
    body, depth = picture.body.copy(), picture.inverse_depth.copy()
    for n in np.unique(behind[differs]):
        own, part = picture.body == n, closed & (behind == n)
        left, top, width, height = cv2.boundingRect((own | part).astype(np.uint8))
        cut = slice(top, top + height), slice(left, left + width)
        own, part = own[cut], part[cut]
        count, region = cv2.connectedComponents((part | own).astype(np.uint8), connectivity=8)
        touches = np.zeros(count, bool)
        touches[region[own]] = True
        part &= touches[region]
        if part.any():
            # Each pixel's label is that of the nearest pixel of the mover.
            _, label = cv2.distanceTransformWithLabels(
                (~own).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
            )
            depth_of = np.zeros(label.max() + 1, np.float32)
            depth_of[label[own]] = depth[cut][own]
            depth[cut][part], body[cut][part] = depth_of[label[part]], n
    return replace(picture, inverse_depth=depth, body=body, surfel=np.where(body == picture.body, picture.surfel, -1))
