"""Ground truth of the network's input images: cropped and resized like them, in the scene frame of the sample.

Labels and instances are sampled at the nearest stored pixel. Depth is transferred from the stored pixel's ray to the
new one along the tangent plane of the surface, so it stays exact on planes.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64

from nurec_sim import geometry, sensors
from nurec_sim.network.profiles import Profile
from nurec_sim.network.tensors import SemanticClass
from nurec_sim.reconstruct.feedforward.chunks import ChunkInputs, ContextImage
from nurec_sim.reconstruct.feedforward.inputs.crop import (
    Crop,
    crop_camera,
    crop_image,
    input_size,
    plan_crop,
)
from nurec_sim.reconstruct.feedforward.inputs.frames import ChunkWindow
from nurec_sim.reconstruct.feedforward.inputs.rays import camera_rays, scene_rays
from nurec_sim.reconstruct.feedforward.inputs.window import context_image, span_fractions
from nurec_sim.training.data.clips import FrameTruth, TrueClip
from nurec_sim.training.data.sample import TargetView, TrueMaps
from nurec_sim.types import CameraModel, Label, Matrix4, Shutter

SEMANTIC_OF_LABEL = np.full(len(Label), SemanticClass.OTHERS, np.int64)
SEMANTIC_OF_LABEL[Label.ROAD] = SemanticClass.ROAD
SEMANTIC_OF_LABEL[Label.MOVABLE] = SemanticClass.MOVABLE
SEMANTIC_OF_LABEL[Label.SKY] = SemanticClass.SKY
SEMANTIC_OF_LABEL[Label.EGO] = SemanticClass.EGO
UNKNOWN = -1

MOST_DEPTH_CHANGE = 1.25
"""Maximum change of depth within a stored pixel; at grazing angles the tangent plane extrapolates beyond it."""


def true_maps(clip: TrueClip, profile: Profile, chunk: ChunkInputs) -> TrueMaps:
    """Ground truth of the context images of a chunk."""
    size = input_size(profile, clip.rig.cameras[chunk.camera_ids[0]])
    depth, normal, semantic, motion, known = [], [], [], [], []
    scene_from_world = geometry.inverse(chunk.world_from_scene)
    rays, scale = chunk.tensors.rays[0].double().numpy(), chunk.tensors.distance_to_depth_scale[0].double().numpy()
    for number, image in enumerate(chunk.images):
        original = clip.rig.cameras[image.camera.id]
        crop = plan_crop(profile, original, size)
        truth = _cropped(clip.truth(original.id, image.frame), original, image.camera, crop)
        hidden = chunk.ego[number]
        depth_m = np.where(hidden, 0, truth.depth_m)
        depth.append(depth_m)
        semantic.append(np.where(hidden, UNKNOWN, SEMANTIC_OF_LABEL[truth.label]))
        turned = scene_rays(image.camera, truth.normal, scene_from_world @ image.world_from_camera)[..., 3:]
        normal.append(np.where(hidden[..., None], 0, turned))
        points = rays[number, ..., :3] + rays[number, ..., 3:] * depth_m[..., None] / scale[number]
        displacement, covered = _motion(clip, image, truth.instance, points, chunk.world_from_scene)
        motion.append(displacement)
        known.append(covered & (depth_m > 0))
    return TrueMaps(
        depth_m=torch.from_numpy(np.stack(depth).astype(np.float32))[None],
        normal=torch.from_numpy(np.stack(normal).astype(np.float32))[None],
        semantic=torch.from_numpy(np.stack(semantic))[None],
        motion_m=torch.from_numpy(np.stack(motion).astype(np.float32))[None],
        motion_known=torch.from_numpy(np.stack(known))[None],
    )


def target_view(
    clip: TrueClip, profile: Profile, window: ChunkWindow, chunk: ChunkInputs, camera_id: str, frame: int
) -> TargetView:
    """A frame of one of the chunk's cameras as a target, in the chunk's scene frame and time.

    Args:
        clip: the clip.
        profile: network profile; gives the input size and the crop.
        window: the window of the chunk; gives the span that ``time`` is a fraction of.
        chunk: inputs of the chunk; give the scene frame.
        camera_id: one of the chunk's cameras.
        frame: index of the frame.
    """
    original = clip.rig.cameras[camera_id]
    crop = plan_crop(profile, original, input_size(profile, clip.rig.cameras[chunk.camera_ids[0]]))
    image = context_image(clip, crop_camera(original, crop), crop, frame)
    truth = _cropped(clip.truth(camera_id, frame), original, image.camera, crop)
    hidden = ~camera_rays(image.camera)[1]
    return TargetView(
        camera=image.camera,
        camera_idx=chunk.camera_ids.index(camera_id),
        scene_from_camera=geometry.inverse(chunk.world_from_scene) @ image.world_from_camera,
        time=float(span_fractions(np.array([image.centre_t_us], np.int64), window)[0]),
        rgb=crop_image(clip.image(camera_id, frame), crop),
        depth_m=torch.from_numpy(np.where(hidden, 0, truth.depth_m).astype(np.float32)),
        semantic=torch.from_numpy(np.where(hidden, UNKNOWN, SEMANTIC_OF_LABEL[truth.label])),
    )


def _cropped(truth: FrameTruth, original: CameraModel, cropped: CameraModel, crop: Crop) -> FrameTruth:
    """Ground truth at the pixels of a cropped and resized image."""
    columns, rows = (
        np.clip(((np.arange(count) + 0.5 + offset) * whole / resized).astype(np.int64), 0, whole - 1)
        for count, offset, whole, resized in zip(
            crop.size, crop.offset, (original.width_px, original.height_px), crop.resized, strict=True
        )
    )
    cells = np.ix_(rows, columns)
    normal, depth_m = truth.normal[cells], truth.depth_m[cells]
    stored_rays, stored_valid = sensors.pixel_rays(original)
    rays, valid = camera_rays(cropped)
    with np.errstate(invalid="ignore", divide="ignore"):
        # A point on a ray r at z-depth z is z r / r_z. Both points lie on one plane: n . (z r / r_z) is equal for both.
        stored, new = stored_rays[cells], rays
        ratio = (normal * stored).sum(-1) * new[..., 2] / ((normal * new).sum(-1) * stored[..., 2])
    tame = stored_valid[cells] & valid & (ratio > 1 / MOST_DEPTH_CHANGE) & (ratio < MOST_DEPTH_CHANGE)
    depth_m = depth_m * np.where(tame, ratio, 1).astype(np.float32)
    return FrameTruth(depth_m, normal, truth.label[cells], truth.instance[cells])


def _motion(
    clip: TrueClip,
    image: ContextImage,
    instance: Int64[np.ndarray, "h w"],
    scene_points: Float64[np.ndarray, "h w 3"],
    world_from_scene: Matrix4,
) -> tuple[Float32[np.ndarray, "h w 2 3"], Bool[np.ndarray, "h w"]]:
    """Displacement of every pixel's point with the rigid motion of its box, and where the box's path is known."""
    motion, known = np.zeros((*instance.shape, 2, 3)), np.ones(instance.shape, bool)
    taken_us = _pixel_times_us(image)
    scene_from_world = geometry.inverse(world_from_scene)
    for number in np.unique(instance[instance > 0]):
        path, pixels = clip.tracks[int(number) - 1].path, instance == number
        # Rolling shutter: pixels of one object have different exposure times, hence different box poses; one inverse
        # per distinct time.
        times, which = np.unique(taken_us[pixels], return_inverse=True)
        box_from_scene = geometry.inverse(path.at(times)) @ world_from_scene
        points = scene_points[pixels]
        for side, target_us in enumerate(image.target_t_us):
            moved = (scene_from_world @ path.at(target_us) @ box_from_scene)[which]
            motion[pixels, side] = np.einsum("nij,nj->ni", moved[:, :3, :3], points) + moved[:, :3, 3] - points
        wanted = (int(times[0]), int(times[-1]), *image.target_t_us)
        known[pixels] = all(path.covers(t_us) for t_us in wanted)
    return motion, known


def _pixel_times_us(image: ContextImage) -> Int64[np.ndarray, "h w"]:
    """Exposure time of each pixel."""
    camera, (start_us, end_us) = image.camera, image.t_us
    by_columns = camera.shutter in (Shutter.LEFT_TO_RIGHT, Shutter.RIGHT_TO_LEFT)
    lines = np.arange(camera.width_px if by_columns else camera.height_px) + 0.5
    fraction = sensors.shutter_fraction(camera, np.stack([lines, lines], axis=1))
    times = start_us + np.rint(fraction * (end_us - start_us)).astype(np.int64)
    return np.broadcast_to(times[None, :] if by_columns else times[:, None], (camera.height_px, camera.width_px))
