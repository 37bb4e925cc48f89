"""Writing a log of any format, or a part of it, as a clip folder of ours."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from nurec_sim.errors import ClipError
from nurec_sim.logs.clip import Clip
from nurec_sim.logs.write import CameraEntry, LidarEntry, write_clip
from nurec_sim.types import Rig, Track, Trajectory

Report = Callable[[str, float], None]


def convert_clip(
    clip: Clip,
    path: str | Path,
    *,
    id: str | None = None,
    start_s: float = 0.0,
    seconds: float | None = None,
    cameras: Sequence[str] | None = None,
    overwrite: bool = False,
    progress: Report = lambda stage, done: None,
) -> Path:
    """Write a log, or a part of it, in our clip format; images keep their bytes where the log has them as files.

    Args:
        clip: the log.
        path: folder to create, or a ``.zip`` file of it.
        id: name of the new clip; that of the log if None.
        start_s: start of the part, in seconds after the start of the log.
        seconds: its length; None goes on to the end.
        cameras: cameras to keep; all if None. LiDARs are always kept.
        overwrite: replace what is at ``path``.
        progress: called with (stage, fraction done).

    Returns:
        ``path``.

    Raises:
        ClipError: no such camera, nothing was recorded in that time, an image or a sweep cannot be read, or something
            is at ``path`` already.
        WriteError: the disk is full, or the place cannot be written.
    """
    first_us, end_us = clip.span_us
    length_s = (end_us - first_us) / 1e6
    if not 0 <= start_s < length_s or (seconds is not None and not seconds > 0):
        raise ClipError(
            f"a part of this log starts at 0 to {length_s:.3f} s and is longer than 0 s; asked for "
            f"{'all' if seconds is None else f'{seconds:g} s'} from {start_s:g} s on"
        )
    start_us = first_us + round(start_s * 1e6)
    stop_us = end_us if seconds is None else min(end_us, start_us + round(seconds * 1e6))
    kept = list(clip.rig.cameras) if cameras is None else [clip.camera(name).id for name in cameras]
    images = [
        (record.start_us, record.end_us, name, index)
        for name in kept
        for index, record in enumerate(clip.image_records(name))
        if start_us <= record.start_us < stop_us
    ]
    sweeps = [
        (record.start_us, record.end_us, name, index)
        for name in clip.rig.lidars
        for index, record in enumerate(clip.sweep_records(name))
        if start_us <= record.t_us < stop_us
    ]
    if not images and not sweeps:
        raise ClipError(f"nothing was recorded from {start_s:g} s to {(stop_us - first_us) / 1e6:g} s of the log")
    rows = sorted([*images, *sweeps])
    low_us, high_us = min(start_us, rows[0][0]), max(stop_us - 1, *(row[1] for row in rows))
    tracks = [_track_part(track, low_us, high_us) for track in clip.tracks]
    offset = {"time_offset_us": clip.time_offset_us} if clip.time_offset_us else {}

    def frames() -> Iterator[CameraEntry | LidarEntry]:
        for number, (begin_us, finish_us, name, index) in enumerate(rows):
            progress("images and sweeps", number / len(rows))
            if name in clip.rig.lidars:
                yield LidarEntry(name, clip.sweep(name, index))
            else:
                poses = clip.world_from_camera(name, index)
                yield CameraEntry(name, begin_us, finish_us, clip.encoded_image(name, index), poses)

    return write_clip(
        path,
        id=clip.id if id is None else id,
        rig=Rig({name: clip.rig.cameras[name] for name in kept}, clip.rig.lidars, clip.rig.body),
        ego=_part(clip.ego, low_us, high_us),
        frames=frames(),
        tracks=[track for track in tracks if track is not None],
        road_map=clip.road_map,
        facts={**clip.facts, "converted_from": clip.format, **offset},
        overwrite=overwrite,
    )


def _part(path: Trajectory, low_us: int, high_us: int) -> Trajectory:
    """A path between two times, with poses at both as far as it reaches."""
    low_us, high_us = max(low_us, path.start_us), min(high_us, path.end_us)
    inner = path.t_us[(path.t_us > low_us) & (path.t_us < high_us)]
    times = np.unique(np.concatenate([[low_us], inner, [high_us]]))
    return Trajectory(times, path.at(times))


def _track_part(track: Track, low_us: int, high_us: int) -> Track | None:
    """A track between two times; None if it does not exist then."""
    if track.path.end_us < low_us or track.path.start_us > high_us:
        return None
    return dataclasses.replace(track, path=_part(track.path, low_us, high_us))
