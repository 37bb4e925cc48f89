"""The sensors of a policy, and their sensor requests.

Policies get ideal pinhole images only: a camera with a fisheye, F-theta or distorted lens, or behind a windshield, is
replaced by a virtual ideal pinhole at the same pose, with the same horizontal field of view up to 100 degrees.
Exposures and sweeps end at planning time, so there is no sensor latency.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim.errors import RequestError, ScenarioError
from nurec_sim.sim.scenario import SensorSettings
from nurec_sim.types import (
    CameraFrame,
    CameraModel,
    LidarFrame,
    LidarModel,
    Matrix4,
    Needs,
    Pinhole,
    Rig,
    Sense,
    SensorFrame,
    SensorRequest,
    Shutter,
    Track,
    Trajectory,
)

MAX_VIRTUAL_FOV_RAD = math.radians(100.0)
FRONT_TOLERANCE_RAD = math.radians(10.0)
TELE_FOV_RAD, TELE_AT_MOST_RAD = math.radians(30.0), math.radians(45.0)
SIDES_RAD = {"left": math.radians(60.0), "right": math.radians(-60.0)}
SIDE_TOLERANCE_RAD = math.radians(40.0)
PoseAt = Callable[[int], Matrix4]
Exposures = Int64[np.ndarray, "frames 2"]


class SceneFacts(Protocol):
    """Scene data for the loop, satisfied by ``types.Clip`` and ``types.GaussianScene``."""

    @property
    def id(self) -> str: ...  # noqa: D102

    @property
    def rig(self) -> Rig: ...  # noqa: D102

    @property
    def ego(self) -> Trajectory: ...  # noqa: D102

    @property
    def tracks(self) -> Sequence[Track]: ...  # noqa: D102

    @property
    def span_us(self) -> tuple[int, int]: ...  # noqa: D102

    @property
    def camera_times_us(self) -> Mapping[str, Exposures] | Callable[[str], Exposures]:
        """Start and end of every exposure by camera: a mapping (scenes) or a method (clips); cameras may be missing."""
        ...


class SensorSuite:
    """The sensors of one rollout, by their name in the policy or the scenario.

    Raises:
        ScenarioError: the rig lacks a required sensor.
    """

    def __init__(self, needs: Needs, settings: SensorSettings, facts: SceneFacts) -> None:
        width = settings.image_width_px or needs.image_width_px
        self._scene_id = facts.id
        # Scenes know whether a camera sees the ego vehicle; clips, whose true world has no ego vehicle, do not.
        self._sees_ego = frozenset(getattr(facts, "ego_images", ()))
        self._span_us = facts.span_us
        self._policy_names = {*needs.cameras, *needs.lidars}
        self.cameras = {
            name: policy_camera(find_camera(facts.rig, name), width)
            for name in dict.fromkeys((*needs.cameras, *settings.record_cameras))
        }
        self.lidars = {
            name: find_lidar(facts.rig, name) for name in dict.fromkeys((*needs.lidars, *settings.record_lidars))
        }
        self._exposure_us = {name: exposure_us(facts, camera) for name, camera in self.cameras.items()}

    def sense(
        self,
        sense: Sense,
        t_us: int,
        pose_at: PoseAt,
        actors: Callable[[int, int], Mapping[str, Float64[np.ndarray, "2 4 4"]]],
    ) -> dict[str, SensorFrame]:
        """All frames that end at ``t_us``, by name, in at most one call of ``sense``.

        Args:
            sense: the renderer.
            t_us: planning time, microseconds.
            pose_at: world-from-rig pose [4, 4] at a time up to ``t_us``.
            actors: poses [2, 4, 4] of edited actors by track id, at the start and the end of an exposure (``start_us``,
                ``end_us``).

        Raises:
            RequestError: the renderer returned frames other than those requested.
        """
        sensors: dict[str, CameraModel | LidarModel] = {**self.cameras, **self.lidars}
        requests = [self._request(name, sensor, t_us, pose_at, actors) for name, sensor in sensors.items()]
        if not requests:
            return {}
        frames = list(sense(requests))
        if len(frames) != len(requests):
            raise RequestError(f"the renderer returned {len(frames)} frames for {len(requests)} requests")
        for (name, sensor), frame in zip(sensors.items(), frames, strict=True):
            wanted = CameraFrame if isinstance(sensor, CameraModel) else LidarFrame
            if not isinstance(frame, wanted):
                raise RequestError(f"sensor '{name}': wanted a {wanted.__name__}, got {type(frame).__name__}")
        return dict(zip(sensors, frames, strict=True))

    def for_policy(self, frames: Mapping[str, SensorFrame]) -> tuple[dict[str, CameraFrame], dict[str, LidarFrame]]:
        """Cameras and LiDARs in the policy's ``needs``, without frames recorded for videos only."""
        mine = {name: frame for name, frame in frames.items() if name in self._policy_names}
        cameras = {name: frame for name, frame in mine.items() if isinstance(frame, CameraFrame)}
        return cameras, {name: frame for name, frame in mine.items() if isinstance(frame, LidarFrame)}

    def _request(
        self, name: str, sensor: CameraModel | LidarModel, t_us: int, pose_at: PoseAt, actors: Callable
    ) -> SensorRequest:
        if isinstance(sensor, LidarModel):
            rig_from_sensor, lasts_us = sensor.rig_from_lidar, int(round(1e6 / sensor.frequency_hz))
        else:
            rig_from_sensor, lasts_us = sensor.rig_from_camera, self._exposure_us[name]
        # An exposure cannot begin before the recording, which has no poses there.
        start_us = max(t_us - lasts_us, self._span_us[0])
        # An instant is [t, t + 1), as in NuRec clients; both ends lie inside the half-open span.
        end_us = max(t_us, start_us + 1)
        poses = np.stack([pose_at(start_us), pose_at(t_us)]) @ rig_from_sensor
        return SensorRequest(self._scene_id, sensor, start_us, end_us, poses, actors(start_us, t_us),
                             show_ego=sensor.id in self._sees_ego)  # fmt: skip


def find_camera(rig: Rig, name: str) -> CameraModel:
    """A camera by id, or by where it looks: ``front``, ``tele``, ``left`` or ``right``.

    Of the cameras within 10 degrees of the most forward-facing one, ``front`` is the one with the widest view, and of
    these the first in the rig, which excludes tele cameras and the right camera of a stereo pair. ``tele`` is the one
    with the narrowest view, if that is at most 45 degrees; otherwise a virtual camera with the middle 30 degrees of
    ``front``. ``left`` and ``right`` are the cameras that look closest to 60 degrees aside, by 40 at most.

    Raises:
        ScenarioError: no such camera; the text lists the rig's.
    """
    if name in rig.cameras:
        return rig.cameras[name]
    if name in ("front", "tele") and rig.cameras:
        off_axis = {c.id: math.acos(min(1.0, float(c.rig_from_camera[0, 2]))) for c in rig.cameras.values()}
        best = min(off_axis.values())
        forward = [c for c in rig.cameras.values() if off_axis[c.id] <= best + FRONT_TOLERANCE_RAD]
        # Rounded to 1 mrad: the two cameras of a stereo pair count as equal, and ``max`` returns the first of equals.
        front = max(forward, key=lambda c: round(horizontal_fov_rad(c), 3))
        return front if name == "front" else _tele(front, forward)
    if name in SIDES_RAD:
        off = {c.id: _off_yaw(c, SIDES_RAD[name]) for c in rig.cameras.values()}
        if off and min(off.values()) <= SIDE_TOLERANCE_RAD:
            return rig.cameras[min(off, key=lambda camera_id: round(off[camera_id], 3))]
    raise ScenarioError(f"camera '{name}' is needed but the rig has no such camera; have {list(rig.cameras)}")


def _off_yaw(camera: CameraModel, yaw_rad: float) -> float:
    """Angle between the horizontal direction of a camera and a yaw in the rig; pi for one that looks up or down."""
    x, y = (float(value) for value in camera.rig_from_camera[:2, 2])
    if math.hypot(x, y) < 0.5:
        return math.pi
    return abs(math.remainder(math.atan2(y, x) - yaw_rad, 2 * math.pi))


def _tele(front: CameraModel, forward: Sequence[CameraModel]) -> CameraModel:
    """The forward camera with the narrowest view, or the middle of ``front``, with as many pixels as the whole."""
    narrow = min(forward, key=lambda c: round(horizontal_fov_rad(c), 3))
    if horizontal_fov_rad(narrow) <= TELE_AT_MOST_RAD:
        return narrow
    focal = front.width_px / 2 / math.tan(TELE_FOV_RAD / 2)
    lens = Pinhole(focal, focal, front.width_px / 2, front.height_px / 2)
    return replace(front, lens=lens, windshield=None)


def find_lidar(rig: Rig, name: str) -> LidarModel:
    """A LiDAR by id, or the first one for ``any``.

    Raises:
        ScenarioError: no such LiDAR; the text lists the rig's.
    """
    if name in rig.lidars:
        return rig.lidars[name]
    if name == "any" and rig.lidars:
        return next(iter(rig.lidars.values()))
    raise ScenarioError(f"LiDAR '{name}' is needed but the rig has no such LiDAR; have {list(rig.lidars)}")


def horizontal_fov_rad(camera: CameraModel) -> float:
    """Angle between the rays at the centres of the left and right image borders, limited to the lens's valid range."""
    from nurec_sim.sensors import unproject

    # 33 columns instead of the two borders: the projection of a fisheye or F-theta lens may end inside the image.
    columns = np.linspace(0.0, camera.width_px, 33)
    rays, valid = unproject(camera, np.column_stack([columns, np.full(33, camera.height_px / 2)]))
    if np.count_nonzero(valid) < 2:
        return MAX_VIRTUAL_FOV_RAD
    azimuth = np.arctan2(rays[valid, 0], rays[valid, 2])
    return float(azimuth[-1] - azimuth[0])


def policy_camera(camera: CameraModel, width_px: int) -> CameraModel:
    """The ideal pinhole that replaces a rig camera: same id, pose and shutter, ``width_px`` wide."""
    from nurec_sim.sensors import scaled_camera

    height_px = max(8, round(width_px * camera.height_px / camera.width_px))
    if camera.ideal_pinhole is not None:
        return scaled_camera(camera, width_px, height_px)
    half = min(horizontal_fov_rad(camera), MAX_VIRTUAL_FOV_RAD) / 2
    focal = width_px / 2 / math.tan(half)
    lens = Pinhole(focal, focal, width_px / 2, height_px / 2)
    return replace(camera, width_px=width_px, height_px=height_px, lens=lens, windshield=None)


def exposure_us(facts: SceneFacts, camera: CameraModel) -> int:
    """Median exposure duration of this camera in the log; 0 for a global shutter or if unknown."""
    if camera.shutter is Shutter.GLOBAL:
        return 0
    times = facts.camera_times_us
    frames = times.get(camera.id, ()) if isinstance(times, Mapping) else times(camera.id)
    if len(frames) == 0:
        return 0
    frames = np.asarray(frames, np.int64)
    return int(np.median(frames[:, 1] - frames[:, 0]))
