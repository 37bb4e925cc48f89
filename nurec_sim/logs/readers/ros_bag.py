"""Reading ROS 2 bags: .mcap files, and folders of rosbag2 with .mcap or .db3 files (extra ``ros``).

Poses come from /tf or odometry, calibration from CameraInfo and /tf_static; a YAML file may name or replace any of them
(docs/log_formats.md). Times are those of the messages' headers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import sensors
from nurec_sim.errors import ClipError
from nurec_sim.logs import calibration
from nurec_sim.logs.clip import Clip, ImageRecord
from nurec_sim.logs.readers import _ros_messages as messages
from nurec_sim.logs.readers import _ros_sensors as decoding
from nurec_sim.logs.readers import _ros_storage as storage
from nurec_sim.logs.readers._ros_frames import WORLDS, Frames
from nurec_sim.logs.readers._ros_settings import CameraSettings, LidarSettings, Settings, read_settings, settings_file
from nurec_sim.logs.readers._ros_source import BagSource, SensorMessages, StoredMessage
from nurec_sim.logs.sweeps import SweepRecord
from nurec_sim.types import CameraModel, LidarModel, Matrix4, Rig, Trajectory

TIMES_LOOKED_AT = 50
ATTACHED = 0.1
"""Metres, and about radians, by which a sensor's pose in the car may change."""


class RosBagReader:
    """Reads ROS 2 bags as clips (``types.LogReader``)."""

    name = "ros2-bag"
    description = "an .mcap file, a folder of rosbag2 with metadata.yaml, or a .yaml file that names one under 'bag'"

    def can_open(self, path: Path) -> bool:
        """Whether it is a bag, or a YAML file with the key ``bag``."""
        if path.suffix in (".yaml", ".yml") and path.is_file():
            with path.open("rb") as file:
                return any(line.startswith(b"bag:") for line in file.read(1 << 16).splitlines())
        return storage.is_bag(path)

    def files(self, path: Path) -> list[Path]:
        """The bag, and the YAML file that names it or lies beside it."""
        bag, _ = read_settings(path)
        file = settings_file(path)
        return [bag, file] if file.is_file() else [bag]

    def open(self, path: Path) -> Clip:
        """The bag as a clip.

        Raises:
            ClipError: the extra is not installed, or a topic, a frame or a value is missing or wrong.
        """
        if not self.can_open(path):
            raise ClipError(f"is not a ROS 2 bag; give {self.description}")
        bag, settings = read_settings(path)
        return _Opening(bag, settings).clip()


@dataclass
class _Opening:
    """A bag while its tables are read."""

    path: Path
    settings: Settings
    files: list[storage.BagFile] = field(init=False)
    topics: dict[str, str] = field(init=False)
    frames: Frames = field(default_factory=Frames)
    infos: dict[str, Any] = field(default_factory=dict)
    found: dict[str, list[StoredMessage]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.files = storage.open_files(self.path)
        self.topics = {name: kind for each in self.files for name, kind in each.topics.items()}

    def clip(self) -> Clip:
        """The clip."""
        cameras, lidars = self._cameras(), self._lidars()
        if not cameras and not lidars:
            raise ClipError(
                f"{self.path.name}: no images with a CameraInfo and no point clouds; topics are {self.topics}"
            )
        self._scan([*(each.topic for each in cameras.values()), *(each.topic for each in lidars.values())])
        source = BagSource(self.files, self.topics)
        base = self.settings.base
        if base not in self.frames.names:
            raise ClipError(
                f"{self.path.name}: there is no frame {base!r}, have {self.frames.names}; "
                "a YAML file names the frame of the car under 'base'"
            )
        above = self.frames.above(base)
        world = self.settings.world or next((name for name in WORLDS if name in above), above[-1])
        recorded = self.frames.trajectory(world, base)
        rig_from_base = np.eye(4)
        rig_from_base[2, 3] = -self.settings.ground_z_m
        base_from_rig = np.linalg.inv(rig_from_base)
        ego = Trajectory(recorded.t_us, recorded.world_from_body @ base_from_rig)
        if self.settings.lidars is None:
            lidars = {name: each for name, each in lidars.items() if self._attached(name, each, ego.t_us)}
        if self.settings.cameras is None:
            cameras = {name: each for name, each in cameras.items() if self.found.get(each.topic)}
        rig_cameras, rig_lidars, images, sweeps = {}, {}, {}, {}
        for name, camera in cameras.items():
            rows = self._sorted(camera.topic)
            source.sensors[name] = SensorMessages(camera.topic, rows)
            rig_cameras[name] = self._camera(name, camera, source, rig_from_base)
            images[name] = list(_images(camera, rig_cameras[name], rows, ego))
        facts: dict[str, Any] = {"dataset": "ROS 2 bag", "poses": f"of {base!r} in {world!r}"}
        for name, lidar in lidars.items():
            source.sensors[name] = _lidar_messages(lidar, self._sorted(lidar.topic), source)
            rig_lidars[name] = self._lidar(name, lidar, rig_from_base)
            sweeps[name] = list(_sweeps(lidar, source.sensors[name], rig_lidars[name], ego))
            facts[f"beams of {name}"] = lidar.beams or f"not named; {sensors.STAND_IN_TABLE} stands in"
        return Clip(
            id=self.path.stem,
            rig=Rig(rig_cameras, rig_lidars),
            ego=ego,
            images=images,
            sweeps=sweeps,
            source=source,
            facts=facts,
            rig_from_log=rig_from_base,
        )

    def _cameras(self) -> dict[str, CameraSettings]:
        """The cameras as set, else those of all image topics that have a CameraInfo."""
        if self.settings.cameras is not None:
            return {name: self._known(name, each, messages.IMAGES) for name, each in self.settings.cameras.items()}
        infos = {name for name, kind in self.topics.items() if kind == messages.CAMERA_INFO}
        found: dict[str, CameraSettings] = {}
        for kind in messages.IMAGES:  # compressed images first: raw ones of the same camera are the same
            for topic in [name for name, each in sorted(self.topics.items()) if each == kind]:
                info = _info_beside(topic, infos)
                if info is not None and not any(each.info == info for each in found.values()):
                    name = info.removesuffix("camera_info").strip("/").replace("/", "_") or "camera"
                    found[name] = CameraSettings(topic=topic, info=info)
        return found

    def _lidars(self) -> dict[str, LidarSettings]:
        if self.settings.lidars is not None:
            return {name: self._known(name, each, (messages.POINTS,)) for name, each in self.settings.lidars.items()}
        topics = sorted(name for name, kind in self.topics.items() if kind == messages.POINTS)
        return {topic.strip("/").replace("/", "_"): LidarSettings(topic=topic) for topic in topics}

    def _known(self, name: str, given: Any, kinds: tuple[str, ...]) -> Any:
        if (kind := self.topics.get(given.topic)) not in kinds:
            there = [topic for topic, each in self.topics.items() if each in kinds]
            what = "is not in the bag" if kind is None else f"holds {kind}"
            raise ClipError(
                f"{self.path.name}: topic {given.topic!r} of {name!r} {what}; topics with {kinds} are {there}"
            )
        info = getattr(given, "info", None)
        if isinstance(given, CameraSettings) and given.lens is None and info is None:
            infos = {topic for topic, each in self.topics.items() if each == messages.CAMERA_INFO}
            info = _info_beside(given.topic, infos)
            if info is None:
                raise ClipError(f"{self.path.name}: camera {name!r} needs 'info' or 'lens'; CameraInfo is in {infos}")
            return dataclasses.replace(given, info=info)
        if info is not None and self.topics.get(info) != messages.CAMERA_INFO:
            raise ClipError(f"{self.path.name}: topic {info!r} of {name!r} holds no CameraInfo")
        return given

    def _scan(self, sensor_topics: list[str]) -> None:
        """Reads transforms, poses and calibration, and the headers of all frames."""
        poses = self.settings.poses
        if poses is not None and self.topics.get(poses) not in messages.POSES:
            there = [topic for topic, each in self.topics.items() if each in messages.POSES]
            raise ClipError(f"{self.path.name}: topic {poses!r} holds no poses; topics with poses are {there}")
        odometry = [topic for topic, kind in self.topics.items() if kind == messages.ODOMETRY]
        transforms = [topic for topic, kind in self.topics.items() if kind == messages.TRANSFORMS]
        if poses is None and len(odometry) == 1 and not any(not name.endswith("static") for name in transforms):
            poses = odometry[0]
        infos = [topic for topic, kind in self.topics.items() if kind == messages.CAMERA_INFO]
        whole = [*transforms, *infos, *([poses] if poses else [])]
        given: list[tuple[str, str, Any, int]] = []
        for number, file in enumerate(self.files):
            for topic, key, data in file.scan(whole, sensor_topics):
                kind = self.topics[topic]
                if topic in sensor_topics:
                    stamp_ns, frame = messages.header(data)
                    self.found.setdefault(topic, []).append(StoredMessage(number, key, stamp_ns, frame.strip("/")))
                elif kind == messages.TRANSFORMS:
                    for each in messages.decode(kind, data).transforms:
                        t_us = None if topic.endswith("static") else _t_us(each.header.stamp)
                        place, turn = each.transform.translation, each.transform.rotation
                        self.frames.add(each.header.frame_id, each.child_frame_id, place, turn, t_us)
                elif kind == messages.CAMERA_INFO:
                    if topic not in self.infos:
                        self.infos[topic] = messages.decode(kind, data)
                else:
                    each = messages.decode(kind, data)
                    pose = each.pose.pose if hasattr(each.pose, "pose") else each.pose
                    child = getattr(each, "child_frame_id", "") or self.settings.base
                    given.append((each.header.frame_id, child, pose, _t_us(each.header.stamp)))
        if given:
            self.frames.replace(given[0][1], given[0][0])
        for parent, child, pose, t_us in given:
            self.frames.add(parent, child, pose.position, pose.orientation, t_us)

    def _sorted(self, topic: str) -> list[StoredMessage]:
        """The messages of a topic by time; repeated ones are left out."""
        found = {each.t_us: each for each in reversed(self.found.get(topic, []))}
        return [found[t] for t in sorted(found)]

    def _in_base(
        self, name: str, given: CameraSettings | LidarSettings, t_us: Int64[np.ndarray, " n"]
    ) -> Float64[np.ndarray, "n 4 4"]:
        """Poses of a sensor in the base frame."""
        if given.base_from_sensor is not None:
            return np.broadcast_to(given.base_from_sensor, (len(t_us), 4, 4))
        rows = self.found.get(given.topic)
        try:
            return self.frames.pose(self.settings.base, given.frame or (rows[0].frame if rows else ""), t_us)
        except ClipError as error:
            raise ClipError(f"{self.path.name}: {name!r}: {error}; or give 'T_base_sensor'") from None

    def _mounting(self, name: str, given: CameraSettings | LidarSettings, rig_from_base: Matrix4) -> Matrix4:
        rows = self._sorted(given.topic)
        middle = np.array([rows[len(rows) // 2].t_us if rows else 0], np.int64)
        pose: Matrix4 = rig_from_base @ self._in_base(name, given, middle)[0]
        return pose

    def _attached(self, name: str, given: LidarSettings, t_us: Int64[np.ndarray, " n"]) -> bool:
        """Whether a topic has messages, and their frame keeps its place in the car; that of a map does not."""
        if not self.found.get(given.topic):
            return False
        poses = self._in_base(name, given, t_us[:: 1 + len(t_us) // TIMES_LOOKED_AT])
        return float(np.abs(poses - poses[0]).max()) < ATTACHED

    def _camera(self, name: str, given: CameraSettings, source: BagSource, rig_from_base: Matrix4) -> CameraModel:
        where = f"{self.path.name}: camera {name!r}"
        pose = self._mounting(name, given, rig_from_base)
        if given.lens is not None:
            return dataclasses.replace(given.lens, id=name, rig_from_camera=pose)
        if given.info not in self.infos:
            raise ClipError(f"{where}: there is no message on {given.info}")
        rectified = "rect" in given.topic if given.rectified is None else given.rectified
        lens, width, height = decoding.lens_of(where, self.infos[given.info], rectified)
        camera = CameraModel(name, width, height, lens, pose, given.shutter)
        if rows := self._sorted(given.topic):
            # Images are often published smaller than they were calibrated.
            rows_px, columns_px = decoding.picture(source.message(given.topic, rows[0])).shape[:2]
            if (columns_px, rows_px) != (width, height) and columns_px * height == rows_px * width:
                camera = sensors.scaled_camera(camera, columns_px, rows_px)
        return calibration.checked_camera(camera)

    def _lidar(self, name: str, given: LidarSettings, rig_from_base: Matrix4) -> LidarModel:
        pose = self._mounting(name, given, rig_from_base)
        return sensors.lidar_model(given.beams or sensors.STAND_IN_TABLE, pose, id=name)


def _t_us(stamp: Any) -> int:
    return round((stamp.sec * 1_000_000_000 + stamp.nanosec) / 1000)


def _info_beside(topic: str, infos: set[str]) -> str | None:
    """The CameraInfo of an image topic: in its own folder of names, or in one above."""
    parts = topic.split("/")
    names = ("/".join([*parts[:count], "camera_info"]) for count in range(len(parts) - 1, 0, -1))
    return next((name for name in names if name in infos), None)


def _images(
    given: CameraSettings, camera: CameraModel, rows: list[StoredMessage], ego: Trajectory
) -> Iterator[ImageRecord]:
    for each in rows:
        start_us = each.t_us + given.delay_us
        times = np.array([start_us, start_us + given.readout_us], np.int64)
        poses = ego.at(times) @ camera.rig_from_camera
        yield ImageRecord(f"{given.topic} at {each.stamp_ns} ns", int(times[0]), int(times[1]), poses)


def _lidar_messages(given: LidarSettings, rows: list[StoredMessage], source: BagSource) -> SensorMessages:
    """The messages of a LiDAR; the extent of its sweeps, relative to their messages, is that of the first one."""
    if not rows:
        return SensorMessages(given.topic, rows)
    points = decoding.cloud(source.message(given.topic, rows[0]))
    times = decoding.point_times(given.topic, points, rows[0].stamp_ns, given.time_field, given.time_unit)
    after_us = np.zeros(1, np.int64) if times is None else times.after_us(points, rows[0].stamp_ns)
    scale = given.intensity_scale or decoding.intensity_scale(points)
    return SensorMessages(given.topic, rows, times, int(after_us.min()), int(after_us.max()), scale)


def _sweeps(given: LidarSettings, sensor: SensorMessages, lidar: LidarModel, ego: Trajectory) -> Iterator[SweepRecord]:
    compensated = given.compensated or sensor.first_us == sensor.last_us
    for each in sensor.rows:
        start_us, end_us = each.t_us + sensor.first_us, each.t_us + sensor.last_us
        # Points that are compensated already belong to the time of their message.
        t_us = min(max(each.t_us, start_us), end_us)
        pose = ego.at(t_us) @ lidar.rig_from_lidar
        yield SweepRecord(f"{given.topic} at {each.stamp_ns} ns", t_us, start_us, end_us, pose, compensated)
