"""From a window of a clip to the network's inputs."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64, UInt8
from torch import Tensor

from nurec_sim import geometry
from nurec_sim.compute.cores import usable_cores
from nurec_sim.network.profiles import Profile
from nurec_sim.network.tensors import SCENE_RESCALE, NetworkInputs
from nurec_sim.reconstruct.feedforward.chunks import ChunkInputs, ContextImage
from nurec_sim.reconstruct.feedforward.inputs.crop import (
    Crop,
    crop_camera,
    crop_exposure,
    crop_image,
    input_size,
    plan_crop,
)
from nurec_sim.reconstruct.feedforward.inputs.ego_mask import ego_masks
from nurec_sim.reconstruct.feedforward.inputs.frames import ChunkWindow
from nurec_sim.reconstruct.feedforward.inputs.rays import camera_rays, pinhole_field_rad, scene_rays
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.types import CameraModel, Clip, Matrix4

LONE_FRAME_GAP_US = 500_000
"""How far the motion decoder looks from the only frame of a camera."""
READING_THREADS = min(8, usable_cores())


@dataclass(frozen=True, eq=False)
class _View:
    """A cropped camera, and what is the same for all of its frames."""

    camera: CameraModel
    crop: Crop
    rays: Float64[np.ndarray, "h w 3"]
    hidden: Bool[np.ndarray, "h w"]
    field_rad: tuple[float, float]


def chunk_inputs(
    clip: Clip,
    profile: Profile,
    window: ChunkWindow,
    settings: FeedForwardSettings,
    ego_images: Mapping[str, UInt8[np.ndarray, "h w 4"]],
) -> ChunkInputs:
    """Read, resize and crop the frames of a window, and compute their geometry in its scene frame.

    Poses stay float64 and times integers up to the scene frame; the same input gives the same bits. ``ego`` of the
    result also covers the pixels outside the lens's field: they show no world either.

    Args:
        clip: the driving log.
        profile: size of the input images.
        window: frame indices per camera, and the chunk's time span.
        settings: ``image_pixels`` and ``ego_masks`` are used.
        ego_images: what cameras see of the ego vehicle, used where ``ego_masks`` names no folder.

    Raises:
        ReconstructError: an ego mask or a lens cannot be used, or the profile has no images of the wanted size.
        ClipError: an image is missing or broken.
    """
    cameras = [clip.rig.cameras[name] for name in window.frames]
    size = input_size(profile, cameras[0], settings.image_pixels)
    crops = {camera.id: plan_crop(profile, camera, size) for camera in cameras}
    masks = ego_masks(settings.ego_masks, ego_images, clip, crops)
    views = [_view(camera, crops[camera.id], masks[camera.id]) for camera in cameras]
    images = [image for view in views for image in _context_images(clip, view, window)]
    camera_idxs = [k for k, frames in enumerate(window.frames.values()) for _ in frames]
    shown = [views[k] for k in camera_idxs]

    ends = [clip.world_from_camera(image.camera.id, image.frame)[1] for image in images]
    # Scene frame: the first context camera at the end of its first exposure, as in the release. World coordinates may
    # be large; relative to the scene they fit into float32.
    world_from_scene = np.asarray(ends[0], np.float64)
    scene_from_world = geometry.inverse(world_from_scene)

    def pixels(image: ContextImage, view: _View) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 6"]]:
        rgb = crop_image(clip.image(image.camera.id, image.frame), view.crop)
        rays = scene_rays(view.camera, view.rays, scene_from_world @ image.world_from_camera)
        return rgb, torch.from_numpy(rays.astype(np.float32))

    with ThreadPoolExecutor(READING_THREADS) as pool:
        read = list(pool.map(pixels, images, shown))
    times = _fractions(images, window)
    tensors = NetworkInputs(
        rgb=torch.stack([rgb for rgb, _ in read])[None],
        c2w=_tensor([_rescaled(scene_from_world @ end) for end in ends]),
        fov=_tensor([view.field_rad for view in shown]),
        rays=torch.stack([rays for _, rays in read])[None],
        distance_to_depth_scale=_tensor([view.rays[..., 2:] for view in shown]),
        camera_idxs=torch.tensor([camera_idxs], dtype=torch.int64),
        time=_tensor(times[:, 0]),
        time_before=_tensor(times[:, 1]),
        time_after=_tensor(times[:, 2]),
        rig_from_scene=_tensor(clip.rig.cameras[images[0].camera.id].rig_from_camera),
    )
    ego = np.stack([view.hidden for view in shown])
    return ChunkInputs(window.index, window.span_us, tuple(images), world_from_scene, tensors, ego)


def _view(camera: CameraModel, crop: Crop, mask: Bool[np.ndarray, "h w"]) -> _View:
    cropped = crop_camera(camera, crop)
    rays, usable = camera_rays(cropped)
    return _View(cropped, crop, rays, mask | ~usable, pinhole_field_rad(cropped))


def context_image(clip: Clip, camera: CameraModel, crop: Crop, frame: int) -> ContextImage:
    """A frame of a cropped camera, without target times."""
    start_us, end_us = (int(t) for t in clip.camera_times_us(camera.id)[frame])
    poses = clip.world_from_camera(camera.id, frame)
    t_us, poses = crop_exposure(clip.rig.cameras[camera.id], crop, (start_us, end_us), poses)
    return ContextImage(camera, frame, t_us, (0, 0), poses)


def _context_images(clip: Clip, view: _View, window: ChunkWindow) -> list[ContextImage]:
    """The frames of one camera, each with the times of its neighbours in the chunk as targets.

    At the ends of the chunk the gap to the one neighbour counts for both sides; a lone frame looks 0.5 s each way.
    """
    images = [context_image(clip, view.camera, view.crop, frame) for frame in window.frames[view.camera.id]]
    taken = [image.centre_t_us for image in images]
    gaps = [after - before for before, after in itertools.pairwise(taken)] or [LONE_FRAME_GAP_US]
    targets = [(t - gaps[max(k - 1, 0)], t + gaps[min(k, len(gaps) - 1)]) for k, t in enumerate(taken)]
    return [dataclasses.replace(image, target_t_us=pair) for image, pair in zip(images, targets, strict=True)]


def _fractions(images: Sequence[ContextImage], window: ChunkWindow) -> Float64[np.ndarray, "v 3"]:
    """Time of each image and its two targets as fractions of the chunk."""
    return span_fractions(np.array([(image.centre_t_us, *image.target_t_us) for image in images], np.int64), window)


def span_fractions(times: Int64[np.ndarray, "*n"], window: ChunkWindow) -> Float64[np.ndarray, "*n"]:
    """Times as fractions of the chunk, which may lie outside of 0..1; differences are taken in integers."""
    length = window.span_us[1] - window.span_us[0]
    if all(len(frames) == 1 for frames in window.frames.values()):
        # A single exposure lasts milliseconds: as fractions of it, targets half a second away would be huge.
        length = max(length, LONE_FRAME_GAP_US)
    return (times - window.span_us[0]) / max(length, 1)


def _rescaled(scene_from_camera: Matrix4) -> Matrix4:
    """A pose in the network's unit of length."""
    pose = scene_from_camera.copy()
    pose[:3, 3] *= SCENE_RESCALE
    return pose


def _tensor(values: Sequence | np.ndarray) -> Tensor:
    """Float32, with the axis of clips in front."""
    return torch.from_numpy(np.asarray(values, np.float32)[None])
