"""Drives by the front image, and brakes by LiDAR too: ``camera_road_follower`` and ``lidar_aeb`` in one car."""

from __future__ import annotations

from nurec_sim.policies._paths import extended, make_plan, pursue
from nurec_sim.policies.camera_road_follower import CameraRoadFollower
from nurec_sim.policies.lidar_aeb import LidarAeb
from nurec_sim.types import Needs, Observation, Plan, Rig


class Fusion:
    """Steers to free road-coloured ground; brakes for its end and for LiDAR obstacles on the path."""

    name = "fusion"
    needs = Needs(cameras=("front",), lidars=("any",), image_width_px=320)

    def __init__(self) -> None:
        self.camera, self.lidar = CameraRoadFollower(), LidarAeb()

    def reset(self, rig: Rig, seed: int) -> None:
        """Resets both halves."""
        self.camera.reset(rig, seed)
        self.lidar.reset(rig, seed)

    def plan(self, observation: Observation) -> Plan:
        """Five seconds along the best path, braking for obstacles."""
        path, seen_accel_of = self.camera.decide(observation)
        brake = self.lidar.brake_for(observation, extended(path))

        def accel_of(t_s: float, driven_m: float, speed: float) -> float:
            return -brake if brake else seen_accel_of(t_s, driven_m, speed)

        return make_plan(observation, pursue(path, observation.ego.speed_mps, accel_of))
