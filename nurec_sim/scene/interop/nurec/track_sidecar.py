"""Tracks from ``sequence_tracks.json``; the inverse of ``scene.sidecars``.

Poses there are ``x y z qx qy qz qw`` of box centres in the world, sizes length, width, height.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.scene import codec
from nurec_sim.types import Track, Trajectory


def tracks_from(content: dict[str, Any], where: str) -> tuple[list[Track], list[str]]:
    """The tracks of all chunks, and the faults of skipped or incomplete ones.

    Raises:
        ArchiveError: a chunk lacks one of its lists, or they differ in length.
    """
    tracks: dict[str, Track] = {}
    faults: list[str] = []
    for chunk, parts in content.items():
        for name, row in _rows(parts, f"{where}: {chunk!r:.60}"):
            if name in tracks:
                faults.append(f"track {name!r:.60} is given twice; the first is taken")
                continue
            try:
                tracks[name], lost = _track(name, row)
            except (ValueError, TypeError, OverflowError) as error:
                faults.append(f"track {name!r:.60} is left out: {error}")
                continue
            if lost:
                faults.append(f"track {name!r:.60}: {lost} samples are left out: not finite, or not in order of time")
    return list(tracks.values()), faults


def _rows(parts: object, where: str) -> list[tuple[str, dict[str, Any]]]:
    """The lists of a chunk turned into one entry per track."""
    data = parts.get("tracks_data") if isinstance(parts, dict) else None
    boxes = parts.get("cuboidtracks_data") if isinstance(parts, dict) else None
    if not isinstance(data, dict) or not isinstance(boxes, dict):
        raise ArchiveError(f"{where}: needs the objects tracks_data and cuboidtracks_data")
    columns = {
        "id": data.get("tracks_id"),
        "label": data.get("tracks_label_class"),
        "times": data.get("tracks_timestamps_us"),
        "poses": data.get("tracks_poses"),
        "size": boxes.get("cuboids_dims"),
    }
    columns["flags"] = data.get("tracks_flags")
    if columns["flags"] is None and isinstance(columns["id"], list):
        columns["flags"] = [None] * len(columns["id"])
    wrong = [name for name, column in columns.items() if not isinstance(column, list)]
    lengths = {name: len(column) for name, column in columns.items() if isinstance(column, list)}
    if wrong or len(set(lengths.values())) > 1:
        raise ArchiveError(f"{where}: needs lists of equal length; {wrong or 'none'} missing, lengths {lengths}")
    rows = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
    if not all(isinstance(row["id"], str) for row in rows):
        raise ArchiveError(f"{where}: tracks_id must be texts")
    return [(row["id"], row) for row in rows]


def _track(name: str, row: dict[str, Any]) -> tuple[Track, int]:
    times, poses = codec.array(np.int64, -1)(row["times"]), codec.array(np.float64, -1, 7)(row["poses"])
    if len(times) != len(poses):
        raise ValueError(f"{len(times)} times, but {len(poses)} poses")
    sound = np.flatnonzero(np.isfinite(poses).all(axis=1) & (np.linalg.norm(poses[:, 3:], axis=1) > 1e-6))
    if len(sound) == 0:
        raise ValueError("it has no sample that can be used")
    # Keep samples later than all before them, so that times increase strictly.
    latest = np.maximum.accumulate(times[sound])
    keep = sound[np.concatenate([[True], times[sound][1:] > latest[:-1]])]
    kept = poses[keep]
    matrices = np.tile(np.eye(4), (len(kept), 1, 1))
    matrices[:, :3, :3] = geometry.matrix_from_quat(kept[:, [6, 3, 4, 5]])
    matrices[:, :3, 3] = kept[:, :3]
    size = codec.numbers(3)(row["size"])
    if min(size) < 0:
        raise ValueError(f"its size must not be negative, got {size}")
    flags = row["flags"]
    words = flags.split("|") if isinstance(flags, str) else flags if isinstance(flags, list) else []
    label = codec.text(row["label"])
    track = Track(name, label, (size[0], size[1], size[2]), Trajectory(times[keep], matrices), "CONTROLLABLE" in words)
    return track, len(times) - len(keep)
