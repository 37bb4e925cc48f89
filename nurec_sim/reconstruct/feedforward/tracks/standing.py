"""Which movable pixels show a static object: a parked car takes part in the consensus like a house."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from nurec_sim import geometry
from nurec_sim.network.tensors import SemanticClass
from nurec_sim.reconstruct.feedforward.chunks import ChunkInputs
from nurec_sim.reconstruct.feedforward.layers import pixel_times_us
from nurec_sim.reconstruct.feedforward.tracks.labelled import owners_of_points, owners_of_rays, scene_actors
from nurec_sim.reconstruct.movers.boxes import STANDING_MPS
from nurec_sim.types import Clip


def standing_pixels(
    clip: Clip,
    chunk: ChunkInputs,
    depth_m: Float32[np.ndarray, "v h w"],
    semantic: Int64[np.ndarray, "v h w"],
    motion_m: Float[Tensor, "1 v h w 2 3"] | None,
) -> Bool[np.ndarray, "v h w"]:
    """Movable pixels whose points, or else rays, meet the box of a static track, or no box and do not move.

    A mover is shown by each image for a moment; a static object exists over the whole clip, so its points of all images
    would lie in front of one another if the images did not agree on them. Without boxes in the log static objects are
    unknown, and the result is empty.

    Args:
        clip: the driving log, with its tracks.
        chunk: the images.
        depth_m: depth along the optical axis.
        semantic: ``SemanticClass``.
        motion_m: displacements to ``ContextImage.target_t_us``; without them only boxes identify static objects.
    """
    actors, found = scene_actors(clip), np.zeros(semantic.shape, bool)
    if not actors:
        return found
    still = np.array([actor.standing for actor in actors] + [False])
    rays = chunk.tensors.rays[0].double().cpu().numpy()
    along = chunk.tensors.distance_to_depth_scale[0, ..., 0].double().cpu().numpy()
    for number, image in enumerate(chunk.images):
        pixel = np.flatnonzero(semantic[number] == SemanticClass.MOVABLE)
        ray = rays[number].reshape(-1, 6)[pixel]
        origin = geometry.transform_points(chunk.world_from_scene, ray[:, :3])
        direction = ray[:, 3:] @ chunk.world_from_scene[:3, :3].T
        distance = (depth_m[number] / along[number]).reshape(-1, 1)[pixel]
        t_us = pixel_times_us(image, pixel)
        owner = owners_of_points(actors, origin + distance * direction, t_us, np.ones(len(pixel), bool))
        lost = np.flatnonzero(owner < 0)
        owner[lost] = owners_of_rays(actors, origin[lost], direction[lost], t_us[lost])
        stands = still[owner]
        if motion_m is not None:
            before_us, after_us = image.target_t_us
            # From the previous to the next frame: the longer baseline halves the effect of errors of a single
            # displacement.
            step_m = np.diff(motion_m[0, number].reshape(-1, 2, 3).float().cpu().numpy()[pixel], axis=1)[:, 0]
            slow = np.linalg.norm(step_m, axis=1) < STANDING_MPS * (after_us - before_us) / 1e6
            stands |= (owner < 0) & slow
        found[number].reshape(-1)[pixel] = stands
    return found
