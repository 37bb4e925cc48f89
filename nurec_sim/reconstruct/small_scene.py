"""A small log and a small scene, on which all that a reconstruction compiles is compiled: what ``ahead`` runs."""

from __future__ import annotations

import numpy as np

from nurec_sim import geometry, sensors
from nurec_sim.reconstruct import reconstruct
from nurec_sim.reconstruct.lift.colour_solve import ColourSolve, SolvedImage
from nurec_sim.reconstruct.lift.settings import LiftSettings, ViewSettings
from nurec_sim.render import make_renderer
from nurec_sim.types import (
    CameraModel,
    DynamicGaussians,
    Gaussians,
    GaussianScene,
    Pinhole,
    Rig,
    SensorRequest,
    Sweep,
    Track,
    Trajectory,
)

START_US, END_US, FRAMES = 1_000_000, 1_100_000, 4


def draw_small_scene() -> None:
    """Draws what a reconstruction draws: an image, with errors taken back to its colours, and a sweep."""
    scene = _scene()
    camera, lidar = scene.rig.cameras["front"], scene.rig.lidars["top"]
    poses = scene.ego.at(np.array([START_US, START_US]))
    shape = camera.height_px, camera.width_px
    weights = np.ones((2, *shape), np.float32)
    image = SolvedImage(camera, 0, START_US, poses @ camera.rig_from_camera, np.zeros((*shape, 3), np.uint8), weights)
    ColourSolve(scene, 1.0, 0.1).step(image)
    ends = scene.ego.at(np.array([START_US, END_US]))
    make_renderer(scene, "cpu").render_lidar(
        SensorRequest(scene.id, lidar, START_US, END_US, ends @ lidar.rig_from_lidar)
    )


def lift_small_log() -> GaussianScene:
    """The scene of a log that is as small as the stages of ``lift`` allow."""
    views = ViewSettings(levels=32, width_px=96)
    return reconstruct(_Street(), "lift", settings=LiftSettings(sky_px=32, views=views))


def _rig() -> Rig:
    forward = geometry.pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.0, 0.0, 1.5]))
    camera = CameraModel("front", 96, 48, Pinhole(60.0, 60.0, 48.0, 24.0), forward)
    roof = geometry.pose(np.eye(3), np.array([0.0, 0.0, 1.8]))
    return Rig({"front": camera}, {"top": sensors.lidar_model("VLP-16", roof, id="top", columns=360)})


def _scene() -> GaussianScene:
    """A wall across a road, and a box that moves in front of it."""
    street = _Street()
    places = np.stack(np.meshgrid([8.0], np.linspace(-4, 4, 20), np.linspace(0, 3, 10), indexing="ij"), axis=-1)
    moving = _discs(np.array([[-0.5, 0.0, 0.0]]))
    path = np.stack([geometry.pose_from_xyyaw(6.0, 0.2 * k, 0.0, z=0.5) for k in range(FRAMES)])
    return GaussianScene(
        id=street.id,
        static=_discs(places.reshape(-1, 3)),
        dynamic=DynamicGaussians.rigid(moving, np.zeros(1, np.int32), START_US),
        sky=np.zeros((6, 16, 16, 3), np.float32),
        isp={},
        rig=street.rig,
        ego=street.ego,
        tracks=[Track("box", "automobile", (1.0, 1.0, 1.0), Trajectory(street.t_us, path))],
        road_map=None,
        span_us=street.span_us,
        camera_times_us={"front": street.camera_times_us("front")},
        provenance={},
    )


class _Street:
    """A log in memory (``types.Clip``): a road between walls, all of it grey noise, and a car that drives along it."""

    id, tracks, road_map, time_offset_us = "small", (), None, 0

    def __init__(self) -> None:
        self.rig = _rig()
        self.t_us = START_US + 100_000 * np.arange(FRAMES)
        self.ego = Trajectory(self.t_us, np.stack([geometry.pose_from_xyyaw(0.8 * k, 0.0, 0.0) for k in range(FRAMES)]))
        self.span_us = START_US, int(self.t_us[-1]) + 100_000

    def camera_times_us(self, camera_id: str) -> np.ndarray:
        return np.stack([self.t_us, self.t_us], axis=1)

    def world_from_camera(self, camera_id: str, index: int) -> np.ndarray:
        pose = self.ego.world_from_body[index] @ self.rig.cameras[camera_id].rig_from_camera
        return np.stack([pose, pose])

    def image(self, camera_id: str, index: int) -> np.ndarray:
        camera = self.rig.cameras[camera_id]
        noise = np.random.default_rng(index).integers(0, 256, (camera.height_px, camera.width_px, 1), np.uint8)
        return noise.repeat(3, axis=2)

    def ego_mask(self, camera_id: str) -> None:
        return None

    def sweep_times_us(self, lidar_id: str) -> np.ndarray:
        return np.stack([self.t_us, self.t_us + 90_000], axis=1)

    def sweep(self, lidar_id: str, index: int) -> Sweep:
        lidar, t_us = self.rig.lidars[lidar_id], int(self.t_us[index])
        pose = self.ego.world_from_body[index] @ lidar.rig_from_lidar
        direction = sensors.beam_directions(lidar).reshape(-1, 3)
        # Ranges of the road below, and of walls beside it.
        down, aside = -pose[2, 3] / np.minimum(direction[:, 2], -1e-6), 6.0 / np.maximum(np.abs(direction[:, 1]), 1e-6)
        xyz_m = direction * np.minimum(down, aside)[:, None]
        xyz_m = xyz_m[np.linalg.norm(xyz_m, axis=1) < 40.0]
        grey = np.full(len(xyz_m), 0.5, np.float32)
        return Sweep(t_us, t_us, t_us + 90_000, pose, xyz_m, grey, np.full(len(xyz_m), t_us, np.int64))


def _discs(mean_m: np.ndarray) -> Gaussians:
    n = len(mean_m)
    return Gaussians(
        mean_m=mean_m.astype(np.float32),
        quat_wxyz=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        scale_m=np.tile(np.array([0.02, 0.4, 0.4], np.float32), (n, 1)),
        opacity=np.full(n, 0.9, np.float32),
        rgb=np.full((n, 3), 0.5, np.float32),
        normal=np.tile(np.array([-1, 0, 0], np.float32), (n, 1)),
        label=np.zeros(n, np.uint8),
        intensity=np.full(n, 0.5, np.float32),
    )


if __name__ == "__main__":
    draw_small_scene()
    lift_small_log()
