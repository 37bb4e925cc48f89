"""The street itself as a sensor simulator: what a renderer of its reconstruction should have shown."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import mujoco
import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.errors import RequestError, TooLargeError
from nurec_sim.types import (
    CameraFrame,
    CameraModel,
    LidarFrame,
    LidarModel,
    Pinhole,
    SensorFrame,
    SensorRequest,
    Shutter,
)
from nurec_sim.world import rays
from nurec_sim.world.backend import pick_backend
from nurec_sim.world.build import ActorPlaces, Street, build_street
from nurec_sim.world.plan import StreetPlan
from nurec_sim.world.surface import LABEL_OF_CLASS, SurfaceClass

MAX_SIDE_PX = 4096
T = TypeVar("T")


@dataclass(frozen=True)
class TrueView:
    """An image with its ground truth. ``instance`` is 0 for static surfaces and i + 1 for actor i of the plan."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth_m: Float32[np.ndarray, "h w"]
    surface: UInt8[np.ndarray, "h w"]
    instance: Int32[np.ndarray, "h w"]


@dataclass(frozen=True)
class TrueScan:
    """A LiDAR turn as measured, ``[rows, columns]``: range (0 no return), intensity 0..1, class and instance."""

    range_m: Float64[np.ndarray, "r c"]
    intensity: Float32[np.ndarray, "r c"]
    surface: UInt8[np.ndarray, "r c"]
    instance: Int32[np.ndarray, "r c"]


class TrueWorld:
    """A street that answers sensor requests for any pose and any place of its actors.

    All of MuJoCo and OpenGL runs in one thread of its own, because a GL context belongs to its thread; ``sense`` may
    be called from any thread. Use it as a context manager or call ``close``.

    Args:
        plan: the street.
        backend: ``egl``, ``osmesa`` or ``rays``; None picks the first that works (``backend.pick_backend``).
    """

    def __init__(self, plan: StreetPlan, backend: str | None = None):
        self.plan = plan
        self.backend = pick_backend(backend)
        self._recorded = {track.id: track.path for track in plan.tracks()}
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="street")
        self._painter: Any = None
        self._closed = False
        try:
            self.street: Street = self._run(self._start)
        except BaseException:
            self._thread.shutdown()
            raise

    def __enter__(self) -> TrueWorld:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Frees the GL context and the thread; may be called again."""
        if not self._closed:
            self._run(self._stop)
            self._closed = True
            self._thread.shutdown()

    def sense(self, requests: Sequence[SensorRequest]) -> list[SensorFrame]:
        """One frame per request, in order (``types.Sense``).

        Raises:
            RequestError: a lens or shutter that the street cannot draw, an unknown actor, or a pose that is none.
            TooLargeError: an image wider or higher than 4096 pixels.
        """
        for request in requests:
            self._check(request)
        return [self._run(functools.partial(self._frame, request)) for request in requests]

    def view(self, request: SensorRequest) -> TrueView:
        """A camera image with exact depth, classes and instances; raises as ``sense`` does."""
        self._check(request)
        return self._run(functools.partial(self._view, request))

    def scan(self, request: SensorRequest) -> TrueScan:
        """A LiDAR turn as measured, each column from where the sensor and the actors were when it fired."""
        self._check(request)
        return self._run(functools.partial(self._scan, request))

    # ------------------------------------------------------------------------------------- in the street's thread

    def _run(self, work: Callable[[], T]) -> T:
        if self._closed:
            raise RuntimeError("this street is closed; make a new TrueWorld")
        return self._thread.submit(work).result()

    def _start(self) -> Street:
        street = build_street(self.plan)
        self._data = mujoco.MjData(street.model)
        start_us = self.plan.span_us[0]
        actors = {name: path.at(start_us)[None] for name, path in self._recorded.items()}
        street.pose(self._data, start_us, street.actor_places(actors, 1))
        if self.backend != "rays":
            from nurec_sim.world.render import GlPainter

            self._painter = GlPainter(street, self.backend)
        return street

    def _stop(self) -> None:
        if self._painter is not None:
            self._painter.close()
            self._painter = None

    def _places(self, request: SensorRequest, fractions: Float64[np.ndarray, " n"]) -> ActorPlaces:
        """All actors at fractions of the request's time: as asked for, else as recorded."""
        times = request.start_us + np.rint(fractions * (request.end_us - request.start_us)).astype(np.int64)
        actors = {name: path.at(times) for name, path in self._recorded.items() if name not in request.actors}
        for name, pair in request.actors.items():
            actors[name] = geometry.interpolate_pose_pair(np.asarray(pair, np.float64), fractions)
        return self.street.actor_places(actors, len(fractions))

    def _view(self, request: SensorRequest) -> TrueView:
        camera = request.sensor
        if not isinstance(camera, CameraModel):
            raise RequestError(f"a view needs a camera, and {camera.id!r} is none")
        self.street.pose(self._data, request.start_us, self._places(request, np.zeros(1)))
        pose = np.asarray(request.world_from_sensor, np.float64)[0]
        if self._painter is not None:
            rgb, geom, depth = self._painter.view(self._data, camera, pose)
        else:
            rgb, geom, depth = rays.view(self.street, self._data, camera, pose)
        return TrueView(rgb, depth, *self._named(geom))

    def _named(self, geom: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Class and instance of geom ids, where -1 is the sky."""
        sky = geom < 0
        surface = np.where(sky, np.uint8(SurfaceClass.SKY), self.street.geom_class[geom])
        return surface, np.where(sky, np.int32(0), self.street.geom_instance[geom])

    def _scan(self, request: SensorRequest) -> TrueScan:
        lidar = request.sensor
        if not isinstance(lidar, LidarModel):
            raise RequestError(f"a scan needs a LiDAR, and {lidar.id!r} is none")
        beams, fractions = sensors.beam_directions(lidar), sensors.column_fraction(lidar)
        poses = geometry.interpolate_pose_pair(np.asarray(request.world_from_sensor, np.float64), fractions)
        shape = beams.shape[:2]
        range_m, intensity, geom = np.zeros(shape), np.zeros(shape, np.float32), np.zeros(shape, np.int32)
        places, span_us = self._places(request, fractions), request.end_us - request.start_us
        for column, fraction in enumerate(fractions):
            self.street.pose(self._data, request.start_us + fraction * span_us, places, column)
            range_m[:, column], intensity[:, column], geom[:, column] = rays.fire_column(
                self.street, self._data, lidar, poses[column], beams[:, column]
            )
        return TrueScan(range_m, intensity, *self._named(geom))

    def _frame(self, request: SensorRequest) -> SensorFrame:
        if isinstance(request.sensor, LidarModel):
            return _lidar_frame(request, request.sensor, self._scan(request))
        view = self._view(request)
        alpha = (view.surface != SurfaceClass.SKY).astype(np.float32)
        return CameraFrame(request.sensor, request.start_us, request.end_us, view.rgb, view.depth_m, alpha,
                           LABEL_OF_CLASS[view.surface])  # fmt: skip

    # ------------------------------------------------------------------------------------------------- checking

    def _check(self, request: SensorRequest) -> None:
        sensor = request.sensor
        pair = np.asarray(request.world_from_sensor, np.float64)
        if pair.shape != (2, 4, 4) or not all(geometry.is_rotation(pose[:3, :3]) for pose in pair):
            raise RequestError(f"sensor {sensor.id!r}: world_from_sensor must be two poses [2,4,4] with rotations")
        if not np.isfinite(pair).all() or request.end_us < request.start_us:
            raise RequestError(f"sensor {sensor.id!r}: poses must be finite and end_us not before start_us")
        for name, actor in request.actors.items():
            if name not in self._recorded:
                raise RequestError(f"no actor {name!r} in this street; have {sorted(self._recorded)}")
            actor = np.asarray(actor)
            if actor.shape != (2, 4, 4) or not all(geometry.is_rotation(pose[:3, :3]) for pose in actor):
                raise RequestError(f"actor {name!r}: world_from_box must be two poses [2,4,4] with rotations")
        if isinstance(sensor, LidarModel):
            return
        if not isinstance(sensor.lens, Pinhole) or sensor.lens.distorted or sensor.windshield is not None:
            raise RequestError(
                f"camera {sensor.id!r}: the street draws pinhole cameras without distortion or windshield only, "
                f"got {type(sensor.lens).__name__}"
            )
        if sensor.shutter is not Shutter.GLOBAL:
            raise RequestError(
                f"camera {sensor.id!r}: the street draws global shutters only, got {sensor.shutter.value}"
            )
        if max(sensor.width_px, sensor.height_px) > MAX_SIDE_PX:
            raise TooLargeError(
                f"camera {sensor.id!r}: {sensor.width_px} x {sensor.height_px} pixels; at most {MAX_SIDE_PX} a side"
            )


def measured_points(
    lidar: LidarModel, scan: TrueScan
) -> tuple[Float64[np.ndarray, "n 3"], Float32[np.ndarray, " n"], Int32[np.ndarray, " n"]]:
    """Returns of a turn: points in the frame of the LiDAR at their own instant, intensity, beam (row-major)."""
    beam = np.flatnonzero(scan.range_m.ravel() > 0).astype(np.int32)
    directions = sensors.beam_directions(lidar).reshape(-1, 3)[beam]
    return directions * scan.range_m.ravel()[beam, None], scan.intensity.ravel()[beam], beam


def _lidar_frame(request: SensorRequest, lidar: LidarModel, scan: TrueScan) -> LidarFrame:
    """A turn as a frame: points in the sensor frame at the end of the spin."""
    xyz, intensity, beam = measured_points(lidar, scan)
    pair = np.asarray(request.world_from_sensor, np.float64)
    fired = geometry.interpolate_pose_pair(pair, sensors.column_fraction(lidar))[beam % scan.range_m.shape[1]]
    xyz = sensors.compensate_sweep(xyz, fired, pair[1])
    range_m = scan.range_m.ravel()[beam]
    return LidarFrame(lidar, request.start_us, request.end_us, xyz.astype(np.float32), range_m.astype(np.float32),
                      intensity, beam)  # fmt: skip
