"""Faults of a clip, one clear line each."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nurec_sim import geometry, sensors
from nurec_sim.errors import ClipError
from nurec_sim.logs.clip import Clip
from nurec_sim.logs.consistency import table_faults
from nurec_sim.logs.reader import read_tables
from nurec_sim.types import Sweep

POINTS_TRIED = 2000
FURTHEST_POINT_M = 10_000.0


def check_clip(clip: Clip | str | Path) -> list[str]:
    """Read everything in a clip and list what is wrong; an empty list means that it is sound.

    Found are: files that are missing, truncated or broken, images of another size than the calibration's, times that go
    back, poses that are no rotations, values that are not finite, empty sweeps, and sweeps that no camera sees.
    """
    if not isinstance(clip, Clip):
        try:
            clip = read_tables(clip)
        except ClipError as error:
            return [str(error)]
    return [*table_faults(clip), *_image_faults(clip), *_sweep_faults(clip)]


def _image_faults(clip: Clip) -> Iterator[str]:
    for name in clip.rig.cameras:
        for index in range(clip.frame_count(name)):
            try:
                clip.image(name, index)
            except ClipError as error:
                yield f"camera {name!r} frame {index}: {error}"


def _sweep_faults(clip: Clip) -> Iterator[str]:
    for name in clip.rig.lidars:
        for index, record in enumerate(clip.sweep_records(name)):
            where = f"LiDAR {name!r} sweep {index} ({record.file})"
            try:
                sweep = clip.sweep(name, index)
            except ClipError as error:
                yield f"LiDAR {name!r} sweep {index}: {error}"
                continue
            if len(sweep.xyz_m) == 0:
                yield f"{where}: it holds no points"
            elif np.abs(sweep.xyz_m).max() > FURTHEST_POINT_M:
                yield f"{where}: a point lies {np.abs(sweep.xyz_m).max():.0f} m away"
            elif len(clip.rig.cameras) and not _seen(clip, sweep):
                yield f"{where}: none of its points projects into any camera; a calibration or pose is wrong"


def _seen(clip: Clip, sweep: Sweep) -> bool:
    """Whether any camera, at its frame nearest in time, sees a point of the sweep."""
    step = max(1, len(sweep.xyz_m) // POINTS_TRIED)
    points = geometry.transform_points(sweep.world_from_lidar, sweep.xyz_m[::step])
    for name, camera in clip.rig.cameras.items():
        times = clip.camera_times_us(name)
        if len(times) == 0:
            continue
        nearest = int(np.argmin(np.abs(times[:, 0] - sweep.t_us)))
        uv, valid, _ = sensors.project_rolling(camera, clip.world_from_camera(name, nearest), points)
        if (valid & sensors.in_image(camera, uv)).any():
            return True
    return not any(clip.frame_count(name) for name in clip.rig.cameras)
