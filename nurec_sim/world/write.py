"""Writing a street as a driving log: what its cameras and LiDAR saw, and nothing of the truth behind it.

The truth (depth, classes, instances, plan) goes to a folder of its own where asked for, so that no reader of the log
can peek.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from nurec_sim import geometry, logs, sensors
from nurec_sim.errors import ClipError
from nurec_sim.types import LidarModel, Rig, SensorRequest, Sweep, Trajectory
from nurec_sim.world.plan import StreetPlan
from nurec_sim.world.rig import street_rig
from nurec_sim.world.road import RoadLine
from nurec_sim.world.sense import TrueView, TrueWorld, measured_points

Progress = Callable[[str, float], None]
"""Called with (what was drawn, fraction done)."""
SPIN_US = 100_000


def write_street_clip(
    plan: StreetPlan,
    path: str | Path,
    *,
    rig: Rig | None = None,
    period_us: int = 200_000,
    jpeg_quality: int = 80,
    point_step_m: float = 0.01,
    backend: str | None = None,
    truth: str | Path | None = None,
    command: str = "",
    progress: Progress | None = None,
    overwrite: bool = False,
) -> Path:
    """Drive through a street and write the log, as a folder or a ``.zip``.

    Every ``period_us`` the LiDAR turns once (0.1 s, clockwise, from straight behind) and all cameras expose at
    once in the middle of the turn, when the LiDAR looks straight ahead. Sweeps are motion-compensated to that middle.

    Args:
        plan: the street and its traffic.
        path: what to write.
        rig: sensors; ``street_rig()`` by default.
        period_us: time from one set of frames to the next, at least one turn.
        jpeg_quality: 1..100; colours are stored at half resolution, as by real cameras.
        point_step_m: LiDAR coordinates are rounded to multiples of it (a centimetre halves the size of the file).
        backend: see ``TrueWorld``.
        truth: a folder that does not exist yet, for ``plan.json`` and ``<camera>/<frame>.npz`` with depth_m [h,w],
            surface [h,w] (``SurfaceClass``) and instance [h,w].
        command: the command line to remember in the log's meta data.
        progress: called after every camera or LiDAR frame.
        overwrite: replace what is at ``path``.

    Returns:
        ``path``.

    Raises:
        ClipError: the path or the truth folder exists, or ``period_us`` is shorter than a turn.
    """
    if period_us < SPIN_US:
        raise ClipError(f"a LiDAR turn takes {SPIN_US} us; period_us must not be less, got {period_us}")
    path, truth = Path(path), None if truth is None else Path(truth)
    if path.exists() and not overwrite:
        raise ClipError(f"{str(path)!r} exists; choose another path or allow overwriting")
    if truth is not None:
        if truth.exists():
            raise ClipError(f"{str(truth)!r} exists; choose another folder for the truth")
        truth.mkdir(parents=True)
        (truth / "plan.json").write_text(plan.to_json())
    rig = street_rig() if rig is None else rig
    with TrueWorld(plan, backend) as world:
        facts = {
            "dataset": "nurec_sim procedural street",
            "source": "synthetic: MuJoCo, drawn by nurec_sim.world",
            "licence": "Apache-2.0",
            "seed": plan.seed,
            "seconds": (plan.span_us[1] - plan.span_us[0]) / 1e6,
            "command": command,
            "backend": world.backend,
            "poses": "exact",
            "boxes": "exact",
            "map": "exact",
        }
        return logs.write_clip(
            path,
            id=f"street-{plan.seed}",
            rig=rig,
            ego=plan.ego_trajectory(),
            frames=_frames(world, rig, period_us, jpeg_quality, point_step_m, truth, progress),
            tracks=plan.tracks(),
            road_map=RoadLine(plan.road).road_map(),
            facts=facts,
            overwrite=overwrite,
        )


def _frames(
    world: TrueWorld,
    rig: Rig,
    period_us: int,
    jpeg_quality: int,
    point_step_m: float,
    truth: Path | None,
    progress: Progress | None,
) -> Iterator[logs.CameraEntry | logs.LidarEntry]:
    start_us, end_us = world.plan.span_us
    ego = world.plan.ego_trajectory()
    turns = range(start_us, end_us - SPIN_US + 1, period_us)
    total, done = len(turns) * (len(rig.lidars) + len(rig.cameras)), 0
    for index, turn_us in enumerate(turns):
        for lidar in rig.lidars.values():
            yield logs.LidarEntry(lidar.id, _sweep(world, ego, lidar, turn_us, point_step_m))
            done += 1
            _tell(progress, lidar.id, done / total)
        now_us = turn_us + SPIN_US // 2
        for camera in rig.cameras.values():
            pose = ego.at(now_us) @ camera.rig_from_camera
            view = world.view(SensorRequest("", camera, now_us, now_us, np.stack([pose, pose])))
            if truth is not None:
                _write_truth(truth / camera.id / f"{index:04d}.npz", view)
            yield logs.CameraEntry(camera.id, now_us, now_us, _jpeg(view.rgb, jpeg_quality), np.stack([pose, pose]))
            done += 1
            _tell(progress, camera.id, done / total)


def _tell(progress: Progress | None, stage: str, fraction: float) -> None:
    if progress is not None:
        progress(stage, fraction)


def _sweep(world: TrueWorld, ego: Trajectory, lidar: LidarModel, start_us: int, point_step_m: float) -> Sweep:
    """One turn, compensated with the car's own motion to the middle of the turn."""
    end_us, middle_us = start_us + SPIN_US, start_us + SPIN_US // 2
    pair = ego.at(np.array([start_us, end_us])) @ lidar.rig_from_lidar
    scan = world.scan(SensorRequest("", lidar, start_us, end_us, pair))
    xyz, intensity, beam = measured_points(lidar, scan)
    fraction = sensors.column_fraction(lidar)[beam % scan.range_m.shape[1]]
    fired = geometry.interpolate_pose_pair(pair, fraction)
    middle = ego.at(middle_us) @ lidar.rig_from_lidar
    point_t_us = start_us + np.rint(fraction * SPIN_US).astype(np.int64)
    xyz = np.rint(sensors.compensate_sweep(xyz, fired, middle) / point_step_m) * point_step_m
    return Sweep(middle_us, start_us, end_us, middle, xyz, intensity, point_t_us)


def _jpeg(rgb: UInt8[np.ndarray, "h w 3"], quality: int) -> bytes:
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    return cv2.imencode(".jpg", np.ascontiguousarray(rgb[:, :, ::-1]), options)[1].tobytes()


def _write_truth(file: Path, view: TrueView) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    instance = view.instance.astype(np.uint16)
    np.savez_compressed(file, allow_pickle=False, depth_m=view.depth_m, surface=view.surface, instance=instance)
