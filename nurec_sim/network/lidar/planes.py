"""The plane through each return and its neighbours, by which footprints lie on surfaces before any training.

In the axes of a beam (h level to its left, v up, d along it) a plane is ``1 / d = m0 + m1 (h / d) + m2 (v / d)``,
linear in what a range image measures. It is fitted to a window of beams by reweighted least squares, so that what lies
beyond an edge does not count.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from nurec_sim.network.lidar.plane_fits import COLUMNS, fit_windows
from nurec_sim.network.lidar.range_image import RangeImage

PLANE_VALUES = ("slope h", "slope v", "offset", "roughness", "support", "left", "right", "up", "down")


def fit_planes(image: RangeImage) -> Float32[np.ndarray, "rows columns 9"]:
    """Planes of all returns, zeros for beams without one.

    Returns:
        By ``PLANE_VALUES``: by how much the range of the plane falls per metre to the left and up, so that its normal
        away from the sensor is (slope h, slope v, 1); metres from the return to the plane along the beam; mean absolute
        residual, metres; sum of weights by the beams of the window; logarithms of the ranges of the four neighbours by
        the own one, 0 where they did not return.
    """
    rows, columns = image.returned.shape
    xyz = np.full((3, rows, columns + 2 * COLUMNS), np.nan, np.float32)
    own = xyz[..., COLUMNS:-COLUMNS]
    own[:] = np.where(image.returned, np.moveaxis(image.xyz_m, -1, 0), np.nan)
    if image.full_turn:
        # Beams across the seam, by index: an image may be narrower than a window.
        xyz[..., :COLUMNS] = own[..., np.arange(-COLUMNS, 0) % columns]
        xyz[..., -COLUMNS:] = own[..., np.arange(COLUMNS) % columns]
    out = np.zeros((rows, columns, len(PLANE_VALUES)), np.float32)
    fit_windows(xyz, np.ascontiguousarray(image.eye_m.T), out)
    return out
