"""Small worlds, sensors and poses for the tests of gradients, and the outputs of the float64 reference."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from render_scenes import CAMERA_AXES, START_US, camera, cloud, moved

from nurec_sim import geometry, sensors
from nurec_sim.render import spec
from nurec_sim.render.cpu.backward.gradients import render_camera, render_lidar
from nurec_sim.render.layers import view_colour
from nurec_sim.render.rays import ray_grid, reference_pose, world_rays
from nurec_sim.types import Fisheye, Gaussians, Pinhole, SensorRequest, Shutter

SMALL = {
    "pinhole": camera(24, 16, Pinhole(17.0, 18.0, 11.5, 8.5)),
    "fisheye": camera(24, 16, Fisheye(8.0, 8.0, 12.0, 8.0, (0.02, -0.005, 0, 0), max_angle_rad=1.3)),
    "rolling": camera(24, 16, Pinhole(17.0, 18.0, 11.5, 8.5), Shutter.TOP_TO_BOTTOM),
    "lidar": sensors.lidar_model("VLP-16", np.eye(4), columns=40),
}


def world(n=40, sh=0, seed=1, around=False):
    """Gaussians in front of or around the sensor, float64, quaternions of any norm, every intensity known."""
    made = cloud(n, seed, low=(-7, -7, -2) if around else (3, -3, -2), high=(7, 7, 2) if around else (9, 3, 2), sh=sh)
    rng = np.random.default_rng(seed)
    made = dataclasses.replace(
        made, intensity=rng.random(n), scale_m=made.scale_m * 1.5 + 0.03, quat_wxyz=made.quat_wxyz * 2
    )
    if around:
        made = dataclasses.replace(made, ray_drop=rng.random(n))
    values = {f.name: getattr(made, f.name) for f in dataclasses.fields(made)}
    # What float32 holds exactly, so that both renderers see the same.
    return Gaussians(
        **{
            k: v.astype(np.float32).astype(np.float64) if v is not None and k != "label" else v
            for k, v in values.items()
        }
    )


def reference(made, sensor, pair, sky=None):
    """The outputs of ``gradients`` by the float64 reference."""
    request = SensorRequest("test", sensor, START_US, START_US + 30_000, pair)
    grid = ray_grid(sensor)
    pose, _ = reference_pose(request, grid.reference)
    centre = geometry.transform_points(geometry.inverse(pose), made.mean_m)
    depth = np.linalg.norm(centre, axis=-1) if grid.by_range else centre[:, 2]
    order = np.argsort(depth, kind="stable")
    order = order[depth[order] >= grid.near_m]
    lidar = sensor is SMALL["lidar"]
    colour = made.rgb if made.sh_rest is None else view_colour(made.rgb, made.sh_rest, made.mean_m - pose[:3, 3])
    known = np.isfinite(made.intensity)
    drop = np.zeros(len(made)) if made.ray_drop is None else made.ray_drop
    values = np.stack([np.where(known, made.intensity, 0), known, drop], axis=1) if lidar else colour
    origin, direction = world_rays(request, grid)
    sums = spec.blend_rays(made, values, order, origin, direction, grid.near_m, grid.valid)
    mean = sums.distance / np.maximum(sums.alpha, spec.MIN_ALPHA)
    if lidar:
        intensity = sums.features[..., 0] / np.maximum(sums.features[..., 1], 1e-12)
        return {"range": np.where(sums.half > 0, sums.half, mean), "distance": mean, "intensity": intensity,
                "alpha": sums.alpha,
                "ray_drop": sums.features[..., 2] / np.maximum(sums.alpha, spec.MIN_ALPHA)}  # fmt: skip
    behind = np.zeros((*sums.alpha.shape, 3)) if sky is None else spec.sky_colour(sky, direction)
    rgb = np.where(grid.valid[..., None], spec.finish_colour(sums.features, sums.alpha, behind, None), 0)
    surface = sums.alpha >= spec.SURFACE_ALPHA
    return {"rgb": rgb, "depth": np.where(surface, mean * grid.direction[..., 2], 0), "alpha": sums.alpha}


def weights(outputs, seed=3):
    """A smooth random weight per value of each output."""
    rng = np.random.default_rng(seed)
    made = {}
    for name, value in outputs.items():
        rows, columns = np.indices(value.shape[:2])
        waves = [np.sin(rows * rng.uniform(0.1, 0.6) + columns * rng.uniform(0.1, 0.6) + rng.uniform(0, 6))
                 for _ in range(3)]  # fmt: skip
        made[name] = np.stack(waves, axis=-1) if value.ndim == 3 else waves[0]
    return made


def drawn(tensors, sensor, poses, sky=None):
    """Outputs by name."""
    if sensor is SMALL["lidar"]:
        images = render_lidar(tensors, sensor, poses, threads=2)
    else:
        images = render_camera(tensors, sensor, poses, sky, threads=2)
    return {f.name: getattr(images, f.name) for f in dataclasses.fields(images)}


def loss_of(outputs, weight, only=None):
    total = 0.0
    for name in only or outputs:
        value = outputs[name]
        total = total + (value * (torch.from_numpy(weight[name]) if torch.is_tensor(value) else weight[name])).sum()
    return total


def poses_of(name):
    """Poses at the start and the end of the exposure; the LiDAR and the rolling shutter move."""
    first, last = moved(0.02, 0.1, 0.0), moved(0.06, 0.5, 0.1)
    mount = np.eye(4) if name == "lidar" else CAMERA_AXES
    return np.stack([first @ mount, (last if name in ("rolling", "lidar") else first) @ mount])


def motion(twist):
    """A small rigid motion: three translations, three rotations about the world's axes."""
    x, y, z = twist[3:]
    zero = 0 * x
    rows = [[zero, -z, y, twist[0]], [z, zero, -x, twist[1]], [-y, x, zero, twist[2]], [zero] * 4]
    return torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows]))


def moved_world(made, new_from_old):
    """Gaussians carried along by a motion."""
    turn = geometry.quat_from_matrix(new_from_old[:3, :3])
    quat = geometry.quat_multiply(np.broadcast_to(turn, (len(made), 4)), made.quat_wxyz)
    return dataclasses.replace(made, mean_m=geometry.transform_points(new_from_old, made.mean_m), quat_wxyz=quat)


def leaves_of(tensors):
    return [
        value.requires_grad_() for f in dataclasses.fields(tensors) if (value := getattr(tensors, f.name)) is not None
    ]
