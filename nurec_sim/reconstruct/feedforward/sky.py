"""The sky of a chunk as a cubemap over the world, complete in every direction.

What the images show is kept. Where nobody looked, the sky goes on as it does where it was seen: the colour of its own
height above the horizon (the world's z is up), changed by what the nearest seen parts differ from that.

A chunk's sky is complete by itself. Chunks merge as means of their skies, weighted by ``seen`` plus a little; what no
chunk saw is then better filled once more, from all of them: ``fill_unseen`` with the largest ``seen``.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from torch import Tensor
from torch.nn import functional

from nurec_sim import geometry
from nurec_sim.network import cubemap
from nurec_sim.network.observed_sky import NOTHING_SEEN, sky_pixels, texture
from nurec_sim.network.tensors import ContextMaps

CUBE_FROM_WORLD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""Axes in which ``GaussianScene``'s sky (world z up) is a cubemap as in ``network.cubemap``; y is down there too."""

FEATHER_PX = 2.0
"""How softly what was seen ends, in texels."""
SURE = 0.5
"""Texels that were seen as surely as this keep their colours."""
ELEVATION_STEPS = 32
"""Bands of equal solid angle, from straight down to straight up, in which colours by height are averaged."""


def observed_world_sky(
    context: ContextMaps,
    rays: Float[Tensor, "1 v h w 6"],
    world_from_scene: Float64[np.ndarray, "4 4"],
    size: int,
    ego: Bool[np.ndarray, "v h w"] | None = None,
) -> tuple[Float32[np.ndarray, "6 size size 3"], Float32[np.ndarray, "6 size size"]]:
    """Sky of one chunk from the pixels that the network calls sky, and how surely each texel was seen.

    Takes the place of ``NetworkOutputs.sky`` where there is no learned sky: that one grows brighter or darker forwards
    instead of upwards. ``rays`` are those of the inputs, in the scene frame; pixels where ``ego`` is True show the car
    and no sky, whatever the network says.
    """
    rgb, logits, rays = context.rgb[0], context.logits[0], rays[0]
    if ego is not None:
        shown = torch.from_numpy(~ego).to(rgb.device)
        rgb, logits, rays = rgb[shown], logits[shown], rays[shown]
    colour, direction = sky_pixels(rgb, logits, rays)
    turn = torch.as_tensor(CUBE_FROM_WORLD @ world_from_scene[:3, :3], dtype=direction.dtype, device=direction.device)
    # Not a matrix product: those may round differently with another number of threads.
    direction = (direction[:, None, :] * turn).sum(dim=-1)
    mean, hits = (values.cpu().numpy() for values in texture(colour, direction, size))
    seen = (hits > 0).astype(np.float32)
    soft = np.stack([cv2.GaussianBlur(face, (0, 0), FEATHER_PX, borderType=cv2.BORDER_REPLICATE) for face in seen])
    # Images may be coarser than the cubemap and leave texels between their pixels: half of them is as good as all.
    return fill_unseen(mean, seen), np.minimum(2 * soft, 1)


def world_sky(
    sky: Float32[np.ndarray, "6 s s 3"],
    seen: Float32[np.ndarray, "6 s s"],
    world_from_scene: Float64[np.ndarray, "4 4"],
    size: int,
) -> tuple[Float32[np.ndarray, "6 size size 3"], Float32[np.ndarray, "6 size size"]]:
    """A cubemap of the network (scene frame) as one of ``GaussianScene``: turned, the sky being far, and resampled."""
    faces = torch.from_numpy(np.concatenate([sky, seen[..., None]], axis=-1, dtype=np.float32))
    # Several rays per texel where the scene's sky is the coarser one: averaged, and not skipped through.
    rays = max(1, round(sky.shape[1] / size))
    direction = np.einsum("...i,ij->...j", geometry.cubemap_directions(rays * size), world_from_scene[:3, :3])
    sampled = cubemap.sample_seamless(faces, torch.from_numpy(direction.astype(np.float32)))
    values = sampled.reshape(6, size, rays, size, rays, 4).mean(dim=(2, 4)).numpy()
    return np.ascontiguousarray(values[..., :3]), np.ascontiguousarray(values[..., 3])


def fill_unseen(
    sky: Float32[np.ndarray, "6 s s 3"], seen: Float32[np.ndarray, "6 s s"]
) -> Float32[np.ndarray, "6 s s 3"]:
    """A sky over the world with its unseen parts replaced; between unseen and surely seen it is a blend.

    No colour leaves the range of those seen. Without anything seen the sky is a light grey.
    """
    if not seen.any():
        return np.full_like(sky, NOTHING_SEEN)
    weight = np.minimum(seen / SURE, 1).astype(np.float32)[..., None]
    if weight.min() == 1:
        return sky
    by_height = _colour_by_height(sky, weight[..., 0])
    rest = _spread(torch.from_numpy(sky - by_height), torch.from_numpy(weight)).numpy()
    darkest, brightest = sky[seen > 0].min(axis=0), sky[seen > 0].max(axis=0)
    return np.where(weight == 1, sky, np.clip(by_height + rest, darkest, brightest))


def _colour_by_height(sky: np.ndarray, weight: np.ndarray) -> Float32[np.ndarray, "6 s s 3"]:
    """Mean seen colour of each texel's height over the horizon, held above the highest and below the lowest seen."""
    height = geometry.cubemap_directions(sky.shape[1])[..., 2]
    place = (height + 1) / 2 * ELEVATION_STEPS - 0.5
    band = np.clip(np.round(place), 0, ELEVATION_STEPS - 1).astype(np.int64).ravel()
    mass = np.bincount(band, weight.ravel(), ELEVATION_STEPS)
    known = np.flatnonzero(mass)
    sums = [np.bincount(band, (weight * sky[..., k]).ravel(), ELEVATION_STEPS)[known] for k in range(3)]
    return np.stack([np.interp(place, known, total / mass[known]) for total in sums], axis=-1, dtype=np.float32)


def _spread(value: Float32[Tensor, "6 s s c"], weight: Float32[Tensor, "6 s s 1"]) -> Float32[Tensor, "6 s s c"]:
    """Values where the weight is 1, flowing from there into the rest, by way of ever coarser cubemaps; 0 far away."""
    size = value.shape[1]
    if size == 1:
        return value * weight
    half = (size + 1) // 2
    coarse = functional.adaptive_avg_pool2d(torch.cat([value * weight, weight], dim=-1).movedim(-1, 1), half)
    total, mass = coarse.movedim(1, -1).split([value.shape[-1], 1], dim=-1)
    around = cubemap.framed(_spread(total / mass.clamp(min=1e-12), (4 * mass).clamp(max=1)))
    centre = ((2 * torch.arange(size) + 1) / size - 1) * half / (half + 2)
    grid = torch.stack(torch.meshgrid(centre, centre, indexing="xy"), dim=-1).expand(6, -1, -1, -1)
    smooth = functional.grid_sample(around.movedim(-1, 1), grid, align_corners=False).movedim(1, -1)
    return torch.lerp(smooth, value, weight)
