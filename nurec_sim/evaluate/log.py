"""Measures a reconstruction against its log: images of cameras that it did not see, sweeps that were held out.

The scene is built from the input cameras and the sweeps that are not held out, then asked, over gRPC unless told
otherwise, for what the target cameras and the held-out sweeps recorded. Figures are plain JSON.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from nurec_sim import geometry
from nurec_sim.errors import ReconstructError
from nurec_sim.evaluate.scores.images import psnr, ssim
from nurec_sim.evaluate.scores.lidar import LidarScore, scanner_along, score_sweep
from nurec_sim.files.new_files import write_file
from nurec_sim.metrics.offroad import offroad_agreement
from nurec_sim.metrics.offroad_grid import scene_offroad_grid
from nurec_sim.render import make_renderer
from nurec_sim.types import CameraFrame, Clip, GaussianScene, LidarFrame, Sense, SensorRequest, Sweep

Progress = Callable[[str, float], None]


def evaluate(
    clip: Clip,
    method: str = "lift",
    *,
    input_cameras: Sequence[str] | None = None,
    target_cameras: Sequence[str] | None = None,
    hold_out_every: int = 0,
    hold_out_sweeps: Sequence[int] = (),
    via_grpc: bool = True,
    device: str = "auto",
    images_dir: Path | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> dict[str, object]:
    """Reconstruct a clip and score what it renders.

    Args:
        clip: the log.
        method: reconstruction method.
        input_cameras: cameras that the reconstruction may see; all if None, or as many as the method takes.
        target_cameras: cameras to compare with, at all their frames; the input cameras if None.
        hold_out_every: hold out sweeps K, 2K, 3K, ...; 0 holds out none.
        hold_out_sweeps: further sweeps to hold out, by index.
        via_grpc: whether frames come from a sensor server in this process over gRPC, or from a renderer directly.
        device: that renders; see ``render.choose_device``.
        images_dir: folder for recorded (top) and rendered (bottom) images, PNG.
        progress: called with a stage and the fraction of all work that is done, about.
        options: passed on to ``reconstruct``.

    Returns:
        JSON-ready figures: ``image`` per target camera (``psnr_db``, ``ssim``: means and per-frame lists; ``floor``:
        the same for copying the input image nearest in time; ``input``: whether the reconstruction saw the camera),
        and over all of them; ``lidar`` (``median_abs_range_error_m`` over the beams that returned,
        ``return_recall`` over the beams with a recorded return, shares within 0.1 m and 0.5 m of these, per-sweep
        lists), None if nothing was held out; ``road``: how off-road from Gaussians agrees with the log's own map
        (``metrics.offroad_agreement``), None without a map; ``seconds`` per stage; ``counts``; ``unknown``.

    Raises:
        ReconstructError: an unknown method, camera or sweep, or a clip that lacks what the method needs.
    """
    from nurec_sim.reconstruct import reconstruct

    report = progress or (lambda stage, fraction: None)
    unknown = [camera for camera in target_cameras or () if camera not in clip.rig.cameras]
    if unknown:
        raise ReconstructError(f"clip {clip.id!r} has no camera {unknown}; have {list(clip.rig.cameras)}")
    if hold_out_every < 0:
        raise ReconstructError(f"hold_out_every must be 0 or more, got {hold_out_every}")
    held = held_out(clip, hold_out_every, hold_out_sweeps)
    stages = _StageClock(_part(report, 0.0, 0.6))
    scene = reconstruct(clip, method, cameras=input_cameras, hold_out_sweeps=held, progress=stages, **options)
    stages.stop()
    inputs = list(scene.provenance["cameras"])
    targets = inputs if target_cameras is None else list(target_cameras)
    seconds = {f"reconstruct: {stage}": round(spent, 3) for stage, spent in stages.seconds.items()}
    seconds["reconstruct"] = round(sum(stages.seconds.values()), 3)
    with sensing(scene, via_grpc, device) as sense:
        started = time.perf_counter()
        image = _score_images(clip, inputs, targets, sense, images_dir, _part(report, 0.6, 0.9))
        seconds["images"] = round(time.perf_counter() - started, 3)
        started = time.perf_counter()
        lidar = _score_lidars(clip, held, sense, _part(report, 0.9, 1.0)) if held else None
        seconds["lidar"] = round(time.perf_counter() - started, 3)
    return {
        "clip": clip.id,
        "method": method,
        "input_cameras": inputs,
        "target_cameras": targets,
        "held_out_sweeps": held,
        "via": "grpc" if via_grpc else "local",
        "image": image,
        "lidar": lidar,
        "road": _score_road(scene),
        "seconds": seconds,
        "counts": {"static": len(scene.static), "dynamic": len(scene.dynamic)}
        | dict(scene.provenance.get("counts", {})),
        "unknown": list(scene.provenance.get("unknown", [])),
    }


def _part(report: Progress, begin: float, end: float) -> Progress:
    """Reports a part of all work."""
    return lambda stage, fraction: report(stage, begin + fraction * (end - begin))


class _StageClock:
    """Passes progress on, and adds up the time between the calls by stage; what follows a comma is no part of it."""

    def __init__(self, report: Progress) -> None:
        self.report, self.stage, self.since = report, "start", time.perf_counter()
        self.seconds: dict[str, float] = {}

    def __call__(self, stage: str, fraction: float) -> None:
        name = stage.partition(",")[0]
        if name != self.stage:
            self.stop()
            self.stage = name
        self.report(stage, fraction)

    def stop(self) -> None:
        now = time.perf_counter()
        self.seconds[self.stage] = self.seconds.get(self.stage, 0.0) + now - self.since
        self.since = now


def held_out(clip: Clip, every: int, listed: Sequence[int]) -> list[int]:
    """Indices of the sweeps to hold out: every K-th but the first, and those listed."""
    most = max((len(clip.sweep_times_us(lidar)) for lidar in clip.rig.lidars), default=0)
    return sorted({*(range(every, most, every) if every else ()), *(int(i) for i in listed)})


@contextlib.contextmanager
def sensing(scene: GaussianScene, via_grpc: bool, device: str) -> Iterator[Sense]:
    """A ``sense`` for a scene: through a server on a free port of this machine, or a renderer in this process."""
    if not via_grpc:
        yield make_renderer(scene, device).sense
        return
    from nurec_sim.serving.client import RemoteSensors
    from nurec_sim.serving.server import SensorServer
    from nurec_sim.serving.store import SceneStore

    with (
        SensorServer(SceneStore([scene], device=device), port=0) as address,
        RemoteSensors(address, scene.id) as remote,
    ):
        yield remote.sense


# ----------------------------------------------------------------------------------------------------------- images


def _score_images(
    clip: Clip, inputs: Sequence[str], targets: Sequence[str], sense: Sense, images_dir: Path | None, report: Progress
) -> dict[str, object]:
    per_camera: dict[str, dict[str, Any]] = {}
    for done, camera in enumerate(targets):
        shown: dict[str, list[float]] = {"psnr_db": [], "ssim": []}
        floor: dict[str, list[float]] = {"psnr_db": [], "ssim": []}
        times = clip.camera_times_us(camera)
        for index in range(len(times)):
            report(f"images of {camera}", (done + index / len(times)) / len(targets))
            recorded = clip.image(camera, index)
            start_us, end_us = int(times[index, 0]), max(int(times[index, 1]), int(times[index, 0]) + 1)
            request = SensorRequest(
                clip.id, clip.rig.cameras[camera], start_us, end_us, clip.world_from_camera(camera, index)
            )
            frame = sense([request])[0]
            assert isinstance(frame, CameraFrame)
            rendered = frame.rgb
            copied = _nearest_input(clip, camera, index, inputs)
            _append(shown, rendered, recorded)
            if copied is not None:
                _append(floor, copied, recorded)
            if images_dir is not None:
                _write_pair(images_dir / f"{camera}_{index:04d}.png", recorded, rendered)
        report(f"images of {camera}", (done + 1) / len(targets))
        per_camera[camera] = {**_with_means(shown), "input": camera in inputs, "floor": _with_means(floor)}
    means: dict[str, float | None] = {}
    for name in ("psnr_db", "ssim"):
        values = [value for row in per_camera.values() for value in row["per_frame"][name]]
        means[name] = float(np.mean(values)) if values else None
    return {**means, "cameras": per_camera}


def _append(lists: dict[str, list[float]], image: np.ndarray, recorded: np.ndarray) -> None:
    lists["psnr_db"].append(min(psnr(image, recorded), 100.0))
    lists["ssim"].append(ssim(image, recorded))


def _with_means(lists: dict[str, list[float]]) -> dict[str, object]:
    if not lists["psnr_db"]:
        return {"psnr_db": None, "ssim": None, "per_frame": lists}
    return {**{name: float(np.mean(values)) for name, values in lists.items()}, "per_frame": lists}


def _nearest_input(clip: Clip, camera: str, index: int, inputs: Sequence[str]) -> UInt8[np.ndarray, "h w 3"] | None:
    """What copying would show: the input frame nearest in time, of the camera that looks most alike; never itself."""
    import cv2

    model, t_us = clip.rig.cameras[camera], int(clip.camera_times_us(camera)[index].sum()) // 2
    best: tuple[float, float, str, int] | None = None
    for other in inputs:
        times = clip.camera_times_us(other).sum(axis=1) // 2
        gap = np.abs(times - t_us).astype(np.float64)
        if other == camera:
            gap[index] = np.inf
        nearest = int(np.argmin(gap)) if len(gap) else 0
        if not len(gap) or not np.isfinite(gap[nearest]):
            continue
        facing = float(clip.rig.cameras[other].rig_from_camera[:3, 2] @ model.rig_from_camera[:3, 2])
        candidate = (round(-facing, 2), float(gap[nearest]), other, nearest)
        best = candidate if best is None or candidate < best else best
    if best is None or best[0] > 0:
        return None
    image = clip.image(best[2], best[3])
    size = (model.width_px, model.height_px)
    return image if image.shape[1::-1] == size else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _write_pair(path: Path, recorded: np.ndarray, rendered: np.ndarray) -> None:
    import cv2

    pair = np.ascontiguousarray(np.vstack([recorded, rendered])[..., ::-1])
    write_file(path, cv2.imencode(path.suffix, pair)[1].tobytes())


# ------------------------------------------------------------------------------------------------------------- road


def _score_road(scene: GaussianScene) -> dict[str, object] | None:
    if scene.road_map is None or not scene.road_map.drivable:
        return None
    try:
        found = offroad_agreement(scene_offroad_grid(scene), scene.road_map, scene.ego, scene.rig.body)
    except (ReconstructError, ValueError) as error:  # no road was labelled, or the car hardly moved
        return {"not_known": str(error)}
    return {name: None if value != value else value for name, value in dataclasses.asdict(found).items()}


# ------------------------------------------------------------------------------------------------------------ LiDAR


def _score_lidars(clip: Clip, held: Sequence[int], sense: Sense, report: Progress) -> dict[str, object]:
    scores, names = [], []
    jobs = [(lidar, i) for lidar in clip.rig.lidars for i in held if i < len(clip.sweep_times_us(lidar))]
    for done, (lidar, index) in enumerate(jobs):
        report("held-out sweeps", done / len(jobs))
        sweep = clip.sweep(lidar, index)
        fired, poses = as_fired(clip, lidar, sweep)
        scanner = scanner_along(clip.rig.lidars[lidar], fired)
        request = SensorRequest(clip.id, scanner, sweep.start_us, max(sweep.end_us, sweep.start_us + 1), poses)
        frame = sense([request])[0]
        assert isinstance(frame, LidarFrame)
        scores.append(score_sweep(frame, fired))
        names.append({"lidar": lidar, "sweep": index})
    report("held-out sweeps", 1.0)
    total = LidarScore.pooled(scores)
    return {
        "median_abs_range_error_m": _known(total.median_abs_error_m),
        "return_recall": _known(total.recall),
        "within_0.1_m": _within(total, 0.1),
        "within_0.5_m": _within(total, 0.5),
        "beams": total.beams,
        "per_sweep": [
            {**name, "median_abs_range_error_m": _known(s.median_abs_error_m), "return_recall": _known(s.recall)}
            for name, s in zip(names, scores, strict=True)
        ],
    }


def _within(score: LidarScore, limit_m: float) -> float | None:
    """Share of the beams with a recorded return whose simulated return exists and is as near as this."""
    return float((score.abs_error_m < limit_m).sum() / score.beams) if score.beams else None


def _known(value: float) -> float | None:
    """JSON has no NaN: what cannot be computed is null."""
    return float(value) if np.isfinite(value) else None


def as_fired(clip: Clip, lidar: str, sweep: Sweep) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "2 4 4"]]:
    """Returns in the frame of the sensor when each was fired, and the sensor's poses at the sweep's start and end."""
    rig_from_lidar = clip.rig.lidars[lidar].rig_from_lidar
    # The log's own pose of the sweep counts; the ego trajectory gives the motion around it.
    fix = sweep.world_from_lidar @ geometry.inverse(clip.ego.at(sweep.t_us) @ rig_from_lidar)
    times = np.array([sweep.start_us, sweep.end_us])
    poses = np.einsum("ij,njk->nik", fix, clip.ego.at(times) @ rig_from_lidar)
    span = max(sweep.end_us - sweep.start_us, 1)
    fraction = np.clip((sweep.point_t_us - sweep.start_us) / span, 0, 1)
    inverse = geometry.inverse(geometry.interpolate_pose_pair(poses, fraction))
    return np.einsum("nij,nj->ni", inverse[:, :3, :3], sweep.xyz_world_m) + inverse[:, :3, 3], poses
