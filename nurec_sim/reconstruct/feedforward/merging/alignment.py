"""Colours of chunks brought to one reference, so that what is shown does not step where chunks meet.

Every chunk has canonical colours of its own and, per camera, an affine row that turns them into what is shown:
``shown = A c + b``. As 4 x 4 matrices, Y of the chunk minimises the sum over cameras of ``|ISP_chunk Y - ISP_ref|_F``
(docs/network.md), hence takes colours of the reference to those of the chunk; colours of the chunk go through its
inverse, and then the reference's rows show them as the chunk's own rows did.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim.reconstruct.feedforward.chunks import ChunkLayers
from nurec_sim.types import Gaussians

LARGEST_GAIN = 4.0
"""Chunks of one log differ by exposure and white balance: no colour is made brighter or darker by more than this."""
RIDGES = (0.0, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
"""Weights of staying at the identity, against one camera's row, that are tried from the least on."""
UNSEEN_WEIGHT = 1e-5
"""What sky counts in a mean with others where its chunk did not see it."""

Rows = Mapping[str, Float64[np.ndarray, "3 4"]]


@dataclass(frozen=True, eq=False)
class ColourMap:
    """``reference = matrix @ chunk + offset``; ``ridge`` is the weight that was needed, infinite for the identity."""

    matrix: Float64[np.ndarray, "3 3"]
    offset: Float64[np.ndarray, " 3"]
    ridge: float

    @property
    def is_identity(self) -> bool:
        """Whether it changes nothing."""
        return bool(np.array_equal(self.matrix, np.eye(3)) and not self.offset.any())

    def __call__(self, rgb: Float32[np.ndarray, "*n 3"]) -> Float32[np.ndarray, "*n 3"]:
        """Colours of the chunk in those of the reference, clipped to 0..1."""
        if self.is_identity:
            return rgb
        mapped = rgb.astype(np.float64) @ self.matrix.T + self.offset
        return np.clip(mapped, 0.0, 1.0).astype(np.float32)

    def of_gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians with mapped colours, view-dependent ones included."""
        if self.is_identity:
            return gaussians
        rest = gaussians.sh_rest
        if rest is not None:
            rest = (rest.astype(np.float64) @ self.matrix.T).astype(np.float32)
        return dataclasses.replace(gaussians, rgb=self(gaussians.rgb), sh_rest=rest)


IDENTITY = ColourMap(np.eye(3), np.zeros(3), np.inf)


def colour_map(rows: Rows, reference: Rows) -> ColourMap:
    """The map that takes a chunk's canonical colours to those of a reference chunk.

    Least squares over the cameras that both have. Rows of a poor network can imply absurd colours, or leave a channel
    open; then the solution is pulled towards the identity, as little as makes it plausible: all singular values of its
    3 x 3 part within 1 / ``LARGEST_GAIN`` to ``LARGEST_GAIN``, no mirroring, offsets below 1. Where no weight does, or
    no camera is shared, colours stay as they are.
    """
    shared = [camera for camera in reference if camera in rows]
    if not shared:
        return IDENTITY
    own = np.stack([np.asarray(rows[camera], np.float64) for camera in shared])
    wanted = np.stack([np.asarray(reference[camera], np.float64) for camera in shared])
    if not (np.isfinite(own).all() and np.isfinite(wanted).all()):
        return IDENTITY
    if np.array_equal(own, wanted):
        return dataclasses.replace(IDENTITY, ridge=0.0)
    # ISP_chunk Y = ISP_ref, whose last row is 0 0 0 1 on both sides: A_chunk Y = [A_ref, b_ref - b_chunk].
    left = own[:, :, :3].reshape(-1, 3)
    right = np.concatenate([wanted[:, :, :3], wanted[:, :, 3:] - own[:, :, 3:]], axis=2).reshape(-1, 4)
    normal = left.T @ left
    for ridge in RIDGES:
        weight = ridge * len(shared)
        if ridge == 0.0:
            solution = np.linalg.lstsq(left, right, rcond=None)[0]
        else:
            solution = np.linalg.solve(normal + weight * np.eye(3), left.T @ right + weight * np.eye(3, 4))
        if _plausible(solution):
            matrix = np.linalg.inv(solution[:, :3])
            return ColourMap(matrix, -matrix @ solution[:, 3], ridge)
    return IDENTITY


def _plausible(y: Float64[np.ndarray, "3 4"]) -> bool:
    if not np.isfinite(y).all():
        return False
    gains = np.linalg.svd(y[:, :3], compute_uv=False)
    small_enough = gains[0] <= LARGEST_GAIN and np.abs(y[:, 3]).max() <= 1.0
    return bool(small_enough and gains[-1] >= 1 / LARGEST_GAIN and np.linalg.det(y[:, :3]) > 0)


def aligned_chunks(chunks: Sequence[ChunkLayers]) -> tuple[list[ChunkLayers], list[ColourMap]]:
    """Chunks with the static, dynamic and sky colours of the first chunk, and how each was mapped.

    The choice of the reference only matters where colours are clipped to 0..1. It is the first, as in the release, so
    that a scene keeps its colours when its log is extended. The rows of every chunk are adjusted to show its new
    colours as the old ones were shown.
    """
    maps = [dataclasses.replace(IDENTITY, ridge=0.0)] + [colour_map(c.isp, chunks[0].isp) for c in chunks[1:]]
    return [_mapped(chunk, colour) for chunk, colour in zip(chunks, maps, strict=True)], maps


def _mapped(chunk: ChunkLayers, colour: ColourMap) -> ChunkLayers:
    if colour.is_identity:
        return chunk
    back = np.linalg.inv(colour.matrix)
    isp = {}
    for camera, row in chunk.isp.items():
        # shown = A c + b with c = M^-1 (c' - m): the row for the new colours is [A M^-1, b - A M^-1 m].
        matrix = row[:, :3] @ back
        isp[camera] = np.concatenate([matrix, (row[:, 3] - matrix @ colour.offset)[:, None]], axis=1)
    return dataclasses.replace(
        chunk,
        static=colour.of_gaussians(chunk.static),
        dynamic=dataclasses.replace(chunk.dynamic, gaussians=colour.of_gaussians(chunk.dynamic.gaussians)),
        sky=colour(chunk.sky),
        isp=isp,
    )


def merged_isp(chunks: Sequence[ChunkLayers]) -> dict[str, Float64[np.ndarray, "3 4"]]:
    """One row per camera of aligned chunks: of the first chunk that has the camera."""
    isp: dict[str, np.ndarray] = {}
    for chunk in chunks:
        for camera, row in chunk.isp.items():
            isp.setdefault(camera, np.asarray(row, np.float64))
    return isp


def merged_sky(chunks: Sequence[ChunkLayers]) -> Float32[np.ndarray, "6 s s 3"]:
    """Mean of the skies of aligned chunks, each texel weighted by how surely its chunk saw it.

    A single chunk's sky stays exactly as it is.
    """
    if len(chunks) == 1:
        return chunks[0].sky
    weights = np.stack([chunk.sky_seen.astype(np.float64) + UNSEEN_WEIGHT for chunk in chunks])
    total = sum(weight[..., None] * chunk.sky for weight, chunk in zip(weights, chunks, strict=True))
    return (total / weights.sum(axis=0)[..., None]).astype(np.float32)
