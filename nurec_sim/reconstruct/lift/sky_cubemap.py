"""The sky cubemap: colours of the pixels that no surface covers, extrapolated where there are none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim import geometry
from nurec_sim.compute.cores import in_order
from nurec_sim.compute.kernels import kernel
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

    def texels(k: int) -> tuple[np.ndarray, np.ndarray]:
        """Texels that a view shows, and the sums of weight and of weighted colour in each."""
        view, mask = views[k], weights[k] > 0
        direction = geometry.rotate_vectors(view.world_from_view[:3, :3], rays_of(view)[mask])
        face, s, t = geometry.cubemap_coordinates(direction)
        column, row = (np.clip((x * size).astype(np.int64), 0, size - 1) for x in (s, t))
        texel = (face * size + row) * size + column
        # By solid angle: a longer lens, with more pixels in a texel, counts like the others.
        weight, rgb = weights[k][mask] / view.tile.focal_px**2, colours[k][mask] / 255
        return sums_by_texel(texel, weight, rgb, 6 * size * size)

    for shown, sums in in_order(texels, range(len(views))):
        count[shown] += sums[:, 0]
        total[shown] += sums[:, 1:]
    known = count > 0
    colour = np.where(known[:, None], total / np.where(known, count, 1.0)[:, None], 0.0)
    seen = known.reshape(6, size, size).astype(np.float32)
    return fill_unseen(colour.reshape(6, size, size, 3).astype(np.float32), seen)


@kernel
def sums_by_texel(texel, weight, rgb, count):
    """Texels [m] that occur among those of pixels [n], and the sums [m,4] there of weight and of weighted colour.

    Args:
        texel: [n] 0..``count`` - 1.
        weight: [n].
        rgb: [n,3].
        count: number of all texels.
    """
    place, shown, sums = np.full(count, -1, np.int32), np.empty(len(texel), np.int64), np.zeros((len(texel), 4))
    found = 0
    for i in range(len(texel)):
        at = place[texel[i]]
        if at < 0:
            at = found
            place[texel[i]], shown[found] = found, texel[i]
            found += 1
        sums[at, 0] += weight[i]
        for k in range(3):
            sums[at, 1 + k] += weight[i] * rgb[i, k]
    return shown[:found].copy(), sums[:found].copy()
