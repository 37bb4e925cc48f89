"""The contents of a driving log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from nurec_sim import display, geometry
from nurec_sim.types.sensors import Rig
from nurec_sim.types.trajectories import Matrix4, Trajectory

MOVABLE_LABELS = ("automobile", "heavy_truck", "bus", "trailer", "train", "other_vehicle", "person", "rider", "animal")


@dataclass(frozen=True)
class Track:
    """One object over time; ``path`` holds the poses of its box centre (x forward, y left, z up).

    ``labelled`` is False for objects that a reconstruction detected by their motion, without a label. ``actor`` marks
    objects that count for metrics, privileged policies and clients; in a log with boxes only those do, and other movers
    are only rendered.
    """

    id: str
    label: str
    size_m: tuple[float, float, float]
    path: Trajectory
    controllable: bool = True
    labelled: bool = True
    actor: bool = True


@dataclass(frozen=True)
class RoadMap:
    """Road geometry: drivable areas as (outer ring, holes...) of [k,2] metres, lane centre lines [k,3] metres."""

    drivable: tuple[tuple[Float64[np.ndarray, "k 2"], ...], ...] = ()
    lanes: tuple[Float64[np.ndarray, "k 3"], ...] = ()

    def __str__(self) -> str:
        counts = ((len(self.drivable), "drivable area"), (len(self.lanes), "lane"))
        return ", ".join(f"{count} {noun}{'' if count == 1 else 's'}" for count, noun in counts)


@dataclass(frozen=True)
class Sweep:
    """One LiDAR revolution, motion-compensated to ``t_us``; ``intensity`` 0..1 or None, ``point_t_us`` when fired."""

    t_us: int
    start_us: int
    end_us: int
    world_from_lidar: Matrix4
    xyz_m: Float64[np.ndarray, "n 3"]
    intensity: Float32[np.ndarray, " n"] | None
    point_t_us: Int64[np.ndarray, " n"]

    @property
    def xyz_world_m(self) -> Float64[np.ndarray, "n 3"]:
        """Points in the world."""
        return geometry.transform_points(self.world_from_lidar, self.xyz_m)

    def __repr__(self) -> str:
        return f"Sweep({self.start_us} to {self.end_us} us, moved to {self.t_us} us: {len(self.xyz_m):,} points)"

    def _repr_png_(self) -> bytes:
        """The points from above, for notebooks."""
        return display.sweep_png(self.xyz_m)


class Clip(Protocol):
    """A driving log, read lazily. ``logs.open_clip`` makes one from a path."""

    @property
    def id(self) -> str:
        """Name of the log."""
        ...

    @property
    def rig(self) -> Rig:
        """Sensors and outline of the car."""
        ...

    @property
    def ego(self) -> Trajectory:
        """Recorded poses of the rig."""
        ...

    @property
    def tracks(self) -> Sequence[Track]:
        """Labelled objects; empty when the log has no boxes."""
        ...

    @property
    def road_map(self) -> RoadMap | None:
        """Road geometry; None if the log has none."""
        ...

    @property
    def span_us(self) -> tuple[int, int]:
        """[start, end) of the log; start >= 1_000_000."""
        ...

    @property
    def time_offset_us(self) -> int:
        """Offset of all times from the recorded ones; 0 unless the log starts too early."""
        ...

    def camera_times_us(self, camera_id: str) -> Int64[np.ndarray, "frames 2"]:
        """Exposure start and end of every frame; equal if the log has a single time per frame."""
        ...

    def world_from_camera(self, camera_id: str, index: int) -> Float64[np.ndarray, "2 4 4"]:
        """Camera poses at the start and the end of the exposure."""
        ...

    def image(self, camera_id: str, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """One RGB frame."""
        ...

    def sweep_times_us(self, lidar_id: str) -> Int64[np.ndarray, "sweeps 2"]:
        """Start and end of every sweep."""
        ...

    def sweep(self, lidar_id: str, index: int) -> Sweep:
        """One motion-compensated sweep."""
        ...

    def ego_mask(self, camera_id: str) -> Bool[np.ndarray, "h w"] | None:
        """Pixels that show the ego vehicle; None if unknown."""
        ...


@dataclass(frozen=True, eq=False)
class SweepPoints:
    """The points of a sweep as a log stores them.

    ``xyz_m`` is in the frame of the LiDAR (x forward, y left, z up); ``intensity`` in 0..1, or None; ``dt_us`` is when
    each point was measured, in microseconds after the start of the sweep, or None.
    """

    xyz_m: Float64[np.ndarray, "n 3"]
    intensity: Float32[np.ndarray, " n"] | None = None
    dt_us: Int64[np.ndarray, " n"] | None = None


class LogSource(Protocol):
    """Loads the large data of a log piece by piece: the part of a log reader that a ``logs.Clip`` keeps.

    It is called when an image or a sweep is requested, concurrently from several threads, with sensor ids of the clip's
    rig and indices into its records. Its exceptions become a ``ClipError`` that names the image or the sweep.
    """

    def image(self, camera_id: str, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """One RGB frame, of the size in the calibration."""
        ...

    def sweep(self, lidar_id: str, index: int) -> SweepPoints:
        """The points of one sweep."""
        ...

    def ego_mask(self, camera_id: str) -> Bool[np.ndarray, "h w"] | None:
        """Pixels that show the ego vehicle, of the camera's image size; None if unknown."""
        ...


class LogReader(Protocol):
    """Opens driving logs of one format (docs/write_a_log_reader.md)."""

    name: str
    """Name of the format, for messages."""
    description: str
    """One line that describes a log of this format: "a folder with ...". Shown if no reader recognises a log."""

    def can_open(self, path: Path) -> bool:
        """Whether a file or folder has this format, from names and headers only.

        A format that keeps several logs in one folder may accept the folder followed by the name of a log, a path that
        does not exist.

        Raises:
            ClipError: it is of this format, but damaged.
        """
        ...

    def open(self, path: Path) -> Clip:
        """Opens the log as a ``logs.Clip``; images and sweeps are read on demand.

        Raises:
            ClipError: something is missing or wrong; the text names the file and the location in it.
        """
        ...
