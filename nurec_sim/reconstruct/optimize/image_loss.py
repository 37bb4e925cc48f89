"""The loss of an image's colours, 0.8 L1 + 0.2 (1 - SSIM), and its gradient in closed form.

SSIM (Wang et al. 2004) is a function of five local means, each a Gaussian blur of the images, their squares or their
product. The blur is its own adjoint (zeros beyond the border), so the gradient takes one more blur per mean. One pass
over the rows keeps all of it in a ring of rows that fits the cache.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from nurec_sim.render.cpu.backward.frame import shared_workers
from nurec_sim.render.cpu.kernel import f4, inner, kernel

REACH_PX, SIGMA_PX = 5, 1.5
"""The window has 11 x 11 pixels."""
C1, C2 = f4(0.01**2), f4(0.03**2)
_ONE_SIDE = np.exp(-(np.arange(-REACH_PX, REACH_PX + 1) ** 2) / (2 * SIGMA_PX**2))
W0, W1, W2, W3, W4, W5 = (_ONE_SIDE / _ONE_SIDE.sum())[REACH_PX:].astype(np.float32)
RING = 2 * REACH_PX + 1
BAND = 96
"""Rows of an image that one call of the kernel does; a fixed number, so that threads do not change the sums."""


def colour_loss(
    shown: Float32[np.ndarray, "h w 3"], recorded: Float32[np.ndarray, "h w 3"], dssim: float
) -> tuple[float, Float32[np.ndarray, "h w 3"]]:
    """The loss and its gradient by ``shown``; colours are 0..1.

    Args:
        shown: the rendered image, not clipped.
        recorded: the image of the log.
        dssim: share of 1 - SSIM, 0..1.
    """
    height = len(shown)
    # Pixels and channels side by side: a step of three values is one pixel.
    x, y, gradient = shown.reshape(height, -1), recorded.reshape(height, -1), np.empty_like(shown)
    bands = [(first, min(first + BAND, height)) for first in range(0, height, BAND)]
    sums = shared_workers(None).run(
        _band, [(*rows, x, y, f4(1 / shown.size), f4(dssim), gradient.reshape(height, -1)) for rows in bands]
    )
    absolute, similarity = np.sum(sums, axis=0) / shown.size
    return (1 - dssim) * absolute + dssim * (1 - similarity), gradient


# Loops of one output and few inputs: LLVM makes vectors of a loop only where it can check that no arrays overlap.


@inner
def _across(row, out):
    """Blur a row of pixels of three values; both have a margin of ``REACH_PX`` pixels, that of ``row`` is 0."""
    for i in range(len(row) - 30):
        out[i + 15] = (
            W0 * row[i + 15] + W1 * (row[i + 12] + row[i + 18]) + W2 * (row[i + 9] + row[i + 21])
            + W3 * (row[i + 6] + row[i + 24]) + W4 * (row[i + 3] + row[i + 27]) + W5 * (row[i] + row[i + 30])
        )  # fmt: skip


@inner
def _down(ring, middle, out):
    """Blur down a ring of rows about row ``middle``; rows beyond the image are 0 in the ring."""
    top = middle + RING - REACH_PX
    a, b, c = ring[(top + 4) % RING], ring[(top + 5) % RING], ring[(top + 6) % RING]
    for i in range(len(out)):
        out[i] = W1 * (a[i] + c[i]) + W0 * b[i]
    _add_pair(W2, ring[(top + 3) % RING], ring[(top + 7) % RING], out)
    _add_pair(W3, ring[(top + 2) % RING], ring[(top + 8) % RING], out)
    _add_pair(W4, ring[(top + 1) % RING], ring[(top + 9) % RING], out)
    _add_pair(W5, ring[top % RING], ring[(top + 10) % RING], out)


@inner
def _add_pair(weight, a, b, out):
    for i in range(len(out)):
        out[i] += weight * (a[i] + b[i])


@inner
def _multiply(a, b, out):
    for i in range(len(out)):
        out[i] = a[i] * b[i]


@inner
def _terms(x, y, xx, yy, xy):
    """Numerators and denominators of SSIM from the blurs of x, y, x^2, y^2 and x y."""
    # Var = E[x^2] - E[x]^2 with the Gaussian window as weights.
    variance, covariance = (xx - x * x) + (yy - y * y), xy - x * y
    return f4(2) * x * y + C1, f4(2) * covariance + C2, x * x + y * y + C1, variance + C2


@inner
def _similarity(x, y, xx, yy, xy, out):
    for i in range(len(out)):
        a1, a2, b1, b2 = _terms(x[i], y[i], xx[i], yy[i], xy[i])
        out[i] = a1 * a2 / (b1 * b2)


@inner
def _by_mean(x, y, xx, yy, xy, out):
    """Derivative of SSIM by the blur of x."""
    for i in range(len(out)):
        a1, a2, b1, b2 = _terms(x[i], y[i], xx[i], yy[i], xy[i])
        scale = f4(1) / (b1 * b2)
        out[i] = f4(2) * scale * (y[i] * (a2 - a1) - a1 * a2 * scale * x[i] * (b2 - b1))


@inner
def _by_square(x, y, xx, yy, xy, out):
    """Derivative of SSIM by the blur of x^2."""
    for i in range(len(out)):
        a1, a2, b1, b2 = _terms(x[i], y[i], xx[i], yy[i], xy[i])
        out[i] = -a1 * a2 / (b1 * b2 * b2)


@inner
def _by_product(x, y, xx, yy, xy, out):
    """Derivative of SSIM by the blur of x y."""
    for i in range(len(out)):
        a1, _, b1, b2 = _terms(x[i], y[i], xx[i], yy[i], xy[i])
        out[i] = f4(2) * a1 / (b1 * b2)


@inner
def _gradient(x, y, by_mean, by_square, by_product, per_value, dssim, out):
    for i in range(len(out)):
        by_ssim = by_mean[i] + f4(2) * x[i] * by_square[i] + y[i] * by_product[i]
        # d|x| / dx = sign(x); each mean divides by the number of values.
        sign = f4(1) if x[i] > y[i] else (f4(-1) if x[i] < y[i] else f4(0))
        out[i] = per_value * ((f4(1) - dssim) * sign - dssim * by_ssim)


@kernel
def _band(first, last, x, y, per_value, dssim, gradient):
    """Rows ``first`` to ``last`` of the gradient; the sums of abs(x - y) and of SSIM over them."""
    height, size = x.shape
    wide = size + 30
    # Rings of rows: five blurs of the images, three of their gradients.
    means, backs = np.zeros((5, RING, wide), np.float32), np.zeros((3, RING, wide), np.float32)
    row, blurred, by = np.zeros(wide, np.float32), np.zeros((5, wide), np.float32), np.zeros((3, wide), np.float32)
    absolute = similarity = 0.0
    # The gradient in a row needs SSIM in 5 rows on both sides, which needs 5 more rows of the images.
    for v in range(first - 2 * REACH_PX, last + 2 * REACH_PX):
        if 0 <= v < height:
            inside = row[15 : 15 + size]
            inside[:] = x[v]
            _across(row, means[0, v % RING])
            inside[:] = y[v]
            _across(row, means[1, v % RING])
            _multiply(x[v], x[v], inside)
            _across(row, means[2, v % RING])
            _multiply(y[v], y[v], inside)
            _across(row, means[3, v % RING])
            _multiply(x[v], y[v], inside)
            _across(row, means[4, v % RING])
        else:
            means[:, v % RING] = f4(0)
        middle = v - REACH_PX
        if 0 <= middle < height and middle >= first - REACH_PX:
            for k in range(5):
                _down(means[k], middle, blurred[k])
            at = blurred[:, 15 : 15 + size]
            _by_mean(at[0], at[1], at[2], at[3], at[4], by[0, 15 : 15 + size])
            _by_square(at[0], at[1], at[2], at[3], at[4], by[1, 15 : 15 + size])
            _by_product(at[0], at[1], at[2], at[3], at[4], by[2, 15 : 15 + size])
            if first <= middle < last:
                _similarity(at[0], at[1], at[2], at[3], at[4], row[15 : 15 + size])
                for i in range(size):
                    similarity += row[15 + i]
            for k in range(3):
                _across(by[k], backs[k, middle % RING])
        else:
            backs[:, middle % RING] = f4(0)
        done = v - 2 * REACH_PX
        if first <= done < last:
            for k in range(3):
                _down(backs[k], done, blurred[k])
            inside = blurred[:, 15 : 15 + size]
            _gradient(x[done], y[done], inside[0], inside[1], inside[2], per_value, dssim, gradient[done])
            for i in range(size):
                absolute += abs(x[done, i] - y[done, i])
    return absolute, similarity
