"""The background seen through gaps between Gaussians: in every direction the surfaces that the images show there.

Nobody sees the sky behind a house, and in a gap between its Gaussians a bright sky would flash. So the background
cubemap holds sky only where an image shows sky, or where none looks. Movable objects leave no trace there.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from nurec_sim.network.sky.observed import texture
from nurec_sim.network.tensors import SemanticClass

BLUR = 0.006
"""Standard deviation, as a share of a face's edge."""
LEAST = 1e-6
"""Blurred pixels per texel from which on a direction counts as covered."""


def is_static(logits: Float[Tensor, "*n 5"]) -> Bool[Tensor, "*n"]:
    """Pixels that show static surfaces: no sky, not the own car, and nothing that can move."""
    semantic = logits.argmax(-1)
    return (semantic == SemanticClass.OTHERS) | (semantic == SemanticClass.ROAD)


def background(
    colour: Float[Tensor, "n 3"], direction: Float[Tensor, "n 3"], size: int
) -> tuple[Float32[np.ndarray, "6 size size 3"], Float32[np.ndarray, "6 size size"]]:
    """Blurred mean colours of surfaces by direction, and where there are any (1, elsewhere 0).

    Args:
        colour: of pixels that show static surfaces.
        direction: where they look, in the cubemap's axes (``network.sky.cubemap``).
        size: edge of a face.
    """
    mean, hits = (values.cpu().numpy().astype(np.float32) for values in texture(colour.detach(), direction, size))
    # Normalised convolution: colours times hits and hits are blurred alike and divided, so empty texels count nothing.
    both = np.concatenate([mean * hits[..., None], hits[..., None]], axis=-1)
    wide = (0, 0), BLUR * size
    soft = np.stack([cv2.GaussianBlur(face, *wide, borderType=cv2.BORDER_REPLICATE) for face in both])
    return soft[..., :3] / np.maximum(soft[..., 3:], LEAST), (soft[..., 3] > LEAST).astype(np.float32)
