"""Rig, path, times and tracks from an archive's JSON files; the inverse of ``scene.sidecars``.

Conventions there: ``T_a_b`` maps a to b; matrices are row-major; track quaternions are ``xyzw``. Paths and tracks are
in the world, Gaussians in the NRE frame: ``world_to_nre`` lies between.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.files.decoding import LIMITS
from nurec_sim.files.zip_package import Package
from nurec_sim.scene import codec
from nurec_sim.scene.checks import MIN_START_US
from nurec_sim.scene.interop.nurec.sensor_models import camera_from, lidar_from
from nurec_sim.scene.interop.nurec.track_sidecar import tracks_from
from nurec_sim.scene.opendrive.reader import road_map_from
from nurec_sim.types import Box, CameraModel, LidarModel, Rig, RoadMap, Track, Trajectory

RIG, TRACKS, DATA_INFO, MAP = "rig_trajectories.json", "sequence_tracks.json", "data_info.json", "map.xodr"


@dataclass
class Surroundings:
    """Contents of an archive's JSON files; None if missing.

    ``camera_order`` are the ids of all cameras, including unreadable ones, in file order; ``missing`` lists what
    another scene of the same place may supply.
    """

    id: str | None = None
    rig: Rig | None = None
    ego: Trajectory | None = None
    tracks: list[Track] = field(default_factory=list)
    road_map: RoadMap | None = None
    span_us: tuple[int, int] | None = None
    camera_times_us: dict[str, Int64[np.ndarray, "frames 2"]] = field(default_factory=dict)
    nre_from_world: Float64[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    camera_order: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)


def read_surroundings(package: Package) -> Surroundings:
    """Reads the JSON files that an archive has.

    Raises:
        ArchiveError: one of them is not JSON, or lacks required data.
    """
    around = Surroundings()
    if RIG in package.names:
        content = _load(package, RIG)
        _add_rig(around, content, f"{package.path}: {RIG}")
        _add_map(around, package, content.get("T_world_base"))
    else:
        around.missing.append(f"no sensors and no path: the archive has no {RIG}")
    if TRACKS in package.names:
        around.tracks, faults = tracks_from(_load(package, TRACKS), f"{package.path}: {TRACKS}")
        around.unknown += faults
    else:
        around.missing.append(f"no tracks: the archive has no {TRACKS}")
    if around.tracks and not np.array_equal(around.nre_from_world, np.eye(4)):
        around.unknown.append(f"{TRACKS} does not say its frame; taken for the world's")
    if DATA_INFO in package.names:
        _add_times(around, _load(package, DATA_INFO))
    _shift(around)
    return around


def _load(package: Package, name: str) -> dict[str, Any]:
    where = f"{package.path}: {name}"
    value = codec.load(package.read(name, LIMITS.json_bytes), where)
    if not isinstance(value, dict):
        raise ArchiveError(f"{where}: must hold an object, got {type(value).__name__}")
    return value


# --------------------------------------------------------------------------------------------------------------- rig


def _add_rig(around: Surroundings, content: dict[str, Any], where: str) -> None:
    around.nre_from_world = _world_to_nre(content.get("world_to_nre"), where)
    names = _add_sensors(around, content)
    paths = content.get("rig_trajectories")
    if not isinstance(paths, list) or not paths or not isinstance(paths[0], dict):
        raise ArchiveError(f"{where}: rig_trajectories must list at least one trajectory")
    if len(paths) > 1:
        around.unknown.append(f"{RIG} has {len(paths)} trajectories; the first is taken")
    path = paths[0]
    times = codec.from_json(codec.array(np.int64, -1), path.get("T_rig_world_timestamps_us"), f"{where}: times")
    poses = codec.from_json(codec.array(np.float64, -1, 4, 4), path.get("T_rig_worlds"), f"{where}: T_rig_worlds")
    try:
        around.ego = Trajectory(times, poses)
    except ValueError as error:
        raise ArchiveError(f"{where}: {error}") from error
    frames = path.get("cameras_frame_timestamps_us")
    for key, value in frames.items() if isinstance(frames, dict) else ():
        if key in names and around.rig is not None and names[key] in around.rig.cameras:
            exposures = codec.from_json(codec.array(np.int64, -1, 2), value, f"{where}: frames of {key!r:.60}")
            around.camera_times_us[names[key]] = exposures[exposures[:, 0] <= exposures[:, 1]]
    body = path.get("rig_bbox")
    if around.rig is not None and body is not None:
        around.rig = dataclasses.replace(around.rig, body=_body(around, body, where))
    else:
        around.unknown.append("no outline of the car: rig_bbox is missing; the usual one is taken")


def _world_to_nre(value: object, where: str) -> Float64[np.ndarray, "4 4"]:
    if value is None:
        return np.eye(4)
    matrix = value.get("matrix") if isinstance(value, dict) else None
    result = codec.from_json(codec.array(np.float64, 4, 4), matrix, f"{where}: world_to_nre.matrix")
    if not np.isfinite(result).all() or not geometry.is_rotation(result[:3, :3]) or result[3].tolist() != [0, 0, 0, 1]:
        raise ArchiveError(f"{where}: world_to_nre.matrix is no rigid transform: {result.tolist()}")
    return result


def _add_map(around: Surroundings, package: Package, world_base: object) -> None:
    if MAP not in package.names or around.ego is None:
        return
    where = f"{package.path}: {MAP}"
    place = None
    if world_base is not None:
        place = codec.from_json(codec.array(np.float64, 4, 4), world_base, f"{package.path}: {RIG}: T_world_base")
        if not geometry.is_rotation(place[:3, :3]):
            place = None
    around.road_map, note = road_map_from(package.read(MAP, LIMITS.xml_bytes), place, around.ego, where)
    around.unknown.append(note)


def _add_sensors(around: Surroundings, content: dict[str, Any]) -> dict[str, str]:
    """Fills the rig; returns the sensors' ids by their names in the file."""
    cameras: dict[str, CameraModel] = {}
    lidars: dict[str, LidarModel] = {}
    names: dict[str, str] = {}
    for kind, read, into in (("camera", camera_from, cameras), ("lidar", lidar_from, lidars)):
        calibrations = content.get(f"{kind}_calibrations")
        for key, calibration in calibrations.items() if isinstance(calibrations, dict) else ():
            logical = calibration.get("logical_sensor_name") if isinstance(calibration, dict) else None
            name = logical if isinstance(logical, str) and logical else key.split("@")[0]
            if kind == "camera":
                around.camera_order.append(name)
            try:
                if not isinstance(calibration, dict) or name in into:
                    raise ValueError("given twice" if name in into else "not an object")
                into[name] = read(calibration, name)  # type: ignore[assignment]
                names[key] = name
            except (ValueError, TypeError, OverflowError) as error:
                around.unknown.append(f"{kind} {name!r:.60} is left out: {error}")
    around.rig = Rig(cameras, lidars)
    return names


def _body(around: Surroundings, value: object, where: str) -> Box:
    if not isinstance(value, Mapping):
        raise ArchiveError(f"{where}: rig_bbox must be null or an object, got {value!r:.60}")
    centre, size, turn = (
        codec.from_json(codec.numbers(3), value.get(name, default), f"{where}: rig_bbox.{name}")
        for name, default in (("centroid", None), ("dim", None), ("rot", [0.0, 0.0, 0.0]))
    )
    if any(abs(angle) > 1e-3 for angle in turn):
        around.unknown.append(f"rig_bbox is turned by {turn}; taken for upright")
    return Box(centre, size)


# ------------------------------------------------------------------------------------------------------------- times


def _add_times(around: Surroundings, info: dict[str, Any]) -> None:
    if isinstance(info.get("sequence_id"), str) and info["sequence_id"]:
        around.id = info["sequence_id"]
    ranges = (
        ("sequence_timestamp_interval_us", "start", "stop"),
        ("pose-range", "start-timestamp_us", "end-timestamp_us"),
    )
    for name, first, last in ranges:
        part = info.get(name)
        if isinstance(part, dict) and all(type(part.get(key)) is int for key in (first, last)):
            if 0 <= part[first] < part[last] < 2**62:
                around.span_us = (part[first], part[last])
                return
    around.unknown.append(f"{DATA_INFO} says no times")


def _shift(around: Surroundings) -> None:
    """Shifts the times of a clip that starts at zero: clients request earlier times as unsigned integers."""
    if around.span_us is None and around.ego is not None:
        around.span_us = (around.ego.start_us, max(around.ego.end_us, around.ego.start_us + 1))
    if around.span_us is None or around.span_us[0] >= MIN_START_US:
        return
    by = MIN_START_US - around.span_us[0]
    around.unknown.append(f"the clip starts at {around.span_us[0]} us; all times are shifted by {by} us")
    around.span_us = (around.span_us[0] + by, around.span_us[1] + by)
    if around.ego is not None:
        around.ego = _later(around.ego, by)
    around.tracks = [dataclasses.replace(track, path=_later(track.path, by)) for track in around.tracks]
    around.camera_times_us = {name: times + by for name, times in around.camera_times_us.items()}


def _later(path: Trajectory, by_us: int) -> Trajectory:
    return Trajectory(path.t_us + by_us, path.world_from_body)
