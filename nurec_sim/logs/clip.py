"""A driving log: poses and tables in memory, images and sweeps loaded on demand."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from nurec_sim import display
from nurec_sim.errors import ClipError
from nurec_sim.logs.describe import SENSOR_COLUMNS, describe_clip
from nurec_sim.logs.kept import Kept, Recent
from nurec_sim.logs.sweeps import SweepRecord, compensated_sweep
from nurec_sim.types import (
    CameraModel,
    LidarModel,
    LogSource,
    Matrix4,
    Rig,
    RoadMap,
    Sweep,
    SweepPoints,
    Track,
    Trajectory,
)

IMAGES_KEPT = 6
SWEEPS_KEPT = 2
STORED_BYTES = 256 << 20
"""Of sweeps as their log stores them, decoded: those of 80 turns of an HDL-64."""

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class ImageRecord:
    """One frame of a camera: where it is stored, when it was exposed and from where.

    Attributes:
        file: where it is stored, for messages.
        start_us: start of the exposure.
        end_us: its end; equal to the start where the log knows one time only.
        world_from_camera: poses of the camera at both times.
    """

    file: str
    start_us: int
    end_us: int
    world_from_camera: Float64[np.ndarray, "2 4 4"]


@runtime_checkable
class EncodedImages(Protocol):
    """A source (``types.LogSource``) whose images are JPEG or PNG files."""

    def encoded_image(self, camera_id: str, index: int) -> bytes:
        """The file of one frame."""
        ...


class Clip:
    """A driving log (``types.Clip``); ``open_clip`` makes one from a path, a log reader from its parts.

    Args:
        id: name of the clip.
        rig: its sensors.
        ego: poses of the rig.
        images: records of each camera's frames, in the order of time.
        sweeps: records of each LiDAR's sweeps, in the order of time.
        source: loads images and sweeps, by sensor id and index into these records.
        tracks: labelled objects; poses are those of box centres in the world.
        road_map: road geometry, or None.
        facts: other metadata of the log (dataset, licence, source of poses, ...), plain JSON.
        rig_from_log: pose in the rig frame of the log's ego frame, to which its calibration refers; identity if None.

    Attributes:
        time_offset_us: offset of all times from the recorded ones.
        path: path it was opened from; None if created in memory.
        format: name of the reader that opened it.
    """

    path: Path | None = None
    format: str = ""
    time_offset_us: int = 0

    def __init__(
        self,
        id: str,
        rig: Rig,
        ego: Trajectory,
        images: Mapping[str, Sequence[ImageRecord]],
        sweeps: Mapping[str, Sequence[SweepRecord]],
        source: LogSource,
        *,
        tracks: Sequence[Track] = (),
        road_map: RoadMap | None = None,
        facts: Mapping[str, Any] | None = None,
        rig_from_log: Matrix4 | None = None,
    ) -> None:
        self.id = id
        self.rig = rig
        self.ego = ego
        self.tracks = tuple(tracks)
        self.road_map = road_map
        self.facts = dict(facts or {})
        self.rig_from_log = np.eye(4) if rig_from_log is None else rig_from_log
        self.source = source
        self._images = {name: tuple(records) for name, records in images.items()}
        self._sweeps = {name: tuple(records) for name, records in sweeps.items()}
        records = [record for group in (self._images, self._sweeps) for rows in group.values() for record in rows]
        starts = [ego.start_us, *(record.start_us for record in records)]
        ends = [ego.end_us, *(record.end_us for record in records)]
        self._span_us = (min(starts), max(ends) + 1)
        self._recent_images: Recent[UInt8[np.ndarray, "h w 3"]] = Recent(IMAGES_KEPT)
        self._recent_sweeps: Recent[Sweep] = Recent(SWEEPS_KEPT)

    def __repr__(self) -> str:
        return f"Clip({self.id!r}, cameras={list(self.rig.cameras)}, lidars={list(self.rig.lidars)})"

    def _repr_html_(self) -> str:
        """Contents, and the first image of each camera, for notebooks."""
        summary = describe_clip(self)
        parts = [display.table(f"clip {self.id}", summary.facts), display.table("", summary.sensors, SENSOR_COLUMNS)]
        for camera_id in self.rig.cameras:
            if self.frame_count(camera_id):
                try:
                    parts.append(display.image_tag(display.jpeg(display.thumbnail(self.image(camera_id, 0)))))
                except ClipError as error:
                    parts.append(display.table("", [(str(error),)]))
        return "".join(parts)

    def replaced(
        self,
        *,
        ego: Trajectory | None = None,
        images: Mapping[str, Sequence[ImageRecord]] | None = None,
        sweeps: Mapping[str, Sequence[SweepRecord]] | None = None,
        tracks: Sequence[Track] | None = None,
        rig: Rig | None = None,
        time_offset_us: int | None = None,
    ) -> Clip:
        """The same log with some parts replaced; arguments as for the class and its attributes."""
        clip = Clip(
            id=self.id,
            rig=rig or self.rig,
            ego=ego or self.ego,
            images=self._images if images is None else images,
            sweeps=self._sweeps if sweeps is None else sweeps,
            source=self.source,
            tracks=self.tracks if tracks is None else tracks,
            road_map=self.road_map,
            facts=self.facts,
            rig_from_log=self.rig_from_log,
        )
        clip.path, clip.format = self.path, self.format
        # What is stored is the same, whatever is known about poses, beams and times.
        clip._stored_sweeps = self._stored_sweeps
        clip.time_offset_us = self.time_offset_us if time_offset_us is None else time_offset_us
        return clip

    @property
    def source(self) -> LogSource:
        """Loads images and sweeps."""
        return self._source

    @source.setter
    def source(self, source: LogSource) -> None:
        self._source = source
        self._stored_sweeps: Kept[SweepPoints] = Kept(STORED_BYTES, _size)

    @property
    def span_us(self) -> tuple[int, int]:
        """[start, end) of everything recorded: ego poses, exposures and sweeps."""
        return self._span_us

    def camera(self, camera_id: str) -> CameraModel:
        """A camera of the rig.

        Raises:
            ClipError: there is none of that name.
        """
        return _named(self.id, "camera", camera_id, self.rig.cameras)

    def lidar(self, lidar_id: str) -> LidarModel:
        """A LiDAR of the rig.

        Raises:
            ClipError: there is none of that name.
        """
        return _named(self.id, "LiDAR", lidar_id, self.rig.lidars)

    def frame_count(self, camera_id: str) -> int:
        """Number of frames of a camera."""
        return len(self.image_records(camera_id))

    def sweep_count(self, lidar_id: str) -> int:
        """Number of sweeps of a LiDAR."""
        return len(self.sweep_records(lidar_id))

    def image_records(self, camera_id: str) -> Sequence[ImageRecord]:
        """Files, times and poses of a camera's frames."""
        self.camera(camera_id)
        return self._images.get(camera_id, ())

    def sweep_records(self, lidar_id: str) -> Sequence[SweepRecord]:
        """Files, times and poses of a LiDAR's sweeps."""
        self.lidar(lidar_id)
        return self._sweeps.get(lidar_id, ())

    def camera_times_us(self, camera_id: str) -> Int64[np.ndarray, "frames 2"]:
        """Exposure start and end of every frame; equal where the log knows one time only."""
        records = self.image_records(camera_id)
        return np.array([(r.start_us, r.end_us) for r in records], np.int64).reshape(-1, 2)

    def sweep_times_us(self, lidar_id: str) -> Int64[np.ndarray, "sweeps 2"]:
        """Start and end of every sweep; equal where the log knows one time only."""
        records = self.sweep_records(lidar_id)
        return np.array([(r.start_us, r.end_us) for r in records], np.int64).reshape(-1, 2)

    def world_from_camera(self, camera_id: str, index: int) -> Float64[np.ndarray, "2 4 4"]:
        """Camera poses at the start and the end of the exposure."""
        return self._record("camera", camera_id, self.image_records(camera_id), index).world_from_camera.copy()

    def image(self, camera_id: str, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """One RGB frame, read-only.

        Raises:
            ClipError: no such frame; its file is missing or broken, or its size is not the calibration's.
        """
        record = self._record("camera", camera_id, self.image_records(camera_id), index)
        return self._recent_images.get((camera_id, index), lambda: self._read_image(camera_id, index, record))

    def encoded_image(self, camera_id: str, index: int) -> bytes | UInt8[np.ndarray, "h w 3"]:
        """The JPEG or PNG file of a frame as it is, if the log has one, otherwise its pixels; both are checked.

        Raises:
            ClipError: see ``image``.
        """
        pixels = self.image(camera_id, index)
        if not isinstance(self.source, EncodedImages):
            return pixels
        with self._reading(f"image {self.image_records(camera_id)[index].file}"):
            return self.source.encoded_image(camera_id, index)

    def sweep(self, lidar_id: str, index: int) -> Sweep:
        """One motion-compensated sweep; its arrays are read-only.

        Raises:
            ClipError: no such sweep; its file is missing or broken, or its arrays do not fit together.
        """
        record = self._record("LiDAR", lidar_id, self.sweep_records(lidar_id), index)
        return self._recent_sweeps.get((lidar_id, index), lambda: self._read_sweep(lidar_id, index, record))

    def ego_mask(self, camera_id: str) -> Bool[np.ndarray, "h w"] | None:
        """Pixels that show the ego vehicle; None if unknown.

        Raises:
            ClipError: no such camera, or the mask differs in size from its images.
        """
        camera = self.camera(camera_id)
        with self._reading(f"ego mask of camera {camera_id!r}"):
            mask = self.source.ego_mask(camera_id)
            if mask is not None and (mask.dtype != bool or mask.shape != (camera.height_px, camera.width_px)):
                raise ClipError(f"must be bool {(camera.height_px, camera.width_px)}, got {mask.dtype} {mask.shape}")
        return mask

    def _record(self, kind: str, name: str, records: Sequence[T], index: int) -> T:
        if not 0 <= index < len(records):
            raise ClipError(f"clip {self.id!r}: {kind} {name!r} has frames 0 to {len(records) - 1}, asked for {index}")
        return records[index]

    def _read_image(self, camera_id: str, index: int, record: ImageRecord) -> UInt8[np.ndarray, "h w 3"]:
        camera = self.rig.cameras[camera_id]
        with self._reading(f"image {record.file}"):
            image = self.source.image(camera_id, index)
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
                raise ClipError(f"must be uint8 [h,w,3], got {image.dtype} {image.shape}")
        height, width = image.shape[:2]
        if (width, height) != (camera.width_px, camera.height_px):
            raise ClipError(
                f"clip {self.id!r}: image {record.file} is {width} x {height} pixels, "
                f"but the calibration of {camera_id!r} says {camera.width_px} x {camera.height_px}"
            )
        image = image.view()
        image.setflags(write=False)
        return image

    def _read_sweep(self, lidar_id: str, index: int, record: SweepRecord) -> Sweep:
        with self._reading(f"sweep {record.file}"):
            stored = self._stored_sweeps.get((lidar_id, index), lambda: self.source.sweep(lidar_id, index))
            return compensated_sweep(record, stored, self.rig.lidars[lidar_id], self.ego)

    @contextlib.contextmanager
    def _reading(self, what: str) -> Iterator[None]:
        """Converts exceptions in the block to a ``ClipError`` that names the log and the file."""
        name = self.id if self.path is None else self.path.name
        try:
            yield
        except ClipError as error:
            # The reader's text may begin with the name already.
            raise error if str(error).startswith(f"{name}: ") else ClipError(f"{name}: {what}: {error}") from None
        except Exception as error:
            raise ClipError(f"{name}: {what} cannot be read: {type(error).__name__}: {error}") from error


def _named(clip_id: str, kind: str, name: str, known: Mapping[str, T]) -> T:
    if name not in known:
        raise ClipError(f"clip {clip_id!r} has no {kind} {name!r}; have {list(known)}")
    return known[name]


def _size(points: SweepPoints) -> int:
    """Bytes of a sweep as stored."""
    return sum(np.asarray(each).nbytes for each in (points.xyz_m, points.intensity, points.dt_us) if each is not None)
