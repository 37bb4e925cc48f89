"""A street of two walls that a car drives towards, with cameras and a LiDAR, as a log and as a chunk of images."""

import numpy as np
import torch

from nurec_sim import geometry, sensors
from nurec_sim.network.tensors import NetworkInputs, QueryGaussians
from nurec_sim.reconstruct.feedforward.chunks import ChunkInputs, ContextImage
from nurec_sim.types import Box, CameraModel, Pinhole, Rig, Shutter, Sweep, Track, Trajectory

EPOCH_US = 1_600_000_000_000_000
"""Any time cast to float32 here is wrong by minutes."""
STEP_US = 100_000
SPEED_MPS = 8.0
WALLS_X_M = (25.0, 70.0)
RIG_FROM_CAMERA = np.array([[0.0, 0, 1, 1.6], [-1, 0, 0, 0.1], [0, -1, 0, 1.4], [0, 0, 0, 1]])
LEFT = geometry.pose(geometry.rotation_from_yaw(1.2), np.zeros(3)) @ RIG_FROM_CAMERA


class WallStreet:
    """A road, a wall across its left half at 25 m and one behind at 70 m, and a car that drives towards them."""

    def __init__(self, frames: int = 4, shutter: Shutter = Shutter.TOP_TO_BOTTOM, tracks: tuple[Track, ...] = ()):
        lens = Pinhole(130.0, 130.0, 84.0, 49.0, (-0.05, 0.01, 0, 0, 0, 0))
        self.id, self.frames, self.tracks = "wall-street", frames, tracks
        self.rig = Rig(
            {
                "front": CameraModel("front", 168, 98, lens, RIG_FROM_CAMERA, shutter),
                "left": CameraModel("left", 168, 98, lens, LEFT, shutter),
            },
            {"top": sensors.lidar_model("HDL-64", geometry.pose(np.eye(3), np.array([1.2, 0, 1.9])), columns=600)},
            Box((1.3, 0, 0.8), (4.6, 1.8, 1.6)),
        )
        t_us = EPOCH_US + STEP_US * np.arange(-3, frames + 3)
        self.ego = Trajectory(
            t_us, np.array([geometry.pose_from_xyyaw(SPEED_MPS * (t - EPOCH_US) * 1e-6, 0.3, 0.02) for t in t_us])
        )
        self.read: list[int] = []
        self.added = np.zeros((0, 3))

    def sweep_times_us(self, lidar_id: str) -> np.ndarray:
        start = EPOCH_US + STEP_US * np.arange(self.frames) - STEP_US // 2
        return np.stack([start, start + STEP_US], axis=1)

    def ego_mask(self, camera_id: str) -> None:
        return None

    def sweep(self, lidar_id: str, index: int) -> Sweep:
        self.read.append(index)
        start, end = self.sweep_times_us(lidar_id)[index].tolist()
        t_us = (start + end) // 2
        world_from_lidar = self.ego.at(t_us) @ self.rig.lidars[lidar_id].rig_from_lidar
        rays = sensors.beam_directions(self.rig.lidars[lidar_id]).reshape(-1, 3) @ world_from_lidar[:3, :3].T
        distance = distance_m(np.broadcast_to(world_from_lidar[:3, 3], rays.shape), rays)
        hit = distance < 120
        xyz = np.concatenate([world_from_lidar[:3, 3] + rays[hit] * distance[hit, None], self.added])
        xyz = geometry.transform_points(geometry.inverse(world_from_lidar), xyz)
        return Sweep(t_us, start, end, world_from_lidar, xyz, None, np.full(len(xyz), t_us))


def distance_m(origin: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """How far along unit rays [n,3] the street's road and walls are; infinite in the sky."""
    best = np.full(len(ray), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        road = -origin[:, 2] / ray[:, 2]
        best = np.where(road > 0, road, best)
        for index, x in enumerate(WALLS_X_M):
            wall = (x - origin[:, 0]) / ray[:, 0]
            place = origin + wall[:, None] * ray
            inside = (wall > 0) & (place[:, 2] < 6) & ((place[:, 1] > 0) | (index == 1))
            best = np.where(inside & (wall < best), wall, best)
    return best


def chunk_of(images: list[ContextImage]) -> tuple[ChunkInputs, np.ndarray]:
    """A chunk, its rays as rolling shutters see them, and the world positions and directions of all rays."""
    world_from_scene = images[0].world_from_camera[1]
    scene_from_world = geometry.inverse(world_from_scene)
    rays, depth_scale, world, turns = [], [], [], []
    for image in images:
        camera = image.camera
        ray, _ = sensors.pixel_rays(camera)
        columns, rows = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
        fraction = sensors.shutter_fraction(camera, np.stack([columns, rows], -1).reshape(-1, 2))
        poses = geometry.interpolate_pose_pair(image.world_from_camera, fraction)
        direction = np.einsum("nij,nj->ni", poses[:, :3, :3], ray.reshape(-1, 3))
        origin = poses[:, :3, 3]
        world.append(np.concatenate([origin, direction], axis=1))
        scene = [geometry.transform_points(scene_from_world, origin), direction @ scene_from_world[:3, :3].T]
        rays.append(np.concatenate(scene, axis=1).reshape(*ray.shape[:2], 6))
        depth_scale.append(ray[..., 2:])
        turns.append(scene_from_world @ image.world_from_camera[1])
    v, (h, w) = len(images), rays[0].shape[:2]
    tensors = NetworkInputs(
        rgb=torch.zeros(1, v, h, w, 3),
        c2w=torch.tensor(np.stack(turns)[None], dtype=torch.float32),
        fov=torch.ones(1, v, 2),
        rays=torch.tensor(np.stack(rays)[None], dtype=torch.float32),
        distance_to_depth_scale=torch.tensor(np.stack(depth_scale)[None], dtype=torch.float32),
        camera_idxs=torch.zeros(1, v, dtype=torch.int64),
        time=torch.zeros(1, v),
        time_before=torch.zeros(1, v),
        time_after=torch.zeros(1, v),
    )
    span = (images[0].t_us[0], images[-1].t_us[1])
    return ChunkInputs(0, span, tuple(images), world_from_scene, tensors, np.zeros((v, h, w), bool)), np.stack(world)


def street_chunk(clip: WallStreet, cameras: tuple[str, ...] = ("front", "left")) -> tuple[ChunkInputs, np.ndarray]:
    """One image per camera and sweep, exposed for 30 ms, and their true depth; the sky is 500 m away."""
    images = []
    for name in cameras:
        for frame in range(clip.frames):
            t_us = (EPOCH_US + STEP_US * frame - 15_000, EPOCH_US + STEP_US * frame + 15_000)
            poses = clip.ego.at(np.array(t_us)) @ clip.rig.cameras[name].rig_from_camera
            images.append(ContextImage(clip.rig.cameras[name], frame, t_us, t_us, poses))
    chunk, world = chunk_of(images)
    distance = np.stack([distance_m(ray[:, :3], ray[:, 3:]) for ray in world]).reshape(chunk.ego.shape)
    z = chunk.tensors.distance_to_depth_scale[0, ..., 0].numpy()
    return chunk, np.where(np.isfinite(distance), distance * z, 500.0).astype(np.float32)


def pixel_gaussians(chunk: ChunkInputs, depth_m: np.ndarray) -> QueryGaussians:
    """A Gaussian on every pixel."""
    inputs = chunk.tensors
    depth = torch.tensor(depth_m).reshape(1, -1, 1)
    rays, z = inputs.rays.reshape(1, -1, 6), inputs.distance_to_depth_scale.reshape(1, -1, 1)
    n = depth.shape[1]
    return QueryGaussians(
        position_m=rays[..., :3] + rays[..., 3:] * depth / z,
        quat_wxyz=torch.eye(4)[:1].expand(1, n, 4),
        scale_m=0.01 * depth.expand(1, n, 3),
        opacity=torch.ones(1, n),
        rgb=torch.zeros(1, n, 3),
        normal=torch.zeros(1, n, 3),
        semantic=torch.zeros(1, n, dtype=torch.int64),
        source=torch.arange(n)[None],
        motion_m=0.1 * depth[..., None].expand(1, n, 2, 3),
    )
