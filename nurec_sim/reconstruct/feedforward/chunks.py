"""One chunk of a clip: the images that go through the network together, and the layers that come out, in the world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from nurec_sim import sensors
from nurec_sim.network.tensors import NetworkInputs
from nurec_sim.types import CameraModel, DynamicGaussians, Gaussians, Matrix4


@dataclass(frozen=True)
class ContextImage:
    """One input image as the network sees it.

    ``camera`` is the resized and cropped camera, exactly; ``world_from_camera`` its poses at the start and the end of
    the exposure ``t_us``; ``frame`` its index in the log; ``target_t_us`` the target times of the motion
    decoder (the same camera's previous and next frames in the chunk).
    """

    camera: CameraModel
    frame: int
    t_us: tuple[int, int]
    target_t_us: tuple[int, int]
    world_from_camera: Float64[np.ndarray, "2 4 4"]

    @property
    def centre_t_us(self) -> int:
        """When the line of the centre pixel was exposed."""
        centre = np.array([[self.camera.width_px // 2 + 0.5, self.camera.height_px // 2 + 0.5]])
        fraction = float(sensors.shutter_fraction(self.camera, centre)[0])
        return self.t_us[0] + int(fraction * (self.t_us[1] - self.t_us[0]))


@dataclass(frozen=True)
class ChunkInputs:
    """A chunk ready for the network; ``images`` are camera-major, as is ``tensors`` (b = 1).

    ``span_us`` is what the chunk covers, ``world_from_scene`` the first image's camera at the end of its exposure,
    ``ego`` True where the log's own mask marks a pixel of the recording car.
    """

    index: int
    span_us: tuple[int, int]
    images: tuple[ContextImage, ...]
    world_from_scene: Matrix4
    tensors: NetworkInputs
    ego: Bool[np.ndarray, "v h w"]

    @property
    def camera_ids(self) -> tuple[str, ...]:
        """Cameras in the order of their indices in the network."""
        return tuple(dict.fromkeys(image.camera.id for image in self.images))


@dataclass(frozen=True)
class ChunkLayers:
    """What one chunk contributes, in the world frame, in its own canonical colours.

    ``sky`` is a cubemap as in ``GaussianScene`` (world axes), ``sky_seen`` how surely each texel was seen, 0..1.
    """

    images: tuple[ContextImage, ...]
    static: Gaussians
    dynamic: DynamicGaussians
    sky: Float32[np.ndarray, "6 s s 3"]
    sky_seen: Float32[np.ndarray, "6 s s"]
    isp: Mapping[str, Float64[np.ndarray, "3 4"]]
