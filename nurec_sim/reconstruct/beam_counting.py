"""Kernels that count the recorded beams of a sweep that meet Gaussians, for ``free_space``."""

from __future__ import annotations

import numpy as np

from nurec_sim.compute.kernels import unchecked_inner, unchecked_kernel

STEP_RAD = np.radians(0.2)
"""Cells of a sweep's image: about one beam of a scanner with 64 rows each."""
COLUMNS = 1800
MEETS = 1.5
"""Squared Mahalanobis distance within which a beam meets a Gaussian: it would lose half of its light there."""
MARGIN_M, MARGIN_SHARE = 0.3, 0.02
"""A beam ends at a Gaussian within this distance along it, plus a share of its range: noise of poses and surfaces."""
NOISE_M, NOISE_SHARE = 0.04, 0.002
"""The same for how opaque a Gaussian is: noise only. By the margin foliage before a wall would be as opaque as that."""
LEAST_FACING = 0.15
"""Noise is measured across the surface; along a grazing beam it is longer, by one over this cosine at most."""
FARTHEST_M = 60.0
"""Poses and boxes are too inaccurate to carve farther away."""
ENOUGH, CLEAR = 24, 6
"""Beams that decide, and those that do if nearly all agree; more are not looked for."""
THINNEST_M = 1e-4
NEAREST_M = 1.0
MOST_CELLS = 3.0
"""Beams are looked for this far from the direction of a centre, in cells, and not between the sensor and the car."""
BLOCK = 256
"""Gaussians whose directions are found together, several per instruction."""
ROUNDING = 1e-6
"""Beams are stored in single precision: their squared lengths are 1 within a fraction of this."""


@unchecked_inner
def _angle(y, x):
    """Angle of the direction (x, y) within 2e-8 rad, by Abramowitz and Stegun 4.4.49; a fifth of ``arctan2``'s time."""
    wide, high = abs(x), abs(y)
    t = min(wide, high) / max(wide, high, 1e-300)
    q = t * t
    angle = ((0.0028662257 * q - 0.0161657367) * q + 0.0429096138) * q - 0.0752896400
    angle = (((angle * q + 0.1065626393) * q - 0.1420889944) * q + 0.1999355085) * q - 0.3333314528
    angle = t * (angle * q + 1.0)
    if high > wide:
        angle = 0.5 * np.pi - angle
    if x < 0:
        angle = np.pi - angle
    return -angle if y < 0 else angle


@unchecked_inner
def _turned(turn, x, y, z):
    return (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z,
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z,
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z,
    )


@unchecked_inner
def _half_width(axes, u, v, w):
    """Half of the width along a unit vector of an ellipsoid with the given half axes (rows)."""
    a, b, c = _turned(axes, u, v, w)
    return np.sqrt(a * a + b * b + c * c)


@unchecked_inner
def _wrapped(column):
    """A column less than a turn outside of the image, in it; what is farther outside, as of no number, at its edge."""
    if column < 0:
        return max(column + COLUMNS, 0)
    return min(column - COLUMNS, COLUMNS - 1) if column >= COLUMNS else column


@unchecked_inner
def _undecided(counts, found):
    """Numbers of the Gaussians that need more beams, into ``found``; returns how many."""
    n = 0
    for i in range(len(counts)):
        passed, stopped = counts[i, 0], counts[i, 1]
        total = passed + stopped
        found[n] = i
        n += not (total >= ENOUGH or (total >= CLEAR and 8 * min(passed, stopped) <= total))
    return n


@unchecked_kernel
def ellipsoids(mean_m, quat_wxyz, scale_m):
    """Gaussians as ``count`` needs them.

    Returns:
        Centres [n,3] (m); ``canonical`` [n,3,3], which times a vector is that vector in standard deviations along the
        Gaussian's axes; half axes [n,3,3] (m) of the ellipsoids that beams have to meet, and the longest ones [n]; the
        standard deviation (m) along the thinnest axis [n], and which one this is [n].
    """
    n = len(mean_m)
    xyz, canonical, extent = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3, 3))
    radius, thinness, thinnest = np.empty(n), np.empty(n), np.empty(n, np.int64)
    for i in range(n):
        w, x, y, z = (
            np.float64(quat_wxyz[i, 0]),
            np.float64(quat_wxyz[i, 1]),
            np.float64(quat_wxyz[i, 2]),
            np.float64(quat_wxyz[i, 3]),
        )
        length = np.sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = w / length, x / length, y / length, z / length
        axes = (
            (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
            (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
            (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
        )
        longest, thinness[i] = 0.0, np.inf
        for k in range(3):
            xyz[i, k] = mean_m[i, k]
            sigma = max(np.float64(scale_m[i, k]), THINNEST_M)
            longest = max(longest, sigma)
            if sigma < thinness[i]:
                thinness[i], thinnest[i] = sigma, k
            for m in range(3):
                canonical[i, k, m] = axes[k][m] / sigma
                extent[i, k, m] = axes[k][m] * (np.sqrt(MEETS) * sigma)
        radius[i] = np.sqrt(MEETS) * longest
    return xyz, canonical, extent, radius, thinness, thinnest


@unchecked_kernel
def count(
    xyz, canonical, extent, radius, thinness, thinnest,
    pose, drift, beams, image, reach_m, farthest_m, low, width, fraction, counts,
):  # fmt: skip
    """Adds the beams of one sweep to ``counts`` [n,4], in the order of ``free_space.BeamCounts``.

    The first row of arguments is of ``ellipsoids``. ``pose`` is that of their body in the axes of the LiDAR; the others
    are fields of ``free_space.SweepBeams``.
    """
    rows = image.shape[0]
    turn = np.ascontiguousarray(pose[:3, :3].T)
    # Scalars and one array per value: loops over them are vectorised.
    p00, p01, p02, p03 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    p10, p11, p12, p13 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    p20, p21, p22, p23 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    d0, d1, d2 = drift[0], drift[1], drift[2]
    px, py, pz, fired = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    azimuths, elevations, levels, distances = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    undecided = np.empty(len(xyz), np.int64)
    every = _undecided(counts, undecided)
    for start in range(0, every, BLOCK):
        size = min(BLOCK, every - start)
        for j in range(size):
            i = undecided[start + j]
            x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            px[j] = p00 * x + p01 * y + p02 * z + p03
            py[j] = p10 * x + p11 * y + p12 * z + p13
            pz[j] = p20 * x + p21 * y + p22 * z + p23
        for j in range(size):
            azimuths[j] = (_angle(py[j], px[j]) + np.pi) / STEP_RAD
        for j in range(size):
            fired[j] = fraction[_wrapped(int(azimuths[j]))] - 0.5
        for j in range(size):
            # The sensor moves while it spins; one correction suffices, as it moves little while it turns by the
            # parallax.
            x, y, z = px[j] - fired[j] * d0, py[j] - fired[j] * d1, pz[j] - fired[j] * d2
            level = np.sqrt(x * x + y * y)
            levels[j], distances[j] = level, np.sqrt(x * x + y * y + z * z)
            azimuths[j] = (_angle(y, x) + np.pi) / STEP_RAD
            elevations[j] = _angle(z, level) / STEP_RAD - low
        for j in range(size):
            level, distance, azimuth, elevation = levels[j], distances[j], azimuths[j], elevations[j]
            if px[j] * px[j] + py[j] * py[j] + pz[j] * pz[j] > FARTHEST_M * FARTHEST_M:
                continue
            # No scanner looks straight up or down.
            if distance < NEAREST_M or level < 0.1 * distance:
                continue
            # Most Gaussians are hidden from most sweeps: all beams around end before them.
            margin = MARGIN_M + MARGIN_SHARE * distance
            middle = min(max(int(np.floor(elevation)), 0), rows - 1)
            if farthest_m[middle, _wrapped(int(azimuth))] < distance - margin:
                continue
            # Seen along the beams a grazing footprint is as small as others, however long.
            i = undecided[start + j]
            x, y, z = px[j] - fired[j] * d0, py[j] - fired[j] * d1, pz[j] - fired[j] * d2
            back = -z / (level * distance)
            across = _half_width(extent[i], *_turned(turn, -y / level, x / level, 0.0)) / level
            upward = _half_width(extent[i], *_turned(turn, back * x, back * y, level / distance)) / distance
            across = min(max(across, width) / STEP_RAD, MOST_CELLS)
            upward = min(max(upward, width) / STEP_RAD, MOST_CELLS)
            first, last = max(int(np.floor(elevation - upward)), 0), min(int(np.floor(elevation + upward)), rows - 1)
            left, right = int(np.floor(azimuth - across)), int(np.floor(azimuth + across))
            for row in range(first, last + 1):
                for cell in range(left, right + 1):
                    column = _wrapped(cell)
                    # Nor is there a beam in cells whose reach is -1.
                    if reach_m[row, column] < distance - margin:
                        continue
                    b = image[row, column]
                    # The beam and the centre as seen from where the beam was fired.
                    f = beams[b, 4] - 0.5
                    ox, oy, oz = px[j] - f * d0, py[j] - f * d1, pz[j] - f * d2
                    dx, dy, dz = np.float64(beams[b, 0]), np.float64(beams[b, 1]), np.float64(beams[b, 2])
                    t = ox * dx + oy * dy + oz * dz
                    square = ox * ox + oy * oy + oz * oz
                    aside = square - t * t
                    close = aside <= (width * distance) ** 2
                    # A sphere around the ellipsoid, before the latter.
                    if not close and aside > radius[i] * radius[i] + ROUNDING * square:
                        continue
                    # The beam, and the centre from its origin, in standard deviations along the Gaussian's axes.
                    u, v, w = _turned(canonical[i], *_turned(turn, dx, dy, dz))
                    if not close:
                        ax, ay, az = _turned(canonical[i], *_turned(turn, ox, oy, oz))
                        ab, bb = ax * u + ay * v + az * w, u * u + v * v + w * w
                        # Where along the beam it is nearest, and the squared Mahalanobis distance there.
                        t = ab / bb
                        if ax * ax + ay * ay + az * az - ab * ab / bb > MEETS:
                            continue
                    behind = beams[b, 3] - t
                    if behind > margin:
                        counts[i, 0] += 1
                    elif behind > -margin:
                        counts[i, 1] += 1
                    # Across the surface noise is as large for all beams; along grazing ones it is longer.
                    along = abs(u if thinnest[i] == 0 else v if thinnest[i] == 1 else w)
                    noise = (NOISE_M + NOISE_SHARE * distance) / max(along * thinness[i], LEAST_FACING)
                    if behind > noise:
                        counts[i, 2] += 1
                    elif behind > -noise:
                        counts[i, 3] += 1
