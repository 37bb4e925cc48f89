"""Reading NCore V4, NVIDIA's open log format, through its own package ``nvidia-ncore`` (extra ``ncore``).

Its conventions: ``T_a_b`` takes points of a to b (ours: ``b_from_a``); frames are called ``rig`` and ``world``; rays
of LiDARs are as measured, in the frame of their own instant; angles of cuboids are 'xyz' Euler angles about fixed axes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import LIMITS
from nurec_sim.logs.boxes import BoxTracks
from nurec_sim.logs.clip import Clip, ImageRecord
from nurec_sim.logs.readers import _ncore_models as models
from nurec_sim.logs.readers._packages import clip_errors, package
from nurec_sim.logs.storage import decode_image
from nurec_sim.logs.sweeps import SweepRecord
from nurec_sim.types import LidarModel, Rig, SweepPoints, Track, Trajectory

FORMAT = "NCore V4"
EXTRA = "ncore"
STORES = ("*.ncore4*.zarr.itar", "*.ncore4*.zarr")
RIG, WORLD = "rig", "world"
DEFAULT_GROUP = "default"
EGO_MASK = "ego"
_META_START = 1 << 16


class NcoreReader:
    """Reads sequences of NCore V4 as clips (``types.LogReader``)."""

    name = "ncore-v4"
    description = (
        "the .json file of an NCore V4 sequence, a .ncore4.zarr.itar file, or a folder with the files of one sequence"
    )

    def can_open(self, path: Path) -> bool:
        """Whether it is a sequence or a folder with one, from names alone (and the start of a .json file)."""
        return bool(_stores(path)) or _is_meta(path)

    def open(self, path: Path) -> Clip:
        """The sequence as a clip.

        Raises:
            ClipError: the extra is not installed, there are several sequences, or something is missing or wrong.
        """
        if not self.can_open(path):
            raise ClipError(f"is not an NCore V4 sequence; give {self.description}")
        v4 = package("ncore.data.v4", EXTRA, FORMAT)
        _refuse_pickles()
        with _reading("it"):
            reader = v4.SequenceComponentGroupsReader([path] if _is_meta(path) else _stores(path))
            loader = v4.SequenceLoaderV4(
                reader,
                poses_component_group_name=_group(reader, v4.PosesComponent, "poses") or DEFAULT_GROUP,
                intrinsics_component_group_name=_group(reader, v4.IntrinsicsComponent, "intrinsics") or DEFAULT_GROUP,
                masks_component_group_name=_group(reader, v4.MasksComponent, "masks"),
                cuboids_component_group_name=_group(reader, v4.CuboidsComponent, "cuboids"),
            )
        return _read(loader)


def _stores(path: Path) -> list[Path]:
    """Files and folders of a sequence's components."""
    if any(path.match(pattern) for pattern in STORES):
        return [path]
    return sorted(each for pattern in STORES for each in path.glob(pattern)) if path.is_dir() else []


def _is_meta(path: Path) -> bool:
    """Whether it is the .json file that lists the files of a sequence."""
    if path.suffix != ".json" or not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(_META_START)
    return b'"component_stores"' in start and b'"sequence_id"' in start


def _refuse_pickles() -> None:
    """From now on, zarr does not unpickle arrays, which would run code that a file brings along."""
    registry, codecs = package("numcodecs.registry", EXTRA, FORMAT), package("numcodecs.abc", EXTRA, FORMAT)

    class NoPickles(codecs.Codec):
        codec_id = "pickle"

        def __init__(self, **settings: Any) -> None:
            pass

        def encode(self, buf: Any) -> Any:
            return self.decode(buf)

        def decode(self, buf: Any, out: Any = None) -> Any:
            raise ClipError("an array in it is pickled; pickled data could run code and is not read")

    registry.register_codec(NoPickles)


def _reading(what: str) -> AbstractContextManager[None]:
    return clip_errors(f"{FORMAT}: {what} cannot be read")


def _group(reader: Any, component: Any, what: str) -> str | None:
    """The instance of a component to read: the default one, or the only one; None if there is none."""
    names = sorted(reader.open_component_readers(component.Reader))
    if not names or DEFAULT_GROUP in names:
        return DEFAULT_GROUP if names else None
    if len(names) > 1:
        raise ClipError(f"{FORMAT}: there are {what} {names}, and none is called {DEFAULT_GROUP!r}")
    return str(names[0])


def _read(loader: Any) -> Clip:
    graph = loader.pose_graph
    ego = _ego(graph)
    cameras, images, lidars, sweeps = {}, {}, {}, {}
    sources: dict[str, Any] = {}
    facts: dict[str, Any] = {"dataset": FORMAT}
    for name in sorted(loader.camera_ids):  # the package has them in the order in which files were opened
        with _reading(f"camera {name!r}"):
            sources[name] = sensor = loader.get_camera_sensor(name)
            cameras[name] = models.camera_model(name, sensor.model_parameters, _mounting(graph, name, ego))
            images[name] = [
                ImageRecord(f"{name}/{end}", start, end, _world_from(graph, name, ego, np.array([start, end])))
                for start, end in sensor.frames_timestamps_us.astype(np.int64).tolist()
            ]
    for name in sorted(loader.lidar_ids):
        with _reading(f"LiDAR {name!r}"):
            sources[name] = sensor = loader.get_lidar_sensor(name)
            lidars[name], note = models.lidar_model(name, sensor.model_parameters, _mounting(graph, name, ego))
            facts[f"beams of {name}"] = note
            sweeps[name] = list(_sweeps(graph, lidars[name], sensor, ego))
    with _reading("its metadata"):
        facts |= {key: value for key, value in loader.generic_meta_data.items() if isinstance(value, str | int | float)}
        id = str(loader.sequence_id)
    return Clip(
        id=id,
        rig=Rig(cameras, lidars),
        ego=ego,
        images=images,
        sweeps=sweeps,
        source=_Sensors(sources),
        tracks=_tracks(loader, graph),
        facts=json.loads(json.dumps(facts)),
    )


def _ego(graph: Any) -> Trajectory:
    """Poses of the rig in the world, at the times at which they are recorded."""
    for node in (RIG, WORLD):
        if node not in graph.nodes:
            raise ClipError(f"{FORMAT}: the poses have no frame {node!r}; have {sorted(graph.nodes)}")
    edge = graph.get_edge(RIG, WORLD, normalized=True)
    if edge is None or edge.timestamps_us is None:
        raise ClipError(f"{FORMAT}: there are no poses over time of {RIG!r} in {WORLD!r}")
    times = edge.timestamps_us.astype(np.int64)
    with _reading("the poses"):
        return Trajectory(times, graph.evaluate_poses(RIG, WORLD, times))


def _world_from(graph: Any, node: str, ego: Trajectory, t_us: Int64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n 4 4"]:
    """Poses of a frame in the world; beyond the ends of the ego's poses the first or the last one holds."""
    times = np.clip(t_us, ego.start_us, ego.end_us)
    return np.asarray(graph.evaluate_poses(node, WORLD, times), np.float64)


def _mounting(graph: Any, node: str, ego: Trajectory) -> Float64[np.ndarray, "4 4"]:
    """Pose of a sensor in the rig, at the middle of the log if it changes."""
    middle = np.array((ego.start_us + ego.end_us) // 2, np.int64)
    return np.asarray(graph.evaluate_poses(node, RIG, middle), np.float64)


def _sweeps(graph: Any, lidar: LidarModel, sensor: Any, ego: Trajectory) -> Iterator[SweepRecord]:
    times = sensor.frames_timestamps_us.astype(np.int64)
    poses = _world_from(graph, lidar.id, ego, times[:, 1])
    for (start, end), pose in zip(times.tolist(), poses, strict=True):
        yield SweepRecord(f"{lidar.id}/{end}", end, start, end, pose, compensated=False)


def _tracks(loader: Any, graph: Any) -> list[Track]:
    from scipy.spatial.transform import Rotation

    boxes, seen = BoxTracks(), set()
    with _reading("the cuboids"):
        for each in loader.get_cuboid_track_observations():
            # Several sources may have labelled the object at one time: the first one counts.
            if (key := (each.track_id, each.timestamp_us)) in seen:
                continue
            seen.add(key)
            time = np.array(each.reference_frame_timestamp_us, np.int64)
            world_from_reference = np.asarray(graph.evaluate_poses(each.reference_frame_id, WORLD, time), np.float64)
            rotation = Rotation.from_euler("xyz", each.bbox3.rot).as_matrix()
            pose = world_from_reference @ geometry.pose(rotation, np.array(each.bbox3.centroid))
            where = f"cuboid of track {each.track_id!r}"
            boxes.add(where, each.track_id, each.class_id, each.timestamp_us, pose, each.bbox3.dim)
    return boxes.tracks()


@dataclass(frozen=True)
class _Sensors:
    """The sensors of a sequence as a ``types.LogSource``; ``sensors`` are those of the package, by id."""

    sensors: Mapping[str, Any]

    def image(self, camera_id: str, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """One RGB frame."""
        return decode_image(bytes(self.sensors[camera_id].get_frame_data(index).get_encoded_image_data()))

    def sweep(self, lidar_id: str, index: int) -> SweepPoints:
        """The first returns of one sweep."""
        sensor = self.sensors[lidar_id]
        if (count := sensor.get_frame_ray_bundle_count(index)) > LIMITS.sweep_points:
            raise ClipError(f"{count:,} rays; a sweep may have {LIMITS.sweep_points:,}")
        distance_m = sensor.get_frame_ray_bundle_return_distance_m(index)
        hit = sensor.get_frame_ray_bundle_return_valid_mask(index) & (distance_m > 0)
        rays = sensor.get_frame_ray_bundle_direction(index)[hit].astype(np.float64)
        start_us = int(sensor.frames_timestamps_us[index, 0])
        return SweepPoints(
            xyz_m=rays * distance_m[hit, None],
            intensity=sensor.get_frame_ray_bundle_return_intensity(index)[hit],
            dt_us=sensor.get_frame_ray_bundle_timestamp_us(index)[hit].astype(np.int64) - start_us,
        )

    def ego_mask(self, camera_id: str) -> Bool[np.ndarray, "h w"] | None:
        """Pixels that show the car: those set in the mask called ``ego``; None if there is none."""
        mask = self.sensors[camera_id].get_mask_images().get(EGO_MASK)
        return None if mask is None else np.asarray(mask.convert("L")) > 0
