"""Held-out drawn worlds as an evaluation sees them: true views of any camera, logs of the rig's sensors in memory."""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Int64

from nurec_sim import geometry
from nurec_sim.evaluate.views import reduced, reduced_mask
from nurec_sim.evaluate.windows import ContextClip, Revolution, Shot, Target
from nurec_sim.types import CameraModel, Label, Pinhole, Rig, SensorRequest, Trajectory
from nurec_sim.world import LIDAR_ID, TrueWorld, street_rig, town_plan, true_sweep
from nurec_sim.world.plan.rig import CAMERA_FROM_RIG_AXES
from nurec_sim.world.plan.surface import LABEL_OF_CLASS, SurfaceClass
from nurec_sim.world.plan.town import TownPlan
from nurec_sim.world.sense.isp import CameraResponse, random_response
from nurec_sim.world.write import SPIN_US

CAMERAS_DEG = {"camera_front": 0.0, "camera_front_left": 45.0, "camera_front_right": -45.0}
"""Where the cameras of the evaluated rig look, left positive."""
FIELD_DEG, HEIGHT_M, AHEAD_M = 50.0, 1.8, 1.5
"""As wide as the front cameras of the public protocol's recordings, on the roof."""


def evaluation_rig(cameras: int = 1, width_px: int = 480, height_px: int = 320) -> Rig:
    """The front camera, or with it the two beside it, and a LiDAR."""
    focal = width_px / 2 / np.tan(np.deg2rad(FIELD_DEG) / 2)
    lens = Pinhole(focal, focal, width_px / 2, height_px / 2)
    models = {}
    for name, yaw_deg in list(CAMERAS_DEG.items())[:cameras]:
        turn = geometry.rotation_from_yaw(np.deg2rad(yaw_deg))
        place = np.array([AHEAD_M, 0.0, HEIGHT_M]) + turn @ np.array([0.1, 0.0, 0.0])
        models[name] = CameraModel(name, width_px, height_px, lens, geometry.pose(turn @ CAMERA_FROM_RIG_AXES, place))
    return Rig(models, {LIDAR_ID: street_rig().lidars[LIDAR_ID]})


def camera_responses(rig: Rig, seed: int) -> dict[str, CameraResponse]:
    """A colour response of its own for every camera, as the cameras of one car differ."""
    return {name: random_response(np.random.default_rng([seed, n, 0xCA3])) for n, name in enumerate(rig.cameras)}


class Drawing:
    """A drawn world under evaluation: hands out true views, shots and sweeps along the recorded drive.

    Shots and sweeps are drawn when they are first asked for; the world must be open then.
    """

    def __init__(self, world: TrueWorld, rig: Rig) -> None:
        self.world, self.rig = world, rig
        self.ego: Trajectory = world.plan.ego_trajectory()

    def request(self, camera_id: str, t_us: int, left_m: float = 0.0) -> SensorRequest:
        """A picture taken in an instant by a camera of the rig, with the car moved to its left."""
        beside = geometry.pose(np.eye(3), np.array([0.0, left_m, 0.0]))
        camera = self.rig.cameras[camera_id]
        pose = self.ego.at(t_us) @ beside @ camera.rig_from_camera
        return SensorRequest("", camera, t_us, t_us + 1, np.stack([pose, pose]))

    def shots(self, times_us: Int64[np.ndarray, " n"]) -> dict[str, tuple[Shot, ...]]:
        """Frames of all cameras of the rig at these times."""
        return {name: tuple(self._shot(name, int(t)) for t in times_us) for name in self.rig.cameras}

    def _shot(self, camera_id: str, t_us: int) -> Shot:
        request = self.request(camera_id, t_us)
        return Shot(t_us, t_us, request.world_from_sensor, cache(lambda: self.world.view(request).rgb))

    def target(self, name: str, camera_id: str, t_us: int, left_m: float = 0.0, beyond: bool = False) -> Target:
        """A view that methods have to show."""
        request = self.request(camera_id, t_us, left_m)
        seen = self.world.view(request)
        movable = reduced_mask(LABEL_OF_CLASS[seen.surface] == Label.MOVABLE)
        depth_m = np.where(seen.surface == SurfaceClass.SKY, np.float32(0), seen.depth_m)
        return Target(name, request, reduced(seen.rgb, depth_m), movable, left_m, beyond)

    def revolutions(self, span_us: tuple[int, int]) -> dict[str, tuple[Revolution, ...]]:
        """Turns of the LiDARs, one after the other, that lie within a span."""
        starts = range(span_us[0], span_us[1] - SPIN_US + 1, SPIN_US)
        return {name: tuple(self._revolution(name, start) for start in starts) for name in self.rig.lidars}

    def _revolution(self, lidar_id: str, start_us: int) -> Revolution:
        lidar = self.rig.lidars[lidar_id]
        measured = cache(lambda: true_sweep(self.world, self.ego, lidar, start_us))
        return Revolution(start_us, start_us + SPIN_US, measured)

    def clip(self, id: str, times_us: Int64[np.ndarray, " n"], span_us: tuple[int, int], boxes: bool) -> ContextClip:
        """A log of the frames at these times and of all sweeps of a span, with or without the boxes of what moves."""
        tracks = self.world.plan.tracks() if boxes else ()
        shots, turns = self.shots(times_us), self.revolutions(span_us)
        return ContextClip(id, self.rig, self.ego, span_us, shots, turns, tracks)


def held_out_plan(seed: int, seconds: float) -> TownPlan:
    """The town of a seed from the split that training never sees (``world.plan.splits``)."""
    return town_plan(seed, "test", seconds=seconds)
