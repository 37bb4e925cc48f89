"""A world of one textured wall, past which a camera of any lens moves."""

import numpy as np
import torch

from nurec_sim.network.tensors import SCENE_RESCALE, NetworkInputs
from nurec_sim.reconstruct.feedforward.inputs.rays import camera_rays, pinhole_field_rad
from nurec_sim.types import CameraModel, Fisheye, Pinhole

WALL_M, STEP_M = 9.0, 0.6
RIG_FROM_CAMERA = torch.tensor([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
LENSES = {
    "pinhole": Pinhole(90.0, 90.0, 56.0, 40.0),
    "off centre": Pinhole(90.0, 96.0, 49.0, 45.0),
    "distorted": Pinhole(90.0, 90.0, 56.0, 40.0, radial=(-0.12, 0.02, 0.0, 0.0, 0.0, 0.0)),
    "fisheye": Fisheye(75.0, 75.0, 56.0, 40.0, (0.02, -0.01, 0.0, 0.0), 1.4),
}


def wall_inputs(lens, images=3, step_m=STEP_M, texture=1.0):
    """A camera that moves to the right past a wall of smooth noise, ``WALL_M`` ahead."""
    camera = CameraModel("front", 112, 80, lens, np.eye(4))
    rays, _ = camera_rays(camera)
    rays = torch.tensor(rays, dtype=torch.float32)
    generator = torch.Generator().manual_seed(5)
    waves = torch.randn(40, 2, generator=generator) * 3.0
    phase = torch.rand(40, 3, generator=generator) * 6.28
    rgb, all_rays, c2w = [], [], torch.eye(4).repeat(images, 1, 1)
    for k in range(images):
        origin = torch.tensor([k * step_m, 0.0, 0.0])
        c2w[k, :3, 3] = origin * SCENE_RESCALE
        place = origin[:2] + rays[..., :2] * (WALL_M / rays[..., 2:])
        look = (place @ waves.T)[..., None] + phase
        rgb.append(0.5 + texture * 0.06 * look.sin().sum(-2))
        all_rays.append(torch.cat([origin.expand_as(rays), rays], dim=-1))
    time = torch.linspace(0, 1, images)[None]
    return NetworkInputs(
        rgb=torch.stack(rgb)[None].clamp(0, 1),
        c2w=c2w[None],
        fov=torch.tensor([pinhole_field_rad(camera)] * images, dtype=torch.float32)[None],
        rays=torch.stack(all_rays)[None],
        distance_to_depth_scale=rays[None, None, ..., 2:].repeat(1, images, 1, 1, 1),
        camera_idxs=torch.zeros(1, images, dtype=torch.int64),
        time=time,
        time_before=time - 0.1,
        time_after=time + 0.1,
        rig_from_scene=RIG_FROM_CAMERA[None],
    )
