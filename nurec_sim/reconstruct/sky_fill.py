"""A partly seen sky cubemap made complete in every direction.

What was seen is kept. Unseen parts are extrapolated: the mean colour at their height above
the horizon (the world's z is up), plus the difference of the nearest seen parts from that mean.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim import geometry
from nurec_sim.scene.usd.dome_texture import sample_cubemap

SURE = 0.5
"""Texels that were seen as surely as this keep their colours."""
ELEVATION_STEPS = 32
"""Bands of equal solid angle, from straight down to straight up, in which colours by height are averaged."""
NOTHING_SEEN = 0.6
"""Grey of a sky of which no texel is known, as the released network's."""


def fill_unseen(
    sky: Float32[np.ndarray, "6 s s 3"], seen: Float32[np.ndarray, "6 s s"]
) -> Float32[np.ndarray, "6 s s 3"]:
    """A sky over the world with its unseen parts replaced; between unseen and surely seen it is a blend.

    No colour leaves the range of those seen. Without anything seen the sky is a light grey.

    Args:
        sky: colours, faces as in ``geometry.cubemap_directions``; those of unseen texels do not matter.
        seen: how surely each texel was seen, 0..1.
    """
    if not seen.any():
        return np.full_like(sky, NOTHING_SEEN)
    weight = np.minimum(seen / SURE, 1).astype(np.float32)[..., None]
    if weight.min() == 1:
        return sky
    by_height = _colour_by_height(sky, weight[..., 0])
    rest = _spread(sky - by_height, weight)
    darkest, brightest = sky[seen > 0].min(axis=0), sky[seen > 0].max(axis=0)
    return np.where(weight == 1, sky, np.clip(by_height + rest, darkest, brightest))


def _colour_by_height(
    sky: Float32[np.ndarray, "6 s s 3"], weight: Float32[np.ndarray, "6 s s"]
) -> Float32[np.ndarray, "6 s s 3"]:
    """Mean seen colour of each texel's height over the horizon, held above the highest and below the lowest seen."""
    height = geometry.cubemap_directions(sky.shape[1])[..., 2]
    # Equal steps of sin(elevation) have equal solid angle (Archimedes), so bands hold equally many texels, about.
    place = (height + 1) / 2 * ELEVATION_STEPS - 0.5
    band = np.clip(np.round(place), 0, ELEVATION_STEPS - 1).astype(np.int64).ravel()
    mass = np.bincount(band, weight.ravel(), ELEVATION_STEPS)
    known = np.flatnonzero(mass)
    sums = [np.bincount(band, (weight * sky[..., k]).ravel(), ELEVATION_STEPS)[known] for k in range(3)]
    return np.stack([np.interp(place, known, total / mass[known]) for total in sums], axis=-1, dtype=np.float32)


def _spread(
    value: Float32[np.ndarray, "6 s s 3"], weight: Float32[np.ndarray, "6 s s 1"]
) -> Float32[np.ndarray, "6 s s 3"]:
    """Values where the weight is 1, flowing from there into the rest, by way of ever coarser cubemaps; 0 far away."""
    size = value.shape[1]
    if size == 1:
        return value * weight
    half = (size + 1) // 2
    both = np.concatenate([value * weight, weight], axis=-1)
    coarse = np.stack([cv2.resize(face, (half, half), interpolation=cv2.INTER_AREA) for face in both])
    total, mass = coarse[..., :3], coarse[..., 3:]
    # Pull-push (Gortler et al. 1996): averages fill holes from coarse to fine, and measured texels are kept at every
    # level. A coarse texel with one known texel of four is taken as fully known, hence 4 * mass.
    smooth = _enlarged(_spread(total / np.maximum(mass, 1e-12), np.minimum(4 * mass, 1)), size)
    return smooth + weight * (value - smooth)


def _enlarged(coarse: Float32[np.ndarray, "6 h h 3"], size: int) -> Float32[np.ndarray, "6 size size 3"]:
    """The cubemap in another size, bilinear across the edges of the faces too."""
    framed = _framed(coarse).astype(np.float32)
    place = (np.arange(size) + 0.5) * coarse.shape[1] / size + 0.5  # in texels, 0 at the centre of the frame's first
    low = place.astype(np.int64)
    part = (place - low).astype(np.float32)[:, None]
    rows = framed[:, low] + part[..., None] * (framed[:, low + 1] - framed[:, low])
    return rows[:, :, low] + part * (rows[:, :, low + 1] - rows[:, :, low])


def _framed(sky: Float32[np.ndarray, "6 s s 3"]) -> Float64[np.ndarray, "6 s+2 s+2 3"]:
    """Every face with one more texel on each side, looked up on its neighbours."""
    direction = geometry.cubemap_directions(sky.shape[1], rim=1)
    wider = np.pad(sky.astype(np.float64), ((0, 0), (1, 1), (1, 1), (0, 0)))
    for side in (0, -1):
        wider[:, side] = sample_cubemap(sky, direction[:, side])
        wider[:, :, side] = sample_cubemap(sky, direction[:, :, side])
    return wider
