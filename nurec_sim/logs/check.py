"""Faults of a clip, one clear line each."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from nurec_sim import geometry, sensors
from nurec_sim.compute.cores import usable_cores
from nurec_sim.errors import ClipError
from nurec_sim.logs.clip import Clip
from nurec_sim.logs.consistency import table_faults
from nurec_sim.logs.reader import read_tables
from nurec_sim.types import Sweep

POINTS_TRIED = 2000
MOST_THREADS = 4
FURTHEST_POINT_M = 10_000.0


def check_clip(clip: Clip | str | Path) -> list[str]:
    """Reads everything in a clip and lists all faults; an empty list means that it is valid.

    Detects missing, truncated or corrupt files, images whose size differs from the calibration, times that do not
    increase, invalid rotations, non-finite values, empty sweeps, and sweeps that no camera sees.
    """
    if not isinstance(clip, Clip):
        try:
            clip = read_tables(clip)
        except ClipError as error:
            return [str(error)]
    images = [(clip, name, index) for name in clip.rig.cameras for index in range(clip.frame_count(name))]
    sweeps = [(clip, name, index) for name in clip.rig.lidars for index in range(clip.sweep_count(name))]
    faults = table_faults(clip)
    # Decoding and decompression release the GIL.
    with ThreadPoolExecutor(max_workers=min(MOST_THREADS, usable_cores())) as pool:
        for fault, jobs in ((_image_fault, images), (_sweep_fault, sweeps)):
            faults += [text for text in pool.map(fault, *zip(*jobs, strict=True)) if text is not None] if jobs else []
    return faults


def _image_fault(clip: Clip, name: str, index: int) -> str | None:
    try:
        clip.image(name, index)
    except ClipError as error:
        return f"camera {name!r} frame {index}: {error}"
    return None


def _sweep_fault(clip: Clip, name: str, index: int) -> str | None:
    where = f"LiDAR {name!r} sweep {index} ({clip.sweep_records(name)[index].file})"
    try:
        sweep = clip.sweep(name, index)
    except ClipError as error:
        return f"LiDAR {name!r} sweep {index}: {error}"
    if len(sweep.xyz_m) == 0:
        return f"{where}: it holds no points"
    if np.abs(sweep.xyz_m).max() > FURTHEST_POINT_M:
        return f"{where}: a point lies {np.abs(sweep.xyz_m).max():.0f} m away"
    if len(clip.rig.cameras) and not _seen(clip, sweep):
        return f"{where}: none of its points projects into any camera; a calibration or pose is wrong"
    return None


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
