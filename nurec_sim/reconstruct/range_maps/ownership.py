"""Windows merged: every surface is kept from where it was seen from nearest, once.

As for cameras, ownership is decided by distance: a return goes where another window saw the same surface from much
nearer. What remains overlaps from window to window, and one return per voxel of the spacing of its beams is kept. Both
are decided before decoding: Gaussians stay near their returns, and only those that are kept cost time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Float64

from nurec_sim import geometry
from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.beam_counting import COLUMNS, MARGIN_M, MARGIN_SHARE, STEP_RAD
from nurec_sim.reconstruct.free_space import BEAM_SHARE, SweepBeams

FINEST_M = 0.04
"""Edge of the finest voxels; coarser ones are doubled. Footprints near the sensor are widened to it."""
MOST_CELLS = 5
"""The image of a sweep is searched around a direction as far as its beams lie apart, up to so many cells."""


def owned(
    xyz_m: Float64[np.ndarray, "n 3"],
    range_m: Float32[np.ndarray, " n"],
    others: Sequence[SweepBeams],
    nearer: float,
) -> Bool[np.ndarray, " n"]:
    """Whether no other window saw the surface at a point from less than ``nearer`` times its range.

    Args:
        xyz_m: points in the world.
        range_m: from where they were seen.
        others: the other windows.
        nearer: 0 keeps all.
    """
    kept = np.ones(len(xyz_m), bool)
    for each in others:
        pose = geometry.inverse(each.world_from_lidar)
        cells = min(int(np.ceil(each.width_rad / BEAM_SHARE / STEP_RAD)), MOST_CELLS)
        _drop_seen_nearer(xyz_m, range_m.astype(np.float64), nearer, pose, each.drift_m, each.reach_m, each.low,
                          each.fraction, cells, kept)  # fmt: skip
    return kept


@kernel
def _drop_seen_nearer(xyz, reach, nearer, pose, drift, image, low, fraction, cells, kept):
    rows = image.shape[0]
    for i in range(len(xyz)):
        if not kept[i]:
            continue
        x = pose[0, 0] * xyz[i, 0] + pose[0, 1] * xyz[i, 1] + pose[0, 2] * xyz[i, 2] + pose[0, 3]
        y = pose[1, 0] * xyz[i, 0] + pose[1, 1] * xyz[i, 1] + pose[1, 2] * xyz[i, 2] + pose[1, 3]
        z = pose[2, 0] * xyz[i, 0] + pose[2, 1] * xyz[i, 1] + pose[2, 2] * xyz[i, 2] + pose[2, 3]
        limit = nearer * reach[i]
        if x * x + y * y + z * z > limit * limit:
            continue
        # The sensor moves while it turns.
        f = fraction[int((np.arctan2(y, x) + np.pi) / STEP_RAD) % COLUMNS] - 0.5
        x, y, z = x - f * drift[0], y - f * drift[1], z - f * drift[2]
        distance = np.sqrt(x * x + y * y + z * z)
        column = int((np.arctan2(y, x) + np.pi) / STEP_RAD) % COLUMNS
        row = int(np.floor(np.arcsin(min(max(z / max(distance, 1e-6), -1.0), 1.0)) / STEP_RAD)) - low
        margin = MARGIN_M + MARGIN_SHARE * distance
        for k in range(max(row - cells, 0), min(row + cells, rows - 1) + 1):
            for n in range(column - cells, column + cells + 1):
                found = image[k, n % COLUMNS]
                if found > 0 and abs(found - distance) < margin:
                    kept[i] = False
                    break
            if not kept[i]:
                break


def voxel_edge_m(size_m: Float32[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
    """Sizes rounded down to ``FINEST_M`` times a power of two, and up to it."""
    level = np.maximum(np.floor(np.log2(np.maximum(size_m, FINEST_M) / FINEST_M)), 0)
    return (FINEST_M * 2.0**level).astype(np.float32)


def one_per_voxel(
    xyz_m: Float64[np.ndarray, "n 3"], edge_m: Float32[np.ndarray, " n"], range_m: Float32[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Which points are those seen from nearest in their voxels.

    Args:
        xyz_m: points.
        edge_m: of the voxel that each falls into (``voxel_edge_m``).
        range_m: from where each was seen; ties go to the first.
    """
    level = np.rint(np.log2(edge_m / FINEST_M)).astype(np.int64)
    cell = np.floor(xyz_m / edge_m[:, None]).astype(np.int64)
    # 5 bits of level, 19 bits per axis.
    key = (level << 57) | ((cell[:, 0] & 0x7FFFF) << 38) | ((cell[:, 1] & 0x7FFFF) << 19) | (cell[:, 2] & 0x7FFFF)
    order = np.argsort(range_m, kind="stable")
    _, first = np.unique(key[order], return_index=True)
    kept = np.zeros(len(xyz_m), bool)
    kept[order[first]] = True
    return kept
