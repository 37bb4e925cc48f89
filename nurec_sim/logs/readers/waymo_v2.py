"""Reading segments of the Waymo Open Dataset, Perception v2 (Parquet files, one folder for each component).

Their conventions: transforms take points of a sensor to the vehicle, or of the vehicle to the world; cameras look along
x, with y to the left and z up; the pose of a frame is that of about its middle, its time that of its start.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.logs import calibration
from nurec_sim.logs.boxes import BoxTracks
from nurec_sim.logs.clip import Clip, ImageRecord
from nurec_sim.logs.readers import _waymo_lidar as ranges
from nurec_sim.logs.readers._folders import FolderReader
from nurec_sim.logs.readers._waymo_tables import CAMERA, LASER, OBJECT, ROW, TIME, Tables, floats, transforms
from nurec_sim.logs.storage import decode_image
from nurec_sim.logs.sweeps import SweepRecord
from nurec_sim.types import CameraModel, LidarModel, Matrix4, Pinhole, Rig, Shutter, SweepPoints, Track, Trajectory

CAMERAS = {1: "front", 2: "front_left", 3: "front_right", 4: "side_left", 5: "side_right"}
LASERS = {1: "top", 2: "lidar_front", 3: "lidar_side_left", 4: "lidar_side_right", 5: "lidar_rear"}
LABELS = {0: "unknown", 1: "vehicle", 2: "pedestrian", 3: "sign", 4: "cyclist"}
SHUTTERS = {
    1: Shutter.TOP_TO_BOTTOM,
    2: Shutter.LEFT_TO_RIGHT,
    3: Shutter.BOTTOM_TO_TOP,
    4: Shutter.RIGHT_TO_LEFT,
}
# x forward, y left, z up in terms of x right, y down, z forward.
THEIRS_FROM_CAMERA = geometry.pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
TOP = 1
POSE, CALIBRATION = "vehicle_pose", ("camera_calibration", "lidar_calibration")
_LENS = tuple(f"intrinsic.{name}" for name in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3"))
_EXPOSURE = tuple(
    f"rolling_shutter_params.{name}" for name in ("camera_trigger_time", "camera_readout_done_time", "shutter")
)


class WaymoReader(FolderReader):
    """Reads segments of Waymo's Perception data set v2 as clips (``types.LogReader``)."""

    name = "waymo-v2"
    description = (
        f"a folder of Waymo Perception v2 with {POSE}/SEGMENT.parquet and its other components beside it, "
        "or one such file if there are several segments"
    )
    noun = "segments of Waymo Perception v2"

    def logs(self, path: Path) -> list[Path]:
        """The files of the vehicle's poses, one for each segment; of any component's file, that beside it."""
        if path.is_file() and path.suffix == ".parquet":
            beside = path.resolve().parent.parent / POSE / path.name
            return [beside] if beside.is_file() else []
        return sorted((path / POSE).glob("*.parquet")) if path.is_dir() else []

    def beside(self, log: Path) -> list[Path]:
        """The segment's files of the other components."""
        return sorted(log.parent.parent.glob(f"*/{log.name}"))

    def read(self, log: Path) -> Clip:
        """The segment as a clip."""
        return _read(Tables(log.parent.parent, log.stem))


@dataclass(frozen=True)
class _Frames:
    """Poses of the vehicle by the start of a frame; they hold half a turn later."""

    world_from_vehicle: dict[int, Matrix4]

    def __getitem__(self, start_us: int) -> Matrix4:
        if start_us not in self.world_from_vehicle:
            raise ClipError(f"{POSE}: there is no pose of the frame at {start_us} us")
        return self.world_from_vehicle[start_us]


def middle(start_us: int) -> int:
    """The time of a frame's pose."""
    return start_us + ranges.TURN_US // 2


def _read(tables: Tables) -> Clip:
    rows = tables.table(POSE, (TIME,), ("world_from_vehicle.transform",))
    poses = transforms(POSE, rows["world_from_vehicle.transform"])
    frames = _Frames(dict(zip(_times(POSE, rows), poses, strict=True)))
    if not len(poses):
        raise ClipError(f"{POSE}: there are no poses")
    cameras, images, image_rows = {}, {}, {}
    ego = None
    if tables.has("camera_image"):
        cameras = _cameras(tables)
        columns = ("pose.transform", "pose_timestamp", *_EXPOSURE)
        exposures = tables.table("camera_image", (TIME, CAMERA), columns).sort(TIME)
        if len(exposures):
            ego = _ego(floats("camera_image", exposures, ("pose_timestamp",))[:, 0], exposures["pose.transform"])
            for number, name in CAMERAS.items():
                own = exposures.filter(exposures[CAMERA] == number)
                if name in cameras:
                    image_rows[name] = own[ROW].to_list()
                    images[name] = list(_images(cameras[name], own, ego))
    if ego is None:
        starts = sorted(frames.world_from_vehicle)
        ego = Trajectory(np.array([middle(t) for t in starts], np.int64), np.array([frames[t] for t in starts]))
    source = _Segment(tables, frames, image_rows)
    lidars, sweeps = {}, {}
    if tables.has("lidar"):
        keys = tables.table("lidar", (TIME, LASER), ()).sort(TIME)
        lidars = _lidars(tables, keys)
        source.lidars |= lidars
        for number, name in LASERS.items():
            if name in lidars:
                own = keys.filter(keys[LASER] == number)
                source.sweep_rows[name] = list(zip(_times("lidar", own), own[ROW].to_list(), strict=True))
                sweeps[name] = list(_sweeps(lidars[name], source.sweep_rows[name], frames))
    if tables.has("lidar_pose"):
        keys = tables.table("lidar_pose", (TIME, LASER), ())
        own = keys.filter(keys[LASER] == TOP)
        source.pose_rows |= dict(zip(_times("lidar_pose", own), own[ROW].to_list(), strict=True))
    return Clip(
        id=tables.segment,
        rig=Rig(cameras, lidars),
        ego=ego,
        images=images,
        sweeps=sweeps,
        source=source,
        tracks=_tracks(tables, frames) if tables.has("lidar_box") else [],
        facts={"dataset": "Waymo Open Dataset, Perception v2", "licence": "Waymo Dataset License (non-commercial)"},
    )


def _times(where: str, table: Any) -> list[int]:
    times = table[TIME]
    if not times.dtype.is_integer():
        raise ClipError(f"{where}: {TIME!r} must hold whole microseconds, got {times.dtype}")
    return [int(value) for value in times]


def _cameras(tables: Tables) -> dict[str, CameraModel]:
    where, sizes = CALIBRATION[0], ("width", "height", "rolling_shutter_direction")
    table = tables.table(where, (CAMERA,), (*_LENS, "extrinsic.transform", *sizes))
    poses, lenses = transforms(where, table["extrinsic.transform"]), floats(where, table, _LENS)
    found = {}
    for number, pose, lens, size in zip(
        table[CAMERA], poses, lenses.tolist(), floats(where, table, sizes).astype(int).tolist(), strict=True
    ):
        if number not in CAMERAS:
            raise ClipError(f"{where}: camera {number} is unknown; known are {CAMERAS}")
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens
        found[CAMERAS[number]] = calibration.checked_camera(
            CameraModel(
                id=CAMERAS[number],
                width_px=size[0],
                height_px=size[1],
                lens=Pinhole(fx, fy, cx, cy, (k1, k2, k3, 0.0, 0.0, 0.0), (p1, p2)),
                rig_from_camera=pose @ THEIRS_FROM_CAMERA,
                shutter=SHUTTERS.get(size[2], Shutter.GLOBAL),
            )
        )
    return {name: found[name] for name in CAMERAS.values() if name in found}


def _microseconds(seconds: Float64[np.ndarray, "*n"]) -> np.ndarray:
    return np.rint(np.asarray(seconds) * 1e6).astype(np.int64)


def _ego(seconds: Float64[np.ndarray, " n"], poses: Any) -> Trajectory:
    """The poses of all images, which are more exact in time than those of frames."""
    times, first = np.unique(_microseconds(seconds), return_index=True)
    return Trajectory(times, transforms("camera_image", poses)[first])


def _images(camera: CameraModel, rows: Any, ego: Trajectory) -> Iterator[ImageRecord]:
    """Frames from the middle of the first row's exposure to that of the last row's."""
    if not len(rows):
        return
    triggered, done, shutter = floats("camera_image", rows, _EXPOSURE).T
    spans = np.stack([_microseconds(triggered + shutter / 2), _microseconds(done - shutter / 2)], axis=1)
    for start_us, (first_us, last_us) in zip(_times("camera_image", rows), spans.tolist(), strict=True):
        if first_us > last_us:
            raise ClipError(f"camera_image: the readout of {camera.id!r} at {start_us} us ends before it starts")
        poses = ego.at(np.array([first_us, last_us])) @ camera.rig_from_camera
        yield ImageRecord(f"camera_image of {camera.id} at {start_us} us", first_us, last_us, poses)


def _lidars(tables: Tables, keys: Any) -> dict[str, LidarModel]:
    where = CALIBRATION[1]
    columns = ("extrinsic.transform", "beam_inclination.min", "beam_inclination.max")
    table = tables.table(where, (LASER,), columns)
    edges, poses = floats(where, table, columns[1:]), transforms(where, table["extrinsic.transform"])
    found = {}
    for index, number in enumerate(table[LASER]):
        own = keys.filter(keys[LASER] == number)
        if number not in LASERS:
            raise ClipError(f"{where}: LiDAR {number} is unknown; known are {LASERS}")
        if len(own):
            rows, columns_px = ranges.range_image(tables, "lidar", own[ROW][0], ranges.CHANNELS).shape[:2]
            angles = tables.inclinations(index)
            angles = edges[index] if len(angles) == 0 else angles
            found[LASERS[number]] = ranges.lidar_model(LASERS[number], (rows, columns_px), angles, poses[index])
    return {name: found[name] for name in LASERS.values() if name in found}


def _sweeps(lidar: LidarModel, rows: list[tuple[int, int]], frames: _Frames) -> Iterator[SweepRecord]:
    for start_us, _ in rows:
        pose = frames[start_us] @ lidar.rig_from_lidar
        name = f"lidar {lidar.id} at {start_us} us"
        yield SweepRecord(name, middle(start_us), start_us, start_us + ranges.TURN_US, pose)


def _tracks(tables: Tables, frames: _Frames) -> list[Track]:
    columns = tuple(f"box.{what}.{axis}" for what in ("center", "size") for axis in "xyz")
    table = tables.table("lidar_box", (TIME, OBJECT), (*columns, "box.heading", "type"))
    values = floats("lidar_box", table, (*columns, "box.heading", "type")).tolist()
    boxes = BoxTracks()
    for start_us, name, (x, y, z, length, width, height, yaw, kind) in zip(
        _times("lidar_box", table), table[OBJECT], values, strict=True
    ):
        pose = frames[start_us] @ geometry.pose_from_xyyaw(x, y, yaw, z)
        label = LABELS.get(int(kind), "unknown")
        boxes.add("lidar_box", str(name), label, middle(start_us), pose, (length, width, height))
    return boxes.tracks()


class _Segment:
    """The images and sweeps of a segment as a ``types.LogSource``."""

    def __init__(self, tables: Tables, frames: _Frames, image_rows: dict[str, list[int]]) -> None:
        self.tables, self.frames, self.image_rows = tables, frames, image_rows
        self.lidars: dict[str, LidarModel] = {}
        self.sweep_rows: dict[str, list[tuple[int, int]]] = {}
        self.pose_rows: dict[int, int] = {}

    def image(self, camera_id: str, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """One RGB frame."""
        row = self.tables.row("camera_image", self.image_rows[camera_id][index], ("image",))
        return decode_image(bytes(row["image"][0]))

    def sweep(self, lidar_id: str, index: int) -> SweepPoints:
        """The points of one sweep, moved to the pose of its frame by the poses of its beams."""
        start_us, row = self.sweep_rows[lidar_id][index]
        image = ranges.range_image(self.tables, "lidar", row, ranges.CHANNELS)
        poses = None
        if lidar_id == LASERS[TOP] and start_us in self.pose_rows:
            poses = ranges.range_image(self.tables, "lidar_pose", self.pose_rows[start_us], ranges.POSE_CHANNELS)
        return ranges.sweep_points(self.lidars[lidar_id], image, poses, self.frames[start_us])

    def ego_mask(self, camera_id: str) -> None:
        """The data set has none."""
        return None
