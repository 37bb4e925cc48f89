"""Levels of detail of static Gaussians: blocks merged four to one, and the choice among them for a view.

``merge_levels`` is done once per scene, ``choose_blocks`` for every frame. Blocks are those of ``render.cpu.pack``:
block k of a level stands for blocks 4 k to 4 k + 3 of the level below, so a choice from the top down renders
everything exactly once. The error of a merged Gaussian is measured when it is made and compared with the size of a
pixel when it is chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64, Int64

from nurec_sim.render.cpu.pack import BLOCK, PackedGaussians, morton_order, pack
from nurec_sim.render.layers import drawable
from nurec_sim.render.merging import GROUP, Surfels, as_surfels, grouped, local_contrast, merge
from nurec_sim.types import Gaussians

LEVELS = 3
NEAREST_M = 0.5
"""Blocks nearer than this are treated as this far away."""


@dataclass(frozen=True, eq=False)
class Level:
    """One level of detail.

    ``gaussians`` are ordered in blocks of ``BLOCK`` rows. ``error_m`` is, per block, the root mean square over its
    Gaussians of the side of the square that is wrong when one of them is rendered instead of those it replaces, seen
    from in front; 0 in the lowest level.
    """

    gaussians: Gaussians
    error_m: Float64[np.ndarray, " blocks"]

    @cached_property
    def packed(self) -> PackedGaussians:
        """The level as kernels read it: all its Gaussians can be rendered, so its blocks stay unchanged."""
        return pack(self.gaussians, sort=False)


@dataclass(frozen=True, eq=False)
class Detail:
    """A layer in levels, rendered as coarsely as ``tolerance_px`` allows (``choose_blocks``)."""

    levels: Sequence[Level]
    tolerance_px: float

    @classmethod
    def of(cls, gaussians: Gaussians, tolerance_px: float) -> Detail:
        """Merge a layer (5 s per million Gaussians)."""
        levels = merge_levels(gaussians)
        for level in levels:
            level.packed  # noqa: B018  made here, once, and not by the first frames
        return cls(levels, tolerance_px)

    def layers(
        self,
        eye_m: Float64[np.ndarray, " 3"],
        angle_per_pixel: float,
        in_view: Callable[[PackedGaussians], Int64[np.ndarray, " b"]],
    ) -> list[tuple[PackedGaussians, Int64[np.ndarray, " b"]]]:
        """Each level and its blocks to draw; ``in_view`` numbers the blocks of a layer that can be seen at all."""
        seen = [in_view(level.packed) for level in self.levels]
        chosen = choose_blocks(self.levels, eye_m, angle_per_pixel, self.tolerance_px, seen)
        return [(level.packed, blocks) for level, blocks in zip(self.levels, chosen, strict=True) if len(blocks)]


def merge_levels(gaussians: Gaussians, levels: int = LEVELS) -> list[Level]:
    """Level 0, all of ``gaussians`` that can be rendered, reordered, and ``levels`` ever coarser ones above it.

    Groups of four are ordered by the error of merging them, in octaves, then by place, so that groups that merge well
    share blocks.
    """
    gaussians = gaussians[np.flatnonzero(drawable(gaussians))]
    gaussians = gaussians[morton_order(gaussians.mean_m)] if len(gaussians) else gaussians
    surfels = as_surfels(gaussians, local_contrast(gaussians))
    groups = grouped(surfels, GROUP * BLOCK)
    merged = merge(surfels, groups)
    # Half the logarithm of an area: octaves of length.
    octave = np.floor(np.log2(np.maximum(merged.error_m2, 1e-12)) / 2)
    # Incomplete groups last, so that block k of a level always stands for blocks 4 k to 4 k + 3.
    order = np.lexsort((octave, (groups < 0).any(axis=1)))
    rows = groups[order].reshape(-1)
    result = [Level(gaussians[rows[rows >= 0]], np.zeros(-(-len(gaussians) // BLOCK)))]
    if levels == 0:
        return result
    merged = merged.rows(order)
    result.append(_level(merged))
    while len(result) <= levels:
        merged = merge(merged, grouped(merged, GROUP * BLOCK))
        result.append(_level(merged))
    return result


def _level(surfels: Surfels) -> Level:
    starts = np.arange(0, len(surfels.error_m2), BLOCK)
    counts = np.diff(np.append(starts, len(surfels.error_m2)))
    error_m2 = np.add.reduceat(surfels.error_m2, starts) / counts if len(starts) else np.zeros(0)
    return Level(surfels.gaussians, np.sqrt(error_m2))


def choose_blocks(
    levels: Sequence[Level],
    eye_m: Float64[np.ndarray, " 3"],
    angle_per_pixel: float,
    tolerance_px: float,
    in_view: Sequence[Int64[np.ndarray, " b"]] | None = None,
) -> list[Int64[np.ndarray, " b"]]:
    """The coarsest blocks whose error looks no larger than ``tolerance_px``: numbers of the blocks to render per level.

    Args:
        levels: from ``merge_levels``.
        eye_m: view point in the world.
        angle_per_pixel: radians between neighbouring rays; see ``ray_spacing``.
        tolerance_px: side of the square, in pixels or beams, that a merged Gaussian may render wrong. 0.15 renders
            surfaces of several layers within 50 dB of their full detail, 0.3 within 45; 0 chooses level 0.
        in_view: per level the blocks that can be seen at all; others are left out.
    """
    chosen: list[np.ndarray] = []
    wanted = np.ones(len(levels[-1].error_m), bool)
    for number in range(len(levels) - 1, -1, -1):
        level = levels[number]
        wanted = wanted[: len(level.error_m)]
        taken = wanted.copy()
        if number > 0:
            offset = level.packed.block_centre - eye_m
            nearest = np.sqrt((offset * offset).sum(axis=1)) - level.packed.block_radius
            # The size that the tolerance covers at the block's nearest point.
            allowed_m = np.maximum(nearest, NEAREST_M) * (angle_per_pixel * tolerance_px)
            taken &= (level.error_m <= allowed_m) & (tolerance_px > 0)
        seen = np.arange(len(taken)) if in_view is None else in_view[number]
        chosen.append(seen[taken[seen]])
        # A block that is not taken passes its four parts on to the level below.
        wanted = np.repeat(wanted & ~taken, GROUP)
    return chosen[::-1]


def check_detail(tolerance_px: float) -> None:
    """Check a tolerance.

    Raises:
        ValueError: it is negative or not finite.
    """
    if not 0 <= tolerance_px < np.inf:
        raise ValueError(f"detail_px must be finite and not negative, got {tolerance_px}")


def ray_spacing(direction: Float32[np.ndarray, "h w 3"]) -> float:
    """Usual angle in radians between neighbouring unit rays, along the middle row and the middle column of a grid."""
    height, width = direction.shape[:2]
    gaps = [
        np.linalg.norm(np.diff(line, axis=0), axis=1) for line in (direction[height // 2], direction[:, width // 2])
    ]
    known = np.concatenate([gap[gap > 0] for gap in gaps])
    return float(np.median(known)) if len(known) else 0.0
