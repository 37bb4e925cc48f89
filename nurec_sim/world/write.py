"""Writes a drive through a town as a driving log: sensor data only, without the ground truth."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Int64, UInt8

from nurec_sim import geometry, logs, sensors
from nurec_sim.errors import ClipError
from nurec_sim.types import CameraModel, LidarModel, Rig, SensorRequest, Shutter, Sweep, Trajectory
from nurec_sim.world.plan.network import TownNetwork
from nurec_sim.world.plan.rig import street_rig
from nurec_sim.world.plan.town import TownPlan
from nurec_sim.world.sense.isp import CameraResponse, random_response
from nurec_sim.world.sense.scan import LidarResponse, measured_points
from nurec_sim.world.sense.simulator import TrueWorld
from nurec_sim.world.sense.truth import scene_flow
from nurec_sim.world.truth_folder import TruthFolder
from nurec_sim.world.xodr import opendrive_town

Progress = Callable[[str, float], None]
"""Called with (sensor id, fraction done)."""
Responses = Mapping[str, CameraResponse | LidarResponse]
SPIN_US = 100_000
READOUT_US = 20_000


def write_town_clip(
    plan: TownPlan,
    path: str | Path,
    *,
    rig: Rig | None = None,
    period_us: int = 100_000,
    readout_us: int = READOUT_US,
    responses: Responses | None = None,
    jpeg_quality: int = 80,
    point_step_m: float = 0.01,
    backend: str | None = None,
    truth: str | Path | None = None,
    command: str = "",
    progress: Progress | None = None,
    overwrite: bool = False,
) -> Path:
    """Drives through a town and writes the log, as a folder or a ``.zip``; log and truth appear complete or not at all.

    Every ``period_us`` the LiDAR turns once (0.1 s, from straight behind) and all cameras expose around the middle of
    the turn, when the LiDAR points straight ahead: at once with a global shutter, else from ``readout_us / 2`` before
    to as much after. Sweeps are motion-compensated to that middle. Poses, calibration, boxes and map are exact.

    Args:
        plan: the town and its traffic.
        path: folder or ``.zip`` file to write.
        rig: sensors; ``street_rig()`` by default.
        period_us: time from one set of frames to the next; at least one turn with a LiDAR.
        readout_us: how long rolling shutters take from their first to their last line, at most 0.1 s.
        responses: imperfections of sensors, by id (``random_responses``); ideal sensors by default. They are written to
            the truth, not to the log.
        jpeg_quality: 1..100; colours are stored at half resolution, as by real cameras.
        point_step_m: LiDAR coordinates are rounded to multiples of it (a centimetre halves the size of the file).
        backend: see ``TrueWorld``.
        truth: a new folder for the ground truth, which the log must not contain (docs/world.md).
        command: the command line to record in the log's metadata.
        progress: called after every camera or LiDAR frame.
        overwrite: replace an existing log at ``path``.

    Returns:
        ``path``.

    Raises:
        ClipError: the path or the truth folder exists, the plan has no ego, or a time is out of range.
    """
    path, rig = Path(path), street_rig() if rig is None else rig
    least_us = SPIN_US if rig.lidars else 2 * max(readout_us, 1)
    if period_us < least_us:
        raise ClipError(f"period_us must be {least_us} or more (a LiDAR turn, or two readouts), got {period_us}")
    if not 0 <= readout_us <= SPIN_US:
        raise ClipError(f"readout_us must be within 0..{SPIN_US}, got {readout_us}")
    if path.exists() and not overwrite:
        raise ClipError(f"{str(path)!r} exists; choose another path or allow overwriting")
    if not plan.ego:
        raise ClipError("the plan has no ego: nobody drives through its town; make plans with town_plan(seed)")
    responses = dict(responses or {})
    with contextlib.ExitStack() as stack:
        folder = None if truth is None else stack.enter_context(TruthFolder(truth))
        world = stack.enter_context(TrueWorld(plan, backend, responses))
        if folder is not None:
            folder.add_plan(plan, responses)
        drive = _Drive(world, rig, period_us, readout_us, jpeg_quality, point_step_m, folder, progress)
        return logs.write_clip(
            path,
            id=f"town-{plan.split}-{plan.template}-{plan.seed}",
            rig=rig,
            ego=drive.ego,
            frames=drive.frames(),
            tracks=plan.tracks(),
            road_map=TownNetwork(plan).road_map(),
            facts=_facts(plan, command, world.backend),
            attachments={"map.xodr": opendrive_town(plan)},
            overwrite=overwrite,
        )


def random_responses(rig: Rig, seed: int) -> dict[str, CameraResponse | LidarResponse]:
    """Imperfect sensors: every camera has its own colours, vignette and noise; LiDARs lose faint echoes."""
    rng = np.random.default_rng([seed, 0x15B])
    cameras = {name: random_response(rng) for name in rig.cameras}
    return {**cameras, **{name: LidarResponse(1.0, 0.015) for name in rig.lidars}}


def _facts(plan: TownPlan, command: str, backend: str) -> dict[str, Any]:
    return {
        "dataset": "nurec_sim procedural town",
        "source": "synthetic: MuJoCo, drawn by nurec_sim.world",
        "licence": "Apache-2.0",
        "seed": plan.seed,
        "split": plan.split,
        "template": plan.template,
        "seconds": (plan.span_us[1] - plan.span_us[0]) / 1e6,
        "command": command,
        "backend": backend,
        "poses": "exact",
        "boxes": "exact",
        "map": "exact",
    }


@dataclass
class _Drive:
    """The frames of a log, rendered one at a time."""

    world: TrueWorld
    rig: Rig
    period_us: int
    readout_us: int
    jpeg_quality: int
    point_step_m: float
    truth: TruthFolder | None
    progress: Progress | None

    def __post_init__(self) -> None:
        self.ego = self.world.plan.ego_trajectory()

    def frames(self) -> Iterator[logs.CameraEntry | logs.LidarEntry]:
        start_us, end_us = self.world.plan.span_us
        # Only complete LiDAR turns within the span.
        turns = range(start_us, end_us - SPIN_US + 1, self.period_us)
        carried: list[LidarModel | CameraModel] = [*self.rig.lidars.values(), *self.rig.cameras.values()]
        total, done = len(turns) * len(carried), 0
        for index, turn_us in enumerate(turns):
            for sensor in carried:
                if isinstance(sensor, LidarModel):
                    sweep = true_sweep(self.world, self.ego, sensor, turn_us, self.point_step_m)
                    yield logs.LidarEntry(sensor.id, sweep)
                else:
                    yield self._image(sensor, index, turn_us + SPIN_US // 2)
                done += 1
                if self.progress is not None:
                    self.progress(sensor.id, done / total)

    def _image(self, camera: CameraModel, index: int, middle_us: int) -> logs.CameraEntry:
        half_us = 0 if camera.shutter is Shutter.GLOBAL else self.readout_us // 2
        start_us, end_us = middle_us - half_us, middle_us + half_us
        poses = self.ego.at(np.array([start_us, end_us])) @ camera.rig_from_camera
        view = self.world.view(SensorRequest("", camera, start_us, end_us, poses))
        if self.truth is not None:
            # Flow leads to the next frame of the same camera.
            now, then = self.world.boxes(middle_us), self.world.boxes(middle_us + self.period_us)
            pose = self.ego.at(middle_us) @ camera.rig_from_camera
            self.truth.add_view(camera.id, index, view, scene_flow(view, camera, pose, now, then))
        return logs.CameraEntry(camera.id, start_us, end_us, _jpeg(view.rgb, self.jpeg_quality), poses)


def true_sweep(
    world: TrueWorld, ego: Trajectory, lidar: LidarModel, start_us: int, point_step_m: float | None = None
) -> Sweep:
    """One turn of a LiDAR, motion-compensated to the middle of the turn.

    Args:
        world: the simulated town.
        ego: trajectory of the rig.
        lidar: the sensor.
        start_us: start of the turn, which takes 0.1 s.
        point_step_m: coordinates are rounded to multiples of it; not rounded if None.
    """
    end_us, middle_us = start_us + SPIN_US, start_us + SPIN_US // 2
    pair = ego.at(np.array([start_us, end_us])) @ lidar.rig_from_lidar
    scan = world.scan(SensorRequest("", lidar, start_us, end_us, pair))
    xyz, intensity, beam = measured_points(lidar, scan)
    fraction = sensors.column_fraction(lidar)[beam % scan.range_m.shape[1]]
    # Sensor pose at the firing time of every point; compensation moves the points into the frame of the middle pose.
    fired = geometry.interpolate_pose_pair(pair, fraction)
    middle = ego.at(middle_us) @ lidar.rig_from_lidar
    point_t_us: Int64[np.ndarray, " n"] = start_us + np.rint(fraction * SPIN_US).astype(np.int64)
    xyz = sensors.compensate_sweep(xyz, fired, middle)
    if point_step_m is not None:
        xyz = np.rint(xyz / point_step_m) * point_step_m
    return Sweep(middle_us, start_us, end_us, middle, xyz, intensity, point_t_us)


def _jpeg(rgb: UInt8[np.ndarray, "h w 3"], quality: int) -> bytes:
    # OpenCV expects BGR.
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    return cv2.imencode(".jpg", np.ascontiguousarray(rgb[:, :, ::-1]), options)[1].tobytes()
