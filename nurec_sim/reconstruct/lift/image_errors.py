"""What a rendered picture lacks to be a recorded image: errors of its pixels, and what they count."""

from __future__ import annotations

import numpy as np

from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.lift.colour import SATURATED

BYTE = np.float32(255)
LEAST_CLEAR = np.float32(1 / 512)
"""Pixels that let less of the sky through do not show it: it changes no byte of theirs."""


@kernel
def image_errors(first, last, rgb, back, offset, planes, clear, behind, counts, valid, error, weight, sky_weight):
    """Errors of some rows of a picture. What is white in the image may be any brighter in the scene.

    Args:
        first: first row.
        last: one behind the last.
        rgb: [h,w,3] uint8, the recorded image.
        back: [3,3] float64, from colours of the image, without their offset, to those of the scene.
        offset: [3] float64.
        planes: what ``draw`` returned: opacity, colours.
        clear: [h,w] what the pixels let through of the sky.
        behind: [3,h,w] the sky's colours; 0 where ``clear`` is.
        counts: [2,h,w] what pixels count in the colours of Gaussians and in those of the sky.
        valid: [h,w] above 0 where there is a ray.
        error: [3,h,w] output: colours that the picture lacks.
        weight: [h,w] output: what they count in the colours of Gaussians.
        sky_weight: [h,w] output: what they count in the sky, times its share of the pixel.
    """
    light = np.empty(3)
    for row in range(first, last):
        for column in range(rgb.shape[1]):
            white = 0
            for c in range(3):
                light[c] = np.float32(rgb[row, column, c]) / BYTE - offset[c]
            for c in range(3):
                wanted = np.float32(back[c, 0] * light[0] + back[c, 1] * light[1] + back[c, 2] * light[2])
                shown = planes[1 + c, row, column] + clear[row, column] * behind[c, row, column]
                lacks = wanted - shown
                if np.float32(rgb[row, column, c]) / BYTE > SATURATED and lacks < 0:
                    lacks = np.float32(0)
                    white += 1
                error[c, row, column] = lacks
            some = np.float32(valid[row, column] > 0 and white < 3)
            weight[row, column] = counts[0, row, column] * some
            sky_weight[row, column] = counts[1, row, column] * some * clear[row, column]
