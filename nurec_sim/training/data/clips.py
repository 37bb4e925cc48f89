"""Training clips on disk: images of a rig's cameras in a procedural world, with ground truth for every pixel.

A clip is a folder that is renamed to its final name when complete::

    meta.json                       rig, tracks, exposures, provenance
    ego_t_us.npy   ego_pose.npy     int64 [k], float64 [k,4,4] world_from_rig
    track_t_us.npy track_pose.npy   the knots of all tracks one after the other
    <n>_t_us.npy   <n>_pose.npy     camera n: int64 [frames,2], float64 [frames,2,4,4] world_from_camera
    <n>_rgb.npy    <n>_label.npy    uint8 [frames,h,w,3], uint8 [frames,h,w] (``types.Label``)
    <n>_depth.npy  <n>_normal.npy   float16 [frames,h,w] z-depth (0 unknown), int8 [frames,h,w,3] camera frame times 127
    <n>_instance.npy                uint16 [frames,h,w]: 0 static, i + 1 the i-th track

Arrays are plain ``.npy``, so that single frames can be read from a memory map.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float16, Float32, Float64, Int8, Int64, UInt8, UInt16

from nurec_sim.errors import ClipError
from nurec_sim.files.new_files import writing
from nurec_sim.logs.calibration import rig_from_json, rig_to_json
from nurec_sim.types import Clip, Rig, RoadMap, Sweep, Track, Trajectory

FORMAT = 1
META_FILE = "meta.json"
UNFINISHED_PREFIX = ".unfinished-"
NORMAL_SCALE = 127
FARTHEST_M = 300.0
"""Larger depths are stored as unknown: half precision is too coarse, and the losses do not need them."""

_FRAME_ARRAYS = {"rgb": (np.uint8, 3), "label": (np.uint8, 0), "depth": (np.float16, 0), "normal": (np.int8, 3),
                 "instance": (np.uint16, 0)}  # fmt: skip


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """Ground truth of one image.

    ``depth_m`` is z-depth (0: sky or unknown), ``normal`` in the camera frame at the pixel's exposure time (zeros:
    unknown), ``label`` a ``types.Label``, ``instance`` 0 for static surfaces and i + 1 for the clip's i-th track.
    """

    depth_m: Float32[np.ndarray, "h w"]
    normal: Float32[np.ndarray, "h w 3"]
    label: UInt8[np.ndarray, "h w"]
    instance: UInt16[np.ndarray, "h w"]


class TrueClip(Clip, Protocol):
    """A driving log with ground truth."""

    def truth(self, camera_id: str, index: int) -> FrameTruth:
        """Ground truth of one frame."""
        ...


@dataclass(frozen=True, eq=False)
class CameraRecord:
    """All frames of one camera, as they are stored."""

    t_us: Int64[np.ndarray, "frames 2"]
    pose: Float64[np.ndarray, "frames 2 4 4"]
    rgb: UInt8[np.ndarray, "frames h w 3"]
    label: UInt8[np.ndarray, "frames h w"]
    depth: Float16[np.ndarray, "frames h w"]
    normal: Int8[np.ndarray, "frames h w 3"]
    instance: UInt16[np.ndarray, "frames h w"]


def write_training_clip(
    folder: Path, rig: Rig, ego: Trajectory, tracks: Sequence[Track], records: Sequence[CameraRecord], facts: Mapping
) -> Path:
    """Writes a clip atomically; an existing clip is kept.

    Args:
        folder: the clip's folder; its last part is the clip's id.
        rig: cameras in the order of ``records``.
        ego: poses of the rig, at least over the time of the clip.
        tracks: all movable objects; ``instance`` counts them from 1.
        records: the frames.
        facts: further metadata, plain JSON.
    """
    unfinished = folder.with_name(f"{UNFINISHED_PREFIX}{os.getpid()}-{folder.name}")
    shutil.rmtree(unfinished, ignore_errors=True)
    knots = [track.path for track in tracks]
    arrays = {
        "ego_t_us": ego.t_us,
        "ego_pose": ego.world_from_body,
        "track_t_us": np.concatenate([np.zeros(0, np.int64), *(path.t_us for path in knots)]),
        "track_pose": np.concatenate([np.zeros((0, 4, 4)), *(path.world_from_body for path in knots)]),
    }
    for number, record in enumerate(records):
        arrays |= {f"{number}_{name}": value for name, value in vars(record).items()}
    meta = {
        "format": FORMAT,
        "id": folder.name,
        **facts,
        "rig": rig_to_json(rig, intensity_scale=255),
        "tracks": [
            {"id": track.id, "label": track.label, "size_m": list(track.size_m), "knots": len(track.path.t_us),
             "controllable": track.controllable} for track in tracks
        ],
    }  # fmt: skip
    with writing(folder):
        try:
            unfinished.mkdir(parents=True)
            for name, array in arrays.items():
                np.save(unfinished / f"{name}.npy", array, allow_pickle=False)
            (unfinished / META_FILE).write_text(json.dumps(meta, indent=1) + "\n")
            unfinished.rename(folder)
        except OSError:
            shutil.rmtree(unfinished, ignore_errors=True)
            if not folder.is_dir():  # otherwise another process wrote the same clip in the meantime
                raise
    return folder


def ready_clips(folder: Path) -> list[str]:
    """Ids of the complete clips in a folder, sorted."""
    if not folder.is_dir():
        return []
    return sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith(UNFINISHED_PREFIX))


class CachedClip:
    """A training clip, read lazily (``TrueClip``).

    Raises:
        ClipError: a file is missing, truncated, or inconsistent in shape with the others.
    """

    def __init__(self, folder: str | Path) -> None:
        self._folder = Path(folder)
        self.id = self._folder.name
        self.facts = self._meta()
        try:
            self.rig = rig_from_json(self.facts["rig"])[0]
            self.ego = Trajectory(self._array("ego_t_us", np.int64), self._array("ego_pose", np.float64))
            self.tracks = self._tracks(self.facts["tracks"])
            self._numbers = {camera: number for number, camera in enumerate(self.rig.cameras)}
            self._times = {c: self._array(f"{n}_t_us", np.int64, (None, 2)) for c, n in self._numbers.items()}
            self._poses = {c: self._array(f"{n}_pose", np.float64, (len(self._times[c]), 2, 4, 4))
                           for c, n in self._numbers.items()}  # fmt: skip
            self._frames = {c: self._frame_arrays(c) for c in self._numbers}
            if not self._times or any(len(times) == 0 for times in self._times.values()):
                raise ValueError("a clip needs cameras, and every camera frames")
        except (KeyError, TypeError, ValueError) as error:
            raise ClipError(f"training clip {self._folder}: {META_FILE} or an array is damaged: {error!r}") from error

    @property
    def plan_hash(self) -> str:
        """SHA-256 of the town plan that it was generated from."""
        return str(self.facts["plan_sha256"])

    @property
    def road_map(self) -> RoadMap | None:
        """None: training needs no map."""
        return None

    @property
    def span_us(self) -> tuple[int, int]:
        """[start, end) of all exposures."""
        times = np.concatenate(list(self._times.values()))
        return int(times[:, 0].min()), int(times[:, 1].max()) + 1

    @property
    def time_offset_us(self) -> int:
        """None: captures keep their times."""
        return 0

    def camera_times_us(self, camera_id: str) -> Int64[np.ndarray, "frames 2"]:
        """Exposure start and end of every frame."""
        return self._times[camera_id]

    def world_from_camera(self, camera_id: str, index: int) -> Float64[np.ndarray, "2 4 4"]:
        """Camera poses at the start and the end of the exposure."""
        return self._poses[camera_id][index]

    def image(self, camera_id: str, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """One clean RGB frame, without any camera response."""
        return np.array(self._frames[camera_id]["rgb"][index])

    def truth(self, camera_id: str, index: int) -> FrameTruth:
        """Ground truth of one frame."""
        stored = self._frames[camera_id]
        return FrameTruth(
            stored["depth"][index].astype(np.float32),
            _unit(stored["normal"][index].astype(np.float32)),
            np.array(stored["label"][index]),
            np.array(stored["instance"][index]),
        )

    def sweep_times_us(self, lidar_id: str) -> Int64[np.ndarray, "sweeps 2"]:
        """No sweeps."""
        return np.zeros((0, 2), np.int64)

    def sweep(self, lidar_id: str, index: int) -> Sweep:
        """Training clips hold none."""
        raise ClipError(f"training clip {self.id!r} holds no LiDAR sweeps")

    def ego_mask(self, camera_id: str) -> None:
        """The car does not see itself."""

    def _meta(self) -> dict[str, Any]:
        try:
            meta = json.loads((self._folder / META_FILE).read_text())
        except (OSError, ValueError) as error:
            raise ClipError(f"no training clip at {self._folder}: {error}") from error
        if not isinstance(meta, dict) or meta.get("format") != FORMAT:
            raise ClipError(f"{self._folder / META_FILE} is not of format {FORMAT} of training clips")
        return meta

    def _array(self, name: str, kind: type, shape: tuple[int | None, ...] | None = None) -> np.ndarray:
        """A validated array; frames are memory-mapped. ``np.load`` itself detects truncated files."""
        frames = name.partition("_")[2] in _FRAME_ARRAYS
        try:
            array = np.load(self._folder / f"{name}.npy", mmap_mode="r" if frames else None, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise ClipError(f"training clip {self._folder}: {name}.npy cannot be read: {error}") from error
        if array.dtype != kind or (shape is not None and not _fits(array.shape, shape)):
            raise ClipError(f"training clip {self._folder}: {name}.npy is {array.dtype} {array.shape}, not "
                            f"{np.dtype(kind)} {shape or ''}")  # fmt: skip
        return array

    def _frame_arrays(self, camera_id: str) -> dict[str, np.ndarray]:
        camera, number = self.rig.cameras[camera_id], self._numbers[camera_id]
        size = (len(self._times[camera_id]), camera.height_px, camera.width_px)
        return {name: self._array(f"{number}_{name}", kind, (*size, channels) if channels else size)
                for name, (kind, channels) in _FRAME_ARRAYS.items()}  # fmt: skip

    def _tracks(self, rows: Sequence[Mapping[str, Any]]) -> tuple[Track, ...]:
        ends = np.cumsum([int(row["knots"]) for row in rows], dtype=np.int64)
        total = int(ends[-1]) if len(ends) else 0
        times = self._array("track_t_us", np.int64, (total,))
        poses = self._array("track_pose", np.float64, (total, 4, 4))
        paths = [Trajectory(t, p) for t, p in zip(np.split(times, ends), np.split(poses, ends), strict=True) if len(t)]
        return tuple(
            Track(str(row["id"]), str(row["label"]), (float(row["size_m"][0]), float(row["size_m"][1]),
                  float(row["size_m"][2])), path, bool(row["controllable"]))
            for row, path in zip(rows, paths, strict=True)
        )  # fmt: skip


def _fits(shape: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
    return len(shape) == len(wanted) and all(b is None or a == b for a, b in zip(shape, wanted, strict=True))


def _unit(vector: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-6)
