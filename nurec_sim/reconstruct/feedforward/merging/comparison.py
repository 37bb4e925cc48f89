"""Comparison of each pixel of an image with the other images of its chunk: the kernel of ``consensus``."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from nurec_sim.compute.cores import usable_cores
from nurec_sim.compute.kernels import inner, kernel
from nurec_sim.network.stereo.matching import ImageView
from nurec_sim.network.tensors import NetworkInputs

SURFACE, MOVABLE, SKY, UNKNOWN = 0, 1, 2, 3
"""Kinds of pixels: static surfaces, what can move, sky, and the own car, which is ignored."""

AGREEMENT = 0.1
"""Depths agree up to this difference of their logarithms."""
OWNER_RING = 0.1
"""Images own by rings of distance, each larger by exp of this."""
OVERLAP = 0.03
"""A ring reaches so much farther for the pixel's own image than for others: where rings meet, both show the surface,
and rounding leaves no gap."""
OFF_AXIS = 0.2
"""What lies at the middle of an image's edge counts as farther by exp of this: there depth is least sure."""
BORDER = 0.04
"""Images own nothing, and see through nothing, in this part of their width at the sides and half of it of their height
above and below: there nothing checks their depth."""
SHARED_COLOUR = 0.3
"""Weight in a pixel's colour of an image that sees the surface from as near as its own does."""
MOST_COLOUR = 4.0
"""How much more an image counts that sees it from nearer, at most."""
EXPOSED = (0.03, 0.95)
"""Colours between which cameras are compared; others may be clipped."""
MOST_OTHERS = 24
"""An image is compared with at most so many others, evenly taken."""
NEAREST_M = 0.3
LEAST_SLOPE = 0.5
"""Points are moved along their own ray; across the owner's axis, no farther than at 60 degrees to it."""


class Pictures(NamedTuple):
    """What is compared: z-depth, kind, which pixels may own surfaces, colour, and each image's camera."""

    depth_m: Float32[np.ndarray, "v h w"]
    kind: UInt8[np.ndarray, "v h w"]
    may_own: Bool[np.ndarray, "v h w"]
    rgb: Float32[np.ndarray, "v h w 3"]
    camera: Int64[np.ndarray, " v"]


class Views(NamedTuple):
    """Rays (origin and direction), the z of directions, and projections into all images (``ImageView``)."""

    rays: Float32[np.ndarray, "v h w 6"]
    along: Float32[np.ndarray, "v h w"]
    eye: Float64[np.ndarray, "v 3"]
    turn: Float64[np.ndarray, "v 3 3"]
    line: Float64[np.ndarray, "v 2 2"]
    steps: Int64[np.ndarray, " v"]
    plane: Float32[np.ndarray, "v 2 h w"]


class Compared(NamedTuple):
    """The comparison of all pixels with all images.

    Attributes:
        depth_m: depth, that of the owner where one was found.
        owned: whether no other image owns the surface.
        agreed: whether as many images see the surface as look through it, weighted by the area of their pixels on it.
        movable: share of the images that see the surface and call it movable, weighted by nearness; the own one too.
        rgb: colour of the surface as the images that see it show it together.
        pairs: per image and camera, over pixels that both see: sum of the image's colours, of the camera's, and count.
    """

    depth_m: Float32[np.ndarray, "v h w"]
    owned: Bool[np.ndarray, "v h w"]
    agreed: Bool[np.ndarray, "v h w"]
    movable: Float32[np.ndarray, "v h w"]
    rgb: Float32[np.ndarray, "v h w 3"]
    pairs: Float64[np.ndarray, "v cameras 7"]


@torch.autocast("cpu", enabled=False)
def views_of(inputs: NetworkInputs) -> Views:
    """Rays of the images, and projections into them, of inputs with b = 1."""
    rays = inputs.rays[0].float().cpu()
    views = [ImageView(each, pose.float()) for each, pose in zip(rays, inputs.c2w[0].cpu(), strict=True)]
    return Views(
        rays.numpy(),
        inputs.distance_to_depth_scale[0, ..., 0].float().cpu().numpy(),
        np.stack([view.eye.numpy() for view in views]).astype(np.float64),
        np.stack([view.turn.numpy() for view in views]).astype(np.float64),
        np.array([[(axis.slope, axis.start) for axis in view.lines] for view in views]),
        np.array([view.steps for view in views]),
        np.stack([view.plane[0].numpy() for view in views]),
    )


def compare(pictures: Pictures, views: Views) -> Compared:
    """Compare every image with the others, on all cores; the result does not depend on their number."""
    count = len(pictures.depth_m)
    with ThreadPoolExecutor(usable_cores()) as pool:
        said = pool.map(lambda image: _compare(image, _others(image, count), pictures, views), range(count))
        return Compared(*(np.stack(maps) for maps in zip(*said, strict=True)))


def _others(image: int, count: int) -> Int64[np.ndarray, " n"]:
    """The images that one is compared with."""
    others = np.delete(np.arange(count), image)
    if len(others) <= MOST_OTHERS:
        return others
    return others[np.arange(MOST_OTHERS) * len(others) // MOST_OTHERS]


@inner
def _plane_at(plane, x, y):
    """A map at the place (x, y), -1..1 from edge to edge, bilinear; beyond its edge the edge's value."""
    height, width = plane.shape
    column = min(max((x + 1) / 2 * width - 0.5, 0.0), width - 1.0)
    row = min(max((y + 1) / 2 * height - 0.5, 0.0), height - 1.0)
    left, top = min(int(column), width - 2), min(int(row), height - 2)
    a, b = column - left, row - top
    upper = (1 - a) * plane[top, left] + a * plane[top, left + 1]
    lower = (1 - a) * plane[top + 1, left] + a * plane[top + 1, left + 1]
    return (1 - b) * upper + b * lower


@inner
def _projected(k, px, py, pz, z, views):
    """Where image k shows what lies at (px, py, pz) from its eye, z along its axis: -1..1 from edge to edge."""
    turn, line, plane = views.turn[k], views.line[k], views.plane[k]
    a = (px * turn[0, 0] + py * turn[1, 0] + pz * turn[2, 0]) / z
    b = (px * turn[0, 1] + py * turn[1, 1] + pz * turn[2, 1]) / z
    x, y = a * line[0, 0] + line[0, 1], b * line[1, 0] + line[1, 1]
    # As ``ImageView``: a pinhole first, then corrected by the rays of the pixels, so any lens works.
    for _ in range(views.steps[k]):
        in_x, in_y = _plane_at(plane[0], x, y), _plane_at(plane[1], x, y)
        x, y = x + (a - in_x) * line[0, 0], y + (b - in_y) * line[1, 0]
    return x, y


@inner
def _ring(distance, x, y):
    """From how near a surface is seen, in rings, what is off the axis counting as farther."""
    # Logarithmic rings: ownership changes with the ratio of distances, as resolution does.
    return (np.log(distance) + OFF_AXIS * (x * x + y * y)) / OWNER_RING


@inner
def _exposed(rgb):
    """Whether no channel may be clipped."""
    return min(rgb[0], rgb[1], rgb[2]) > EXPOSED[0] and max(rgb[0], rgb[1], rgb[2]) < EXPOSED[1]


@inner
def _place_in(k, ray, distance, farthest_z, views):
    """Where image k shows the point at a distance along a ray [6].

    Returns:
        Whether it does; the point's z-depth and distance from the image's eye; its place (x, y), -1..1 from edge to
        edge; the row and the column of the pixel there.
    """
    px = ray[0] + distance * ray[3] - views.eye[k, 0]
    py = ray[1] + distance * ray[4] - views.eye[k, 1]
    pz = ray[2] + distance * ray[5] - views.eye[k, 2]
    axis = views.turn[k, :, 2]
    z = px * axis[0] + py * axis[1] + pz * axis[2]
    if z <= NEAREST_M or z > farthest_z:
        return False, z, 0.0, 0.0, 0.0, 0, 0
    x, y = _projected(k, px, py, pz, z, views)
    if not (abs(x) < 1 and abs(y) < 1):
        return False, z, 0.0, x, y, 0, 0
    height, width = views.along.shape[1:]
    row, column = min(int((y + 1) / 2 * height), height - 1), min(int((x + 1) / 2 * width), width - 1)
    return True, z, np.sqrt(px * px + py * py + pz * pz), x, y, row, column


@inner
def _add_pair(pair, own, other):
    """Add the colours [3] of one surface in two cameras to ``Compared.pairs`` [7], unless either may be clipped."""
    if _exposed(own) and _exposed(other):
        for channel in range(3):
            pair[channel] += own[channel]
            pair[3 + channel] += other[channel]
        pair[6] += 1


@inner
def _add_colour(mixed, other, nearness):
    """Add another image's colour [3] of the surface; returns its weight, which grows with the area of its pixels."""
    weight = SHARED_COLOUR * min(nearness**2, MOST_COLOUR)
    for channel in range(3):
        mixed[channel] += weight * other[channel]
    return weight


@inner
def _compare_pixel(image, row, column, others, pictures, views, mixed, pairs):
    """Compare one pixel with the other images.

    Args:
        image: the pixel's image, then its row and column.
        row: see image.
        column: see image.
        others: [n] the images to compare it with.
        pictures: see ``Pictures``.
        views: see ``Views``.
        mixed: [3] the pixel's colour, which becomes the one that all images show together.
        pairs: [cameras,7] added to, see ``Compared``.

    Returns:
        Its depth, whether its image owns the surface, whether the images agree that there is one, and the share of
        those that see it which call it movable. The first three mean nothing where the pixel is movable itself.
    """
    depth, kind, may_own, rgb, camera = pictures
    height, width = depth.shape[1:]
    mine, here = kind[image, row, column], float(depth[image, row, column])
    ray, distance = views.rays[image, row, column], here / views.along[image, row, column]
    # The nearest ring owns the surface, in a ring the image with the lowest number.
    claim = (np.floor(_ring(distance, 2 * (column + 0.5) / width - 1, 2 * (row + 0.5) / height - 1)), image)
    shift = 0.0
    moves, rests = (1.0, 0.0) if mine == MOVABLE else (0.0, 1.0)
    agree = through = 0.0
    colours = 1.0
    for k in others:
        seen, z, away, x, y, v, u = _place_in(k, ray, distance, 1.5 * here, views)
        its = kind[k, v, u]
        if not seen or its == UNKNOWN:
            continue
        nearness = here / z
        inside = abs(x) < 1 - 2 * BORDER and abs(y) < 1 - BORDER
        # Log ratio of the depth seen there and the point's: positive where the other image looks past the point.
        difference = np.inf if its == SKY else np.log(depth[k, v, u] / z)
        if difference >= AGREEMENT:
            through += inside * nearness**2  # it sees something behind: there should be nothing here
        if abs(difference) >= AGREEMENT:
            continue
        if its == MOVABLE:
            moves += nearness
        else:
            rests += nearness
        if mine == MOVABLE or its == MOVABLE:
            continue
        agree += nearness**2
        if camera[k] != camera[image]:
            _add_pair(pairs[camera[k]], rgb[image, row, column], rgb[k, v, u])
        if not inside:
            continue
        colours += _add_colour(mixed, rgb[k, v, u], nearness)
        # Tuples compare ring first, then image number: a strict order, apart from OVERLAP.
        its_claim = (np.floor(_ring(away, x, y) + OVERLAP / OWNER_RING), k)
        if may_own[k, v, u] and its_claim < claim:
            claim = its_claim
            # A step along the ray is so much of a step along the owner's axis.
            axis = views.turn[k, :, 2]
            slope = ray[3] * axis[0] + ray[4] * axis[1] + ray[5] * axis[2]
            shift = (depth[k, v, u] - z) / max(slope, LEAST_SLOPE)
    if mine == SURFACE:
        for channel in range(3):
            mixed[channel] /= colours
    # shift is a distance along the pixel's own ray; its z per distance makes it a depth.
    moved = here + shift * views.along[image, row, column]
    return moved, claim[1] == image, through <= agree, moves / (moves + rests)


@kernel
def _compare(image, others, pictures, views):
    """One image's part of ``Compared``."""
    depth, kind, _, rgb, camera = pictures
    height, width = depth.shape[1:]
    moved, mixed = depth[image].copy(), rgb[image].copy()
    owned, agreed = np.ones((height, width), np.bool_), np.ones((height, width), np.bool_)
    movable = np.zeros((height, width), np.float32)
    pairs = np.zeros((camera.max() + 1, 7))
    for row in range(height):
        for column in range(width):
            mine = kind[image, row, column]
            if mine != SURFACE and mine != MOVABLE:
                continue
            depth_m, is_owner, is_agreed, movable[row, column] = _compare_pixel(
                image, row, column, others, pictures, views, mixed[row, column], pairs
            )
            if mine == SURFACE:
                moved[row, column], owned[row, column], agreed[row, column] = depth_m, is_owner, is_agreed
    return moved, owned, agreed, movable, mixed, pairs
