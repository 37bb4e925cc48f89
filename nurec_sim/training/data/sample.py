"""One training sample: inputs of the network, their ground truth, and target views to render.

b clips (1), v context images (camera-major), h x w pixels. The *scene frame* is that of ``network.tensors``: the first
image's camera at the end of its exposure, metres. Times are fractions of the sample's span, as in ``NetworkInputs``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from nurec_sim.network.tensors import NetworkInputs
from nurec_sim.types import CameraModel


@dataclass(frozen=True)
class TrueMaps:
    """Ground truth of the context images.

    Attributes:
        depth_m: z-depth in the camera, 0 for sky or unknown.
        normal: unit surface normals in the scene frame, towards the camera; zeros where unknown.
        semantic: ``network.tensors.SemanticClass``, -1 where unknown.
        motion_m: displacement of the pixel's point to ``time_before`` and ``time_after``; zeros on static surfaces.
        motion_known: mask of valid ``motion_m``.
    """

    depth_m: Float[Tensor, "b v h w"]
    normal: Float[Tensor, "b v h w 3"]
    semantic: Int64[Tensor, "b v h w"]
    motion_m: Float[Tensor, "b v h w 2 3"]
    motion_known: Bool[Tensor, "b v h w"]


@dataclass(frozen=True, eq=False)
class TargetView:
    """A target view to render and compare with.

    Attributes:
        camera: camera model of the resized and cropped image.
        camera_idx: index of its camera response, as in ``NetworkInputs.camera_idxs``.
        scene_from_camera: poses at the start and the end of the exposure.
        time: time of the exposure.
        rgb: colours in 0..1, with the same camera response as the context images of this camera.
        depth_m: z-depth, 0 for sky or unknown.
        semantic: ``SemanticClass``, -1 where unknown.
    """

    camera: CameraModel
    camera_idx: int
    scene_from_camera: Float64[np.ndarray, "2 4 4"]
    time: float
    rgb: Float[Tensor, "h w 3"]
    depth_m: Float[Tensor, "h w"]
    semantic: Int64[Tensor, "h w"]


@dataclass(frozen=True, eq=False)
class TrainingSample:
    """One sample of a step; ``id`` names its clip and window."""

    id: str
    inputs: NetworkInputs
    truth: TrueMaps
    targets: tuple[TargetView, ...]
