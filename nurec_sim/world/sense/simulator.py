"""The town itself as a sensor simulator: the reference for any renderer of its reconstruction."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar
from zlib import crc32

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim import geometry, sensors
from nurec_sim.errors import RequestError, TooLargeError
from nurec_sim.files.closing import Closing
from nurec_sim.types import CameraFrame, CameraModel, LidarFrame, LidarModel, SensorFrame, SensorRequest, Shutter
from nurec_sim.world.model.assemble import Town, build_town
from nurec_sim.world.plan.surface import LABEL_OF_CLASS
from nurec_sim.world.plan.town import TownPlan
from nurec_sim.world.sense import scan
from nurec_sim.world.sense.backend import pick_backend
from nurec_sim.world.sense.isp import CameraResponse, apply_response
from nurec_sim.world.sense.scan import LidarResponse, TrueScan, measured_points
from nurec_sim.world.sense.stage import Quality, Stage, named
from nurec_sim.world.sense.truth import TrueView

MAX_SIDE_PX = 4096
T = TypeVar("T")


class TrueWorld(Closing):
    """A town that serves sensor requests for any sensor pose and any actor poses.

    Cameras may have any lens, windshield and shutter. MuJoCo and OpenGL run in a dedicated thread, since a GL context
    belongs to its thread; ``sense`` may be called from any thread. Use it as a context manager or call ``close``.

    Args:
        plan: the town.
        backend: ``egl``, ``osmesa`` or ``rays``; None picks the first that works (``backend.pick_backend``).
        responses: imperfections of cameras and LiDARs, by sensor id; other sensors are ideal. Noise depends only on the
            plan's seed, the sensor's id and the time.
        quality: of rendering.
    """

    def __init__(
        self,
        plan: TownPlan,
        backend: str | None = None,
        responses: Mapping[str, CameraResponse | LidarResponse] | None = None,
        quality: Quality = Quality(),  # noqa: B008  (frozen)
    ):
        self.plan = plan
        self.backend = pick_backend(backend)
        self._responses, self._quality = dict(responses or {}), quality
        self._recorded = {track.id: track.path for track in plan.tracks()}
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="town")
        self._closed = False
        try:
            self._stage: Stage = self._run(self._start)
        except BaseException:
            self._thread.shutdown()
            raise

    @property
    def town(self) -> Town:
        """The compiled model; read-only."""
        return self._stage.town

    def close(self) -> None:
        """Frees the GL context and the thread; may be called again."""
        if not self._closed:
            self._run(self._stage.close)
            self._closed = True
            self._thread.shutdown()

    def sense(self, requests: Sequence[SensorRequest]) -> list[SensorFrame]:
        """One frame per request, in order (``types.Sense``).

        Raises:
            RequestError: an unsupported lens or shutter, an unknown actor, or an invalid pose.
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
        """A LiDAR turn as measured, each column from the poses of sensor and actors at its firing time."""
        self._check(request)
        return self._run(functools.partial(self._scan, request))

    def boxes(self, t_us: int) -> Float64[np.ndarray, "actors 4 4"]:
        """``world_from_box`` of all recorded actors, in the order of the plan: row i is instance i + 1 of a view."""
        return np.array([path.at(t_us) for path in self._recorded.values()], np.float64).reshape(-1, 4, 4)

    # ------------------------------------------------------------------------------------- in the town's thread

    def _run(self, work: Callable[[], T]) -> T:
        if self._closed:
            raise RuntimeError("this town is closed; make a new TrueWorld")
        return self._thread.submit(work).result()

    def _start(self) -> Stage:
        return Stage(build_town(self.plan), self._recorded, self.backend, self._quality)

    def _view(self, request: SensorRequest) -> TrueView:
        camera = request.sensor
        if not isinstance(camera, CameraModel):
            raise RequestError(f"a view needs a camera, and {camera.id!r} is none")
        seen = self._stage.see(request, camera)
        # Depth along the optical axis; rays of more than 90 degrees off the axis have none.
        forward = sensors.pixel_rays(camera)[0][..., 2]
        depth = np.where(seen.range_m > 0, np.maximum(seen.range_m * forward, 0), 0).astype(np.float32)
        # Fog lies between surface and camera, so it comes before the camera response.
        rgb, response = self.town.through_air(seen.rgb, seen.range_m), self._responses.get(camera.id)
        if isinstance(response, CameraResponse):
            rgb = apply_response(rgb, response, self._seed(request))
        return TrueView(rgb, depth, *named(self.town, seen.geom), seen.normal, seen.range_m)

    def _scan(self, request: SensorRequest) -> TrueScan:
        lidar = request.sensor
        if not isinstance(lidar, LidarModel):
            raise RequestError(f"a scan needs a LiDAR, and {lidar.id!r} is none")
        rasterised = self._quality.lidar == "rasterised" and self.backend != "rays"
        turn = (scan.rasterised_turn if rasterised else scan.cast_turn)(self._stage, request, lidar)
        response = self._responses.get(lidar.id)
        if isinstance(response, LidarResponse):
            return scan.measure(self.town, lidar, turn, response, self._seed(request))
        return scan.measure(self.town, lidar, turn)

    def _seed(self, request: SensorRequest) -> tuple[int, ...]:
        # crc32 is the same in every process, unlike hash().
        return self.plan.seed, crc32(request.sensor.id.encode()), request.start_us

    def _frame(self, request: SensorRequest) -> SensorFrame:
        if isinstance(request.sensor, LidarModel):
            return _lidar_frame(request, request.sensor, self._scan(request))
        view = self._view(request)
        alpha = (view.range_m > 0).astype(np.float32)
        normal = _in_world(view.normal, request, request.sensor)
        return CameraFrame(request.sensor, request.start_us, request.end_us, view.rgb, view.depth_m, alpha,
                           LABEL_OF_CLASS[view.surface], normal)  # fmt: skip

    # ------------------------------------------------------------------------------------------------- checking

    def _check(self, request: SensorRequest) -> None:
        sensor = request.sensor
        pair = np.asarray(request.world_from_sensor, np.float64)
        if pair.shape != (2, 4, 4) or not all(geometry.is_rotation(pose[:3, :3]) for pose in pair):
            raise RequestError(f"sensor {sensor.id!r}: world_from_sensor must be two poses [2,4,4] with rotations")
        if not np.isfinite(pair).all() or request.end_us < request.start_us:
            raise RequestError(f"sensor {sensor.id!r}: poses must be finite and end_us not before start_us")
        if request.hidden:
            raise RequestError(f"this town renders all actors; hidden must be empty, got {sorted(request.hidden)}")
        for name, actor in request.actors.items():
            if name not in self._recorded:
                raise RequestError(f"no actor {name!r} in this town; have {sorted(self._recorded)}")
            actor = np.asarray(actor)
            if actor.shape != (2, 4, 4) or not all(geometry.is_rotation(pose[:3, :3]) for pose in actor):
                raise RequestError(f"actor {name!r}: world_from_box must be two poses [2,4,4] with rotations")
        try:
            if isinstance(sensor, LidarModel):
                sensors.check_lidar(sensor)
                return
            sensors.check_camera(sensor)
        except ValueError as error:
            raise RequestError(str(error)) from None
        if max(sensor.width_px, sensor.height_px) > MAX_SIDE_PX:
            raise TooLargeError(
                f"camera {sensor.id!r}: {sensor.width_px} x {sensor.height_px} pixels; at most {MAX_SIDE_PX} a side"
            )


def _in_world(
    normal: Float32[np.ndarray, "h w 3"], request: SensorRequest, camera: CameraModel
) -> Float32[np.ndarray, "h w 3"]:
    """Normals in the world's axes; a camera that rotates during its exposure has one rotation per line."""
    height, width = normal.shape[:2]
    by_column = camera.shutter in (Shutter.LEFT_TO_RIGHT, Shutter.RIGHT_TO_LEFT)
    lines = np.arange(width if by_column else height) + 0.5
    fractions = sensors.shutter_fraction(camera, np.stack([lines, lines], axis=1))
    poses = geometry.interpolate_pose_pair(np.asarray(request.world_from_sensor, np.float64), fractions)
    # Row vectors: n R^T is R n.
    turns = np.ascontiguousarray(poses[:, :3, :3].transpose(0, 2, 1), np.float32)
    if by_column:
        return np.ascontiguousarray((normal.transpose(1, 0, 2) @ turns).transpose(1, 0, 2))
    return normal @ turns


def _lidar_frame(request: SensorRequest, lidar: LidarModel, turn: TrueScan) -> LidarFrame:
    """A turn as a frame, with points motion-compensated to the sensor frame at the end of the spin."""
    xyz, intensity, beam = measured_points(lidar, turn)
    pair = np.asarray(request.world_from_sensor, np.float64)
    fired = geometry.interpolate_pose_pair(pair, sensors.column_fraction(lidar))[beam % turn.range_m.shape[1]]
    xyz = sensors.compensate_sweep(xyz, fired, pair[1])
    range_m = turn.range_m.ravel()[beam]
    return LidarFrame(lidar, request.start_us, request.end_us, xyz.astype(np.float32), range_m.astype(np.float32),
                      intensity, beam)  # fmt: skip
