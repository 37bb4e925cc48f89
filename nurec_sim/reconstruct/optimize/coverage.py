"""Where images show the sky and where surfaces: what the start of a fit says of it holds.

A fit that may do both lets the sky shine through a wall and paints the wall's colour on the sky: right from where the
image was taken, and wrong from everywhere else.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from nurec_sim.reconstruct.optimize.settings import LossWeights

SKY, SURFACE = 0.05, 0.95
"""Pixels with less alpha than the first at the start show the sky; those with more than the second a surface."""

Mask = Bool[np.ndarray, "h w"]


class Coverage:
    """Pixels of each image that show the sky, and those that show a surface, at the image's first step.

    Taken anew at every step, they would follow what they are meant to hold.
    """

    def __init__(self) -> None:
        self._packed: dict[int, UInt8[np.ndarray, "2 bytes"]] = {}

    def of(
        self, number: int, alpha: Float32[np.ndarray, "h w"], valid: Float32[np.ndarray, "h w"]
    ) -> tuple[Mask, Mask]:
        """The pixels of an image that show the sky, and those that show a surface.

        Args:
            number: of the image.
            alpha: what it shows now.
            valid: above 0 where there is a ray.
        """
        if number not in self._packed:
            masks = np.stack([alpha < SKY, alpha > SURFACE]) & (valid > 0)
            self._packed[number] = np.packbits(masks.reshape(2, -1), axis=1)
        bits = np.unpackbits(self._packed[number], axis=1, count=alpha.size)
        sky, surface = bits.view(bool).reshape(2, *alpha.shape)
        return sky, surface

    def state(self) -> dict[str, np.ndarray]:
        """What a later run needs to go on exactly."""
        return {f"coverage {number}": packed for number, packed in self._packed.items()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a state, of which other entries do not matter."""
        self._packed = {int(name.split()[1]): packed for name, packed in state.items() if name.startswith("coverage ")}


def coverage_loss(
    alpha: Float32[np.ndarray, "h w"], sky: Mask, surface: Mask, weights: LossWeights,
    by_alpha: Float32[np.ndarray, "h w"],
) -> float:  # fmt: skip
    """Mean alpha in the sky and mean 1 - alpha on surfaces, weighted; adds its gradient to ``by_alpha``."""
    loss = 0.0
    if count := np.count_nonzero(sky):
        loss += weights.sky * float(alpha[sky].mean())
        by_alpha[sky] += weights.sky / count
    if count := np.count_nonzero(surface):
        loss += weights.surface * float(1 - alpha[surface].mean())
        by_alpha[surface] -= weights.surface / count
    return loss
