"""Small chunks of a clip, as the network's layers come out of them."""

from __future__ import annotations

import numpy as np
from render_scenes import CAMERA_AXES, camera

from nurec_sim import geometry
from nurec_sim.reconstruct.feedforward.chunks import ChunkLayers, ContextImage
from nurec_sim.types import DynamicGaussians, Gaussians


def image(sensor, x=0.0, yaw=0.0, moves_m=0.0, turns_rad=0.0) -> ContextImage:
    """An image of a camera that looks forward from (x, 0, 0), and comes there from behind during its exposure."""
    end = geometry.pose_from_xyyaw(x, 0.0, yaw) @ CAMERA_AXES
    start = geometry.pose_from_xyyaw(x - moves_m, 0.0, yaw - turns_rad) @ CAMERA_AXES
    return ContextImage(sensor, 0, (1_000_000, 1_030_000), (900_000, 1_100_000), np.stack([start, end]))


def chunk(static=None, images=None, isp=None, sky=0.5, seen=1.0, dynamic=None, size=4) -> ChunkLayers:
    return ChunkLayers(
        images=tuple(images or [image(camera())]),
        static=Gaussians.empty() if static is None else static,
        dynamic=DynamicGaussians.empty() if dynamic is None else dynamic,
        sky=np.broadcast_to(np.float32(sky), (6, size, size, 3)).copy(),
        sky_seen=np.full((6, size, size), seen, np.float32),
        isp={"front": np.eye(3, 4)} if isp is None else isp,
    )


def drive(sensor, first_x, frames=4, step_m=5.0, moves_m=0.3):
    return [image(sensor, first_x + step_m * k, yaw=0.03 * k, moves_m=moves_m, turns_rad=0.01) for k in range(frames)]
