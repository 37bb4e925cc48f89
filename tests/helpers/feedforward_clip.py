"""A driving log in memory: any cameras, any frame times, a car in a curve, images that differ by camera and frame."""

import dataclasses
from collections.abc import Mapping
from functools import cached_property

import numpy as np

from nurec_sim import geometry
from nurec_sim.types import CameraModel, Pinhole, Rig, Trajectory

FORWARD = np.array([[0.0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.4], [0, 0, 0, 1]])
START_US = 1_600_000_000_000_000


def looking(azimuth_deg: float, x: float = 0.0, y: float = 0.0) -> np.ndarray:
    """Mount of a camera that looks to a side, left positive."""
    return geometry.pose(geometry.rotation_from_yaw(np.radians(azimuth_deg)), np.array([x, y, 0.0])) @ FORWARD


def pinhole(name: str, mount: np.ndarray = FORWARD, width: int = 96, height: int = 54, field_deg: float = 100.0):
    focal = width / 2 / np.tan(np.radians(field_deg) / 2)
    return CameraModel(name, width, height, Pinhole(focal, focal, width / 2, height / 2), mount)


def frame_times(count: int, step_us: int, first_us: int = START_US, exposure_us: int = 0) -> np.ndarray:
    start = first_us + np.arange(count, dtype=np.int64) * step_us
    return np.stack([start, start + exposure_us], axis=1)


@dataclasses.dataclass(frozen=True, eq=False)
class MadeClip:
    """See the module; ``times`` are exposures [frames, 2] of every camera."""

    cameras: Mapping[str, CameraModel]
    times: Mapping[str, np.ndarray]
    id: str = "made"
    tracks: tuple = ()
    road_map: None = None

    @cached_property
    def rig(self) -> Rig:
        return Rig(self.cameras, {})

    time_offset_us = 0

    @property
    def span_us(self) -> tuple[int, int]:
        shown = [times for times in self.times.values() if len(times)]
        return min(int(t.min()) for t in shown), max(int(t.max()) for t in shown) + 1

    @cached_property
    def ego(self) -> Trajectory:
        """Poses at 20 Hz over all exposures: 10 m/s, turning left, nodding."""
        start, end = self.span_us
        t_us = np.arange(start, end + 50_000, 50_000)
        poses = []
        for s in (t_us - start) / 1e6:
            nod = 0.02 * np.sin(3 * s)
            pitch = np.array([[np.cos(nod), 0, np.sin(nod)], [0, 1, 0], [-np.sin(nod), 0, np.cos(nod)]])
            position = np.array([4000 + 10 * s, -7000 + 0.8 * s**2, 5.0])
            poses.append(geometry.pose(geometry.rotation_from_yaw(0.3 + 0.16 * s) @ pitch, position))
        return Trajectory(t_us, np.array(poses))

    def camera_times_us(self, camera_id: str) -> np.ndarray:
        return self.times[camera_id]

    def world_from_camera(self, camera_id: str, index: int) -> np.ndarray:
        return self.ego.at(self.times[camera_id][index]) @ self.cameras[camera_id].rig_from_camera

    def ego_mask(self, camera_id: str) -> np.ndarray | None:
        return None

    def image(self, camera_id: str, index: int) -> np.ndarray:
        camera = self.cameras[camera_id]
        rows, columns = np.indices((camera.height_px, camera.width_px))
        number = list(self.cameras).index(camera_id)
        picture = np.stack([columns * 200 / camera.width_px, rows * 200 / camera.height_px, 0 * rows + 10 * index], -1)
        return (picture + 5 * number).astype(np.uint8)


def clip_of(*cameras: CameraModel, times: np.ndarray | Mapping[str, np.ndarray]) -> MadeClip:
    """A clip of cameras; one array of times serves all."""
    each = times if isinstance(times, Mapping) else {camera.id: times for camera in cameras}
    return MadeClip({camera.id: camera for camera in cameras}, each)
