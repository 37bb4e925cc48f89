"""What ``network.py`` runs: profiles with a number of images, seeded inputs for them, and a drive to reconstruct."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from nurec_sim import geometry
from nurec_sim.types import CameraModel, Pinhole, Rig, RoadMap, Sweep, Track, Trajectory

if TYPE_CHECKING:
    from nurec_sim.network.tensors import ContextMaps, NetworkInputs

STEP_M = 1.0
"""What the car drives between two images of a camera."""
FRAME_US = 100_000
START_US = 2_000_000
SPEED_MPS = 10.0
CAMERA_YAWS = {"front": 0.0, "left": 1.0, "right": -1.0}
RIG_FROM_FRONT = np.array([[0.0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.4], [0, 0, 0, 1]])


@dataclass(frozen=True)
class Case:
    """Something to time: a pass over images, a comparison of road slots, or a whole clip.

    Attributes:
        profile: of the network.
        cameras: number of cameras.
        frames: images per camera of a pass.
        device: ``cpu`` or ``cuda``.
        limit_s: seconds of wall time that it must not exceed.
        limit_gb: the same for the peak memory of its process.
        road_shares: parts of each image that show road, for comparisons of the selective decoder's two rules.
        clip_s: length of the clip to reconstruct, in place of a pass.
    """

    profile: str
    cameras: int
    frames: int
    device: str = "cpu"
    limit_s: float | None = None
    limit_gb: float | None = None
    road_shares: tuple[float, ...] = ()
    clip_s: float | None = None


CASES: Mapping[str, Case] = {
    "tiny": Case("tiny", 3, 8, limit_s=12.0, limit_gb=4.0),
    "tiny-selective": Case("tiny-selective", 3, 8),
    "pa-front": Case("pa-front", 1, 2, limit_s=25.0, limit_gb=4.0),
    "pa-multiview": Case("pa-multiview", 3, 1),
    "pq-front": Case("pq-front", 1, 2),
    "pq-front-slots": Case("pq-front", 1, 1, road_shares=(0.0, 0.02, 0.05, 0.25)),
    "tiny-clip": Case("tiny", 3, 18, clip_s=20.0),
    "pa-multiview-chunk": Case("pa-multiview", 3, 18, "cuda"),
    "pa-multiview-clip": Case("pa-multiview", 3, 18, "cuda", limit_s=0.5, clip_s=20.0),
}
QUICK_CASES: Mapping[str, Case] = {
    "tiny-quick": Case("tiny", 3, 1),
    "tiny-quick-slots": Case("tiny-selective", 1, 2, road_shares=(0.0, 0.05)),
    "tiny-quick-clip": Case("tiny", 1, 2, clip_s=1.0),
}


def inputs_of(case: Case, seed: int) -> NetworkInputs:
    """Random pictures of pinhole cameras with 90 degrees across, on a car that drives ahead."""
    import torch

    from nurec_sim.network import PROFILES
    from nurec_sim.network.tensors import SCENE_RESCALE, NetworkInputs

    profile = PROFILES[case.profile]
    width, height, v = profile.width_px, profile.height_px, case.cameras * case.frames
    columns, rows = torch.meshgrid(torch.arange(width) + 0.5, torch.arange(height) + 0.5, indexing="xy")
    focal = width / 2
    ray = torch.stack([(columns - width / 2) / focal, (rows - height / 2) / focal, torch.ones_like(columns)], dim=-1)
    ray = ray / ray.norm(dim=-1, keepdim=True)
    camera = torch.arange(case.cameras).repeat_interleave(case.frames)
    frame = torch.arange(case.frames).repeat(case.cameras)
    yaw = camera * (math.pi / 3)
    c2w = torch.eye(4).repeat(v, 1, 1)
    c2w[:, 0, 0], c2w[:, 0, 2], c2w[:, 2, 0], c2w[:, 2, 2] = yaw.cos(), yaw.sin(), -yaw.sin(), yaw.cos()
    place = torch.stack([0 * frame, 0 * frame, STEP_M * frame], dim=-1)
    c2w[:, :3, 3] = SCENE_RESCALE * place
    direction = torch.einsum("vij,hwj->vhwi", c2w[:, :3, :3], ray)
    gap = 1 / max(case.frames - 1, 1)
    time = frame * gap
    return NetworkInputs(
        rgb=torch.rand(1, v, height, width, 3, generator=torch.Generator().manual_seed(seed)),
        c2w=c2w[None],
        fov=torch.full((1, v, 2), math.pi / 2),
        rays=torch.cat([place[:, None, None].expand_as(direction), direction], dim=-1)[None],
        distance_to_depth_scale=ray[..., 2:].expand(1, v, height, width, 1).contiguous(),
        camera_idxs=camera[None],
        time=time[None],
        time_before=(time - gap)[None],
        time_after=(time + gap)[None],
        rig_from_scene=torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])[None],
    )


def features_and_context(model: Any, inputs: NetworkInputs, road_share: float) -> tuple[Any, ContextMaps]:
    """What the decoder of a model gets, with classes replaced: road in the lower part of every image."""
    import torch

    from nurec_sim.network.tensors import SemanticClass

    features = model.features(inputs)
    context = model.decoder.context(features, inputs, False)
    height = inputs.rgb.shape[2]
    logits = torch.zeros_like(context.logits)
    logits[..., SemanticClass.OTHERS] = 5.0
    logits[:, :, height - round(height * road_share) :, :, SemanticClass.ROAD] = 10.0
    return features, dataclasses.replace(context, logits=logits)


class Drive:
    """A clip in memory: a straight drive with cameras of 1920x1080 at 10 Hz that see coloured clouds; no LiDAR."""

    def __init__(self, cameras: int, seconds: float) -> None:
        self.id, self.time_offset_us = "drive", 0
        count = round(seconds * 1e6 / FRAME_US)
        lens = Pinhole(960.0, 960.0, 960.0, 540.0)
        self.rig = Rig(
            {
                name: CameraModel(name, 1920, 1080, lens, geometry.pose_from_xyyaw(0, 0, yaw) @ RIG_FROM_FRONT)
                for name, yaw in list(CAMERA_YAWS.items())[:cameras]
            },
            {},
        )
        t_us = START_US + FRAME_US * np.arange(count)
        self.ego = Trajectory(
            t_us, np.array([geometry.pose_from_xyyaw(SPEED_MPS * 1e-6 * (t - START_US), 0, 0) for t in t_us])
        )
        self.tracks: tuple[Track, ...] = ()
        self.road_map: RoadMap | None = None
        self.span_us = (START_US, START_US + FRAME_US * count)
        clouds = np.random.default_rng(0).integers(0, 256, (5, 9, 16, 3), np.uint8)
        self.pictures = [cv2.resize(cloud, (1920, 1080), interpolation=cv2.INTER_CUBIC) for cloud in clouds]

    def camera_times_us(self, camera_id: str) -> np.ndarray:
        """Start and end of every exposure."""
        return np.stack([self.ego.t_us, self.ego.t_us], axis=1)

    def world_from_camera(self, camera_id: str, index: int) -> np.ndarray:
        """Poses at the start and the end of an exposure."""
        pose = self.ego.world_from_body[index] @ self.rig.cameras[camera_id].rig_from_camera
        return np.stack([pose, pose])

    def image(self, camera_id: str, index: int) -> np.ndarray:
        """One of a few pictures."""
        return self.pictures[index % len(self.pictures)]

    def sweep_times_us(self, lidar_id: str) -> np.ndarray:
        """There is no LiDAR."""
        raise KeyError(lidar_id)

    def ego_mask(self, camera_id: str) -> None:
        """The car does not see itself."""

    def sweep(self, lidar_id: str, index: int) -> Sweep:
        """There is no LiDAR."""
        raise KeyError(lidar_id)
