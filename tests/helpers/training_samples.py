"""Small training samples whose truth is exact by construction: a plane of ground seen while driving straight on."""

import contextlib
import dataclasses
import itertools

import numpy as np
import torch
from torch.nn import functional

from nurec_sim.network.tensors import SCENE_RESCALE, NetworkInputs, SemanticClass
from nurec_sim.reconstruct.feedforward.inputs.rays import camera_rays, pinhole_field_rad, scene_rays
from nurec_sim.training.config import TrainingConfig, checked_config
from nurec_sim.training.data.sample import TargetView, TrainingSample, TrueMaps
from nurec_sim.types import CameraModel, Pinhole

CAMERA_HEIGHT_M = 1.5
STEP_M = 1.0
RIG_FROM_CAMERA = torch.tensor([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, CAMERA_HEIGHT_M], [0, 0, 0, 1]])


def ground_sample(seed=0, width=56, height=42, images=2, targets=1):
    """Images of a coloured plane 1.5 m below the camera, which moves 1 m from each image to the next."""
    camera = CameraModel("front", width, height, Pinhole(0.7 * width, 0.7 * width, width / 2, height / 2), np.eye(4))
    rays, _ = camera_rays(camera)
    poses = np.tile(np.eye(4), (images, 1, 1))
    poses[:, 2, 3] = STEP_M * np.arange(images)
    down = rays[..., 1] > 0.05
    depth = np.where(down, CAMERA_HEIGHT_M * rays[..., 2] / np.where(down, rays[..., 1], 1), 0)
    depth = torch.tensor(depth, dtype=torch.float32)
    semantic = torch.where(depth > 0, int(SemanticClass.ROAD), int(SemanticClass.SKY))
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(images, 3, 4, 5, generator=generator)
    rgb = functional.interpolate(coarse, (height, width), mode="bilinear").permute(0, 2, 3, 1)
    scene = [scene_rays(camera, rays, np.stack([pose, pose])) for pose in poses]
    c2w = torch.tensor(poses, dtype=torch.float32)[None].clone()
    c2w[..., :3, 3] *= SCENE_RESCALE
    time = torch.linspace(0, 1, images)[None]
    inputs = NetworkInputs(
        rgb=rgb[None],
        c2w=c2w,
        fov=torch.tensor([pinhole_field_rad(camera)] * images, dtype=torch.float32)[None],
        rays=torch.tensor(np.stack(scene), dtype=torch.float32)[None],
        distance_to_depth_scale=torch.tensor(rays[None, None, ..., 2:], dtype=torch.float32).repeat(1, images, 1, 1, 1),
        camera_idxs=torch.zeros(1, images, dtype=torch.int64),
        time=time,
        time_before=time - 0.5,
        time_after=time + 0.5,
        rig_from_scene=RIG_FROM_CAMERA[None],
    )
    normal = torch.zeros(1, images, height, width, 3)
    normal[..., 1] = -1
    normal[semantic.expand(1, images, -1, -1) == SemanticClass.SKY] = 0
    truth = TrueMaps(
        depth_m=depth.repeat(1, images, 1, 1),
        normal=normal,
        semantic=semantic.repeat(1, images, 1, 1),
        motion_m=torch.zeros(1, images, height, width, 2, 3),
        motion_known=torch.ones(1, images, height, width, dtype=torch.bool),
    )
    views = tuple(
        TargetView(camera, 0, np.stack([poses[k % images]] * 2), float(time[0, k % images]), rgb[k % images], depth,
                   semantic)
        for k in range(targets)
    )  # fmt: skip
    return TrainingSample(f"ground-{seed}", inputs, truth, views)


def with_moving_block(sample, shift_m=(0.5, 0.0, 0.0)):
    """The same with a block of pixels that is movable and moves."""
    semantic, motion = sample.truth.semantic.clone(), sample.truth.motion_m.clone()
    semantic[..., 30:36, 10:20] = SemanticClass.MOVABLE
    motion[..., 30:36, 10:20, 1, :] = torch.tensor(shift_m)
    motion[..., 30:36, 10:20, 0, :] = -torch.tensor(shift_m)
    return dataclasses.replace(sample, truth=dataclasses.replace(sample.truth, semantic=semantic, motion_m=motion))


class GroundSamples:
    """Sample k by its number."""

    def stream(self, stage, step, processes):
        numbers = itertools.count(step * processes.count + processes.rank, processes.count)
        return contextlib.nullcontext(ground_sample(k % 4, targets=stage.targets) for k in numbers)

    def data_hash(self):
        return "ground"


def small_config(**changes) -> TrainingConfig:
    """A recipe of the three stages in a few steps."""
    raw = {
        "stages": [
            {"name": "context", "steps": 3, "trains": ["encoder", "context"], "warm_up": 2},
            {"name": "motion", "steps": 2, "trains": ["encoder", "context", "motion", "sky"], "warm_up": 1},
            {"name": "gaussians", "steps": 3, "trains": ["context", "sky", "gaussians", "isp"], "targets": 1,
             "warm_up": 1},
        ],
        "log_every": 1, "checkpoint_every": 100, "sample_every": 100,
    }  # fmt: skip
    return checked_config(raw | changes, "recipe")


def mean_difference(image, truth):
    """Stands for the perceptual term."""
    return (image - truth).abs().mean()
