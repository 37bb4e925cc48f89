"""Surfaces closed between neighbouring rows of beams, in the depth that surfels give to a view.

Rows of a LiDAR with 32 beams lie 23 cm apart on a wall 10 m away. What is behind the wall, and was measured from
elsewhere, would be drawn between them; and where the wall has no texture, matching finds nothing there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.lift.lifting import BETWEEN
from nurec_sim.reconstruct.lift.views import WorkingView
from nurec_sim.types import LidarModel

WIDER = 1.1
"""Gaps are closed up to so many times the angle between rows: the camera is not where the LiDAR is."""
SAME_DEPTH = np.float32(BETWEEN)
"""``BETWEEN`` at the precision of depth pictures."""


def row_gaps(view: WorkingView, lidars: Sequence[LidarModel]) -> Float32[np.ndarray, "h w"]:
    """How many pixels two neighbouring rows of beams are apart at most, by the elevation of each pixel's ray.

    Args:
        view: a working view.
        lidars: scanners, taken as upright and as being at the camera; of several the finest counts. None: all 0.
    """
    tile, up = view.tile, view.world_from_view[2, :3]
    steps = np.zeros((tile.height, tile.width))
    models = [np.sort(lidar.elevation_rad) for lidar in lidars if len(lidar.elevation_rad) > 1]
    if models:
        x = (np.arange(tile.width) + 0.5 - tile.center_px[0]) / tile.focal_px
        y = (np.arange(tile.height)[:, None] + 0.5 - tile.center_px[1]) / tile.focal_px
        elevation = np.arcsin(np.clip((up[0] * x + up[1] * y + up[2]) / np.sqrt(x * x + y * y + 1), -1, 1))
        of_each = [np.interp(elevation, (rows[1:] + rows[:-1]) / 2, np.diff(rows)) for rows in models]
        steps = np.minimum.reduce(of_each)
    return (WIDER * tile.focal_px * steps).astype(np.float32)


@kernel
def close_rows(inverse_depth, index, body, gap):
    """Fill what lies between two pixels of one surface in a column that are as far apart as rows of beams.

    Only what is farther away than both, or not measured, is filled: what is nearer stands before the surface.

    Args:
        inverse_depth: [h,w] 1/m, 0 where there is none; changed.
        index: [h,w] surfel of each pixel; changed: -1 in the world, whose pixels then follow the surface, and in actors
            that of the nearer end.
        body: [h,w] its body, 0 for the world; changed.
        gap: [h,w] how many pixels the two are apart at most (``row_gaps``), by the lower one.
    """
    height, width = index.shape
    for column in range(width):
        for row in range(2, height):
            lower = inverse_depth[row, column]
            if lower <= 0:
                continue
            for above in range(row - 1, max(row - 1 - np.int64(gap[row, column]), -1), -1):
                upper = inverse_depth[above, column]
                if upper < (1 - SAME_DEPTH) * lower:
                    continue
                number = body[row, column]
                if (1 - SAME_DEPTH) * upper <= lower and body[above, column] == number:
                    for r in range(above + 1, row):
                        share = np.float32(r - above) / np.float32(row - above)
                        nearer = above if share < 0.5 else row
                        inverse_depth[r, column] = upper + share * (lower - upper)
                        index[r, column] = index[nearer, column] if number > 0 else -1
                        body[r, column] = number
                break
