"""A training sample made from nothing: a striped road, a box on it and a sky, seen by a camera that drives on."""

import numpy as np
import torch
from network_inputs import straight_drive

from nurec_sim.network.tensors import ContextMaps, NetworkInputs, SemanticClass
from nurec_sim.training.sample import TargetView, TrainingSample, TrueMaps
from nurec_sim.types import CameraModel, Pinhole

CAMERA_HEIGHT_M, BOX_M, FARTHEST_M = 1.6, 14.0, 200.0


def plain_sample(images: int = 3, height: int = 56, width: int = 84, targets: int = 2) -> TrainingSample:
    """Camera frame of the first image is the scene frame; each next image is one metre further on."""
    inputs = straight_drive(images, height=height, width=width)
    truth, rgb = [], []
    for k in range(images):
        rays = inputs.rays[0, k, ..., 3:].numpy()
        depth, normal, semantic, colour = _look(rays, float(k))
        truth.append((depth, normal, semantic))
        rgb.append(colour)
    stack = lambda index: torch.from_numpy(np.stack([each[index] for each in truth]))[None]  # noqa: E731
    zeros = torch.zeros(1, images, height, width, 2, 3)
    maps = TrueMaps(stack(0), stack(1), stack(2), zeros, torch.ones(1, images, height, width, dtype=torch.bool))
    seen = {name: getattr(inputs, name) for name in NetworkInputs.__dataclass_fields__}
    seen["rgb"] = torch.from_numpy(np.stack(rgb))[None]
    views = tuple(_view(0.5 + k, inputs.rays[0, 0, ..., 3:].numpy(), images) for k in range(targets))
    return TrainingSample("plain", NetworkInputs(**seen), maps, views)


def true_context(sample: TrainingSample) -> ContextMaps:
    """What a network would say that knows everything."""
    truth = sample.truth
    logits = 10.0 * torch.nn.functional.one_hot(truth.semantic, len(SemanticClass)).float()
    return ContextMaps(truth.depth_m.clamp(min=0.1), sample.inputs.rgb, truth.normal, logits, truth.motion_m)


def _look(rays: np.ndarray, along_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Depth, normals, classes and colours along unit rays from a camera that has gone so far."""
    per_depth = rays / rays[..., 2:]
    ground = np.where(per_depth[..., 1] > 1e-3, CAMERA_HEIGHT_M / per_depth[..., 1].clip(1e-3), FARTHEST_M)
    depth = np.where(ground < FARTHEST_M, ground, 0)
    ahead = BOX_M - along_m
    beside, below = per_depth[..., 0] * ahead, per_depth[..., 1] * ahead
    box = (np.abs(beside - 1) < 1.2) & (below > -0.8) & (below < CAMERA_HEIGHT_M)
    stripes = np.sin(2 * np.pi * (depth + along_m) / 4) * (np.abs(per_depth[..., 0] * depth + 1.5) < 0.15) > 0
    sky = (depth == 0) & ~box
    semantic = np.where(sky, SemanticClass.SKY, SemanticClass.ROAD)
    semantic = np.where(box, SemanticClass.MOVABLE, semantic).astype(np.int64)
    depth = np.where(box, ahead, depth).astype(np.float32)
    normal = np.where(sky[..., None], 0, np.where(box[..., None], [0, 0, -1], [0, -1, 0])).astype(np.float32)
    colour = np.where(stripes[..., None], 0.95, np.array([0.35, 0.35, 0.37]))
    colour = np.where(sky[..., None], [0.4, 0.6, 0.9] + 0.3 * per_depth[..., 1:2], colour)
    colour = np.where(box[..., None], np.array([0.8, 0.2, 0.1]) + 0.1 * np.sign(np.sin(8 * beside))[..., None], colour)
    return depth, normal, semantic, colour.clip(0, 1).astype(np.float32)


def _view(along_m: float, rays: np.ndarray, images: int) -> TargetView:
    height, width = rays.shape[:2]
    depth, _, semantic, rgb = _look(rays, along_m)
    camera = CameraModel(
        "front", width, height, Pinhole(width / 2, width / 2, width / 2, height / 2), rig_from_camera=np.eye(4)
    )
    pose = np.tile(np.eye(4), (2, 1, 1))
    pose[:, 2, 3] = along_m
    parts = (torch.from_numpy(each) for each in (rgb, depth, semantic))
    return TargetView(camera, 0, pose, along_m / max(images - 1, 1), *parts)
