"""The sky cubemap: colours of the pixels that no surface covers, extrapolated where there are none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim import geometry
from nurec_sim.reconstruct.lift.lifting import rays_of
from nurec_sim.reconstruct.lift.views import WorkingView
from nurec_sim.reconstruct.sky_fill import fill_unseen


def make_sky(
    views: Sequence[WorkingView],
    colours: Sequence[Float64[np.ndarray, "h w 3"]],
    weights: Sequence[Float64[np.ndarray, "h w"]],
    size: int,
) -> Float32[np.ndarray, "6 size size 3"]:
    """Average the far pixels of all views per cubemap texel and fill the rest as ``sky_fill`` does.

    Args:
        views: working views.
        colours: their canonical colours, 0..255, in the same order.
        weights: how surely each pixel is sky; 0 if it is not.
        size: edge of a cubemap face, texels.
    """
    total, count = np.zeros((6 * size * size, 3)), np.zeros(6 * size * size)
    for view, rgb, weight in zip(views, colours, weights, strict=True):
        mask = weight > 0
        if not mask.any():
            continue
        direction = rays_of(view)[mask] @ view.world_from_view[:3, :3].T
        face, s, t = geometry.cubemap_coordinates(direction)
        column, row = (np.clip((x * size).astype(np.int64), 0, size - 1) for x in (s, t))
        texel = (face * size + row) * size + column
        count += np.bincount(texel, weights=weight[mask], minlength=len(count))
        for k in range(3):
            total[:, k] += np.bincount(texel, weights=weight[mask] * rgb[mask][:, k] / 255, minlength=len(count))
    known = count > 0
    colour = np.where(known[:, None], total / np.maximum(count, 1e-9)[:, None], 0.0)
    seen = known.reshape(6, size, size).astype(np.float32)
    return fill_unseen(colour.reshape(6, size, size, 3).astype(np.float32), seen)
