"""How well the pixels of a working view fit its neighbours at each depth: census and differences of colour.

Costs are whole numbers (``smoothing.UNIT``). Compiled kernels run without the interpreter lock. Their loops over levels
have no branches where they can, and index whole arrays, so that they become vector instructions.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int16, UInt8, UInt64

from nurec_sim.compute.kernels import inner, kernel, unchecked_kernel
from nurec_sim.reconstruct.lift.smoothing import UNIT

BIT_COST, COLOUR_COST, MOST_COST = 20, 6, 500
"""In parts of 2 / ``UNIT``: of a differing bit of census, of a difference of a colour by one (of 255), and of each of
both at most, so that an occlusion costs no more than a clear mismatch. Two neighbours together then cost up to 100."""
UNSEEN = 1 << 20
"""More than any cost."""
NEUTRAL_COST = 24 * UNIT
BEHIND = 1e-6
"""Points of less depth, times their inverse depth in the view, are behind a neighbour."""


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


def open_costs(
    packed: Float64[np.ndarray, " 23"],
    world_from_view: Float64[np.ndarray, "4 4"],
    rgb: UInt8[np.ndarray, "h w 3"],
    codes: UInt64[np.ndarray, "h w"],
    open_pixels: Bool[np.ndarray, "h w"],
    neighbours: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    inverse_depths: Float64[np.ndarray, " levels"],
) -> Int16[np.ndarray, "open levels"]:
    """Costs (0..100 times ``UNIT``) of the open pixels, row by row: mean of the two neighbours that fit best.

    Args:
        packed: the view's projection (``WorkingView.packed``).
        world_from_view: its pose.
        rgb: its colours, 0..255.
        codes: its ``census``.
        open_pixels: where costs are wanted.
        neighbours: (packed view, rgb, census) of the views to match against; without any, all depths fit alike.
        inverse_depths: the hypotheses, 1/m, increasing from 0.
    """
    cost = np.full((np.count_nonzero(open_pixels), len(inverse_depths)), NEUTRAL_COST, np.int16)
    if neighbours:
        others, texels = np.stack([packed for packed, _, _ in neighbours]), texels_of([item[1:] for item in neighbours])
        flat = texels.reshape(len(neighbours), -1, 2)
        matching_cost(
            packed, world_from_view, open_pixels, others, rgb, codes, flat, texels.shape[2], inverse_depths, cost
        )
    return cost


def texels_of(
    pictures: Sequence[tuple[UInt8[np.ndarray, "h w 3"], UInt64[np.ndarray, "h w"]]],
) -> UInt64[np.ndarray, "n hh ww 2"]:
    """Census and colour (red, green and blue from the lowest byte on) of pictures, padded to one size.

    Side by side, since both are looked up in the same places.
    """
    height, width = (max(code.shape[axis] for _, code in pictures) for axis in (0, 1))
    texels = np.zeros((len(pictures), height, width, 2), np.uint64)
    for texel, (rgb, code) in zip(texels, pictures, strict=True):
        _fill_texels(rgb, code, texel)
    return texels


@kernel
def _fill_texels(rgb, codes, texels):
    for row in range(codes.shape[0]):
        for column in range(codes.shape[1]):
            texels[row, column, 0] = codes[row, column]
            word = np.uint64(rgb[row, column, 0]) | np.uint64(rgb[row, column, 1]) << np.uint64(8)
            texels[row, column, 1] = word | np.uint64(rgb[row, column, 2]) << np.uint64(16)


@unchecked_kernel
def matching_cost(view, world_from_view, open_pixels, others, rgb, codes, texels, across, inverse_depths, cost):
    """Fill ``cost``: see ``open_costs``.

    Args:
        view: [23] packed projection of the view.
        world_from_view: [4,4] its pose.
        open_pixels: [h,w] where costs are wanted.
        others: [n,23] packed projections from the world into the neighbours.
        rgb: [h,w,3] the view's colours, 0..255.
        codes: [h,w] its ``census``.
        texels: [n,h'*w',2] of the neighbours (``texels_of``).
        across: w'.
        inverse_depths: [levels] 1/m.
        cost: [open,levels] output.
    """
    (height, width), levels, pixel = open_pixels.shape, len(inverse_depths), -1
    focal, unseen, across = view[0], np.int32(UNSEEN), np.int32(across)
    first, second = np.empty(levels, np.int32), np.empty(levels, np.int32)
    place, bits, colours = np.empty(levels, np.int32), np.empty(levels, np.int32), np.empty(levels, np.int32)
    for row in range(height):
        for column in range(width):
            if not open_pixels[row, column]:
                continue
            pixel += 1
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
            red, green, blue = rgb[row, column, 0], rgb[row, column, 1], rgb[row, column, 2]
            code = codes[row, column]
            first[:], second[:] = unseen, unseen
            for n in range(len(others)):
                # X = o + r / w, scaled by w: r + w o. It stays finite at infinity (w = 0), and projection does not
                # depend on the scale of X. In the other view it is (a, b, c) + w (a1, b1, c1).
                a0, b0, c0 = _turned(others, n, dx, dy, dz)
                a1, b1, c1 = _turned(others, n, px, py, pz)
                a1, b1, c1 = a1 + others[n, 14], b1 + others[n, 15], c1 + others[n, 16]
                scale, middle_u, middle_v = others[n, 0], others[n, 1], others[n, 2]
                right, bottom = others[n, 3], others[n, 4]
                drift_x, drift_y, drift_z = others[n, 17], others[n, 18], others[n, 19]
                if drift_x != 0.0 or drift_y != 0.0 or drift_z != 0.0:
                    for level in range(levels):
                        w = inverse_depths[level]
                        a, b, c = a0 + w * a1, b0 + w * b1, c0 + w * c1
                        inverse = scale / c
                        u, v = a * inverse + middle_u, b * inverse + middle_v
                        # One fixed-point step for the other view's own shutter: the drift at the row where the point
                        # was first projected (times w, as X is).
                        g = w * min(max(others[n, 20] * u + others[n, 21] * v + others[n, 22], -0.5), 0.5)
                        inverse = scale / max(c - drift_z * g, BEHIND)
                        u, v = (a - drift_x * g) * inverse + middle_u, (b - drift_y * g) * inverse + middle_v
                        place[level] = _place(u, v, c, right, bottom, across)
                else:
                    for level in range(levels):
                        w = inverse_depths[level]
                        a, b, c = a0 + w * a1, b0 + w * b1, c0 + w * c1
                        inverse = scale / c
                        u, v = a * inverse + middle_u, b * inverse + middle_v
                        place[level] = _place(u, v, c, right, bottom, across)
                for level in range(levels):
                    at = place[level]
                    if at >= 0:
                        bits[level], colours[level] = _popcount(code ^ texels[n, at, 0]), texels[n, at, 1]
                    else:
                        bits[level] = -1
                for level in range(levels):
                    colour = colours[level]
                    difference = (
                        _apart(colour & 255, red) + _apart(colour >> 8 & 255, green) + _apart(colour >> 16, blue)
                    )
                    # Census compares the order of brightness and survives exposure changes; colour tells where there is
                    # no texture.
                    value = np.int32(_at_most(difference * COLOUR_COST) + _at_most(bits[level] * BIT_COST))
                    value = value if bits[level] >= 0 else unseen
                    # The best two of all neighbours: the others may have the point hidden.
                    best = first[level]
                    second[level] = min(max(value, best), second[level])
                    first[level] = min(value, best)
            total, number = np.int32(0), np.int32(0)
            for level in range(levels):
                here = first[level]
                here = np.int32(here + (here if second[level] == unseen else second[level]))
                first[level] = here
                total = np.int32(total + (here if here < unseen else np.int32(0)))
                number = np.int32(number + (here < unseen))
            # A level that no neighbour sees is no better than the mean of those that some see.
            mean = np.int32(max(np.rint(total / max(number, 1)), NEUTRAL_COST))
            for level in range(levels):
                cost[pixel, level] = first[level] if first[level] < unseen else mean


@inner
def _turned(others, n, x, y, z):
    """A vector in the frame of a neighbour."""
    return (
        others[n, 5] * x + others[n, 6] * y + others[n, 7] * z,
        others[n, 8] * x + others[n, 9] * y + others[n, 10] * z,
        others[n, 11] * x + others[n, 12] * y + others[n, 13] * z,
    )


@inner
def _place(u, v, c, right, bottom, across):
    """Number of the pixel, row by row, that a point of depth c falls in; -1 if it is not in the picture."""
    inside = (c > BEHIND) & (u >= 0.0) & (v >= 0.0) & (u < right) & (v < bottom)
    # The nearest pixel: levels are farther apart than pixels.
    return np.int32(v if inside else 0.0) * across + np.int32(u if inside else -1.0)


@inner
def _popcount(x):
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (x * np.uint64(0x0101010101010101)) >> np.uint64(56)


@inner
def _apart(a, b):
    # With sums of default width, half as many fit into a vector.
    a, b = np.int32(a), np.int32(b)
    return np.int32(max(a, b) - min(a, b))


@inner
def _at_most(value):
    return min(np.int32(value), np.int32(MOST_COST))
