"""The town posed at an instant, viewed by a sensor; everything here belongs to one thread, as OpenGL contexts do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float64, Int32, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.types import CameraModel, Matrix4, SensorRequest, Shutter, Trajectory
from nurec_sim.world.model.assemble import ActorPlaces, Town
from nurec_sim.world.plan.surface import SurfaceClass
from nurec_sim.world.sense import rays
from nurec_sim.world.sense.faces import Seen
from nurec_sim.world.sense.shutter import (
    MOTION_PX,
    RayPatch,
    bands_for,
    camera_patches,
    line_turns,
    motion_px,
    turned_patch,
)

PROBES = (24, 16)
"""Probe rays, across and down, that measure the image motion during a rolling shutter."""


@dataclass(frozen=True)
class Quality:
    """Rendering quality against time.

    Args:
        samples: colour samples per pixel, 0, 2 or 4; more give smoother edges.
        shadow_px: side of the shadow map, 0 for no shadows.
        lidar: ``rays`` casts one exact ray per beam at its own firing time; ``rasterised`` resamples twelve sectors of
            OpenGL images: several times faster, exact on static surfaces, approximate at edges and on moving actors.
    """

    samples: int = 4
    shadow_px: int = 2048
    lidar: str = "rays"

    def __post_init__(self) -> None:
        if self.samples not in (0, 2, 4) or not 0 <= self.shadow_px <= 8192 or self.lidar not in ("rays", "rasterised"):
            raise ValueError(
                "samples must be 0, 2 or 4, shadow_px 0..8192, lidar 'rays' or 'rasterised'; "
                f"got {self.samples}, {self.shadow_px}, {self.lidar!r}"
            )


@dataclass(frozen=True, eq=False)
class Moments:
    """Instants of one request: times, poses of all actors, and poses of the sensor."""

    town: Town
    data: Any
    t_us: Float64[np.ndarray, " n"]
    places: ActorPlaces
    world_from_sensor: Float64[np.ndarray, "n 4 4"]

    def enter(self, index: int) -> Matrix4:
        """Poses the town at an instant and returns the sensor's pose."""
        self.town.pose(self.data, float(self.t_us[index]), self.places, index)
        return self.world_from_sensor[index]


def named(town: Town, geom: Int32[np.ndarray, "*n"]) -> tuple[UInt8[np.ndarray, "*n"], Int32[np.ndarray, "*n"]]:
    """``SurfaceClass`` and instance of geom ids, where -1 is the sky."""
    sky = geom < 0
    surface = np.where(sky, np.uint8(SurfaceClass.SKY), town.geom_class[geom])
    return surface, np.where(sky, np.int32(0), town.geom_instance[geom])


class Stage:
    """A compiled town with its own state and, for OpenGL back ends, a painter.

    Args:
        town: the town.
        recorded: trajectories of its actors, for those that a request does not place.
        backend: ``egl``, ``osmesa`` or ``rays``.
        quality: of rendered images.
    """

    def __init__(self, town: Town, recorded: Mapping[str, Trajectory], backend: str, quality: Quality):
        self.town, self._recorded = town, recorded
        self.data = mujoco.MjData(town.model)
        start_us = town.plan.span_us[0]
        actors = {name: path.at(start_us)[None] for name, path in recorded.items()}
        town.pose(self.data, start_us, town.actor_places(actors, 1))
        self.gl: Any = None
        if backend != "rays":
            from nurec_sim.world.sense.render import GlRenderer

            self.gl = GlRenderer(town, backend, quality.samples, quality.shadow_px)

    def close(self) -> None:
        """Frees the painter."""
        if self.gl is not None:
            self.gl.close()
            self.gl = None

    def actor_boxes(
        self, request: SensorRequest, fractions: Float64[np.ndarray, " n"]
    ) -> dict[str, Float64[np.ndarray, "n 4 4"]]:
        """``world_from_box`` of all actors at fractions of the request's time: as requested, else as recorded."""
        times = request.start_us + np.rint(fractions * (request.end_us - request.start_us)).astype(np.int64)
        boxes = {name: path.at(times) for name, path in self._recorded.items() if name not in request.actors}
        for name, pair in request.actors.items():
            boxes[name] = geometry.interpolate_pose_pair(np.asarray(pair, np.float64), fractions)
        return boxes

    def moments(self, request: SensorRequest, fractions: Float64[np.ndarray, " n"]) -> Moments:
        """Instants at fractions of the request's time."""
        times = request.start_us + fractions * (request.end_us - request.start_us)
        places = self.town.actor_places(self.actor_boxes(request, fractions), len(fractions))
        poses = geometry.interpolate_pose_pair(np.asarray(request.world_from_sensor, np.float64), fractions)
        return Moments(self.town, self.data, times, places, poses)

    def look(self, patch: RayPatch, world_from_sensor: Matrix4, seen: Seen, colours: bool = True) -> None:
        """Fills in what the rays of a patch hit at the current instant.

        Args:
            patch: rays of the sensor.
            world_from_sensor: pose of the sensor.
            seen: result, of the same size as the patch.
            colours: if False only geometry is needed, and OpenGL back ends skip the colour pass.
        """
        if self.gl is None:
            rays.look(self.town, self.data, patch.rays, patch.valid, world_from_sensor, seen)
        else:
            for face in patch.faces:
                face.read(self.gl.render(self.data, face, world_from_sensor, colours), seen)

    def see(self, request: SensorRequest, camera: CameraModel) -> Seen:
        """A camera image, with every band of a rolling shutter at its own time.

        Moving points are off by at most half of their motion within a band. If the bands are too wide for a camera that
        rotates fast, every line gets its own rotation, and the bands only approximate the translation.
        """
        bands, turning = self._bands(request, camera)
        patches = camera_patches(camera, bands)
        moments = self.moments(request, np.array([patch.fraction for patch in patches]))
        seen = Seen.nothing(camera.height_px, camera.width_px)
        for index, patch in enumerate(patches):
            pose, part = moments.enter(index), seen.part(patch.rows, patch.columns)
            if turning:
                turns = line_turns(camera, patch, np.asarray(request.world_from_sensor, np.float64))
                self.look(turned_patch(patch, turns), pose, part)
                # Normals are returned in the frame of their own line, not of the band.
                part.normal[:] = (part.normal[..., None, :] @ turns.astype(np.float32))[..., 0, :]
            else:
                self.look(patch, pose, part)
        return seen

    def _bands(self, request: SensorRequest, camera: CameraModel) -> tuple[int, bool]:
        """Number of bands of a rolling shutter, and whether every line needs its own rotation.

        The number depends on the image motion; ray casting uses one band per line.
        """
        if camera.shutter is Shutter.GLOBAL:
            return 1, False
        if self.gl is None:
            by_column = camera.shutter in (Shutter.LEFT_TO_RIGHT, Shutter.RIGHT_TO_LEFT)
            return (camera.width_px if by_column else camera.height_px), False
        ends = np.array([0.0, 1.0])
        moments, boxes = self.moments(request, ends), self.actor_boxes(request, ends)
        u, v = (
            (np.arange(n) + 0.5) * size / n for n, size in zip(PROBES, (camera.width_px, camera.height_px), strict=True)
        )
        directions, valid = sensors.unproject(camera, np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
        pose = moments.enter(0)
        directions = directions[valid] @ pose[:3, :3].T
        geom, distance, _ = rays.cast(self.town, self.data, pose[:3, 3], directions)
        # The sky is placed so far away that only rotation moves it.
        start = pose[:3, 3] + np.where(geom < 0, 1e4, distance)[:, None] * directions
        end, instance = start.copy(), np.where(geom < 0, 0, self.town.geom_instance[geom])
        # Probed points on actors move rigidly with their boxes.
        for index, actor in enumerate(self.town.plan.actors):
            on_it = instance == index + 1
            if on_it.any():
                moved = boxes[actor.id][1] @ geometry.inverse(boxes[actor.id][0])
                end[on_it] = geometry.transform_points(moved, start[on_it])
        pair = moments.world_from_sensor
        motion = motion_px(camera, pair, start, end)
        bands = bands_for(camera, motion)
        if motion <= bands * MOTION_PX:
            return bands, False
        # Lines with their own rotation leave only the translation to the bands.
        straight = pair.copy()
        straight[1, :3, :3] = pair[0, :3, :3]
        return bands_for(camera, motion_px(camera, straight, start, end)), True
