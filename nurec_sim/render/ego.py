"""The ego vehicle over rendered images: what its own cameras saw of it, as the scene keeps it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8

from nurec_sim import sensors
from nurec_sim.render.cpu.grid import grid_key
from nurec_sim.types import CameraFrame, CameraModel, Rig


class Overlay(NamedTuple):
    """A picture to blend over an image: colours [h,w,3], 0 to 255, multiplied by their cover [h,w,1], 0 to 1."""

    colour: Float32[np.ndarray, "h w 3"]
    cover: Float32[np.ndarray, "h w 1"]

    @classmethod
    def of(cls, premultiplied: Float32[np.ndarray, "h w 4"]) -> Overlay:
        """From colours that are multiplied by alpha, and alpha from 0 to 1."""
        return cls(premultiplied[..., :3], premultiplied[..., 3:])

    def over(self, rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """The image with the picture over it."""
        return np.rint(self.colour + (1 - self.cover) * rgb).astype(np.uint8)


class EgoOverlays:
    """The scene's images of the ego vehicle, brought into the lens and the size of requested cameras.

    Args:
        images: RGBA by camera id, ``GaussianScene.ego_images``.
        rig: the rig whose cameras saw them.
    """

    def __init__(self, images: Mapping[str, UInt8[np.ndarray, "h w 4"]], rig: Rig) -> None:
        self._images, self._rig = images, rig
        self._latest: dict[str, tuple[tuple, Overlay]] = {}

    def over(self, frame: CameraFrame) -> CameraFrame:
        """The frame with the ego vehicle over its colours; the same frame if the camera does not see it."""
        camera = frame.camera
        if camera.id not in self._images:
            return frame
        key = grid_key(camera)
        latest = self._latest.get(camera.id)
        if latest is None or latest[0] != key:
            latest = self._latest[camera.id] = key, self._resampled(camera)
        return dataclasses.replace(frame, rgb=latest[1].over(frame.rgb))

    def _resampled(self, camera: CameraModel) -> Overlay:
        import cv2

        own = self._rig.cameras[camera.id]
        layers: np.ndarray = self._images[camera.id].astype(np.float32)
        # Multiplied by alpha, so that colours of transparent pixels do not bleed in.
        layers[..., 3:] /= 255
        layers[..., :3] *= layers[..., 3:]
        # Averaged first: the look-up below takes four pixels only.
        reduction = max(1, round(own.width_px / camera.width_px))
        if reduction > 1:
            own = sensors.scaled_camera(own, own.width_px // reduction, own.height_px // reduction)
            layers = cv2.resize(layers, (own.width_px, own.height_px), interpolation=cv2.INTER_AREA)
        rays, seen = sensors.pixel_rays(camera)
        uv, valid = sensors.project(own, rays.reshape(-1, 3))
        valid = (valid & sensors.in_image(own, uv)).reshape(seen.shape) & seen
        u, v = np.nan_to_num(uv).reshape(*seen.shape, 2).astype(np.float32).transpose(2, 0, 1) - 0.5
        resampled = cv2.remap(layers, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return Overlay.of(resampled * valid[..., None])
