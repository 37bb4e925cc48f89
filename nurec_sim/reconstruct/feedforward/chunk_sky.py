"""The sky of a chunk as a cubemap over the world, complete in every direction (``reconstruct.sky_fill``).

Chunks merge as means of their skies, weighted by ``seen`` plus a little (``alignment.merged_sky``).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor
from torch.nn import functional

from nurec_sim import geometry
from nurec_sim.network.sky import cubemap
from nurec_sim.network.sky.background import background, is_static
from nurec_sim.network.sky.observed import texture
from nurec_sim.network.tensors import ContextMaps, SemanticClass
from nurec_sim.reconstruct.sky_fill import fill_unseen
from nurec_sim.types import Matrix4

CUBE_FROM_WORLD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""Axes in which ``GaussianScene``'s sky (world z up) is a cubemap as in ``network.sky.cubemap``, whose y is down."""

FEATHER_PX = 2.0
"""Standard deviation of the blur at the border of the observed part, in texels."""
EDGE_PX = 3
"""Sky pixels this near to something else, in image pixels, may be mixed with it."""
SEAM_PX = 6.0
"""Standard deviation of the blur between the skies of chunks, in texels."""
BORDER_WEIGHT = 0.05
"""Weight of a chunk's sky at the border of its observed part."""


@dataclass(frozen=True, eq=False)
class ObservedSky:
    """Sky of one chunk from the pixels that the network calls sky.

    Attributes:
        rgb: complete in every direction.
        shown: whether the texel was observed, 0..1.
        weight: in the mean of all chunks; it falls towards the border of the observed part, where things in front of
            the sky mix in and the colours of chunks differ a little.
    """

    rgb: Float32[np.ndarray, "6 size size 3"]
    shown: Float32[np.ndarray, "6 size size"]
    weight: Float32[np.ndarray, "6 size size"]


def observed_world_sky(
    context: ContextMaps,
    rays: Float[Tensor, "1 v h w 6"],
    world_from_scene: Matrix4,
    size: int,
    ego: Bool[np.ndarray, "v h w"] | None = None,
) -> ObservedSky:
    """Sky of one chunk over the world, from the pixels that the network classifies as sky.

    It replaces ``NetworkOutputs.sky`` where there is no learned sky: the gradient of the release runs forwards instead
    of upwards.

    Args:
        context: colours and semantic logits of the chunk's images (b = 1).
        rays: those of the inputs, in the scene frame (origin in metres, unit direction).
        world_from_scene: pose of the scene frame; only its rotation matters, as the sky is infinitely far.
        size: edge of a cubemap face, texels.
        ego: True where a pixel shows the recording car: no sky there, whatever the network predicts. None: nowhere.
    """
    shows_sky = context.logits[0].argmax(dim=-1) == SemanticClass.SKY
    near_other = functional.max_pool2d((~shows_sky).float(), 2 * EDGE_PX + 1, stride=1, padding=EDGE_PX) > 0
    # Near another class the image already mixes its colour in (blur, a depth edge off by a pixel), so such pixels only
    # count where a texel has no clear one.
    (edge, edge_hits), (clear, clear_hits) = (
        (each.cpu().numpy() for each in texture(*_pixels(chosen, context, rays, world_from_scene, ego), size))
        for chosen in (shows_sky & near_other, shows_sky & ~near_other)
    )
    rgb = np.where((clear_hits > 0)[..., None], clear, edge)
    seen = (clear_hits + edge_hits > 0).astype(np.float32)
    # Images may be coarser than the cubemap and leave texels between their pixels: half of them count as all.
    clearly = np.minimum(2 * _blurred((clear_hits > 0).astype(np.float32), FEATHER_PX), 1)
    # The square lets the weight vanish smoothly with zero slope; 2 * blurred - 1 falls to 0 at the border itself.
    weight = clearly**2 * np.clip(2 * _blurred(clearly, SEAM_PX) - 1, BORDER_WEIGHT, 1)
    return ObservedSky(fill_unseen(rgb, seen), np.minimum(2 * _blurred(seen, FEATHER_PX), 1), weight)


def _blurred(faces: Float32[np.ndarray, "6 s s"], sigma_px: float) -> Float32[np.ndarray, "6 s s"]:
    return np.stack([cv2.GaussianBlur(face, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE) for face in faces])


def world_background(
    context: ContextMaps,
    rays: Float[Tensor, "1 v h w 6"],
    world_from_scene: Matrix4,
    size: int,
    ego: Bool[np.ndarray, "v h w"] | None = None,
) -> tuple[Float32[np.ndarray, "6 size size 3"], Float32[np.ndarray, "6 size size"]]:
    """``network.sky.background`` over the world: what one chunk shows of all static surfaces.

    Args:
        context: colours and semantic logits of the chunk's images (b = 1).
        rays: those of the inputs, in the scene frame.
        world_from_scene: pose of the scene frame; only its rotation is used.
        size: edge of a cubemap face, texels.
        ego: True where a pixel shows the recording car and is ignored; None: nowhere.

    Returns:
        Blurred mean colours by direction, and where there are any (1, elsewhere 0).
    """
    return background(*_pixels(is_static(context.logits[0]), context, rays, world_from_scene, ego), size)


def _pixels(
    chosen: Bool[Tensor, "v h w"],
    context: ContextMaps,
    rays: Float[Tensor, "1 v h w 6"],
    world_from_scene: Matrix4,
    ego: Bool[np.ndarray, "v h w"] | None,
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Colours of pixels and where they look, in the axes of the world's cubemap; none on the car."""
    if ego is not None:
        chosen = chosen & torch.from_numpy(~ego).to(chosen.device)
    direction = rays[0][chosen][:, 3:]
    turn = torch.as_tensor(CUBE_FROM_WORLD @ world_from_scene[:3, :3], dtype=direction.dtype, device=direction.device)
    # Not a matrix product: those may round differently with another number of threads.
    return context.rgb[0][chosen].detach(), (direction[:, None, :] * turn).sum(dim=-1)


def world_sky(
    sky: Float32[np.ndarray, "6 s s 3"], seen: Float32[np.ndarray, "6 s s"], world_from_scene: Matrix4, size: int
) -> tuple[Float32[np.ndarray, "6 size size 3"], Float32[np.ndarray, "6 size size"]]:
    """A cubemap of the network (scene frame) resampled as one of ``GaussianScene`` (world axes).

    Args:
        sky: colours, faces as in ``network.sky.cubemap``.
        seen: how clearly each texel was seen, 0..1.
        world_from_scene: pose of the scene frame; only its rotation is used, as the sky is infinitely far.
        size: edge of the result's faces, texels.

    Returns:
        Colours and ``seen`` in world axes.
    """
    faces = torch.from_numpy(np.concatenate([sky, seen[..., None]], axis=-1, dtype=np.float32))
    # Several rays per texel where the scene's sky is the coarser one: averaged, and not skipped through.
    rays = max(1, round(sky.shape[1] / size))
    direction = np.einsum("...i,ij->...j", geometry.cubemap_directions(rays * size), world_from_scene[:3, :3])
    sampled = cubemap.sample_seamless(faces, torch.from_numpy(direction.astype(np.float32)))
    values = sampled.reshape(6, size, rays, size, rays, 4).mean(dim=(2, 4)).numpy()
    return np.ascontiguousarray(values[..., :3]), np.ascontiguousarray(values[..., 3])
