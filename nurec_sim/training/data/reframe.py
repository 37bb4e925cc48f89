"""Geometric augmentation of a clip, exact: images are cropped, the whole world is mirrored.

A crop changes field of view, aspect ratio and principal point. Mirroring swaps left and right: y is negated in the
world and x in the camera; two reflections make a rotation, so every camera frame stays right-handed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from nurec_sim.reconstruct.feedforward.inputs.crop import Crop, crop_camera, crop_exposure
from nurec_sim.training.data.clips import FrameTruth, TrueClip
from nurec_sim.types import (
    Box,
    CameraModel,
    Rig,
    RoadMap,
    Shutter,
    Sweep,
    Trajectory,
)

_WORLD_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
_CAMERA_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
_MIRRORED_SHUTTER = {Shutter.LEFT_TO_RIGHT: Shutter.RIGHT_TO_LEFT, Shutter.RIGHT_TO_LEFT: Shutter.LEFT_TO_RIGHT}


@dataclasses.dataclass(frozen=True)
class Cut:
    """The part of an image that is kept: upper left corner and size, integer pixels."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int


class ReframedClip:
    """A clip whose cameras are cropped to ``cuts`` and optionally mirrored (``TrueClip``).

    Cameras keep their ids, so after mirroring the one called left looks to the right.

    Raises:
        ValueError: a cut exceeds the image, or a camera behind a windshield is to be mirrored.
    """

    def __init__(self, clip: TrueClip, cuts: Mapping[str, Cut], mirrored: bool = False) -> None:
        self._clip, self._mirrored = clip, mirrored
        self._crops: dict[str, Crop] = {}
        for name, camera in clip.rig.cameras.items():
            cut = cuts.get(name, Cut(0, 0, camera.width_px, camera.height_px))
            right, lower = cut.x_px + cut.width_px, cut.y_px + cut.height_px
            if min(cut.x_px, cut.y_px) < 0 or right > camera.width_px or lower > camera.height_px:
                raise ValueError(f"{cut} reaches out of {camera.width_px} x {camera.height_px} pixels of {name!r}")
            full = (camera.width_px, camera.height_px)
            self._crops[name] = Crop(full, (cut.x_px, cut.y_px), (cut.width_px, cut.height_px), align_corners=False)
        cameras = {name: crop_camera(camera, self._crops[name]) for name, camera in clip.rig.cameras.items()}
        if mirrored:
            cameras = {name: mirrored_camera(camera) for name, camera in cameras.items()}
        (x, y, z), size = clip.rig.body.center_m, clip.rig.body.size_m
        self.rig = Rig(cameras, {}, Box((x, -y if mirrored else y, z), size))
        self.ego = self._path(clip.ego)
        self.tracks = tuple(dataclasses.replace(track, path=self._path(track.path)) for track in clip.tracks)

    @property
    def id(self) -> str:
        """That of the clip."""
        return self._clip.id

    @property
    def road_map(self) -> RoadMap | None:
        """None."""
        return None

    @property
    def span_us(self) -> tuple[int, int]:
        """That of the clip."""
        return self._clip.span_us

    @property
    def time_offset_us(self) -> int:
        """That of the clip."""
        return self._clip.time_offset_us

    def camera_times_us(self, camera_id: str) -> Int64[np.ndarray, "frames 2"]:
        """Exposure start and end of every frame; cropping lines of a rolling shutter shortens the exposure."""
        whole = self._clip.camera_times_us(camera_id)
        return np.array([self._exposure(camera_id, index)[0] for index in range(len(whole))], np.int64)

    def world_from_camera(self, camera_id: str, index: int) -> Float64[np.ndarray, "2 4 4"]:
        """Camera poses at the start and the end of the exposure."""
        poses = self._exposure(camera_id, index)[1]
        return _WORLD_MIRROR @ poses @ _CAMERA_MIRROR if self._mirrored else poses

    def image(self, camera_id: str, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """One RGB frame."""
        return self._part(camera_id, self._clip.image(camera_id, index))

    def truth(self, camera_id: str, index: int) -> FrameTruth:
        """Ground truth of one frame."""
        whole = self._clip.truth(camera_id, index)
        parts = {name: self._part(camera_id, array) for name, array in vars(whole).items()}
        if self._mirrored:
            parts["normal"] = parts["normal"] * np.array([-1, 1, 1], np.float32)
        return FrameTruth(**parts)

    def sweep_times_us(self, lidar_id: str) -> Int64[np.ndarray, "sweeps 2"]:
        """No sweeps."""
        return self._clip.sweep_times_us(lidar_id)

    def sweep(self, lidar_id: str, index: int) -> Sweep:
        """As in the clip, which has none."""
        return self._clip.sweep(lidar_id, index)

    def ego_mask(self, camera_id: str) -> None:
        """The car does not see itself."""

    def _exposure(self, camera_id: str, index: int) -> tuple[tuple[int, int], Float64[np.ndarray, "2 4 4"]]:
        start_us, end_us = (int(t) for t in self._clip.camera_times_us(camera_id)[index])
        poses = self._clip.world_from_camera(camera_id, index)
        return crop_exposure(self._clip.rig.cameras[camera_id], self._crops[camera_id], (start_us, end_us), poses)

    def _part(self, camera_id: str, whole: np.ndarray) -> np.ndarray:
        (x, y), (width, height) = self._crops[camera_id].offset, self._crops[camera_id].size
        part = whole[y : y + height, x : x + width]
        return np.ascontiguousarray(part[:, ::-1] if self._mirrored else part)

    def _path(self, path: Trajectory) -> Trajectory:
        if not self._mirrored:
            return path
        # Conjugation: the body frame is mirrored too, so that rotations stay proper (determinant 1).
        return Trajectory(path.t_us, _WORLD_MIRROR @ path.world_from_body @ _WORLD_MIRROR)


def mirrored_camera(camera: CameraModel) -> CameraModel:
    """The camera that takes mirrored images in the mirrored world.

    Raises:
        ValueError: it is behind a windshield, whose polynomials have no simple mirror image.
    """
    if camera.windshield is not None:
        raise ValueError(f"camera {camera.id!r} is behind a windshield and cannot be mirrored")
    return dataclasses.replace(
        camera,
        lens=camera.lens.mirrored(camera.width_px),
        shutter=_MIRRORED_SHUTTER.get(camera.shutter, camera.shutter),
        rig_from_camera=_WORLD_MIRROR @ camera.rig_from_camera @ _CAMERA_MIRROR,
    )
