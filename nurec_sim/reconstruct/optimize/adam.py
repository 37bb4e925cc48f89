"""Kernel that takes one step of Adam (Kingma and Ba 2015) on the Gaussians that an image shows.

A Gaussian's moments rest while it is out of view; its bias correction counts the images that showed it.

Adam takes steps of nearly the same size however small a gradient is. So that they leave surfaces where LiDAR has put
them, a step is measured in the Gaussian itself: a mean moves along each axis in proportion to the standard deviation
there, and turns are limited where they would change a thin disc most. Seen at a grazing angle, a disc of 6 cm that is
tilted by 5 degrees shifts a beam's return by decimetres.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from nurec_sim.compute.kernels import inner, kernel

VALUES = 14
MEAN, QUAT, SCALE, OPACITY, RGB = 0, 3, 7, 10, 11
"""First columns of a Gaussian's values: mean, quaternion, log scales, logit of opacity, colour."""
BETA1, BETA2 = 0.9, 0.99
EPSILON = 1e-15
KEEP1, KEEP2, TINY = np.float32(1 - BETA1), np.float32(1 - BETA2), np.float32(EPSILON)
SMALLEST_M = 1e-3
BRIGHTEST = 4.0
"""Of the sky, where white is 1: two stops above what the longest exposure can show."""


@inner
def _to_own_axes(quat, axes, gradient):
    """Turn the gradients by the mean and by the quaternion into those along and about a Gaussian's own axes.

    Args:
        quat: unit quaternion.
        axes: [3,3] output; its columns are the axes.
        gradient: [14]; of the four of the quaternion the first becomes 0, the others are by a turn about each axis.
    """
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
    one, two = np.float32(1), np.float32(2)
    axes[0, 0], axes[0, 1], axes[0, 2] = one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)
    axes[1, 0], axes[1, 1], axes[1, 2] = two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)
    axes[2, 0], axes[2, 1], axes[2, 2] = two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)
    a, b, c = gradient[MEAN], gradient[MEAN + 1], gradient[MEAN + 2]
    for k in range(3):
        gradient[MEAN + k] = axes[0, k] * a + axes[1, k] * b + axes[2, k] * c
    # A small turn t about the own axes gives quat (1, t / 2), so its gradient is half of conj(quat) times theirs.
    half = np.float32(0.5)
    p, q, r, s = gradient[QUAT], gradient[QUAT + 1], gradient[QUAT + 2], gradient[QUAT + 3]
    gradient[QUAT] = np.float32(0)
    gradient[QUAT + 1] = half * (w * q - x * p - y * s + z * r)
    gradient[QUAT + 2] = half * (w * r + x * s - y * p - z * q)
    gradient[QUAT + 3] = half * (w * s - x * r + y * q - z * p)


@inner
def _move(quat, axes, scale, change, mean):
    """Take a step of mean and quaternion, in units of the Gaussian itself (``adam_step``).

    Args:
        quat: changed, no longer of unit length.
        axes: see ``_to_own_axes``.
        scale: standard deviations along the axes.
        change: [14] what to subtract, means in standard deviations, turns (rad) before they are limited.
        mean: changed.
    """
    a, b, c = change[MEAN] * scale[0], change[MEAN + 1] * scale[1], change[MEAN + 2] * scale[2]
    for k in range(3):
        mean[k] -= axes[k, 0] * a + axes[k, 1] * b + axes[k, 2] * c
    half = np.float32(0.5)
    a = half * change[QUAT + 1] * _freedom(scale[1], scale[2])
    b = half * change[QUAT + 2] * _freedom(scale[2], scale[0])
    c = half * change[QUAT + 3] * _freedom(scale[0], scale[1])
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
    quat[0], quat[1] = w + x * a + y * b + z * c, x - w * a - y * c + z * b
    quat[2], quat[3] = y - w * b + x * c - z * a, z - w * c - x * b + y * a


@inner
def _freedom(a, b):
    """Share of a turn in the plane of two axes that is taken.

    Turning by t changes the Gaussian as much as shifting it by t abs(a^2 - b^2) / (a b) standard deviations does
    (Fisher's metric), so a disc is tilted in proportion to its thickness.
    """
    return min(np.float32(1), a * b / max(abs(a * a - b * b), TINY))


@inner
def _keep_near(values, start, axes, scale, keep, images, gradient):
    """Add the gradient of what holds a Gaussian near its start: a prior, once per Gaussian and not once per image.

    Args:
        values: [14] as they are.
        start: [14] as they were.
        axes: see ``_to_own_axes``; ``gradient`` is by these.
        scale: standard deviations along them.
        keep: [14] weights, see ``adam_step``.
        images: how many share them.
        gradient: [14] changed.
    """
    for k in range(3):
        moved = np.float32(0)
        for j in range(3):
            moved += axes[j, k] * (values[MEAN + j] - start[MEAN + j])
        # In standard deviations u = moved / scale, and d/d moved of u^2 / 2 is u / scale.
        gradient[MEAN + k] += keep[MEAN + k] / images * moved / (scale[k] * scale[k])
    for k in range(SCALE, VALUES):
        gradient[k] += keep[k] / images * (values[k] - start[k])


@kernel
def adam_step(
    rows,
    values,
    first,
    second,
    visits,
    corrections,
    turns,
    row_turn,
    by,
    scale,
    opacity,
    rates,
    pulls,
    largest_m,
    thickest,
    start,
    keep,
    images_per_step,
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
        rates: [14] float32 learning rates: of means in standard deviations; of the four of the quaternion the first is
            not used, the others are of turns (rad) about the Gaussian's axes before they are limited (``_freedom``).
        pulls: [2] float32 weights of a Gaussian's opacity, and of the sum of its standard deviations, in the loss.
        largest_m: standard deviations end here.
        thickest: [n,3] the largest log standard deviation along each axis, besides ``largest_m``.
        start: [n,14] ``values`` at the start.
        keep: [14] float32 gradient of the loss of all images by a value's difference to the start, that of a mean in
            standard deviations along each axis; turns are free. The images that show a Gaussian share it.
        images_per_step: float32 number of images divided by that of the steps so far: times a Gaussian's visits, it is
            the number of images that show it.
    """
    gradient, change, axes = np.zeros(VALUES, np.float32), np.zeros(VALUES, np.float32), np.zeros((3, 3), np.float32)
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
        quat = values[i, QUAT : QUAT + 4]
        _to_own_axes(quat, axes, gradient)
        _keep_near(values[i], start[i], axes, scale[i], keep, max(visits[i] * images_per_step, np.float32(1)), gradient)
        # Float32 throughout, so that the fourteen values are a vector.
        for k in range(VALUES):
            g = gradient[k]
            m = first[i, k] + KEEP1 * (g - first[i, k])
            v = second[i, k] + KEEP2 * (g * g - second[i, k])
            first[i, k], second[i, k] = m, v
            change[k] = rates[k] * (m * c1) / (np.sqrt(v * c2) + TINY)
        _move(quat, axes, scale[i], change, values[i, MEAN : MEAN + 3])
        for k in range(SCALE, VALUES):
            values[i, k] -= change[k]
        # Bounds: a scale near 0 makes the covariance singular, a huge one covers the view from inside.
        for k in range(3):
            values[i, SCALE + k] = min(max(values[i, SCALE + k], low), high, thickest[i, k])
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
    """One step of Adam on the cells of a table that have a gradient, and only those; values stay in 0..``BRIGHTEST``.

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
            values[i, k] = min(max(values[i, k] - rate * step, 0.0), BRIGHTEST)


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
