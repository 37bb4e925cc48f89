"""Kernel that turns blended beams into the returns of a LiDAR sweep; what ``spec.sweep_frame`` does."""

from __future__ import annotations

import numpy as np

from nurec_sim.render.cpu.kernel import kernel

# Planes of a sweep, see ``draw.draw_tiles``.
ALPHA, INTENSITY, KNOWN, DROP, DISTANCE, HALF = 0, 1, 2, 3, 4, 5
MIN_ALPHA = 1 / 255


@kernel
def sweep_returns(
    first, last, planes, direction, beam, line, end_from_line, limits, filters, ranges, intensities, points, beams
):
    """Returns of the rows first..last, in the order of their beams.

    Args:
        first: first row.
        last: one behind the last.
        planes: see ``draw.draw_tiles``.
        direction: [h,w,3] unit rays in the sensor's frame by grid cell.
        beam: [h,w] number of each cell's beam; a row's beams are those of its cells, rolled.
        line: [h,w] line of each cell.
        end_from_line: [l,3,4] float64 from the pose of a line to that at the end of the sweep; one if nothing moves.
        limits: smallest and largest range.
        filters: most drop probability, least opacity (not included), most distance from the mean.
        ranges: output; row r writes from r * columns on, as for the following three.
        intensities: output.
        points: output [..,3].
        beams: output.

    Returns:
        Number of returns, written one after the other from row ``first``'s place on.
    """
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
            if not alpha > filters[1]:
                continue
            mean = np.float64(planes[DISTANCE, y, x]) / max(alpha, MIN_ALPHA)
            half = np.float64(planes[HALF, y, x])
            distance = half if half > 0.0 else mean
            if not (limits[0] <= distance <= limits[1]) or planes[DROP, y, x] > filters[0] * alpha:
                continue
            if abs(distance - mean) > filters[2]:
                continue
            ranges[n] = np.float32(distance)
            intensity = np.float64(planes[INTENSITY, y, x]) / max(np.float64(planes[KNOWN, y, x]), 1e-12)
            intensities[n] = np.float32(min(max(intensity, 0.0), 1.0))
            m = end_from_line[line[y, x] if moving else 0]
            a, b, c = direction[y, x, 0] * distance, direction[y, x, 1] * distance, direction[y, x, 2] * distance
            for row in range(3):
                points[n, row] = np.float32(m[row, 0] * a + m[row, 1] * b + m[row, 2] * c + m[row, 3])
            beams[n] = beam[y, x]
            n += 1
    return n - first * columns
