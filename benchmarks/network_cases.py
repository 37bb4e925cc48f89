"""What ``network.py`` runs: profiles with a number of images, and seeded inputs for them."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nurec_sim.network.tensors import ContextMaps, NetworkInputs

STEP_M = 1.0
"""What the car drives between two frames."""


@dataclass(frozen=True)
class Case:
    """Some images of a profile's size.

    ``limit_s`` and ``limit_gb`` are what a pass must reach; ``road_shares`` the parts of each image that show road, for
    comparisons of the road branch; ``chunks`` how many passes make a clip.
    """

    profile: str
    cameras: int
    frames: int
    limit_s: float | None = None
    limit_gb: float | None = None
    device: str = "cpu"
    chunks: int = 1
    road_shares: tuple[float, ...] = ()


CASES = {
    "tiny": Case("tiny", 3, 8, 12.0, 4.0),
    "tiny-selective": Case("tiny-selective", 3, 8),
    "pa-front": Case("pa-front", 1, 2, 25.0, 4.0),
    "pa-multiview": Case("pa-multiview", 3, 1),
    "pq-front": Case("pq-front", 1, 2),
    # Twenty seconds of three cameras.
    "pa-multiview-20s": Case("pa-multiview", 3, 18, 0.5, device="cuda", chunks=2),
}
SLOT_CASES = {"pq-front": Case("pq-front", 1, 2, road_shares=(0.0, 0.02, 0.05, 0.25))}
QUICK_CASES = {"tiny": Case("tiny", 3, 1)}
QUICK_SLOTS = {"tiny-selective": Case("tiny-selective", 1, 2, road_shares=(0.0, 0.5))}


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
    origin = place[:, None, None].expand_as(direction)
    time = frame / max(case.frames - 1, 1)
    gap = 1 / max(case.frames - 1, 1)
    return NetworkInputs(
        rgb=torch.rand(1, v, height, width, 3, generator=torch.Generator().manual_seed(seed)),
        c2w=c2w[None],
        fov=torch.full((1, v, 2), math.pi / 2),
        rays=torch.cat([origin, direction], dim=-1)[None],
        distance_to_depth_scale=ray[..., 2:].expand(1, v, height, width, 1).contiguous(),
        camera_idxs=camera[None],
        time=time[None],
        time_before=(time - gap)[None],
        time_after=(time + gap)[None],
    )


def features_and_context(model: Any, inputs: NetworkInputs, road_share: float) -> tuple[Any, ContextMaps]:
    """What the decoder of a model gets, with classes replaced: road in the lower part of every image."""
    import torch

    from nurec_sim.network.tensors import SemanticClass

    features = model.encoder(inputs.rgb, inputs.c2w, inputs.fov)
    context = model.decoder.context(features, inputs, False)
    height = inputs.rgb.shape[2]
    first = height - round(height * road_share)
    logits = torch.zeros_like(context.logits)
    logits[..., SemanticClass.OTHERS] = 5.0
    logits[:, :, first:, :, SemanticClass.ROAD] = 10.0
    return features, dataclasses.replace(context, logits=logits)
