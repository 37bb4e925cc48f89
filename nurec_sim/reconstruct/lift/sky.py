"""The sky cubemap: colours of the pixels that no surface covers, spread into the directions that no view saw."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim import geometry
from nurec_sim.reconstruct.lift.lifting import rays_of
from nurec_sim.reconstruct.lift.views import View


def make_sky(
    views: Sequence[View],
    colours: Sequence[Float64[np.ndarray, "h w 3"]],
    weights: Sequence[Float64[np.ndarray, "h w"]],
    size: int,
) -> Float32[np.ndarray, "6 size size 3"]:
    """Average the far pixels of all views per cubemap texel and fill the rest from their surroundings.

    ``colours`` are canonical, 0..255; ``weights`` say how surely each pixel is sky, 0 if it is not.
    Directions that nothing is known of take the colour of the nearest known ones, ever smoother with distance.
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
    return _spread(colour.reshape(6, size, size, 3), known.reshape(6, size, size)).astype(np.float32)


def _spread(colour: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Fill unknown texels: near ones on their face by a pyramid, the rest by the average over direction."""
    size = colour.shape[1]
    result, weight = np.zeros_like(colour), np.zeros(known.shape)
    for face in range(6):
        value, mass = colour[face] * known[face][..., None], known[face].astype(np.float64)
        for sigma in (1.0, 2.0, 4.0, 8.0, 16.0, 32.0):
            missing = weight[face] == 0
            if not missing.any():
                break
            blurred, soft = cv2.GaussianBlur(value, (0, 0), sigma), cv2.GaussianBlur(mass, (0, 0), sigma)
            take = missing & (soft > 0.02)
            result[face][take] = blurred[take] / soft[take, None]
            weight[face][take] = 1
    if not known.any():
        return np.full_like(colour, 0.6)
    return _by_direction(result, weight > 0, geometry.cubemap_directions(size))


def _by_direction(colour: np.ndarray, known: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Fill the rest from a coarse set of known directions, weighted by angle, elevation counting double."""
    step = max(1, colour.shape[1] // 32)
    source = np.zeros_like(known)
    source[:, ::step, ::step] = known[:, ::step, ::step]
    if not source.any():
        source = known
    points, values = direction[source] * (1, 1, 2), colour[source]
    coarse = np.s_[:, step // 2 :: step, step // 2 :: step]
    wanted = direction[coarse].reshape(-1, 3) * (1, 1, 2)
    square = np.sum(wanted**2, axis=1)[:, None] + np.sum(points**2, axis=1)[None] - 2 * wanted @ points.T
    distance = np.sqrt(np.maximum(square, 0))
    weight = 1 / (distance + 0.05) ** 4
    mixed = (weight @ values / weight.sum(axis=1, keepdims=True)).reshape(*direction[coarse].shape[:3], 3)
    for face in range(6):
        smooth = cv2.resize(mixed[face], colour.shape[1:3], interpolation=cv2.INTER_LINEAR)
        colour[face] = np.where(known[face][..., None], colour[face], smooth)
    return colour
