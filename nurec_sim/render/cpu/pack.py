"""Gaussians as the kernels read them: blocks of neighbours in space, each a structure of float32 arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from nurec_sim.compute.cores import in_order
from nurec_sim.render.layers import drawable
from nurec_sim.types import Gaussians

# Fields of a block.
MEAN, QUAT, SCALE, LOG_OPACITY, COLOUR, LABEL, INTENSITY, KNOWN, DROP, NORMAL = 0, 3, 7, 10, 11, 14, 15, 16, 17, 18
FALLOFF = 21
FIELDS = 22

BLOCK = 256
MIN_SCALE_M = 1e-5
MAX_OPACITY = 0.99
REACH = float(np.sqrt(2 * np.log(255)))
"""Standard deviations at which an opaque Gaussian has faded to 1/255."""
PART = 64
"""Blocks that a thread packs at a time."""
NEVER_SEEN = -1e9
"""LOG_OPACITY of rows that only fill a block up."""


class LayerBlocks(NamedTuple):
    """Blocks of a layer as the projecting kernels read them."""

    fields: Float32[np.ndarray, "blocks 22 256"]
    sh_rest: Float32[np.ndarray, "blocks k3 256"]
    """[0,0,0] without view-dependent colours."""
    chosen: Int64[np.ndarray, " b"]
    """Numbers of the blocks to project."""


@dataclass(frozen=True, eq=False)
class PackedGaussians:
    """Gaussians in blocks of ``BLOCK``; the last block of a group is filled up with rows that are never seen.

    ``index`` is the row of each packed Gaussian in the Gaussians it was packed from, -1 where it only fills up.
    ``block_centre`` and ``block_radius`` bound everything of a block that is at least 1/255 opaque. ``sh_rest`` is
    coefficient-major, row 3 j + c for coefficient j of colour c, and [0,0,0] without view-dependent colours.
    """

    fields: Float32[np.ndarray, "blocks 22 256"]
    sh_rest: Float32[np.ndarray, "blocks k3 256"]
    index: Int32[np.ndarray, " rows"]
    block_centre: Float64[np.ndarray, "blocks 3"]
    block_radius: Float64[np.ndarray, " blocks"]

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self.fields)


def pack(gaussians: Gaussians, sort: bool = True) -> PackedGaussians:
    """Pack Gaussians; those that can never be rendered (not finite, opacity below 1/255) are left out.

    ``sort`` groups neighbours in space into blocks, which changes the order of Gaussians of exactly equal depth only.
    """
    parts = [slice(first, first + PART * BLOCK) for first in range(0, len(gaussians), PART * BLOCK)]
    seen = in_order(lambda part: drawable(gaussians[part]), parts)
    chosen = np.flatnonzero(np.concatenate([np.zeros(0, bool), *seen]))
    if sort and len(chosen):
        chosen = chosen[morton_order(gaussians.mean_m[chosen])]
    blocks = -(-len(chosen) // BLOCK)
    index = np.full(blocks * BLOCK, -1, np.int32)
    index[: len(chosen)] = chosen
    fields = np.empty((blocks, FIELDS, BLOCK), np.float32)
    centre, radius = np.empty((blocks, 3)), np.empty(blocks)

    def fill(first: int) -> None:
        some = slice(first, min(first + PART, blocks))
        columns = gaussian_columns(gaussians, chosen[some.start * BLOCK : some.stop * BLOCK])
        fields[some] = to_blocks(columns, some.stop - some.start, fill=LOG_OPACITY)
        centre[some], radius[some] = block_spheres(fields[some])

    for _ in in_order(fill, range(0, blocks, PART)):
        pass
    rest = gaussians.sh_rest
    sh_rest = np.zeros((0, 0, 0), np.float32)
    if rest is not None and len(chosen):
        sh_rest = to_blocks(rest[chosen].reshape(len(chosen), -1).astype(np.float32), blocks)
    return PackedGaussians(fields, sh_rest, index, centre, radius)


def gaussian_columns(gaussians: Gaussians, chosen: Int64[np.ndarray, " n"]) -> Float32[np.ndarray, "n 22"]:
    """The fields of the chosen Gaussians, one row each."""
    columns = np.zeros((len(chosen), FIELDS), np.float32)
    quat = gaussians.quat_wxyz[chosen].astype(np.float64)
    columns[:, MEAN : MEAN + 3] = gaussians.mean_m[chosen]
    columns[:, QUAT : QUAT + 4] = quat / np.maximum(np.linalg.norm(quat, axis=1, keepdims=True), 1e-12)
    columns[:, SCALE : SCALE + 3] = np.maximum(gaussians.scale_m[chosen], MIN_SCALE_M)
    opacity = gaussians.opacity[chosen].astype(np.float64)
    # The logarithm: alpha = exp(log p - q / 2) needs one exponential and no product. Capped as in ``spec``.
    columns[:, LOG_OPACITY] = np.log(np.clip(opacity, 1e-6, MAX_OPACITY))
    columns[:, COLOUR : COLOUR + 3] = gaussians.rgb[chosen]
    columns[:, LABEL] = gaussians.label[chosen]
    intensity = gaussians.intensity[chosen]
    known = np.isfinite(intensity)
    columns[:, INTENSITY], columns[:, KNOWN] = np.where(known, intensity, 0), known
    drop = getattr(gaussians, "ray_drop", None)
    if drop is not None:
        columns[:, DROP] = np.clip(np.nan_to_num(drop[chosen]), 0, 1)
    normal = gaussians.normal[chosen]
    columns[:, NORMAL : NORMAL + 3] = np.where(np.isfinite(normal), np.clip(normal, -1, 1), 0)
    falloff = getattr(gaussians, "falloff", None)
    if falloff is not None:
        # Without a normal there is no incidence.
        columns[:, FALLOFF] = columns[:, NORMAL : NORMAL + 3].any(axis=1) * np.clip(
            np.nan_to_num(falloff[chosen]), 0, 1
        )
    return columns


def to_blocks(
    columns: Float32[np.ndarray, "n fields"], blocks: int, fill: int | None = None
) -> Float32[np.ndarray, "blocks fields 256"]:
    """Rows to blocks of arrays; rows that fill up are zero but for the column ``fill``, which is NEVER_SEEN."""
    count, fields = columns.shape
    made = np.empty((blocks, fields, BLOCK), np.float32)
    full, left = divmod(count, BLOCK)
    made[:full] = columns[: full * BLOCK].reshape(full, BLOCK, fields).transpose(0, 2, 1)
    made[full:] = 0
    if fill is not None:
        made[full:, fill] = NEVER_SEEN
        # Unit rotation and extent, so that no kernel divides by zero.
        made[full:, [QUAT, SCALE, SCALE + 1, SCALE + 2]] = 1
    if left:
        made[full, :, :left] = columns[full * BLOCK :].T
    return made


def morton_order(points: Float32[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """Order of points along a Z-order curve of 2^21 cells a side over all but the most distant of them."""
    # Quantiles: a few Gaussians far away (sky, outliers) would otherwise take all of the curve's resolution.
    low, high = np.quantile(points, 0.001, axis=0), np.quantile(points, 0.999, axis=0)
    extent = max(float((high - low).max()), 1e-9)

    def codes(first: int) -> np.ndarray:
        cells = np.clip((points[first : first + PART * BLOCK] - low) / extent, 0, 1) * (2**21 - 1)
        code = np.zeros(len(cells), np.uint64)
        for axis in range(3):
            v = cells[:, axis].astype(np.uint64)
            # Spread 21 bits to every third place (Morton 1966), by halves.
            for shift, mask in ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
                                (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)):  # fmt: skip
                v = (v | (v << np.uint64(shift))) & np.uint64(mask)
            code |= v << np.uint64(axis)
        return code

    code = np.concatenate(list(in_order(codes, range(0, len(points), PART * BLOCK))))
    return np.argsort(code, kind="stable")


def block_spheres(
    fields: Float32[np.ndarray, "blocks 22 256"],
) -> tuple[Float64[np.ndarray, "blocks 3"], Float64[np.ndarray, " blocks"]]:
    """A sphere around everything of each block that is at least 1/255 opaque."""
    if len(fields) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    mean = fields[:, MEAN : MEAN + 3].astype(np.float64)
    # The largest axis, times the standard deviations at which an opaque Gaussian has faded to 1/255.
    reach = fields[:, SCALE : SCALE + 3].max(axis=1).astype(np.float64)[:, None] * REACH
    seen = fields[:, None, LOG_OPACITY] > NEVER_SEEN
    low = np.where(seen, mean - reach, np.inf).min(axis=2)
    high = np.where(seen, mean + reach, -np.inf).max(axis=2)
    empty = ~seen.any(axis=(1, 2))
    low[empty], high[empty] = 0, 0
    return (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2
