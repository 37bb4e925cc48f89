"""A log with selected frames and sweeps of another one, loaded on demand, or with other tracks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar, cast

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from nurec_sim.types import Clip, Rig, RoadMap, Sweep, Track, Trajectory

Image = UInt8[np.ndarray, "h w 3"]
AnyClip = TypeVar("AnyClip", bound=Clip)


@dataclass(frozen=True, eq=False)
class Shot:
    """A camera frame: exposure, poses, and a function that loads it."""

    start_us: int
    end_us: int
    world_from_camera: Float64[np.ndarray, "2 4 4"]
    image: Callable[[], Image]


@dataclass(frozen=True, eq=False)
class Revolution:
    """A LiDAR sweep: time span, and a function that loads it."""

    start_us: int
    end_us: int
    sweep: Callable[[], Sweep]


@dataclass(frozen=True, eq=False)
class ContextClip:
    """An in-memory driving log (``types.Clip``) with selected frames and sweeps.

    Attributes:
        id: name of the log.
        rig: its sensors.
        ego: poses of the rig, also between and after the frames.
        span_us: [start, end) of all requests to the reconstruction.
        shots: the frames of each camera, in time order.
        revolutions: the sweeps of each LiDAR, in time order.
        tracks: labelled objects; empty if withheld from the methods.
        time_offset_us: offset of all times from the log's own.
        road_map: the road map, if any.
        ego_mask: pixels of a camera in which the car sees itself, or None.
        facts: other metadata of the log, plain JSON.
    """

    id: str
    rig: Rig
    ego: Trajectory
    span_us: tuple[int, int]
    shots: Mapping[str, Sequence[Shot]]
    revolutions: Mapping[str, Sequence[Revolution]] = field(default_factory=dict)
    tracks: Sequence[Track] = ()
    time_offset_us: int = 0
    road_map: RoadMap | None = None
    ego_mask: Callable[[str], Bool[np.ndarray, "h w"] | None] = lambda camera_id: None
    facts: Mapping[str, Any] = field(default_factory=dict)

    def camera_times_us(self, camera_id: str) -> Int64[np.ndarray, "frames 2"]:
        """Exposure start and end of every frame."""
        return _times(self.shots.get(camera_id, ()))

    def world_from_camera(self, camera_id: str, index: int) -> Float64[np.ndarray, "2 4 4"]:
        """Camera poses at the start and the end of the exposure."""
        return self.shots[camera_id][index].world_from_camera

    def image(self, camera_id: str, index: int) -> Image:
        """One RGB frame."""
        return self.shots[camera_id][index].image()

    def sweep_times_us(self, lidar_id: str) -> Int64[np.ndarray, "sweeps 2"]:
        """Start and end of every sweep."""
        return _times(self.revolutions.get(lidar_id, ()))

    def sweep(self, lidar_id: str, index: int) -> Sweep:
        """One motion-compensated sweep."""
        return self.revolutions[lidar_id][index].sweep()


class _OtherTracks:
    """A log with other tracks."""

    def __init__(self, clip: Clip, tracks: Sequence[Track]) -> None:
        self._clip, self.tracks = clip, tuple(tracks)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._clip, name)


def with_tracks(clip: AnyClip, tracks: Sequence[Track]) -> AnyClip:
    """The same log with these tracks instead of its own."""
    return cast(AnyClip, _OtherTracks(clip, tracks))


def _times(records: Sequence[Shot] | Sequence[Revolution]) -> Int64[np.ndarray, "n 2"]:
    return np.array([(record.start_us, record.end_us) for record in records], np.int64).reshape(-1, 2)
