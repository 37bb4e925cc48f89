"""Kernels that write what is rendered: activations of the optimised values, at their places in the world."""

from __future__ import annotations

import numpy as np

from nurec_sim.compute.kernels import inner, kernel
from nurec_sim.reconstruct.optimize.adam import MEAN, OPACITY, QUAT, RGB, SCALE
from nurec_sim.render.cpu.pack import BLOCK, COLOUR, LOG_OPACITY, MAX_OPACITY, NEVER_SEEN
from nurec_sim.render.cpu.pack import MEAN as PACKED_MEAN
from nurec_sim.render.cpu.pack import QUAT as PACKED_QUAT
from nurec_sim.render.cpu.pack import SCALE as PACKED_SCALE

LEAST_OPACITY = 1 / 255
"""Fainter Gaussians are not rendered (``layers.drawable``)."""


@inner
def _activate(i, values, fade, world, packed):
    """Scale, opacity and colour of a Gaussian, for the gradients (``world``) and for the renderer (``packed``)."""
    block, k = i // BLOCK, i % BLOCK
    for c in range(3):
        world.scale[i, c] = np.exp(values[i, SCALE + c])
        world.features[i, c] = values[i, RGB + c]
        packed[block, PACKED_SCALE + c, k] = world.scale[i, c]
        packed[block, COLOUR + c, k] = world.features[i, c]
    opacity = fade / (np.float32(1) + np.exp(-values[i, OPACITY]))
    world.opacity[i] = opacity
    packed[block, LOG_OPACITY, k] = (
        np.log(min(opacity, np.float32(MAX_OPACITY))) if opacity >= LEAST_OPACITY else np.float32(NEVER_SEEN)
    )


@inner
def _place(i, mean, quat, world, packed):
    block, k = i // BLOCK, i % BLOCK
    for c in range(3):
        world.mean[i, c] = packed[block, PACKED_MEAN + c, k] = mean[c]
    for c in range(4):
        world.quat[i, c] = packed[block, PACKED_QUAT + c, k] = quat[c]


@kernel
def place_static(rows, values, world, packed):
    """Write Gaussians whose values are those in the world.

    Args:
        rows: [k] which ones.
        values: [n,14] what is optimised, see ``adam``.
        world: output, see ``backward.repack.RawGaussians``: exp of the log scales, sigmoid of the logits.
        packed: [blocks,21,256] output, see ``pack``; row i of the Gaussians is packed row i.
    """
    for row in range(rows.shape[0]):
        i = rows[row]
        _place(i, values[i, MEAN : MEAN + 3], values[i, QUAT : QUAT + 4], world, packed)
        _activate(i, values, np.float32(1), world, packed)


@kernel
def place_moving(rows, first, values, poses, turns, row_turn, shift, fade, world, packed):
    """Write Gaussians that move.

    Args:
        rows: [k] which ones.
        first: row of the first one that moves.
        values: see ``place_static``.
        poses: [t,4,4] world_from_box at the instant.
        turns: [t,4] their rotations as quaternions.
        row_turn: [n] which of ``poses`` moves a Gaussian; -1 none.
        shift: [m,3] of those without a box, what their trajectory adds to the mean.
        fade: [m] what opacities are multiplied by.
        world: see ``place_static``.
        packed: see ``place_static``.
    """
    mean, quat = np.empty(3), np.empty(4)
    for row in range(rows.shape[0]):
        i = rows[row]
        a, b, c = values[i, MEAN], values[i, MEAN + 1], values[i, MEAN + 2]
        p, q, r, s = values[i, QUAT], values[i, QUAT + 1], values[i, QUAT + 2], values[i, QUAT + 3]
        turn = row_turn[i]
        if turn >= 0:
            for k in range(3):
                pose = poses[turn, k]
                mean[k] = pose[0] * a + pose[1] * b + pose[2] * c + pose[3]
            w, x, y, z = turns[turn, 0], turns[turn, 1], turns[turn, 2], turns[turn, 3]
            quat[0], quat[1] = w * p - x * q - y * r - z * s, w * q + x * p + y * s - z * r
            quat[2], quat[3] = w * r - x * s + y * p + z * q, w * s + x * r - y * q + z * p
        else:
            mean[0], mean[1], mean[2] = a + shift[i - first, 0], b + shift[i - first, 1], c + shift[i - first, 2]
            quat[0], quat[1], quat[2], quat[3] = p, q, r, s
        _place(i, mean, quat, world, packed)
        _activate(i, values, fade[i - first], world, packed)
