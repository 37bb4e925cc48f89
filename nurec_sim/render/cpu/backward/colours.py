"""Which Gaussians make which pixels of a drawn picture: errors of pixels spread over Gaussians by their weights.

A rendered colour is linear in the colours of Gaussians: the sum of weight times colour. What is computed here is the
transpose of that map, which is all that an iteration for the colours needs.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from nurec_sim.render.cpu.backward.blend import COLOUR_SUMS, COLOURS, IMAGE_PLANES
from nurec_sim.render.cpu.backward.frame import carry_back
from nurec_sim.render.cpu.blend.background import find_face, find_place, turned
from nurec_sim.render.cpu.kernel import kernel
from nurec_sim.render.cpu.pack import BLOCK
from nurec_sim.render.cpu.pipeline import Picture
from nurec_sim.render.cpu.records import tile_count
from nurec_sim.render.cpu.workers import Workers


@kernel
def _gather(first, count, projected, slots, shares):
    """Sums of a run of records, added to those of their Gaussians.

    Args:
        first: first record.
        count: how many.
        projected: see ``records.Projected``.
        slots: see ``tiles.RecordSlots``.
        shares: [rows,4] added to: weight, weight times error.
    """
    spans = projected.spans
    for i in range(first, first + count):
        tiles = tile_count(spans, i)
        row = projected.sources[i]
        for slot in range(slots.first[i], slots.first[i] + tiles):
            for k in range(COLOUR_SUMS):
                shares[row, k] += slots.sums[slot, k]


def spread_errors(
    picture: Picture,
    planes: Float32[np.ndarray, "6 h w"],
    weight: Float32[np.ndarray, "y x"],
    error: Float32[np.ndarray, "3 y x"],
    workers: Workers,
) -> list[Float32[np.ndarray, "rows 4"]]:
    """Sums over all pixels of a Gaussian's share of the pixel, and of that times the error there.

    Args:
        picture: what has been drawn; its projection mode is not ROLLING (``frame.ExactView``).
        planes: what ``draw`` returned.
        weight: how much each pixel counts; 0 where there is no valid ray.
        error: colours that the pixels lack.
        workers: threads to run on.

    Returns:
        For each layer of the picture, by packed row: the sum of shares, then those of shares times errors.
    """
    height, width = weight.shape
    gradients = picture.scratch("gradients", (IMAGE_PLANES, *planes.shape[1:]), np.float32)
    gradients[:] = 0
    gradients[0, :height, :width] = weight
    gradients[1:4, :height, :width] = weight * error
    slots = carry_back(picture, COLOURS, planes, gradients, workers)
    shares = [np.zeros((len(layer) * BLOCK, 4), np.float32) for layer, _ in picture.layers]
    # Blocks are projected in one run each, so no two runs of a layer share a Gaussian.
    workers.run(_gather, [(first, many, picture.projected, slots, shares[layer])
                          for layer, first, many in picture.runs])  # fmt: skip
    return shares


@kernel
def spread_sky_errors(direction, turn, weight, error, shares):
    """The same for the texels of a sky: transpose of ``background.look_up``.

    Args:
        direction: [h,w,3] rays in the reference frame.
        turn: [3,3] float64, world_from_reference.
        weight: [h,w] how much each pixel counts, times its share of the sky.
        error: [3,h,w] colours that the pixels lack.
        shares: [6,s,s,4] added to: weight, weight times error.
    """
    d, size = np.empty(3), shares.shape[1]
    for row in range(weight.shape[0]):
        for column in range(weight.shape[1]):
            w = weight[row, column]
            if w <= 0:
                continue
            turned(direction, row, column, turn, d)
            face = find_face(d)
            x, y, _, _ = find_place(d, size, face)
            i, j = int(x), int(y)
            fx, fy = x - i, y - j
            for dy in range(2):
                for dx in range(2):
                    share = np.float32(w * (fx if dx else 1 - fx) * (fy if dy else 1 - fy))
                    texel = shares[face, min(j + dy, size - 1), min(i + dx, size - 1)]
                    texel[0] += share
                    for c in range(3):
                        texel[1 + c] += share * error[c, row, column]
