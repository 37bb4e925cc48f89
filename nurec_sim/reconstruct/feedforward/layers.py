"""Network outputs of a chunk as layers of the world: pruned, moved out of the scene frame, split by motion.

Movable points are dynamic (paper section 3.3). Their middle knot is where and when their own pixel saw them; the outer
knots are at the camera's previous and next frame, where the motion head or their track puts them. So at the instant of
one frame the points of three frames are visible: its own in full, and those of its neighbours as they fade out (exp(-1)
at their outer knots); wrong displacements show as doubled edges.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64
from torch import Tensor

from nurec_sim import geometry, sensors
from nurec_sim.network.tensors import NetworkOutputs, QueryGaussians, SemanticClass
from nurec_sim.reconstruct.feedforward.chunk_sky import observed_world_sky, world_background, world_sky
from nurec_sim.reconstruct.feedforward.chunks import ChunkInputs, ChunkLayers, ContextImage
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.reconstruct.feedforward.tracks.labelled import (
    knots_along,
    owners_of_points,
    owners_of_rays,
    scene_actors,
)
from nurec_sim.reconstruct.lift.points import Actor
from nurec_sim.types import Clip, DynamicGaussians, Gaussians, Label

COVERED_WEIGHT = 3e-4
"""Weight of surfaces that hide the sky from one chunk, in a mean with the sky that another chunk sees there."""
MIN_DYNAMIC_OPACITY = 0.75
"""Dynamic Gaussians are at least this opaque, as in the released model."""
_LABELS = {
    SemanticClass.OTHERS: Label.OTHER,
    SemanticClass.EGO: Label.EGO,
    SemanticClass.SKY: Label.SKY,
    SemanticClass.ROAD: Label.ROAD,
    SemanticClass.MOVABLE: Label.MOVABLE,
}
LABEL_OF_CLASS = np.array([_LABELS[each] for each in SemanticClass], np.uint8)


@dataclass(frozen=True)
class _Points:
    """Gaussians of one image in the world: their places in the ``QueryGaussians`` and their (flat) pixels."""

    gaussians: Gaussians
    position_m: Float64[np.ndarray, "n 3"]
    query: Int64[np.ndarray, " n"]
    pixel: Int64[np.ndarray, " n"]

    def __getitem__(self, index: np.ndarray) -> _Points:
        return _Points(self.gaussians[index], self.position_m[index], self.query[index], self.pixel[index])


def chunk_layers(clip: Clip, chunk: ChunkInputs, outputs: NetworkOutputs, settings: FeedForwardSettings) -> ChunkLayers:
    """A chunk's contribution to the scene, in the world frame.

    Dropped are Gaussians that are not more opaque than ``settings.min_opacity`` (sky and ego car by the network's
    mask), not finite, or on pixels where the log's own mask shows the ego car. Dynamic is every movable point, with or
    without tracks, and every other point off the road that lies in a track's box. Without a motion head a movable point
    outside all tracks stays in place between its knots.

    Args:
        clip: the driving log; its movable tracks, of any source, carry the points in their boxes.
        chunk: the network's inputs.
        outputs: its outputs (b = 1), on any device.
        settings: ``min_opacity``, ``learned_sky`` and ``sky_px`` are used.

    Returns:
        The layers; ``dynamic.track`` indexes ``clip.tracks``, -1 where the motion head moves a point.
    """
    actors = scene_actors(clip)
    static, dynamic = [], []
    for number, rows in enumerate(_rows_of_images(chunk, outputs.gaussians)):
        points = _points_in_world(chunk, number, outputs.gaussians, rows, settings.min_opacity)
        standing, moving = _split(actors, clip.span_us, chunk, number, points, outputs.gaussians.motion_m)
        static.append(standing)
        dynamic.append(moving)
    sky, seen = _sky(chunk, outputs, settings)
    isp = _numpy(outputs.isp[0].double())
    return ChunkLayers(
        images=chunk.images,
        static=Gaussians.concatenate(static),
        dynamic=DynamicGaussians.concatenate(dynamic),
        sky=sky,
        sky_seen=seen,
        isp={name: isp[number] for number, name in enumerate(chunk.camera_ids)},
    )


def _sky(
    chunk: ChunkInputs, outputs: NetworkOutputs, settings: FeedForwardSettings
) -> tuple[Float32[np.ndarray, "6 s s 3"], Float32[np.ndarray, "6 s s"]]:
    """What lies behind everything, and how surely each texel was seen.

    Sky where images show sky; standing surfaces where they show those (``network.sky.background``); elsewhere the
    learned sky, or the observed sky extrapolated.
    """
    context, size = outputs.context, settings.sky_px
    rays = chunk.tensors.rays.to(context.rgb.device)
    observed = observed_world_sky(context, rays, chunk.world_from_scene, size, chunk.ego)
    sky = observed.rgb
    if settings.learned_sky and outputs.sky_learned:
        learned, seen = (_float32(values[0]) for values in (outputs.sky, outputs.sky_seen))
        sky, _ = world_sky(learned, seen[..., 0], chunk.world_from_scene, size)
    surfaces, covered = world_background(context, rays, chunk.world_from_scene, size, chunk.ego)
    # Layered from the weakest evidence to the strongest: extrapolated or learned sky, surfaces, observed sky.
    sky = sky + covered[..., None] * (surfaces - sky)
    covered = np.maximum(covered, observed.shown)
    return sky + observed.shown[..., None] * (observed.rgb - sky), np.maximum(observed.weight, COVERED_WEIGHT * covered)


# ------------------------------------------------------------------------------------------------- scene to world


def _rows_of_images(chunk: ChunkInputs, query: QueryGaussians) -> Sequence[Int64[Tensor, " n"]]:
    """Which Gaussians were lifted from each image; to go image by image bounds the memory."""
    image_of = query.source[0] // chunk.ego[0].size
    order = torch.arange(len(image_of), device=image_of.device)
    if not bool((image_of[1:] >= image_of[:-1]).all()):
        order = torch.argsort(image_of, stable=True)
    return torch.split(order, torch.bincount(image_of, minlength=len(chunk.images)).tolist())


def _points_in_world(
    chunk: ChunkInputs, number: int, query: QueryGaussians, rows: Int64[Tensor, " n"], min_opacity: float
) -> _Points:
    """Those of an image worth keeping; the work is done where the tensors are, so that only these leave a GPU."""
    ego = torch.tensor(chunk.ego[number].reshape(-1), device=rows.device)
    rows = rows[(query.opacity[0, rows] > min_opacity) & ~ego[query.source[0, rows] % len(ego)]]
    names = ("position_m", "quat_wxyz", "scale_m", "opacity", "rgb", "normal")
    kept = {name: getattr(query, name)[0, rows] for name in names}
    sound = (kept["quat_wxyz"] != 0).any(dim=-1)
    for values in kept.values():
        finite = torch.isfinite(values)
        sound &= finite if finite.ndim == 1 else finite.all(dim=-1)
    if not bool(sound.all()):
        rows, kept = rows[sound], {name: values[sound] for name, values in kept.items()}

    turn, shift = chunk.world_from_scene[:3, :3], chunk.world_from_scene[:3, 3]
    # Row k of the products is turn * e_k, so its transpose multiplies by the turn from the left.
    turn_quat = geometry.quat_multiply(np.tile(geometry.quat_from_matrix(turn), (4, 1)), np.eye(4)).T
    quat = _multiplied(turn_quat, kept["quat_wxyz"])
    quat = quat / torch.linalg.vector_norm(quat, dim=-1, keepdim=True)
    position = _multiplied(turn, kept["position_m"], shift)
    semantic = _numpy(query.semantic[0, rows])
    gaussians = Gaussians(
        mean_m=_float32(position),
        quat_wxyz=_float32(torch.where(quat[:, :1] < 0, -quat, quat)),
        scale_m=_float32(kept["scale_m"]),
        opacity=_float32(kept["opacity"]),
        rgb=_float32(kept["rgb"]),
        normal=_float32(_multiplied(turn, kept["normal"])),
        label=LABEL_OF_CLASS[semantic],
        intensity=np.full(len(semantic), np.nan, np.float32),
    )
    return _Points(gaussians, _numpy(position), _numpy(rows), _numpy(query.source[0, rows] % len(ego)))


def _multiplied(
    matrix: Float64[np.ndarray, "k k"], vectors: Float[Tensor, "n k"], shift: Float64[np.ndarray, " k"] | None = None
) -> Float64[Tensor, "n k"]:
    """``matrix @ vector + shift``, written out: library products may round differently at other thread counts."""
    columns = [column.double() for column in vectors.unbind(dim=-1)]
    rows = []
    for number, factors in enumerate(matrix.tolist()):
        total = factors[0] * columns[0]
        for factor, column in zip(factors[1:], columns[1:], strict=True):
            total += factor * column
        rows.append(total if shift is None else total + float(shift[number]))
    return torch.stack(rows, dim=-1)


def _numpy(values: Tensor) -> np.ndarray:
    return values.detach().cpu().numpy()


def _float32(values: Tensor) -> np.ndarray:
    return _numpy(values.float())


# ---------------------------------------------------------------------------------------------- static and dynamic


def _split(
    actors: Sequence[Actor],
    span_us: tuple[int, int],
    chunk: ChunkInputs,
    number: int,
    points: _Points,
    motion_m: Float[Tensor, "1 n 2 3"] | None,
) -> tuple[Gaussians, DynamicGaussians]:
    """Static and moving points of image ``number``."""
    image, label = chunk.images[number], points.gaussians.label
    # With boxes even points that the network does not call movable may belong to one; road never does.
    rows = np.flatnonzero(label != Label.ROAD if actors else label == Label.MOVABLE)
    t_us = pixel_times_us(image, points.pixel[rows])
    movable = label[rows] == Label.MOVABLE
    owner = owners_of_points(actors, points.position_m[rows], t_us, movable)
    # A wrong depth puts a point outside its box, but its ray still passes through: accepted if the box is unambiguous.
    lost = np.flatnonzero(movable & (owner < 0))
    owner[lost] = owners_of_rays(actors, *_rays(chunk, number, points.pixel[rows[lost]]), t_us[lost])
    moving = movable | (owner >= 0)
    rows, t_us, owner = rows[moving], t_us[moving], owner[moving]
    moved = points[rows]
    displacement = _displacement(chunk, motion_m, moved.query)
    dynamic = _moving_points(actors, image, moved, t_us, owner, displacement, span_us)
    is_static = np.ones(len(label), bool)
    is_static[rows] = False
    return points.gaussians[is_static], dynamic


def pixel_times_us(image: ContextImage, pixel: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """When pixels, given by their flat index, were exposed."""
    row, column = np.divmod(pixel, image.camera.width_px)
    fraction = sensors.shutter_fraction(image.camera, np.stack([column, row], axis=-1) + 0.5)
    # Integer microseconds: epoch times do not fit into float32, where neighbouring rows would share one instant.
    start_us, end_us = image.t_us
    return start_us + np.rint(fraction * (end_us - start_us)).astype(np.int64)


def _displacement(
    chunk: ChunkInputs, motion_m: Float[Tensor, "1 n 2 3"] | None, rows: Int64[np.ndarray, " k"]
) -> Float64[np.ndarray, "k 2 3"]:
    """Predictions of the motion head for some Gaussians, in world axes; zeros without it."""
    if motion_m is None:
        return np.zeros((len(rows), 2, 3))
    motion = _numpy(motion_m[0, torch.from_numpy(rows).to(motion_m.device)])
    return np.einsum("ij,nkj->nki", chunk.world_from_scene[:3, :3], motion)


def _rays(
    chunk: ChunkInputs, number: int, pixel: Int64[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Origins and directions, in the world, of some pixels of image ``number``."""
    of_image = chunk.tensors.rays[0, number].reshape(-1, 6)
    rays = _numpy(of_image[torch.from_numpy(pixel).to(of_image.device)].double())
    world_from_scene = chunk.world_from_scene
    return geometry.transform_points(world_from_scene, rays[:, :3]), rays[:, 3:] @ world_from_scene[:3, :3].T


def _moving_points(
    actors: Sequence[Actor],
    image: ContextImage,
    points: _Points,
    t_us: np.ndarray,
    owner: np.ndarray,
    displacement_m: Float64[np.ndarray, "n 2 3"],
    span_us: tuple[int, int],
) -> DynamicGaussians:
    """Dynamic points of one image with their knots."""
    before, after = image.target_t_us
    # Knot times must increase strictly, also where a row is exposed at the very time of a neighbouring frame.
    times = np.stack([np.minimum(before, t_us - 1), t_us, np.maximum(after, t_us + 1)], axis=1)
    knots = np.repeat(points.position_m[:, None], 3, axis=1)
    knots[:, [0, 2]] += displacement_m
    track = np.full(len(owner), -1, np.int32)
    for number in np.unique(owner[owner >= 0]):
        mine = np.flatnonzero(owner == number)
        actor = actors[number]
        track[mine] = actor.index
        if actor.standing:
            # Movable ones are those that the images disagree on (``tracks.standing``): over the whole clip they would
            # hide each other, so each stays for the moment of its image.
            knots[mine] = points.position_m[mine, None]
            mine = mine[points.gaussians.label[mine] != Label.MOVABLE]
        times[mine], knots[mine] = knots_along(actor, points.position_m[mine], t_us[mine], image.target_t_us, span_us)
    gaussians = dataclasses.replace(
        points.gaussians,
        # As in the release: movers are seen for a moment only, and a faint one would let the background show through.
        opacity=np.maximum(points.gaussians.opacity, np.float32(MIN_DYNAMIC_OPACITY)),
        label=np.full(len(owner), Label.MOVABLE, np.uint8),
    )
    sound = np.isfinite(knots).all(axis=(1, 2))
    return DynamicGaussians(gaussians[sound], times[sound], knots[sound].astype(np.float32), track[sound])
