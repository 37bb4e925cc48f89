"""A street made of planes and boxes, sensed exactly: a log in memory for the tests of reconstruction."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from nurec_sim import geometry
from nurec_sim.types import CameraModel, LidarModel, Pinhole, Rig, RoadMap, Sweep, Track, Trajectory

KERB_M, WALL_M, STEP_M = 4.0, 8.0, 0.15
FRAME_US = 200_000
RIG_FROM_CAMERA = geometry.pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([1.5, 0.0, 1.5]))


def camera(name: str = "front", left_m: float = 0.0, width: int = 192, height: int = 96) -> CameraModel:
    pose = RIG_FROM_CAMERA.copy()
    pose[1, 3] = left_m
    return CameraModel(name, width, height, Pinhole(120.0, 120.0, width / 2, height / 2), pose)


@dataclass
class Street:
    """A road 8 m wide between pavements 0.15 m higher and walls; the car drives along x at 5 m/s unless it stands.

    ``boxes`` maps ids to (size, positions per frame); labelled as tracks if ``labelled``.
    """

    frames: int = 5
    speed_mps: float = 5.0
    cameras: tuple[CameraModel, ...] = (camera(),)
    boxes: dict[str, tuple[tuple[float, float, float], np.ndarray]] = field(default_factory=dict)
    labelled: bool = True
    with_intensity: bool = True
    kerb: bool = True
    gains: dict[str, float] = field(default_factory=dict)
    id: str = "street"
    road_map: RoadMap | None = None
    time_offset_us: int = 0

    def __post_init__(self) -> None:
        rows, columns = 32, 360
        lidar = LidarModel(
            "top",
            np.radians(np.linspace(6, -24, rows)),
            np.radians(np.linspace(180, -179, columns)),
            np.zeros(rows),
            geometry.pose(np.eye(3), np.array([0.5, 0, 1.8])),
            range_m=(0.5, 60.0),
        )
        self.rig = Rig({c.id: c for c in self.cameras}, {"top": lidar})
        self.t_us = 1_000_000 + FRAME_US * np.arange(self.frames)
        poses = np.stack(
            [geometry.pose_from_xyyaw(self.speed_mps * k * FRAME_US / 1e6, 0, 0) for k in range(self.frames)]
        )
        self.ego = Trajectory(self.t_us, poses)
        self.tracks = [
            Track(name, "automobile", size, Trajectory(self.t_us, self._box_poses(name)))
            for name, (size, _) in self.boxes.items()
            if self.labelled
        ]

    def _box_poses(self, name: str) -> np.ndarray:
        size, where = self.boxes[name]
        xy = np.broadcast_to(np.asarray(where, float), (self.frames, 2))
        return np.stack([geometry.pose_from_xyyaw(x, y, 0, size[2] / 2 + 0.02) for x, y in xy])

    @property
    def span_us(self) -> tuple[int, int]:
        return int(self.t_us[0]), int(self.t_us[-1]) + FRAME_US

    def camera_times_us(self, camera_id: str) -> np.ndarray:
        return np.stack([self.t_us, self.t_us], axis=1)

    def world_from_camera(self, camera_id: str, index: int) -> np.ndarray:
        pose = self.ego.world_from_body[index] @ self.rig.cameras[camera_id].rig_from_camera
        return np.stack([pose, pose])

    def sweep_times_us(self, lidar_id: str) -> np.ndarray:
        return np.stack([self.t_us, self.t_us + 1000], axis=1)

    def image(self, camera_id: str, index: int) -> np.ndarray:
        from nurec_sim import sensors

        rays, _ = sensors.pixel_rays(self.rig.cameras[camera_id])
        pose = self.world_from_camera(camera_id, index)[0]
        direction = np.nan_to_num(rays.reshape(-1, 3) @ pose[:3, :3].T)
        distance, what = self.cast(pose[:3, 3], direction, index)
        hit = pose[:3, 3] + np.where(np.isfinite(distance), distance, 0)[:, None] * direction
        rgb = self.colours(what, hit, index) * self.gains.get(camera_id, 1.0)
        return np.clip(rgb * 255, 0, 255).astype(np.uint8).reshape(rays.shape)

    def colours(self, what: np.ndarray, hit: np.ndarray, index: int) -> np.ndarray:
        return colour_of(what, hit)

    def ego_mask(self, camera_id: str) -> None:
        return None

    def sweep(self, lidar_id: str, index: int) -> Sweep:
        from nurec_sim import sensors

        lidar = self.rig.lidars[lidar_id]
        local = sensors.beam_directions(lidar).reshape(-1, 3)
        pose = self.ego.world_from_body[index] @ lidar.rig_from_lidar
        distance, what = self.cast(pose[:3, 3], local @ pose[:3, :3].T, index)
        back = distance < 60
        n = int(back.sum())
        t_us = int(self.t_us[index])
        intensity = (0.1 + 0.1 * what[back]).astype(np.float32) if self.with_intensity else None
        return Sweep(t_us, t_us, t_us + 1000, pose, local[back] * distance[back, None], intensity, np.full(n, t_us))

    def cast(self, origin: np.ndarray, direction: np.ndarray, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Distance (inf: sky) and what was hit: 0 sky, 1 road, 2 pavement, 3 kerb, 4 wall, 5+ boxes."""
        best, what = np.full(len(direction), np.inf), np.zeros(len(direction), int)
        step = STEP_M if self.kerb else 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            planes = (
                [(2, 0.0, 1), (2, step, 2)]
                + [(1, s * KERB_M, 3) for s in (1, -1)]
                + [(1, s * WALL_M, 4) for s in (1, -1)]
            )
            for axis, at, kind in planes:
                t = (at - origin[axis]) / direction[:, axis]
                p = origin + t[:, None] * direction
                side, z = np.abs(p[:, 1]), p[:, 2]
                fits = {1: side < KERB_M, 2: (side >= KERB_M) & (side <= WALL_M), 3: (z > 0) & (z < step),
                        4: (z > 0) & (z < 6)}[kind]  # fmt: skip
                hit = (t > 0) & (t < best) & fits
                best[hit], what[hit] = t[hit], kind
            for number, (name, (size, _)) in enumerate(self.boxes.items()):
                centre = self._box_poses(name)[index][:3, 3]
                low = (centre - np.array(size) / 2 - origin) / direction
                high = (centre + np.array(size) / 2 - origin) / direction
                enter, leave = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
                hit = (enter < leave) & (enter > 0) & (enter < best)
                best[hit], what[hit] = enter[hit], 5 + number
        return best, what


def colour_of(what: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Display colours: a pattern of 0.8 m patches on everything but the sky."""
    base = np.array([[0.7, 0.8, 1.0], [0.35, 0.35, 0.35], [0.6, 0.55, 0.5], [0.5, 0.5, 0.5], [0.55, 0.35, 0.25],
                     [0.7, 0.15, 0.15], [0.15, 0.2, 0.7]])[np.minimum(what, 6)]  # fmt: skip
    patch = np.sin(hit[:, 0] * 4) * np.sin(hit[:, 1] * 4 + hit[:, 2] * 4)
    return np.clip(base * (1 + 0.35 * patch[:, None] * (what > 0)[:, None]), 0, 1)
