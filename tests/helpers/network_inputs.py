"""Inputs of the network made from nothing: random pictures of a pinhole camera that drives straight ahead."""

import torch
from torch.nn import functional

from nurec_sim.network.tensors import SCENE_RESCALE, NetworkInputs

RIG_FROM_CAMERA = torch.tensor([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
"""Of a camera that looks ahead, 1.5 m above the ground."""


def straight_drive(images: int, cameras: int = 1, height: int = 56, width: int = 84, clips: int = 1) -> NetworkInputs:
    """``images`` pictures of ``cameras`` cameras that look the same way, one metre from frame to frame."""
    generator = torch.Generator().manual_seed(0)
    frames = images // cameras
    forward = torch.arange(frames).repeat(cameras).float()
    c2w = torch.eye(4).repeat(clips, images, 1, 1)
    c2w[:, :, 2, 3] = SCENE_RESCALE * forward
    y, x = torch.meshgrid((torch.arange(height) + 0.5) / width * 2 - height / width,
                          (torch.arange(width) + 0.5) / width * 2 - 1, indexing="ij")  # fmt: skip
    direction = functional.normalize(torch.stack([x, y, torch.ones_like(x)], dim=-1), dim=-1)
    origin = torch.zeros(clips, images, height, width, 3)
    origin[..., 2] = forward[:, None, None]
    time = (forward / max(frames - 1, 1)).expand(clips, images)
    return NetworkInputs(
        rgb=torch.rand(clips, images, height, width, 3, generator=generator),
        c2w=c2w,
        fov=torch.full((clips, images, 2), 1.57),
        rays=torch.cat([origin, direction.expand_as(origin)], dim=-1),
        distance_to_depth_scale=direction[..., 2:].expand(clips, images, height, width, 1),
        camera_idxs=torch.arange(cameras).repeat_interleave(frames).expand(clips, images),
        time=time,
        time_before=time - 0.2,
        time_after=time + 0.2,
        rig_from_scene=RIG_FROM_CAMERA.expand(clips, 4, 4),
    )


def given(inputs: NetworkInputs) -> dict[str, torch.Tensor]:
    """The tensors that are there, by name: matches are found later, by the network."""
    return {name: value for name, value in vars(inputs).items() if value is not None}
