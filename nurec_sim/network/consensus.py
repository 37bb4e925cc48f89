"""One world from the images of a chunk: a surface that several see lies in one place, and one of them shows it.

The network predicts depth image by image. Put into one world, the surfaces of many images lie in front of one another,
and the wrong ones hide the right ones. So, among the points that stand still:

- an image owns what it sees from nearest, by rings of distance, as in ``lift``; others move their points to the depth
  that the owner gives them, and then leave the surface to it;
- a point that more images look through than agree with is dropped.
"""

from __future__ import annotations

import dataclasses
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from numba import njit

from nurec_sim.network.depth_change import with_changed_depth
from nurec_sim.network.matching import ImageView
from nurec_sim.network.tensors import NetworkInputs, QueryGaussians, SemanticClass

AGREEMENT = 0.1
"""Depths agree up to this difference of their logarithms."""
OWNER_RING = 0.1
"""Images own by rings of distance, each larger by exp of this."""
BORDER = 0.04
"""Images own nothing, and see through nothing, in this part of their width at the sides and half of it of their height
above and below: there nothing checks their depth."""
OVERLAP = 0.03
"""A ring reaches so much farther for the pixel's own image than for others: where rings meet, both show the surface,
and rounding leaves no gap."""
MOVES = 2
"""How often points are moved to their owner's depth, which moves too."""
MOST_OTHERS = 24
"""An image is compared with at most so many others, evenly taken."""
NEAREST_M = 0.3
LEAST_SLOPE = 0.5
"""Points are moved along their own ray; across the owner's axis, no farther than at 60 degrees to it."""
SURFACE, SKY, UNKNOWN = 0, 1, 2
_KIND_OF_CLASS = np.full(len(SemanticClass), SURFACE, np.uint8)
_KIND_OF_CLASS[[SemanticClass.EGO, SemanticClass.MOVABLE]] = UNKNOWN
_KIND_OF_CLASS[SemanticClass.SKY] = SKY


@dataclass(frozen=True)
class Consensus:
    """What the images agree on: the factor from each pixel's depth to the agreed one, and whether it is shown."""

    factor: Float32[np.ndarray, "v h w"]
    shown: Bool[np.ndarray, "v h w"]

    def apply(self, gaussians: QueryGaussians, inputs: NetworkInputs) -> QueryGaussians:
        """Gaussians where the images agree that they are; those that are not shown get opacity 0."""
        device = gaussians.source.device
        moved = with_changed_depth(gaussians, inputs, torch.from_numpy(self.factor).to(device))
        shown = torch.from_numpy(self.shown).to(device).reshape(-1)[gaussians.source]
        return dataclasses.replace(moved, opacity=moved.opacity * shown)


def find_consensus(
    inputs: NetworkInputs,
    depth_m: Float32[np.ndarray, "v h w"],
    semantic: Int64[np.ndarray, "v h w"],
    ego: Bool[np.ndarray, "v h w"] | None = None,
) -> Consensus:
    """Compare every image's depth with the others'.

    Args:
        inputs: the images, b = 1.
        depth_m: their depth, along the optical axis.
        semantic: their ``SemanticClass``; what can move, sky and the own car keep their depth and are always shown.
        ego: pixels known to show the own car, whatever their class.
    """
    views = _packed(inputs)
    kind = _KIND_OF_CLASS[semantic]
    if ego is not None:
        kind[ego] = UNKNOWN
    predicted_m = depth_m = np.ascontiguousarray(depth_m, np.float32)
    everything = agreed = np.ones(depth_m.shape, np.bool_)
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        for _ in range(MOVES):
            depth_m, _, agreed = _compare_all(pool, depth_m, kind, everything, views)
        _, owned, agreed = _compare_all(pool, depth_m, kind, agreed, views)
    return Consensus(depth_m / predicted_m, owned & agreed)


def _compare_all(
    pool: ThreadPoolExecutor, depth_m: np.ndarray, kind: np.ndarray, stands: np.ndarray, views: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, ...]:
    """``_compare`` of every image."""
    count = len(depth_m)

    def compare(image: int) -> tuple[np.ndarray, ...]:
        return _compare(image, _others(image, count), depth_m, kind, stands, *views)

    return tuple(np.stack(maps) for maps in zip(*pool.map(compare, range(count)), strict=True))


def _others(image: int, count: int) -> Int64[np.ndarray, " n"]:
    """The images that one is compared with."""
    others = np.delete(np.arange(count), image)
    if len(others) <= MOST_OTHERS:
        return others
    return others[np.arange(MOST_OTHERS) * len(others) // MOST_OTHERS]


@torch.autocast("cpu", enabled=False)
def _packed(inputs: NetworkInputs) -> tuple[np.ndarray, ...]:
    """Rays, and projections into all images by them (``ImageView``), as the kernel takes them."""
    rays = inputs.rays[0].float().cpu()
    views = [ImageView(each, pose.float()) for each, pose in zip(rays, inputs.c2w[0].cpu(), strict=True)]
    eye = np.stack([view.eye.numpy() for view in views]).astype(np.float64)
    turn = np.stack([view.turn.numpy() for view in views]).astype(np.float64)
    line = np.array([[(axis.slope, axis.start) for axis in view.lines] for view in views])
    steps = np.array([view.steps for view in views])
    plane = np.stack([view.plane[0].numpy() for view in views])
    return rays.numpy(), inputs.distance_to_depth_scale[0, ..., 0].float().cpu().numpy(), eye, turn, line, steps, plane


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _compare(image, others, depth, kind, stands, rays, along, eye, turn, line, steps, plane):
    """An image's depth moved to that of the owners, and which pixels are shown as they are.

    ``rays`` are origins and directions, ``along`` the z of directions; what follows projects (``ImageView``).
    """
    height, width = depth.shape[1:]
    moved, owned, agreed = depth[image].copy(), np.ones((height, width), np.bool_), np.ones((height, width), np.bool_)
    for row in range(height):
        for column in range(width):
            if kind[image, row, column] != SURFACE:
                continue
            here = float(depth[image, row, column])
            ray, distance = rays[image, row, column], here / along[image, row, column]
            ring, owner, shift = np.floor(np.log(here) / OWNER_RING), image, 0.0
            agree = through = 0
            for k in others:
                px = ray[0] + distance * ray[3] - eye[k, 0]
                py = ray[1] + distance * ray[4] - eye[k, 1]
                pz = ray[2] + distance * ray[5] - eye[k, 2]
                z = px * turn[k, 0, 2] + py * turn[k, 1, 2] + pz * turn[k, 2, 2]
                if z <= NEAREST_M or z > 1.5 * here:
                    continue
                a = (px * turn[k, 0, 0] + py * turn[k, 1, 0] + pz * turn[k, 2, 0]) / z
                b = (px * turn[k, 0, 1] + py * turn[k, 1, 1] + pz * turn[k, 2, 1]) / z
                x, y = a * line[k, 0, 0] + line[k, 0, 1], b * line[k, 1, 0] + line[k, 1, 1]
                for _ in range(steps[k]):
                    in_x, in_y = _plane_at(plane[k, 0], x, y), _plane_at(plane[k, 1], x, y)
                    x, y = x + (a - in_x) * line[k, 0, 0], y + (b - in_y) * line[k, 1, 0]
                if not (abs(x) < 1 and abs(y) < 1):
                    continue
                v, u = min(int((y + 1) / 2 * height), height - 1), min(int((x + 1) / 2 * width), width - 1)
                inside = abs(x) < 1 - 2 * BORDER and abs(y) < 1 - BORDER
                if kind[k, v, u] == UNKNOWN:
                    continue
                if kind[k, v, u] == SKY:
                    through += inside
                    continue
                difference = np.log(depth[k, v, u] / z)
                if abs(difference) < AGREEMENT:
                    agree += 1
                    its_ring = np.floor((np.log(z) + OVERLAP) / OWNER_RING)
                    if inside and stands[k, v, u] and (its_ring, k) < (ring, owner):
                        ring, owner = its_ring, k
                        # A step along the ray is so much of a step along the owner's axis.
                        slope = ray[3] * turn[k, 0, 2] + ray[4] * turn[k, 1, 2] + ray[5] * turn[k, 2, 2]
                        shift = (depth[k, v, u] - z) / max(slope, LEAST_SLOPE)
                elif difference > 0:
                    through += inside
            moved[row, column] = here + shift * along[image, row, column]
            owned[row, column], agreed[row, column] = owner == image, through <= agree
    return moved, owned, agreed
