"""Levels of detail of static Gaussians: blocks merged four to one, and which of them will do for a view.

``merge_levels`` is done once per scene, ``choose_blocks`` for every frame. Blocks are those of ``render.cpu.pack``:
block k of a level stands for blocks 4 k to 4 k + 3 of the level below, so a choice from the top down draws everything
exactly once. What a merged Gaussian draws differently is measured when it is made (``merging.Merged.error_m``) and
compared with the size of a pixel when it is chosen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim.render.cpu.pack import BLOCK, PackedGaussians, drawable, morton_order, pack
from nurec_sim.render.merging import GROUP, as_surfels, grouped, local_contrast, merge
from nurec_sim.types import Gaussians

NEAREST_M = 0.5
"""Blocks nearer than this are taken to be this far away."""


@dataclass(frozen=True, eq=False)
class Level:
    """One level of detail.

    ``gaussians`` are ordered in blocks of ``BLOCK`` rows and all drawable, so ``pack(gaussians, sort=False)`` keeps
    the blocks. ``error_m`` is, per block, the root mean square over its Gaussians of the side of a square that drawing
    one of them instead of what it stands for paints wrong, as seen from in front; 0 in the lowest level.
    """

    gaussians: Gaussians
    error_m: Float64[np.ndarray, " blocks"]

    def packed(self) -> PackedGaussians:
        """The level as kernels read it."""
        return pack(self.gaussians, sort=False)


def ray_spacing(direction: Float64[np.ndarray, "h w 3"]) -> float:
    """Usual angle in radians between neighbouring rays, along the middle row and the middle column of a grid."""
    height, width = direction.shape[:2]
    gaps = [
        np.linalg.norm(np.diff(line, axis=0), axis=1) for line in (direction[height // 2], direction[:, width // 2])
    ]
    known = np.concatenate([gap[gap > 0] for gap in gaps])
    return float(np.median(known)) if len(known) else 0.0


def merge_levels(gaussians: Gaussians, levels: int = 3) -> list[Level]:
    """Level 0, all that can be drawn of ``gaussians`` in another order, and ``levels`` ever coarser ones above it.

    Level 0 is ordered by size in octaves, then by place: the blocks that may be merged at a distance, those of small
    Gaussians, are not held back by the large ones between them.
    """
    gaussians = gaussians[np.flatnonzero(drawable(gaussians))]
    gaussians = gaussians[morton_order(gaussians.mean_m)] if len(gaussians) else gaussians
    contrast = local_contrast(gaussians)
    octave = np.floor(np.log2(np.sort(gaussians.scale_m.astype(np.float64), axis=1)[:, 1:].prod(axis=1)) / 2)
    order = np.argsort(octave, kind="stable")
    surfels = as_surfels(gaussians[order], contrast[order])
    result = [Level(surfels.gaussians, np.zeros(-(-len(order) // BLOCK)))]
    for _ in range(levels):
        surfels = merge(surfels, grouped(surfels, GROUP * BLOCK))
        result.append(Level(surfels.gaussians, _block_error(surfels.error_m2)))
    return result


def _block_error(error_m2: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " blocks"]:
    starts = np.arange(0, len(error_m2), BLOCK)
    counts = np.diff(np.append(starts, len(error_m2)))
    return np.sqrt(np.add.reduceat(error_m2, starts) / counts) if len(starts) else np.zeros(0)


def choose_blocks(
    levels: Sequence[Level],
    packed: Sequence[PackedGaussians],
    eye_m: Float64[np.ndarray, " 3"],
    angle_per_pixel: float,
    tolerance_px: float,
    in_view: Sequence[Bool[np.ndarray, " blocks"]] | None = None,
) -> list[Int64[np.ndarray, " b"]]:
    """The coarsest blocks whose error looks no larger than ``tolerance_px``: numbers of the blocks to draw per level.

    Args:
        levels: from ``merge_levels``.
        packed: the same levels packed.
        eye_m: view point in the world.
        angle_per_pixel: radians between neighbouring rays.
        tolerance_px: side of the square that a merged Gaussian may paint wrong; 0 chooses level 0.
        in_view: per level whether a block can be seen at all; those that cannot are left out.
    """
    chosen: list[np.ndarray] = []
    wanted = np.ones(len(packed[-1]), bool)
    for number in range(len(levels) - 1, -1, -1):
        wanted = wanted[: len(packed[number])]
        taken = wanted.copy()
        if number > 0:
            offset = packed[number].block_centre - eye_m
            nearest = np.sqrt((offset * offset).sum(axis=1)) - packed[number].block_radius
            allowed_m = np.maximum(nearest, NEAREST_M) * (angle_per_pixel * tolerance_px)
            taken &= levels[number].error_m <= allowed_m if tolerance_px > 0 else False
        chosen.append(np.flatnonzero(taken if in_view is None else taken & in_view[number]))
        wanted = np.repeat(wanted & ~taken, GROUP)
    return chosen[::-1]
