"""Rules for AlpaSim's runtime: metadata, rig, tracks, maps and the ground mesh.

It ignores USD structure, alignment and Gaussians, which only the server uses.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Int64

from nurec_sim.errors import ArchiveError
from nurec_sim.scene.interop.validate import maps, meshes, shared
from nurec_sim.scene.interop.validate.contents import Contents, entry_of, numbers_of, shown, text_of
from nurec_sim.scene.interop.validate.finding import Report, Rule
from nurec_sim.scene.interop.validate.map_agreement import LEAST_SHARE
from nurec_sim.scene.interop.validate.shared import RIG, TRACKS

MIN_START_US = 1_000_000
SHUTTER_ROOM_US = 50_000
MOVED_M = 2.0
METADATA_TEXTS = ("scene_id", "version_string", "training_date", "dataset_hash", "uuid")

RULES = {
    "zip": Rule("error", "a readable ZIP", "nothing is found"),
    "name": Rule("error", "a file name that ends in .usdz", "the scene is not found"),
    "metadata-file": Rule("error", "metadata.yaml, a mapping", "the scene cannot be listed"),
    "metadata-fields": Rule(
        "error",
        f"texts {', '.join(METADATA_TEXTS)}, a bool is_resumable, lists sensors.camera_ids and sensors.lidar_ids, a "
        "mapping logger, numbers time_range.start and .end",
        "the scene cannot be listed",
    ),
    "time-range": Rule("warning", "time_range in microseconds, on the clock of the rig", "times are misinterpreted"),
    "rig-file": Rule("error", f"{RIG} with a list rig_trajectories", "the scene cannot be opened"),
    "one-trajectory": Rule("error", "exactly one rig trajectory", "the scene cannot be opened"),
    "sequence-id": Rule("error", "the text rig_trajectories[0].sequence_id", "the scene cannot be opened"),
    "path": Rule(
        "error",
        "as many rigid poses T_rig_worlds [n,4,4] as strictly increasing integers T_rig_world_timestamps_us",
        "the scene cannot be opened",
    ),
    "duration": Rule("warning", "at least two poses of the rig", "there is no time to simulate"),
    "start-time": Rule(
        "error", f"times from {MIN_START_US} us on", "half a second before the start is no unsigned number"
    ),
    "world-to-nre": Rule("error", "world_to_nre.matrix, 4x4", "the scene cannot be opened"),
    "one-frame": Rule(
        "warning", "world_to_nre = identity", "tools disagree whether boxes are in the world or in the NRE frame"
    ),
    "calibrations": Rule("error", "camera_calibrations with logical_sensor_name each", "the cameras are not known"),
    "frame-times": Rule(
        "error",
        "per camera in cameras_frame_timestamps_us: pairs of integers [start, end], end > start, strictly increasing",
        "that camera cannot be simulated",
    ),
    "first-frame": Rule(
        "error", "the end of a camera's first frame within the rig's path", "rendering starts where there is no pose"
    ),
    "shutter-room": Rule(
        "error",
        f"a camera's first frame that ends {SHUTTER_ROOM_US // 1000} ms or more after the first pose",
        "the first image (30 ms of shutter by default) begins where there is no pose",
    ),
    "frames-inside": Rule("warning", "frames within the rig's path", "those frames have no recorded pose"),
    "rig-box": Rule(
        "error",
        "rig_bbox {centroid, dim, rot = 0}, in metres in the rig frame",
        "only runs with simulation_config.vehicle start",
    ),
    "tracks-file": Rule("error", f"{TRACKS}, an object", "the scene cannot be opened"),
    "tracks-key": Rule("error", "exactly one top-level key", "the scene cannot be opened"),
    "tracks-fields": Rule(
        "error",
        f"lists tracks_data.{{{', '.join(shared.TRACK_FIELDS)}}} and cuboidtracks_data.cuboids_dims",
        "the scene cannot be opened",
    ),
    "tracks-lengths": Rule("error", "one entry per track in each list", "the scene cannot be opened"),
    "track-dims": Rule("error", "length, width, height > 0 per track", "collisions cannot be judged"),
    "track-flags": Rule("error", "flags per track: a text or a list of texts", "the scene cannot be opened"),
    "track-samples": Rule(
        "error", "as many poses [k,7] as strictly increasing integer times per track", "the scene cannot be opened"
    ),
    "track-quaternions": Rule("error", "unit quaternions x y z w", "poses are refused"),
    "track-two-samples": Rule("warning", "two samples per track", "smoothing (the default) may fail"),
    "track-ids": Rule("warning", "track ids that differ", "all but one of them vanish"),
    "static-moves": Rule(
        "warning", "CONTROLLABLE on tracks that move", "they count as static: no traffic, no collision with them"
    ),
    "map": Rule(
        "warning",
        "map_data/, clipgt/, fastmap/ or map.xodr",
        "only routes of kind RECORDED or NONE run, off-road and scene score are missing",
    ),
    "clipgt": Rule(
        "warning",
        f"the tables {', '.join(maps.CLIPGT_TABLES)} in clipgt/, and at least one lane with two equal rails",
        "there is no map (clipgt/ is read before map.xodr)",
    ),
    "xodr": Rule("error", "OpenDRIVE with roads and a geoReference in map.xodr", "the scene is refused"),
    "xodr-lanes": Rule(
        "error",
        "roads of <line> and <arc> in map.xodr that give at least one lane",
        "the scene is refused (failed to load vector map)",
    ),
    "lane-under-path": Rule(
        "warning", "a lane of map.xodr under every recorded pose", "routes and off-road are wrong where the car drove"
    ),
    "offroad-on-path": Rule(
        "warning",
        "lanes without gaps between them around every recorded pose",
        "the recorded drive counts as off-road",
    ),
    "offroad-agrees": Rule(
        "warning",
        f"lanes and road edges that give the drivable area's verdict on {LEAST_SHARE:.0%} of cars on and beside the "
        "path",
        "off-road and the scene score are wrong",
    ),
    "base-frame": Rule("warning", "T_world_base, 4x4, to align map.xodr", "there is no map"),
    "mesh-ground": Rule(
        "error",
        "mesh_ground.ply, triangles in the world",
        "physics fails (on by default), only physics_update_mode NONE runs",
    ),
    "mesh-under-path": Rule(
        "warning", "ground under the whole path", "physics finds no ground there (INSUFFICIENT_POINTS_FITPLANE)"
    ),
    "mesh": Rule("warning", "mesh.ply, triangles in the world", "physics with use-ground-mesh=false fails"),
}


def check(report: Report, contents: Contents) -> None:
    """Adds the findings for AlpaSim."""
    if contents.path.suffix != ".usdz":
        report.add("name", f"the file is called {contents.path.name}")
    rig = shared.rig_document(report, contents)
    path_us = None
    world_from_rig = None
    if rig is not None:
        document, trajectory = rig
        with report.rule("sequence-id"):
            text_of(trajectory, "sequence_id", f"{RIG}: rig_trajectories[0]")
        path = shared.rig_path(report, trajectory)
        if path is not None:
            path_us, world_from_rig = path
            _check_span(report, path_us)
        _check_world_to_nre(report, document)
        _check_frames(report, shared.calibrations(report, document), trajectory, path_us)
        _check_box(report, trajectory)
    _check_metadata(report, contents, path_us)
    _check_tracks(report, contents)
    maps.check_alpasim_map(report, contents, None if rig is None else rig[0], world_from_rig)
    meshes.check_ground(report, contents, world_from_rig)


def _check_span(report: Report, path_us: Int64[np.ndarray, " t"]) -> None:
    if path_us[0] < MIN_START_US:
        report.add("start-time", f"{RIG}: the first pose is at {path_us[0]} us")
    if len(path_us) < 2:
        report.add("duration", f"{RIG}: rig_trajectories[0] has one pose")


def _check_metadata(report: Report, contents: Contents, path_us: Int64[np.ndarray, " t"] | None) -> None:
    name = "metadata.yaml"
    metadata: Any = None
    with report.rule("metadata-file"):
        metadata = contents.yaml(name)
        if not isinstance(metadata, dict):
            raise ArchiveError(f"{name} is no mapping but {shown(metadata)}")
    if not isinstance(metadata, dict):
        return
    for key in METADATA_TEXTS:
        with report.rule("metadata-fields"):
            text_of(metadata, key, name)
    with report.rule("metadata-fields"):
        if not isinstance(entry_of(metadata, "is_resumable", name), bool):
            raise ArchiveError(f"{name}: is_resumable is no bool but {shown(metadata['is_resumable'])}")
    for key in ("camera_ids", "lidar_ids"):
        with report.rule("metadata-fields"):
            ids = entry_of(entry_of(metadata, "sensors", name), key, f"{name}: sensors")
            if not isinstance(ids, list) or not all(isinstance(each, str) for each in ids):
                raise ArchiveError(f"{name}: sensors.{key} is no list of texts but {shown(ids)}")
    with report.rule("metadata-fields"):
        if not isinstance(entry_of(metadata, "logger", name), dict):
            raise ArchiveError(f"{name}: logger is no mapping but {shown(metadata['logger'])}")
    with report.rule("metadata-fields"):
        span = entry_of(metadata, "time_range", name)
        start, end = (_number(entry_of(span, key, f"{name}: time_range"), f"{name}: time_range.{key}")
                      for key in ("start", "end"))  # fmt: skip
        if path_us is not None and not (start < end and start <= path_us[-1] and end >= path_us[0]):
            message = f"{name}: time_range is {start:.0f} to {end:.0f}, the rig's path {path_us[0]} to {path_us[-1]}"
            report.add("time-range", message)


def _number(value: Any, where: str) -> float:
    """A finite number.

    Raises:
        ArchiveError: it is none.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ArchiveError(f"{where} is no number but {shown(value)}")
    return value


def _check_world_to_nre(report: Report, document: dict[str, Any]) -> None:
    where = f"{RIG}: world_to_nre"
    with report.rule("world-to-nre"):
        matrix = numbers_of(entry_of(entry_of(document, "world_to_nre", RIG), "matrix", where), f"{where}.matrix", 4, 4)
        if np.abs(matrix - np.eye(4)).max() > 1e-9:
            offset = ", ".join(f"{value:.3f}" for value in matrix[:3, 3])
            report.add("one-frame", f"{where}.matrix is not the identity (translation {offset} m)")


def _check_frames(
    report: Report,
    cameras: dict[str, dict[str, Any]],
    trajectory: dict[str, Any],
    path_us: Int64[np.ndarray, " t"] | None,
) -> None:
    frames_of: Any = None
    where = f"{RIG}: cameras_frame_timestamps_us"
    with report.rule("frame-times"):
        frames_of = entry_of(trajectory, "cameras_frame_timestamps_us", f"{RIG}: rig_trajectories[0]")
    if frames_of is None:
        return
    for uid in cameras:
        with report.rule("frame-times"):
            here = f"{where}[{shown(uid)}]"
            frames = numbers_of(entry_of(frames_of, uid, where), here, -1, 2, integers=True)
            if len(frames) == 0:
                raise ArchiveError(f"{here} holds no frame")
            if (frames[:, 1] <= frames[:, 0]).any():
                raise ArchiveError(f"{here}: frame {int(np.argmax(frames[:, 1] <= frames[:, 0]))} has no length")
            if (np.diff(frames, axis=0) <= 0).any():
                raise ArchiveError(f"{here} does not increase")
            if path_us is not None:
                _check_frames_inside(report, frames, path_us, here)


def _check_frames_inside(
    report: Report, frames: Int64[np.ndarray, "f 2"], path_us: Int64[np.ndarray, " t"], where: str
) -> None:
    first_us, last_us = path_us[0], path_us[-1]
    if not first_us <= frames[0, 1] <= last_us:
        report.add(
            "first-frame", f"{where}: the first frame ends at {frames[0, 1]} us, {first_us} to {last_us} is driven"
        )
        return
    if frames[0, 1] < first_us + SHUTTER_ROOM_US:
        message = f"{where}: the first frame ends {(frames[0, 1] - first_us) / 1000:.2f} ms after the first pose"
        report.add("shutter-room", message)
    outside = (frames[:, 0] < first_us) | (frames[:, 1] > last_us)
    if outside.any():
        message = f"{where}: {int(outside.sum())} of {len(frames)} frames are outside of {first_us} to {last_us} us"
        report.add("frames-inside", message)


def _check_box(report: Report, trajectory: dict[str, Any]) -> None:
    where = f"{RIG}: rig_trajectories[0]"
    with report.rule("rig-box"):
        box = entry_of(trajectory, "rig_bbox", where)
        if box is None:
            raise ArchiveError(f"{where}.rig_bbox is null")
        values = {
            key: numbers_of(entry_of(box, key, f"{where}.rig_bbox"), f"{where}.rig_bbox.{key}", 3)
            for key in ("centroid", "dim", "rot")
        }
        if not (values["dim"] > 0).all() or np.abs(values["rot"]).max() > 1e-3:
            raise ArchiveError(f"{where}.rig_bbox is {shown(box)}")


def _check_tracks(report: Report, contents: Contents) -> None:
    rows = shared.tracks(report, contents, None)
    single = [row.id for row in rows if len(row.t_us) < 2]
    if single:
        report.add(
            "track-two-samples", f"{TRACKS}: {len(single)} of {len(rows)} tracks have one sample: {shown(single)}"
        )
    ids = [row.id for row in rows]
    if len(set(ids)) < len(ids):
        twice = sorted({each for each in ids if ids.count(each) > 1})
        report.add("track-ids", f"{TRACKS}: ids that appear twice: {shown(twice)}")
    moving = [
        row.id
        for row in rows
        if "CONTROLLABLE" not in row.flags and np.linalg.norm(np.ptp(row.poses[:, :3], axis=0)) > MOVED_M
    ]
    if moving:
        message = f"{TRACKS}: {len(moving)} tracks move but are not CONTROLLABLE: {shown(moving)}"
        report.add("static-moves", message)
