"""Rules that AlpaSim and CARLA share: both read ``rig_trajectories.json`` and ``sequence_tracks.json``.

A consumer's report must have every rule named here. Functions return what they read, or None if it is unusable (the
report then has the reason).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim.errors import ArchiveError
from nurec_sim.scene.interop.validate.contents import Contents, entry_of, numbers_of, shown, text_of
from nurec_sim.scene.interop.validate.finding import Report

RIG, TRACKS = "rig_trajectories.json", "sequence_tracks.json"
TRACK_FIELDS = ("tracks_id", "tracks_label_class", "tracks_flags", "tracks_timestamps_us", "tracks_poses")


@dataclass(frozen=True)
class TrackRow:
    """One track as the file has it; poses are ``x y z qx qy qz qw``."""

    id: str
    flags: str
    t_us: Int64[np.ndarray, " k"]
    poses: Float64[np.ndarray, "k 7"]


def rig_document(report: Report, contents: Contents) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """(the document, its only trajectory)."""
    with report.rule("rig-file"):
        document = contents.json(RIG)
        rows = entry_of(document, "rig_trajectories", RIG)
        with report.rule("one-trajectory"):
            if not isinstance(rows, list) or len(rows) != 1 or not isinstance(rows[0], dict):
                count = len(rows) if isinstance(rows, list) else shown(rows)
                raise ArchiveError(f"{RIG}: rig_trajectories holds {count} trajectories")
            return document, rows[0]
    return None


def rig_path(
    report: Report, trajectory: dict[str, Any]
) -> tuple[Int64[np.ndarray, " t"], Float64[np.ndarray, "t 4 4"]] | None:
    """Times and poses of the rig in the world."""
    where = f"{RIG}: rig_trajectories[0]"
    with report.rule("path"):
        times = entry_of(trajectory, "T_rig_world_timestamps_us", where)
        t_us = numbers_of(times, f"{where}.T_rig_world_timestamps_us", -1, integers=True)
        poses = entry_of(trajectory, "T_rig_worlds", where)
        world_from_rig = numbers_of(poses, f"{where}.T_rig_worlds", -1, 4, 4)
        if len(t_us) == 0 or len(t_us) != len(world_from_rig):
            raise ArchiveError(f"{where} has {len(world_from_rig)} poses for {len(t_us)} times")
        if np.any(np.diff(t_us) <= 0):
            raise ArchiveError(f"{where}.T_rig_world_timestamps_us does not increase at place {_first_stop(t_us)}")
        check_rigid(world_from_rig, f"{where}.T_rig_worlds")
        return t_us, world_from_rig
    return None


def calibrations(report: Report, document: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The calibrations of cameras that have a name, by their unique id."""
    good = {}
    with report.rule("calibrations"):
        where = f"{RIG}: camera_calibrations"
        cameras = entry_of(document, "camera_calibrations", RIG)
        if not isinstance(cameras, dict) or not cameras:
            raise ArchiveError(f"{where} holds no camera but {shown(cameras)}")
        for uid, camera in cameras.items():
            with report.rule("calibrations"):
                text_of(camera, "logical_sensor_name", f"{where}[{shown(uid)}]")
                good[uid] = camera
    return good


def check_rigid(poses: Float64[np.ndarray, "n 4 4"], where: str) -> None:
    """Refuses matrices that are no rotation and translation.

    Raises:
        ArchiveError: one of them is none.
    """
    rotation = poses[:, :3, :3]
    skew = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max(axis=(1, 2))
    last_row = np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1)
    sound = (skew <= 1e-3) & (np.linalg.det(rotation) > 0) & (last_row <= 1e-6)  # NaN, where huge numbers overflow
    if not sound.all():
        message = "is no rotation and translation (with a last row 0 0 0 1)"
        raise ArchiveError(f"{where} {message}" if len(poses) == 1 else f"{where}[{int(np.argmin(sound))}] {message}")


def tracks(report: Report, contents: Contents, key: str | None) -> list[TrackRow]:
    """The tracks that have at least one good sample; ``key`` is the chunk that is read, None for the only one."""
    chunk = None
    with report.rule("tracks-file"):
        document = contents.json(TRACKS)
        if not isinstance(document, dict):
            raise ArchiveError(f"{TRACKS} is no object but {shown(document)}")
        with report.rule("tracks-key"):
            if (key is None and len(document) != 1) or (key is not None and key not in document):
                raise ArchiveError(f"{TRACKS} has the top-level keys {shown(list(document))}")
            chunk = document[next(iter(document)) if key is None else key]
    if chunk is None:
        return []
    columns: dict[str, list] = {}
    with report.rule("tracks-fields"):
        data = entry_of(chunk, "tracks_data", TRACKS)
        cuboids = entry_of(chunk, "cuboidtracks_data", TRACKS)
        columns = {name: entry_of(data, name, f"{TRACKS}: tracks_data") for name in TRACK_FIELDS}
        columns["cuboids_dims"] = entry_of(cuboids, "cuboids_dims", f"{TRACKS}: cuboidtracks_data")
        wrong = [name for name, column in columns.items() if not isinstance(column, list)]
        if wrong:
            columns = {name: column for name, column in columns.items() if name not in wrong}
            raise ArchiveError(f"{TRACKS}: {', '.join(wrong)} is no list")
    if len(columns) != len(TRACK_FIELDS) + 1:
        return []
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        message = ", ".join(f"{name} {length}" for name, length in lengths.items())
        report.add("tracks-lengths", f"{TRACKS}: lists of different lengths: {message}")
        return []
    return _rows(report, columns)


def _rows(report: Report, columns: dict[str, list]) -> list[TrackRow]:
    """Checks every track; reports the first fault per rule, with the number of tracks that violate it."""
    faults: dict[str, list[str]] = {}
    good = []
    for index in range(len(columns["tracks_id"])):
        values = {name: column[index] for name, column in columns.items()}
        track_id = values["tracks_id"]
        where = f"{TRACKS}: track {shown(track_id)}"
        if not isinstance(track_id, str) or not isinstance(values["tracks_label_class"], str):
            label = shown(values["tracks_label_class"])
            faults.setdefault("tracks-fields", []).append(f"{where}, label {label}: both must be text")
            continue
        try:
            dims = numbers_of(values["cuboids_dims"], f"{where}: cuboids_dims", 3)
            if not (dims > 0).all():
                raise ArchiveError(f"{where}: cuboids_dims is {shown(values['cuboids_dims'])}")
        except ArchiveError as error:
            faults.setdefault("track-dims", []).append(str(error))
        flags = _flags(values["tracks_flags"])
        if flags is None:
            fault = f"{where}: tracks_flags is {shown(values['tracks_flags'])}"
            faults.setdefault("track-flags", []).append(fault)
        try:
            t_us, poses = _samples(values, where)
        except ArchiveError as error:
            faults.setdefault("track-samples", []).append(str(error))
            continue
        norm = (poses[:, 3:] ** 2).sum(axis=1)
        if np.abs(norm - 1).max() > 1e-4:
            worst = float(norm[np.abs(norm - 1).argmax()])
            fault = f"{where}: a quaternion has the squared length {worst:.5g}"
            faults.setdefault("track-quaternions", []).append(fault)
        good.append(TrackRow(track_id, flags or "", t_us, poses))
    for rule, texts in faults.items():
        more = f" (and {len(texts) - 1} more)" if len(texts) > 1 else ""
        report.add(rule, texts[0] + more)
    return good


def _samples(values: dict[str, Any], where: str) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, "k 7"]]:
    t_us = numbers_of(values["tracks_timestamps_us"], f"{where}: tracks_timestamps_us", -1, integers=True)
    poses = numbers_of(values["tracks_poses"], f"{where}: tracks_poses", -1, 7)
    if len(t_us) == 0 or len(t_us) != len(poses):
        raise ArchiveError(f"{where} has {len(poses)} poses for {len(t_us)} times")
    if np.any(np.diff(t_us) <= 0):
        raise ArchiveError(f"{where}: tracks_timestamps_us does not increase at place {_first_stop(t_us)}")
    return t_us, poses


def _flags(value: Any) -> str | None:
    """Flags as one text; files have ``"A|B"`` or a list of texts."""
    if isinstance(value, str):
        return value
    if isinstance(value, list) and all(isinstance(each, str) for each in value):
        return "|".join(value)
    return None


def _first_stop(t_us: Int64[np.ndarray, " n"]) -> int:
    return int(np.argmax(np.diff(t_us) <= 0)) + 1
