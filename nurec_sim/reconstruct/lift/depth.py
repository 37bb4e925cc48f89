"""Dense depth of a working view: measured where surfels lie, matched against neighbours elsewhere, smoothed over all.

Inverse depth (1/m, along the optical axis) everywhere; 0 is infinitely far. Compiled kernels run without the
interpreter lock.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt64

from nurec_sim.compute.kernels import inner, kernel
from nurec_sim.network.stereo.paths import FORWARDS, add_paths, brightness_steps

PRIOR_COST, PRIOR_CAP = 40.0, 220.0
NOT_SKY, MAYBE_SKY, SKY = 0, 1, 2
"""What a pixel looks like (``lifting.sky_likeness``)."""
SKY_COST, NOT_SKY_COST = 60.0, 40.0
NEUTRAL_COST = 24.0
SMOOTH_ONE, SMOOTH_MANY = 10.0, 80.0
NO_SURFACE = 0.0035
"""Levels up to this inverse depth (1/m; from 285 m on) are sky rather than a surface."""


def census(gray: UInt8[np.ndarray, "h w"]) -> UInt64[np.ndarray, "h w"]:
    """48 bits per pixel: which of the 7x7 neighbours are darker."""
    return _census(np.pad(gray, 3, mode="edge"))


@kernel
def _census(padded):
    """The same from a picture with three more pixels at every side."""
    height, width = padded.shape[0] - 6, padded.shape[1] - 6
    bits = np.zeros((height, width), np.uint64)
    for row in range(height):
        for dy in range(7):
            for dx in range(7):
                if dy == 3 and dx == 3:
                    continue
                for column in range(width):
                    # Two more than another byte fits no byte: int64.
                    darker = np.int64(padded[row + dy, column + dx]) + 1 < np.int64(padded[row + 3, column + 3])
                    bits[row, column] = (bits[row, column] << np.uint64(1)) | np.uint64(darker)
    return bits


@inner
def _popcount(x):
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (x * np.uint64(0x0101010101010101)) >> np.uint64(56)


@kernel
def matching_cost(view, world_from_view, prior, others, rgb, codes, other_rgb, other_codes, inverse_depths, cost):
    """Fill ``cost`` (0..100): mean of the two best neighbours of census and colour differences.

    Pixels with a prior are left alone.

    Args:
        view: [23] packed projection of the view (``WorkingView.packed``).
        world_from_view: [4,4] its pose.
        prior: [h,w] measured inverse depth, 1/m; 0 where there is none.
        others: [n,23] packed projections from the world into the neighbours.
        rgb: [h,w,3] the view's colours, 0..255.
        codes: [h,w] its ``census``.
        other_rgb: [n,h',w',3] the neighbours' colours, padded to one size.
        other_codes: [n,h',w'] their ``census``, padded likewise.
        inverse_depths: [levels] inverse depth of each level, 1/m, increasing from 0.
        cost: [h,w,levels] output.
    """
    height, width, levels = cost.shape
    focal = view[0]
    first, second, seen = np.empty(levels), np.empty(levels), np.empty(levels, np.int64)
    for row in range(height):
        for column in range(width):
            if prior[row, column] > 0:
                continue
            rx, ry = (column + 0.5 - view[1]) / focal, (row + 0.5 - view[2]) / focal
            # Rolling shutter: the pixel was exposed f of the exposure off its middle, when the camera was drift * f
            # further. So its ray starts at o = drift * f.
            f = min(max(view[20] * (column + 0.5) + view[21] * (row + 0.5) + view[22], -0.5), 0.5)
            ox, oy, oz = view[17] * f, view[18] * f, view[19] * f
            m = world_from_view
            dx, dy = m[0, 0] * rx + m[0, 1] * ry + m[0, 2], m[1, 0] * rx + m[1, 1] * ry + m[1, 2]
            dz = m[2, 0] * rx + m[2, 1] * ry + m[2, 2]
            px = m[0, 0] * ox + m[0, 1] * oy + m[0, 2] * oz + m[0, 3]
            py = m[1, 0] * ox + m[1, 1] * oy + m[1, 2] * oz + m[1, 3]
            pz = m[2, 0] * ox + m[2, 1] * oy + m[2, 2] * oz + m[2, 3]
            red, green, blue = (
                np.int64(rgb[row, column, 0]),
                np.int64(rgb[row, column, 1]),
                np.int64(rgb[row, column, 2]),
            )
            code = codes[row, column]
            first[:], second[:], seen[:] = 1e9, 1e9, 0
            for n in range(len(others)):
                o = others[n]
                # X = o + r / w, scaled by w: r + w o. It stays finite at infinity (w = 0), and projection does not
                # depend on the scale of X. In the other view it is (a, b, c) + w (a1, b1, c1).
                a0, a1 = o[5] * dx + o[6] * dy + o[7] * dz, o[5] * px + o[6] * py + o[7] * pz + o[14]
                b0, b1 = o[8] * dx + o[9] * dy + o[10] * dz, o[8] * px + o[9] * py + o[10] * pz + o[15]
                c0, c1 = o[11] * dx + o[12] * dy + o[13] * dz, o[11] * px + o[12] * py + o[13] * pz + o[16]
                rolling = o[17] != 0.0 or o[18] != 0.0 or o[19] != 0.0
                scale, middle_u, middle_v, right, bottom = o[0], o[1], o[2], o[3], o[4]
                for level in range(levels):
                    w = inverse_depths[level]
                    a, b, c = a0 + w * a1, b0 + w * b1, c0 + w * c1
                    if c <= 1e-6:
                        continue
                    inverse = scale / c
                    u, v = a * inverse + middle_u, b * inverse + middle_v
                    if rolling:
                        # One fixed-point step for the other view's own shutter: the drift at the row where the point
                        # was first projected (times w, as X is).
                        g = w * min(max(o[20] * u + o[21] * v + o[22], -0.5), 0.5)
                        inverse = scale / max(c - o[19] * g, 1e-6)
                        u, v = (a - o[17] * g) * inverse + middle_u, (b - o[18] * g) * inverse + middle_v
                    if u < 0 or v < 0 or u >= right or v >= bottom:
                        continue
                    # The nearest pixel: levels are farther apart than pixels.
                    iu, iv = np.uint64(u), np.uint64(v)
                    difference = (
                        abs(np.int64(other_rgb[n, iv, iu, 0]) - red)
                        + abs(np.int64(other_rgb[n, iv, iu, 1]) - green)
                        + abs(np.int64(other_rgb[n, iv, iu, 2]) - blue)
                    )
                    bits = _popcount(code ^ other_codes[n, iv, iu])
                    # Both terms saturate, so that an occlusion costs no more than a clear mismatch. Census compares the
                    # order of brightness and survives exposure changes; colour tells where there is no texture.
                    value = min(difference * 0.6, 50.0) + min(bits * 2.0, 50.0)
                    seen[level] += 1
                    # The best two of all neighbours: the others may have the point hidden.
                    second[level] = min(max(value, first[level]), second[level])
                    first[level] = min(value, first[level])
            total, number = 0.0, 0
            for level in range(levels):
                if seen[level] > 0:
                    mean = first[level] if seen[level] == 1 else 0.5 * (first[level] + second[level])
                    cost[row, column, level] = mean
                    total, number = total + mean, number + 1
            # A level that no neighbour sees is no better than the mean of those that some see.
            unseen = max(NEUTRAL_COST, total / number) if number > 0 else NEUTRAL_COST
            for level in range(levels):
                if seen[level] == 0:
                    cost[row, column, level] = unseen


@kernel
def add_prior(cost, prior, sky, inverse_depths):
    """Bend the costs towards the measured inverse depth where there is one, and towards infinity in the sky.

    Args:
        cost: [h,w,levels] changed; replaced where there is a prior.
        prior: [h,w] measured inverse depth, 1/m; 0 where there is none.
        sky: [h,w] ``NOT_SKY``, ``MAYBE_SKY`` or ``SKY``.
        inverse_depths: [levels] see ``matching_cost``.
    """
    height, width, levels = cost.shape
    surfaces = 1
    while surfaces < levels and inverse_depths[surfaces] <= NO_SURFACE:
        surfaces += 1
    for row in range(height):
        for column in range(width):
            w = prior[row, column]
            if w > 0:
                above = min(max(np.searchsorted(inverse_depths, w), 1), levels - 1)
                below = inverse_depths[above - 1]
                at = above - 1 + (w - below) / (inverse_depths[above] - below)
                for level in range(levels):
                    # Truncated linear: a wrong measurement (a splat over a silhouette) can be outvoted by its
                    # surroundings.
                    cost[row, column, level] = min(PRIOR_COST * abs(level - at), PRIOR_CAP)
            elif sky[row, column] == SKY:
                for level in range(surfaces, levels):
                    cost[row, column, level] += SKY_COST
            elif sky[row, column] == NOT_SKY:
                # Infinity fits any pixel without texture; without this charge plain walls would become sky.
                for level in range(surfaces):
                    cost[row, column, level] += NOT_SKY_COST


def smooth_depth(
    cost: Float32[np.ndarray, "h w levels"],
    gray: UInt8[np.ndarray, "h w"],
    inverse_depths: Float64[np.ndarray, " levels"],
) -> Float32[np.ndarray, "h w"]:
    """Inverse depth of least cost after semi-global matching along eight paths (``stereo.paths``)."""
    total, brightness = np.zeros_like(cost), gray.astype(np.float32)
    for directions in (np.array(FORWARDS), -np.array(FORWARDS)):
        # Depth is likely to jump where the brightness does, so a jump costs less there.
        steps = np.stack([brightness_steps(brightness, dy, dx) for dy, dx in directions])
        jump = np.maximum(SMOOTH_MANY / (1 + steps / 8), SMOOTH_ONE + 1)
        add_paths(cost, jump.astype(np.float32), np.float32(SMOOTH_ONE), directions, total)
    return _least(total, inverse_depths)


@kernel
def _least(total, inverse_depths):
    """The level of least cost [h,w,levels], with a parabola between levels, as inverse depth [h,w]."""
    height, width, levels = total.shape
    result = np.zeros((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            best = np.argmin(total[row, column])
            shift = 0.0
            if 0 < best < levels - 1:
                # Vertex of the parabola through three equally spaced values: (a - c) / (2 (a - 2 b + c)) from the
                # middle one.
                a, b, c = total[row, column, best - 1], total[row, column, best], total[row, column, best + 1]
                curve = a - 2 * b + c
                if curve > 1e-6:
                    shift = min(max(0.5 * (a - c) / curve, -0.5), 0.5)
            if best > 0:
                beside = best + 1 if shift > 0 else best - 1
                here, there = inverse_depths[best], inverse_depths[beside]
                result[row, column] = here + abs(shift) * (there - here)
    return result


def dense_inverse_depth(
    packed: Float64[np.ndarray, " 23"],
    world_from_view: Float64[np.ndarray, "4 4"],
    rgb: UInt8[np.ndarray, "h w 3"],
    prior: Float32[np.ndarray, "h w"],
    sky: UInt8[np.ndarray, "h w"],
    neighbours: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
    inverse_depths: Float64[np.ndarray, " levels"],
) -> Float32[np.ndarray, "h w"]:
    """Inverse depth of every pixel: the prior where it holds, matching and smoothness elsewhere, 0 in the sky.

    Args:
        packed: the view's projection (``WorkingView.packed``).
        world_from_view: its pose.
        rgb: its colours, 0..255.
        prior: measured inverse depth, 1/m; 0 where there is none.
        sky: ``NOT_SKY``, ``MAYBE_SKY`` or ``SKY``.
        neighbours: (packed view, rgb, census) of the views to match against; empty leaves only priors and smoothness.
        inverse_depths: the hypotheses, 1/m, increasing from 0.
    """
    height, width = prior.shape
    levels = len(inverse_depths)
    cost = np.full((height, width, levels), NEUTRAL_COST, np.float32)
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    if neighbours:
        shape = tuple(max(item[1].shape[axis] for item in neighbours) for axis in (0, 1))
        others = np.stack([item[0] for item in neighbours])
        pictures = np.zeros((len(neighbours), *shape, 3), np.uint8)
        codes = np.zeros((len(neighbours), *shape), np.uint64)
        for n, (_, picture, code) in enumerate(neighbours):
            pictures[n, : picture.shape[0], : picture.shape[1]] = picture
            codes[n, : code.shape[0], : code.shape[1]] = code
        matching_cost(packed, world_from_view, prior, others, rgb, census(gray), pictures, codes, inverse_depths, cost)
    add_prior(cost, prior, sky, inverse_depths)
    result = smooth_depth(cost, gray, inverse_depths)
    # The prior is exact where smoothing agrees with it; nearer than the nearest level, smoothing cannot express it.
    step = inverse_depths[-1] / (levels - 1)
    trusted = (prior > 0) & ((np.abs(result - prior) < 1.5 * step + 0.1 * prior) | (prior > inverse_depths[-2]))
    return np.where(trusted, prior, result).astype(np.float32)
