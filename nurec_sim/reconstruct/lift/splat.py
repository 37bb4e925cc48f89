"""Surfels drawn into a working view: where they lie, and what lies behind them.

Inverse depth (1/m, along the optical axis) everywhere; 0 is nothing. Compiled kernels run without the interpreter lock.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int32

from nurec_sim.compute.kernels import inner, kernel

SPLAT_RADIUS = 0.5
"""Radius of a drawn surfel per metre of its spacing; what stays open is filled by matching."""
WIDEST_PX, WIDEST_OF_ACTORS_PX = 8.0, 64.0
"""Drawn surfels have no larger radius: wide discs reach over trunks and bars. Actors are bodies without gaps, and a car
in the next lane, whose surfels are 20 pixels apart, would be pierced."""
FROM_BEHIND = 0.2
"""Cosine between ray and normal from which on surfels are not drawn: they were measured from their other side, and what
hides them from here, a wall higher than beams reach, may not be measured at all."""
HIGHEST_GAP, DEEPEST_GAP = 1 / 8, 1 / 4
"""Gaps in an actor are filled up to this share of its length, if the depths of their ends differ by so little."""


@inner
def project_point(views, k, x, y, z):
    """Pixel and depth of a point: (u, v, depth); depth <= 0 if behind.

    Args:
        views: [n,23] packed projections (``WorkingView.packed``). All of them: to take one out in an inner loop would
            count its references, which takes as long as the projection.
        k: which of them.
        x: of the point, metres, in the frame that the view projects from.
        y: likewise.
        z: likewise.
    """
    a = views[k, 5] * x + views[k, 6] * y + views[k, 7] * z + views[k, 14]
    b = views[k, 8] * x + views[k, 9] * y + views[k, 10] * z + views[k, 15]
    c = views[k, 11] * x + views[k, 12] * y + views[k, 13] * z + views[k, 16]
    if c <= 1e-3:
        return 0.0, 0.0, -1.0
    u, v = views[k, 0] * a / c + views[k, 1], views[k, 0] * b / c + views[k, 2]
    if views[k, 17] != 0.0 or views[k, 18] != 0.0 or views[k, 19] != 0.0:
        # Where a point is shown depends on when its row was exposed, and the other way round: a fixed point, which
        # contracts fast because the drift is small against the depth.
        for _ in range(3):
            f = min(max(views[k, 20] * u + views[k, 21] * v + views[k, 22], -0.5), 0.5)
            d = c - views[k, 19] * f
            if d <= 1e-3:
                return 0.0, 0.0, -1.0
            u, v = (
                views[k, 0] * (a - views[k, 17] * f) / d + views[k, 1],
                views[k, 0] * (b - views[k, 18] * f) / d + views[k, 2],
            )
        c -= views[k, 19] * f
    return u, v, c


@inner
def world_point(view, world_from_view, u, v, inverse_depth):
    """The point that a pixel shows, the reverse of ``project_point``: (x, y, z) in metres.

    Args:
        view: [23] packed projection.
        world_from_view: [4,4] pose of the view.
        u: of the pixel.
        v: likewise.
        inverse_depth: along the optical axis, 1/m, not 0.
    """
    # Where the camera was when the pixel was exposed, off its middle (rolling shutter).
    f = min(max(view[20] * u + view[21] * v + view[22], -0.5), 0.5)
    x = (u - view[1]) / view[0] / inverse_depth + view[17] * f
    y = (v - view[2]) / view[0] / inverse_depth + view[18] * f
    z = 1.0 / inverse_depth + view[19] * f
    m = world_from_view
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@kernel
def project_surfels(view, xyz, widest):
    """Rows [m] of the points [n,3] that may reach into the image, and their pixels and depths [m,3] (u, v, metres).

    ``widest``: how far a point reaches at most, pixels.
    """
    width, height, views = int(view[3]), int(view[4]), view.reshape(1, -1)
    rows, places, count = np.empty(len(xyz), np.int64), np.empty((len(xyz), 3)), 0
    for i in range(len(xyz)):
        u, v, depth = project_point(views, 0, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        if depth >= 0.3 and -widest <= u <= width + widest and -widest <= v <= height + widest:
            rows[count], places[count, 0], places[count, 1], places[count, 2] = i, u, v, depth
            count += 1
    return rows[:count].copy(), places[:count].copy()


@kernel
def splat(view, rows, places, normal, spacing, widest, offset, front, total, weight, nearest, index, second):
    """Splat surfels: the first pass keeps the smallest depth in ``front``, the second averages near it.

    Each surfel covers a disc of its spacing and takes at every pixel the depth of its tangent plane, bounded so that a
    grazing plane does not run away. Those seen from behind (``FROM_BEHIND``) are left out. The second pass sums inverse
    depths within 4 % of the front, weighted by the distance from the pixel's centre, so that noise does not pull
    surfaces forward.

    Args:
        view: [23] packed projection from the surfels' frame.
        rows: see ``project_surfels``.
        places: likewise.
        normal: [n,3] unit normals, towards where the surfels were measured from.
        spacing: [n] distance between surfels, metres.
        widest: largest radius of a disc, pixels.
        offset: added to row numbers in ``index``.
        front: [h,w] largest inverse depth so far, 1/m; written in the first pass, read in the second.
        total: [h,w] weighted sum of inverse depths; added to in the second pass.
        weight: [h,w] sum of the weights; likewise.
        nearest: [h,w] squared distance of the nearest surfel centre in radii; lowered in the second pass.
        index: [h,w] ``offset`` + row of that surfel; written in the second pass.
        second: whether this is the second pass.
    """
    width, height, focal = int(view[3]), int(view[4]), view[0]
    for k in range(len(rows)):
        i, u, v, depth = rows[k], places[k, 0], places[k, 1], places[k, 2]
        # Distant surfels should still hit a pixel.
        radius = min(max(SPLAT_RADIUS * spacing[i] * focal / depth, 0.6), widest)
        n0 = view[5] * normal[i, 0] + view[6] * normal[i, 1] + view[7] * normal[i, 2]
        n1 = view[8] * normal[i, 0] + view[9] * normal[i, 1] + view[10] * normal[i, 2]
        n2 = view[11] * normal[i, 0] + view[12] * normal[i, 1] + view[13] * normal[i, 2]
        x, y = (u - view[1]) / focal, (v - view[2]) / focal
        along = n0 * x + n1 * y + n2
        if along > FROM_BEHIND * np.sqrt(x * x + y * y + 1.0):
            continue
        w = 1.0 / depth
        # dw = w^2 dz: the tangent plane may deviate by 1.5 spacings over the slope, and by 10 % at most.
        limit = min(1.5 * spacing[i] * w * w / max(abs(along), 0.05), 0.1 * w)
        for row in range(max(int(v - radius), 0), min(int(v + radius) + 1, height)):
            for column in range(max(int(u - radius), 0), min(int(u + radius) + 1, width)):
                du, dv = column + 0.5 - u, row + 0.5 - v
                square = (du * du + dv * dv) / (radius * radius)
                if square > 1.0:
                    continue
                here = w
                if abs(along) > 1e-6:
                    # On a plane w is linear in the pixel: w = n.ray / d, so dw / w = n.(du, dv, 0) / (f n.ray).
                    slant = w * (n0 * du + n1 * dv) / (focal * along)
                    here = w + min(max(slant, -limit), limit)
                if not second:
                    front[row, column] = max(front[row, column], here)
                elif here > 0.96 * front[row, column]:
                    share = np.exp(-2.0 * square)
                    total[row, column] += share * here
                    weight[row, column] += share
                    if square < nearest[row, column]:
                        nearest[row, column] = square
                        index[row, column] = offset + i


@kernel
def drop_shine_through(inverse_depth, index):
    """Empty pixels that most of their 7x7 surroundings lie well in front of: seen through gaps of a surface."""
    height, width = inverse_depth.shape
    bad = np.zeros((height, width), np.bool_)
    for row in range(height):
        for column in range(width):
            w = inverse_depth[row, column]
            if w <= 0:
                continue
            front, total = 0, 0
            for r in range(max(row - 3, 0), min(row + 4, height)):
                for c in range(max(column - 3, 0), min(column + 4, width)):
                    other = inverse_depth[r, c]
                    if other > 0:
                        total += 1
                        front += other > 1.2 * w + 0.002
            bad[row, column] = front * 2 > total + 4
    for row in range(height):
        for column in range(width):
            if bad[row, column]:
                inverse_depth[row, column] = 0
                index[row, column] = -1


@kernel
def close_gaps(inverse_depth, index, body, length, focal):
    """Fill what lies between two pixels of one actor in a column: between rows of beams the scenery shines through.

    Glass lets beams pass as well, and what images show there is the car. Rows are left open: from its side there is a
    gap between the wheels of a car.

    Args:
        inverse_depth: [h,w] 1/m, 0 where there is none; changed.
        index: [h,w] surfel of each pixel; changed to that of the nearer end of the gap.
        body: [h,w] its body; changed.
        length: [bodies] metres; 0 of those that stay open.
        focal: of the view, pixels.
    """
    height, width = index.shape
    for column in range(width):
        above = -1
        for row in range(height):
            number = body[row, column]
            if length[number] == 0:
                continue
            if 0 <= above < row - 1 and body[above, column] == number:
                upper, lower = inverse_depth[above, column], inverse_depth[row, column]
                low = (row - above) / (focal * min(upper, lower)) <= HIGHEST_GAP * length[number]
                if low and abs(1 / upper - 1 / lower) <= DEEPEST_GAP * length[number]:
                    for r in range(above + 1, row):
                        share = np.float32(r - above) / np.float32(row - above)
                        w = upper + share * (lower - upper)
                        if inverse_depth[r, column] < w:
                            inverse_depth[r, column], body[r, column] = w, number
                            index[r, column] = index[above if share < 0.5 else row, column]
            above = row


@kernel
def trim_silhouettes(inverse_depth, index, gray):
    """Empty pixels at the rim of a nearer surface that look unlike its inside: splats reach over silhouettes."""
    height, width = inverse_depth.shape
    rim = np.zeros((height, width), np.bool_)
    for row in range(1, height - 1):
        for column in range(1, width - 1):
            w = inverse_depth[row, column]
            if w <= 0:
                continue
            own = float(gray[row, column])
            outside, inside, n_outside, n_inside = 0.0, 0.0, 0, 0
            for r in range(max(row - 2, 0), min(row + 3, height)):
                for c in range(max(column - 2, 0), min(column + 3, width)):
                    if inverse_depth[r, c] < 0.8 * w:
                        outside += gray[r, c]
                        n_outside += 1
                    else:
                        inside += gray[r, c]
                        n_inside += 1
            if n_outside >= 3 and n_inside > 0:
                rim[row, column] = abs(own - outside / n_outside) + 8 < abs(own - inside / n_inside)
    for row in range(height):
        for column in range(width):
            if rim[row, column]:
                inverse_depth[row, column] = 0
                index[row, column] = -1


def draw_surfels(
    shape: tuple[int, int], bodies: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float, int]]
) -> tuple[Float32[np.ndarray, "h w"], Int32[np.ndarray, "h w"]]:
    """Inverse depth (0: nothing) and surfel per pixel (-1: none) of bodies: arguments of ``splat`` and their points.

    Each body is (packed view, xyz, normal, spacing, widest, offset).
    """
    front, total, weight = (np.zeros(shape, np.float32) for _ in range(3))
    nearest, index = np.full(shape, 2.0, np.float32), np.full(shape, -1, np.int32)
    jobs = [
        (packed, *project_surfels(packed, xyz, widest), normal, spacing, widest, offset)
        for packed, xyz, normal, spacing, widest, offset in bodies
    ]
    for second in (False, True):
        for job in jobs:
            splat(*job, front, total, weight, nearest, index, second)
    inverse_depth = np.where(weight > 0, total / np.maximum(weight, 1e-9), 0).astype(np.float32)
    drop_shine_through(inverse_depth, index)
    return inverse_depth, index
