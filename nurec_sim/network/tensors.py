"""Inputs and outputs of the network.

b clips, v images (camera-major, the same number for every camera), h x w pixels. The *scene frame* is the first image's
camera at the end of its exposure: x right, y down, z forward, metres.
"""

from __future__ import annotations

import dataclasses
import enum
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

SCENE_RESCALE = 0.15
"""Metres to the network's internal unit: 0.15 units per metre, in poses, depths, scales and motion."""


class SemanticClass(enum.IntEnum):
    """Order of the semantic logits."""

    OTHERS = 0
    EGO = 1
    SKY = 2
    ROAD = 3
    MOVABLE = 4


@dataclass(frozen=True)
class NetworkInputs:
    """Images and their geometry; names are those of the released model's inputs.

    Attributes:
        rgb: colours in 0..1.
        c2w: scene_from_camera at the end of exposure, translation times ``SCENE_RESCALE``.
        fov: horizontal and vertical field of view of a pinhole like the camera, radians.
        rays: origin (metres) and unit direction of every pixel in the scene frame, at the instant it was exposed.
        distance_to_depth_scale: z of the pixel's unit ray in its camera.
        camera_idxs: index of each image's camera, 0.. in the order of the images.
        time: when each image's centre was exposed, as a fraction of the clip's span (0..1).
        time_before: target time of the first displacement, as such a fraction: the camera's previous frame.
        time_after: the same for the camera's next frame.
        rig_from_scene: pose of the scene frame in the rig, metres; read by our own profiles (``car_view``) only.
        matches: the result of ``plane_sweep`` on these inputs, if it has been computed already.
    """

    rgb: Float[Tensor, "b v h w 3"]
    c2w: Float[Tensor, "b v 4 4"]
    fov: Float[Tensor, "b v 2"]
    rays: Float[Tensor, "b v h w 6"]
    distance_to_depth_scale: Float[Tensor, "b v h w 1"]
    camera_idxs: Int64[Tensor, "b v"]
    time: Float[Tensor, "b v"]
    time_before: Float[Tensor, "b v"]
    time_after: Float[Tensor, "b v"]
    rig_from_scene: Float[Tensor, "b 4 4"] | None = None
    matches: Float[Tensor, "b v h w 4"] | None = None

    def to(self, device: torch.device | str) -> NetworkInputs:
        """The same on another device."""
        present = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if getattr(self, f.name) is not None}
        return NetworkInputs(**{name: value.to(device) for name, value in present.items()})


@dataclass(frozen=True)
class ContextMaps:
    """Predictions of the heads for every input pixel.

    Attributes:
        depth_m: z-depth, metres.
        rgb: canonical colour, 0..1.
        normal: unit normal in the scene frame.
        logits: in the order of ``SemanticClass``.
        motion_m: displacement to ``time_before`` and to ``time_after``, metres; None if not requested.
    """

    depth_m: Float[Tensor, "b v h w"]
    rgb: Float[Tensor, "b v h w 3"]
    normal: Float[Tensor, "b v h w 3"]
    logits: Float[Tensor, "b v h w 5"]
    motion_m: Float[Tensor, "b v h w 2 3"] | None


@dataclass(frozen=True)
class QueryGaussians:
    """Gaussians in the scene frame, one per query point, in activated units.

    ``source`` is the flat (v, h, w) index of the pixel that each was lifted from; ``semantic`` its arg-max class;
    ``motion_m`` as in ``ContextMaps``. Selective slots that hold no valid point do not occur here.
    """

    position_m: Float[Tensor, "b n 3"]
    quat_wxyz: Float[Tensor, "b n 4"]
    scale_m: Float[Tensor, "b n 3"]
    opacity: Float[Tensor, "b n"]
    rgb: Float[Tensor, "b n 3"]
    normal: Float[Tensor, "b n 3"]
    semantic: Int64[Tensor, "b n"]
    source: Int64[Tensor, "b n"]
    motion_m: Float[Tensor, "b n 2 3"] | None


@dataclass(frozen=True)
class NetworkOutputs:
    """Everything that one forward pass returns.

    Attributes:
        context: maps of the input images.
        gaussians: the Gaussians, static and moving alike.
        sky: cubemap of colours in 0..1 in the scene frame, faces as in ``cubemap.py``.
        sky_seen: how surely each texel was seen, 0..1 (all 1 for the learned sky).
        sky_learned: whether the sky comes from the learned decoder, or from the colours of pixels that show sky.
        isp: per camera, shown = ``isp[..., :3] @ colour + isp[..., 3]``, clamped to 0..1, after sky compositing.
    """

    context: ContextMaps
    gaussians: QueryGaussians
    sky: Float[Tensor, "b 6 s s 3"]
    sky_seen: Float[Tensor, "b 6 s s 1"]
    sky_learned: bool
    isp: Float[Tensor, "b cameras 3 4"]
