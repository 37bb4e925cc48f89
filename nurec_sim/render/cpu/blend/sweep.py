"""Kernel that turns blended beams into the returns of a LiDAR sweep; what ``spec.sweep_frame`` does."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

from nurec_sim.render.cpu.kernel import kernel

# Planes of a sweep, see ``draw.draw_tiles``.
ALPHA, INTENSITY, KNOWN, DROP, DISTANCE, HALF = 0, 1, 2, 3, 4, 5
MIN_ALPHA = 1 / 255


class SweepRays(NamedTuple):
    """A LiDAR's rays by cell of its grid; see ``grid.Grid``."""

    direction: Float32[np.ndarray, "h w 3"]
    """Unit rays in the sensor's frame."""
    valid: UInt8[np.ndarray, "h w"]
    """0 for blocked beams."""
    beam: Int32[np.ndarray, "h w"]
    """Number of each cell's beam; a row's beams are those of its cells, rolled."""
    line: Int32[np.ndarray, "h w"]
    end_from_line: Float64[np.ndarray, "l 3 4"]
    """From the pose of a line to that at the end of the sweep; one if nothing moves."""


class SweepFilter(NamedTuple):
    """Which beams return; see ``types.LidarFilter``."""

    nearest_m: float
    farthest_m: float
    most_drop: float
    """Largest drop probability."""
    least_opacity: float
    """Not included."""
    most_offset_m: float
    """Largest distance of the return from the weighted mean along the beam."""


class SweepReturns(NamedTuple):
    """Room for a return per beam; row r of the grid writes from r * columns on."""

    range_m: Float32[np.ndarray, " n"]
    intensity: Float32[np.ndarray, " n"]
    xyz_m: Float32[np.ndarray, "n 3"]
    """In the sensor at the end of the sweep."""
    beam: Int32[np.ndarray, " n"]


@kernel
def sweep_returns(first, last, planes, rays, limits, returns):
    """Returns of the rows first..last, in the order of their beams.

    Args:
        first: first row.
        last: one behind the last.
        planes: see ``draw.draw_tiles``.
        rays: see ``SweepRays``.
        limits: see ``SweepFilter``.
        returns: output, see ``SweepReturns``.

    Returns:
        Number of returns, written one after the other from row ``first``'s place on.
    """
    # A row's range of output is its own, so rows can be finished in any order and by any thread.
    direction, valid, beam, line, end_from_line = rays
    columns = beam.shape[1]
    moving = end_from_line.shape[0] > 1
    n = first * columns
    for y in range(first, last):
        # The cell of the row's first beam; later beams follow it around the row.
        start = 0
        for x in range(columns):
            if beam[y, x] == y * columns:
                start = x
        for k in range(columns):
            x = start + k if start + k < columns else start + k - columns
            alpha = np.float64(planes[ALPHA, y, x])
            if not alpha > limits.least_opacity or not valid[y, x]:
                continue
            # The planes hold weighted sums; float64 from here on, as in ``spec``.
            mean = np.float64(planes[DISTANCE, y, x]) / max(alpha, MIN_ALPHA)
            half = np.float64(planes[HALF, y, x])
            # An echo comes from one surface: where half of the beam has been stopped, not a mean between surfaces.
            distance = half if half > 0.0 else mean
            if not (limits.nearest_m <= distance <= limits.farthest_m) or planes[DROP, y, x] > limits.most_drop * alpha:
                continue
            if abs(distance - mean) > limits.most_offset_m:
                continue
            returns.range_m[n] = np.float32(distance)
            # The mean over the Gaussians whose intensity is known; the others have added to neither sum.
            intensity = np.float64(planes[INTENSITY, y, x]) / max(np.float64(planes[KNOWN, y, x]), 1e-12)
            returns.intensity[n] = np.float32(min(max(intensity, 0.0), 1.0))
            # Points of a sweep are given in the frame of its end, whatever column they were fired in.
            m = end_from_line[line[y, x] if moving else 0]
            a, b, c = direction[y, x, 0] * distance, direction[y, x, 1] * distance, direction[y, x, 2] * distance
            for row in range(3):
                returns.xyz_m[n, row] = np.float32(m[row, 0] * a + m[row, 1] * b + m[row, 2] * c + m[row, 3])
            returns.beam[n] = beam[y, x]
            n += 1
    return n - first * columns
