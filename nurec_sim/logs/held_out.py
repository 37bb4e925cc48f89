"""Held-out data of a log: every N-th image, sweeps, and cameras that are not inputs of the reconstruction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from nurec_sim.errors import ReconstructError
from nurec_sim.logs.selection import ContextClip, Revolution, Shot
from nurec_sim.types import Clip


@dataclass(frozen=True)
class HeldOut:
    """Indices of held-out images by camera, and of held-out sweeps (of every LiDAR)."""

    images: Mapping[str, frozenset[int]] = field(default_factory=dict)
    sweeps: frozenset[int] = frozenset()


def hold_out(
    clip: Clip, cameras: Sequence[str], *, images_every: int = 0, sweeps_every: int = 0, sweeps: Sequence[int] = ()
) -> HeldOut:
    """Chooses what to hold out.

    Args:
        clip: the log.
        cameras: input cameras whose images are held out.
        images_every: images N-1, 2N-1, ... of each camera; 0 holds out none. Sweeps that overlap the exposure of such
            an image are held out too: their points are its depth.
        sweeps_every: sweeps K, 2K, ...; 0 holds out none.
        sweeps: further sweeps by index.

    Raises:
        ReconstructError: a negative number, 1 (nothing would be left), or a camera without enough images.
    """
    for name, value in (("images_every", images_every), ("sweeps_every", sweeps_every)):
        if value < 0 or value == 1:
            raise ReconstructError(f"{name} must be 0 (none) or at least 2, got {value}")
    images = {}
    held = set(every(clip, sweeps_every)) | {int(index) for index in sweeps}
    for camera in cameras if images_every else ():
        count = len(clip.camera_times_us(camera))
        if count < images_every:
            raise ReconstructError(
                f"camera {camera!r} has {count} images, none to hold out when every {images_every}th is"
            )
        images[camera] = frozenset(range(images_every - 1, count, images_every))
        for lidar in clip.rig.lidars:
            spins = clip.sweep_times_us(lidar)
            for start, end in clip.camera_times_us(camera)[sorted(images[camera])]:
                held |= set(np.flatnonzero((spins[:, 0] <= end) & (spins[:, 1] >= start)).tolist())
    return HeldOut(images, frozenset(held))


def every(clip: Clip, step: int) -> range:
    """Sweeps K, 2K, 3K, ...; none for 0."""
    most = max((len(clip.sweep_times_us(lidar)) for lidar in clip.rig.lidars), default=0)
    return range(step, most, step) if step else range(0)


def without_images(clip: Clip, held: HeldOut) -> Clip:
    """The log without the held-out images; all sweeps remain, with their indices."""
    if not any(held.images.values()):
        return clip
    shots = {
        camera: tuple(
            Shot(int(start), int(end), clip.world_from_camera(camera, index), partial(clip.image, camera, index))
            for index, (start, end) in enumerate(clip.camera_times_us(camera))
            if index not in held.images.get(camera, frozenset())
        )
        for camera in clip.rig.cameras
    }
    turns = {
        lidar: tuple(
            Revolution(int(start), int(end), partial(clip.sweep, lidar, index))
            for index, (start, end) in enumerate(clip.sweep_times_us(lidar))
        )
        for lidar in clip.rig.lidars
    }
    return ContextClip(
        clip.id, clip.rig, clip.ego, clip.span_us, shots, turns, tuple(clip.tracks), clip.time_offset_us, clip.road_map,
        clip.ego_mask, getattr(clip, "facts", {}),
    )  # fmt: skip
