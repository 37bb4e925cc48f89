"""Held-out procedural worlds for evaluation: ground-truth views of any camera, in-memory logs of a rig."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from jaxtyping import Int64

from nurec_sim import geometry
from nurec_sim.evaluate.covisible import TrueImage, covisible
from nurec_sim.evaluate.detection.sights import Sight
from nurec_sim.evaluate.views import reduced, reduced_mask
from nurec_sim.evaluate.windows import EvaluationView
from nurec_sim.logs.selection import ContextClip, Revolution, Shot
from nurec_sim.network.detector.objects import labelled_objects
from nurec_sim.sensors import lidar_model
from nurec_sim.types import CameraModel, Label, Pinhole, Rig, SensorRequest, Trajectory
from nurec_sim.world import LIDAR_ID, TrueWorld, street_rig, town_plan, true_sweep
from nurec_sim.world.plan.rig import CAMERA_FROM_RIG_AXES
from nurec_sim.world.plan.surface import LABEL_OF_CLASS, SurfaceClass
from nurec_sim.world.plan.town import TownPlan
from nurec_sim.world.sense.isp import CameraResponse, random_response
from nurec_sim.world.write import SPIN_US

CAMERAS_DEG = {"camera_front": 0.0, "camera_front_left": 45.0, "camera_front_right": -45.0}
"""Camera yaw angles of the evaluation rig, left positive."""
FIELD_DEG, HEIGHT_M, AHEAD_M = 50.0, 1.8, 1.5
"""Field of view as for the front cameras of the public protocol; mounted on the roof."""


def evaluation_rig(cameras: int = 1, width_px: int = 480, height_px: int = 320, lidar: str | None = None) -> Rig:
    """A front camera, optionally two side cameras, and a LiDAR: the demo rig's, or a device of ``LIDAR_TABLES``."""
    focal = width_px / 2 / np.tan(np.deg2rad(FIELD_DEG) / 2)
    lens = Pinhole(focal, focal, width_px / 2, height_px / 2)
    models = {}
    for name, yaw_deg in list(CAMERAS_DEG.items())[:cameras]:
        turn = geometry.rotation_from_yaw(np.deg2rad(yaw_deg))
        place = np.array([AHEAD_M, 0.0, HEIGHT_M]) + turn @ np.array([0.1, 0.0, 0.0])
        models[name] = CameraModel(name, width_px, height_px, lens, geometry.pose(turn @ CAMERA_FROM_RIG_AXES, place))
    scanner = street_rig().lidars[LIDAR_ID]
    if lidar is not None:
        scanner = lidar_model(lidar, scanner.rig_from_lidar, LIDAR_ID)
    return Rig(models, {LIDAR_ID: scanner})


def camera_responses(rig: Rig, seed: int) -> dict[str, CameraResponse]:
    """A random colour response per camera."""
    return {name: random_response(np.random.default_rng([seed, n, 0xCA3])) for n, name in enumerate(rig.cameras)}


class EvaluationWorld:
    """A procedural world under evaluation: ground-truth views, frames and sweeps along the recorded drive.

    Frames and sweeps are rendered on first use, while the world must be open.
    """

    def __init__(self, world: TrueWorld, rig: Rig, left_m: float = 0.0) -> None:
        self.world, self.rig = world, rig
        ego = world.plan.ego_trajectory()
        beside = geometry.pose(np.eye(3), np.array([0.0, left_m, 0.0]))
        self.ego = Trajectory(ego.t_us, ego.world_from_body @ beside)
        """The recorded drive, or one beside it."""

    def request(self, camera_id: str, t_us: int, left_m: float = 0.0) -> SensorRequest:
        """A request for an instantaneous camera image, with the car shifted to its left."""
        beside = geometry.pose(np.eye(3), np.array([0.0, left_m, 0.0]))
        camera = self.rig.cameras[camera_id]
        pose = self.ego.at(t_us) @ beside @ camera.rig_from_camera
        return SensorRequest("", camera, t_us, t_us + 1, np.stack([pose, pose]))

    def image(self, camera_id: str, t_us: int) -> TrueImage:
        """A camera image with its ground truth."""
        request = self.request(camera_id, t_us)
        return TrueImage(request, self.world.view(request))

    def shots(self, times_us: Int64[np.ndarray, " n"]) -> dict[str, tuple[Shot, ...]]:
        """Frames of all cameras of the rig at these times."""
        return {name: tuple(self._shot(name, int(t)) for t in times_us) for name in self.rig.cameras}

    def _shot(self, camera_id: str, t_us: int) -> Shot:
        request = self.request(camera_id, t_us)
        # Rendered at most once: methods under comparison read the same frames.
        return Shot(t_us, t_us, request.world_from_sensor, cache(lambda: self.world.view(request).rgb))

    def target(
        self, name: str, camera_id: str, t_us: int, left_m: float = 0.0, beyond: bool = False, sight: bool = False,
        inputs: Sequence[TrueImage] = (),
    ) -> EvaluationView:  # fmt: skip
        """A target view with its ground truth.

        Args:
            name: unique within its window.
            camera_id: a camera of the rig.
            t_us: instant of the exposure, microseconds.
            left_m: lateral offset of the car from the recorded drive, left positive.
            beyond: whether the instant is before the first or after the last input frame.
            sight: whether it gets what a detector needs.
            inputs: input images, to know what of the view they show.
        """
        request = self.request(camera_id, t_us, left_m)
        seen = self.world.view(request)
        movable = reduced_mask(LABEL_OF_CLASS[seen.surface] == Label.MOVABLE)
        depth_m = np.where(seen.surface == SurfaceClass.SKY, np.float32(0), seen.depth_m)
        view = EvaluationView(name, request, reduced(seen.rgb, depth_m), movable, left_m, beyond)
        if inputs:
            shown = covisible(TrueImage(request, seen), inputs, self.world.plan.tracks())
            # Of the scored pixels those whose pixels are all shown: colours of the others are mixed with what is not.
            view = dataclasses.replace(view, shown=~reduced_mask(~shown))
        if not sight:
            return view
        camera, pose = self.rig.cameras[camera_id], request.world_from_sensor[0]
        objects = labelled_objects(self.world.plan.tracks(), t_us, camera, pose, seen.instance)
        return dataclasses.replace(view, sight=Sight(seen.rgb, camera, objects))

    def revolutions(self, span_us: tuple[int, int]) -> dict[str, tuple[Revolution, ...]]:
        """Consecutive LiDAR sweeps within a time span."""
        starts = range(span_us[0], span_us[1] - SPIN_US + 1, SPIN_US)
        return {name: tuple(self._revolution(name, start) for start in starts) for name in self.rig.lidars}

    def _revolution(self, lidar_id: str, start_us: int) -> Revolution:
        lidar = self.rig.lidars[lidar_id]
        measured = cache(lambda: true_sweep(self.world, self.ego, lidar, start_us))
        return Revolution(start_us, start_us + SPIN_US, measured)

    def clip(
        self, id: str, times_us: Int64[np.ndarray, " n"], span_us: tuple[int, int], boxes: bool,
        sweeps: Callable[[int], bool] = lambda index: True,
    ) -> ContextClip:  # fmt: skip
        """A log of frames at given times and of the sweeps of a span.

        Args:
            id: name of the log.
            times_us: instants of the frames of every camera, microseconds.
            span_us: [start, end) of the log and of its sweeps.
            boxes: whether the log has labelled boxes.
            sweeps: which sweeps the log has, by their index in the span; all by default.
        """
        tracks = self.world.plan.tracks() if boxes else ()
        turns = {
            lidar: tuple(turn for index, turn in enumerate(every) if sweeps(index))
            for lidar, every in self.revolutions(span_us).items()
        }
        return ContextClip(id, self.rig, self.ego, span_us, self.shots(times_us), turns, tracks)


def held_out_plan(seed: int, seconds: float) -> TownPlan:
    """The town of a seed from the held-out split ``test`` (``world.plan.splits``)."""
    return town_plan(seed, "test", seconds=seconds)
