"""The layers of all chunks of a clip as those of one scene (paper section 3.4)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct.budget import reduce_to_budget
from nurec_sim.reconstruct.feedforward.chunks import ChunkLayers
from nurec_sim.reconstruct.feedforward.merging.alignment import aligned_chunks, merged_isp, merged_sky
from nurec_sim.reconstruct.feedforward.merging.ownership import owned
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.render.layers import drawable
from nurec_sim.types import DynamicGaussians, Gaussians

Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class MergedLayers:
    """Layers of a whole clip in the world, in the canonical colours of its first chunk.

    ``sky`` and ``isp`` are as in ``GaussianScene``. ``counts`` is plain JSON for the provenance: static Gaussians at
    the start, what each step took from each chunk, what was left, ``voxel_m`` (None if no voxels were needed), and the
    numbers of the chunks whose colours could not be aligned to the first one's.
    """

    static: Gaussians
    dynamic: DynamicGaussians
    sky: Float32[np.ndarray, "6 s s 3"]
    isp: Mapping[str, Float64[np.ndarray, "3 4"]]
    counts: Mapping[str, Any]


def merge_chunks(
    chunks: Sequence[ChunkLayers],
    settings: FeedForwardSettings,
    progress: Progress = lambda stage, fraction: None,
) -> MergedLayers:
    """Join any number of chunks.

    Static Gaussians that cannot be drawn are dropped, the others kept where their chunk owns them
    (``settings.merge``), then reduced to ``settings.max_gaussians``. The dynamic layer is only joined: its Gaussians
    live but for a moment, in which other chunks hardly have any.

    Args:
        chunks: layers of every chunk, in the order of the clip; colours come to those of the first.
        settings: ``merge``, ``ownership_tolerance_m`` and ``max_gaussians`` are read.
        progress: called with the stage's name and the fraction of it that is done.

    Raises:
        ReconstructError: there is no chunk, or the skies differ in size.
    """
    if not chunks:
        raise ReconstructError("no chunks to merge: need at least 1, got 0")
    sizes = [chunk.sky.shape for chunk in chunks]
    if len(set(sizes)) > 1:
        raise ReconstructError(f"skies of all chunks must have one size, got {sizes}")

    progress("merging", 0.0)
    before = [len(chunk.static) for chunk in chunks]
    chunks, maps = aligned_chunks([_drawable(chunk) for chunk in chunks])
    sound = [len(chunk.static) for chunk in chunks]
    static = [chunk.static for chunk in chunks]
    if settings.merge == "ownership":
        masks = owned(chunks, settings.ownership_tolerance_m, lambda fraction: progress("merging", 0.8 * fraction))
        static = [part if mask.all() else part[mask] for part, mask in zip(static, masks, strict=True)]
    joined = Gaussians.concatenate(static) if len(static) > 1 else static[0]
    progress("merging", 0.8)
    reduced, voxel_m = reduce_to_budget(joined, settings.max_gaussians)
    dynamic = DynamicGaussians.concatenate([chunk.dynamic for chunk in chunks])
    progress("merging", 1.0)
    counts = {
        "chunks": len(chunks),
        "static_before": before,
        "not_drawable": [b - s for b, s in zip(before, sound, strict=True)],
        "owned_by_others": [s - len(part) for s, part in zip(sound, static, strict=True)],
        "static_merged": len(joined),
        "voxel_m": voxel_m,
        "static": len(reduced),
        "dynamic": len(dynamic),
        "colours_not_aligned": [number for number, colour in enumerate(maps) if not np.isfinite(colour.ridge)],
    }
    return MergedLayers(reduced, dynamic, merged_sky(chunks), merged_isp(chunks), counts)


def _drawable(chunk: ChunkLayers) -> ChunkLayers:
    """A chunk without static Gaussians that are not finite, have no extent or are not to be seen."""
    mask = drawable(chunk.static)
    return chunk if mask.all() else dataclasses.replace(chunk, static=chunk.static[mask])
