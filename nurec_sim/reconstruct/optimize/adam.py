"""Kernel that takes one step of Adam (Kingma and Ba 2015) on the Gaussians that an image shows.

A Gaussian's moments rest while it is out of view; its bias correction counts the images that showed it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from nurec_sim.compute.kernels import kernel

VALUES = 14
MEAN, QUAT, SCALE, OPACITY, RGB = 0, 3, 7, 10, 11
"""First columns of a Gaussian's values: mean, quaternion, log scales, logit of opacity, colour."""
BETA1, BETA2 = 0.9, 0.99
EPSILON = 1e-15
KEEP1, KEEP2, TINY = np.float32(1 - BETA1), np.float32(1 - BETA2), np.float32(EPSILON)
SMALLEST_M = 1e-3


@kernel
def adam_step(
    rows, values, first, second, visits, corrections, turns, row_turn, by, scale, opacity, rates, pulls, largest_m
):
    """One step on some Gaussians; those without any gradient, which others hide, are left as they are.

    Args:
        rows: [k] which ones.
        values: [n,14] what is optimised, see ``MEAN`` and the others; changed.
        first: [n,14] first moments; changed.
        second: [n,14] second moments; changed.
        visits: [n] steps so far; changed.
        corrections: [v,2] what bias corrections multiply both moments by after so many steps, see ``bias_corrections``.
        turns: [t,4] rotations world_from_frame as quaternions, what ``row_turn`` numbers.
        row_turn: [n] which of ``turns`` took a Gaussian to the world; -1 none.
        by: gradients in the world by mean, quaternion, standard deviations, opacity and colour, see
            ``backward.repack.RawGaussians``; those of ``rows`` are set to 0 again.
        scale: [n,3] standard deviations as rendered.
        opacity: [n] opacities as rendered.
        rates: [14] float32 learning rates.
        pulls: [2] float32 weights of a Gaussian's opacity, and of the sum of its standard deviations, in the loss.
        largest_m: standard deviations end here.
    """
    gradient = np.zeros(VALUES, np.float32)
    low, high = np.float32(np.log(SMALLEST_M)), np.float32(np.log(largest_m))
    for row in range(rows.shape[0]):
        i = rows[row]
        size = np.float32(0)
        for k in range(3):
            gradient[MEAN + k] = by.mean[i, k]
            # Chain rule of the activations: d exp(x) / dx = exp(x), d sigmoid(x) / dx = s (1 - s).
            gradient[SCALE + k] = by.scale[i, k] * scale[i, k]
            gradient[RGB + k] = by.features[i, k]
            by.mean[i, k] = by.scale[i, k] = by.features[i, k] = np.float32(0)
        for k in range(4):
            gradient[QUAT + k] = by.quat[i, k]
            by.quat[i, k] = np.float32(0)
        gradient[OPACITY] = by.opacity[i] * opacity[i] * (np.float32(1) - opacity[i])
        by.opacity[i] = np.float32(0)
        for k in range(VALUES):
            size += abs(gradient[k])
        if not (size > 0 and size < np.inf):
            continue
        gradient[OPACITY] += pulls[0] * opacity[i] * (np.float32(1) - opacity[i])
        for k in range(3):
            gradient[SCALE + k] += pulls[1] * scale[i, k]
        turn = row_turn[i]
        if turn >= 0:
            # mean_world = R mean + t and quat_world = r quat, so gradients go back by R^T and by conj(r).
            w, x, y, z = turns[turn, 0], turns[turn, 1], turns[turn, 2], turns[turn, 3]
            a, b, c = gradient[MEAN], gradient[MEAN + 1], gradient[MEAN + 2]
            gradient[MEAN] = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c
            gradient[MEAN + 1] = 2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c
            gradient[MEAN + 2] = 2 * (x * z + w * y) * a + 2 * (y * z - w * x) * b + (1 - 2 * (x * x + y * y)) * c
            p, q, r, s = gradient[QUAT], gradient[QUAT + 1], gradient[QUAT + 2], gradient[QUAT + 3]
            gradient[QUAT] = w * p + x * q + y * r + z * s
            gradient[QUAT + 1] = w * q - x * p - y * s + z * r
            gradient[QUAT + 2] = w * r + x * s - y * p - z * q
            gradient[QUAT + 3] = w * s - x * r + y * q - z * p
        visits[i] += 1
        correction = corrections[min(visits[i], corrections.shape[0] - 1)]
        c1, c2 = correction[0], correction[1]
        # Float32 throughout, so that the fourteen values are a vector.
        for k in range(VALUES):
            g = gradient[k]
            m = first[i, k] + KEEP1 * (g - first[i, k])
            v = second[i, k] + KEEP2 * (g * g - second[i, k])
            first[i, k], second[i, k] = m, v
            values[i, k] -= rates[k] * (m * c1) / (np.sqrt(v * c2) + TINY)
        # Bounds: a scale near 0 makes the covariance singular, a huge one covers the view from inside.
        for k in range(SCALE, SCALE + 3):
            values[i, k] = min(max(values[i, k], low), high)
        # The renderer takes unit quaternions, and a step leaves the unit sphere.
        norm = np.float32(0)
        for k in range(QUAT, QUAT + 4):
            norm += values[i, k] * values[i, k]
        shrink = np.float32(1) / np.sqrt(max(norm, TINY))
        for k in range(QUAT, QUAT + 4):
            values[i, k] *= shrink


def bias_corrections() -> Float32[np.ndarray, "v 2"]:
    """1 / (1 - beta^v) of both moments; the last row holds for all further steps."""
    steps = np.arange(2000)
    steps[0] = 1  # never read
    return np.stack([1 / (1 - BETA1**steps), 1 / (1 - BETA2**steps)], axis=1).astype(np.float32)


@kernel
def adam_cells(values, first, second, visits, gradient, rate):
    """One step of Adam on the cells of a table that have a gradient, and those only; values stay within 0..1.

    Args:
        values: [n,c] what is optimised; changed.
        first: [n,c] first moments; changed.
        second: [n,c] second moments; changed.
        visits: [n] steps so far; changed.
        gradient: [n,c] cells whose row is all 0 are skipped.
        rate: learning rate.
    """
    for i in range(values.shape[0]):
        touched = False
        for k in range(values.shape[1]):
            touched = touched or gradient[i, k] != 0
        if not touched:
            continue
        visits[i] += 1
        correction1, correction2 = 1 - BETA1 ** visits[i], 1 - BETA2 ** visits[i]
        for k in range(values.shape[1]):
            first[i, k] += (1 - BETA1) * (gradient[i, k] - first[i, k])
            second[i, k] += (1 - BETA2) * (gradient[i, k] * gradient[i, k] - second[i, k])
            step = first[i, k] / correction1 / (np.sqrt(second[i, k] / correction2) + EPSILON)
            values[i, k] = min(max(values[i, k] - rate * step, 0.0), 1.0)


class SkyAdam:
    """Adam on the texels of a cubemap that an image shows."""

    def __init__(self, sky: np.ndarray) -> None:
        self._shape = (sky.size // sky.shape[-1], sky.shape[-1])
        self.first, self.second = np.zeros(self._shape, np.float32), np.zeros(self._shape, np.float32)
        self.visits = np.zeros(self._shape[0], np.int32)

    def step(self, sky: np.ndarray, gradient: np.ndarray, rate: float) -> None:
        """Change ``sky`` in place."""
        adam_cells(sky.reshape(self._shape), self.first, self.second, self.visits, gradient.reshape(self._shape), rate)


class RowAdam:
    """Adam on the rows of a small array, with the same constants; rows rest until they are stepped."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.first, self.second, self.visits = np.zeros(shape), np.zeros(shape), np.zeros(shape[0], np.int64)

    def step(self, row: int, values: np.ndarray, gradient: np.ndarray, rate: float) -> None:
        """Change ``values[row]`` in place."""
        self.visits[row] += 1
        first, second, visits = self.first[row], self.second[row], self.visits[row]
        first += (1 - BETA1) * (gradient - first)
        second += (1 - BETA2) * (gradient * gradient - second)
        values[row] -= rate * first / (1 - BETA1**visits) / (np.sqrt(second / (1 - BETA2**visits)) + EPSILON)
