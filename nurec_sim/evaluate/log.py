"""Measures a scene against a log: images of cameras that it did not see, images and sweeps that were held out.

The scene is built from what is not held out, or given, then renders, over gRPC unless told otherwise, what the log
recorded. Figures are plain JSON.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nurec_sim.errors import ReconstructError
from nurec_sim.evaluate.actor_scores import score_actors
from nurec_sim.evaluate.detection.log import score_log_detections
from nurec_sim.evaluate.image_scores import score_images
from nurec_sim.evaluate.lidar_scores import score_free_space, score_sweeps
from nurec_sim.logs.alignment import FACT, aligned_as, with_aligned_sensors
from nurec_sim.logs.held_out import HeldOut, hold_out, without_images
from nurec_sim.logs.selection import with_tracks
from nurec_sim.metrics.offroad_agreement import road_agreement
from nurec_sim.metrics.offroad_grid import scene_offroad_grid
from nurec_sim.reconstruct.movers import NAME as FOUND
from nurec_sim.render import make_renderer
from nurec_sim.types import CameraFrame, Clip, GaussianScene, Sense, SensorRequest

Progress = Callable[[str, float], None]
SAME_PATH_M = 0.01
"""A scene of the log has the log's path, to rounding."""
ALIGNED_PATH_M = 0.5
"""Alignment of sweeps moves it by centimetres."""


def evaluate(
    clip: Clip,
    method: str = "lift",
    *,
    input_cameras: Sequence[str] | None = None,
    target_cameras: Sequence[str] | None = None,
    hold_out_every: int = 0,
    hold_out_sweeps_every: int = 0,
    hold_out_sweeps: Sequence[int] = (),
    via_grpc: bool = True,
    device: str = "auto",
    images_dir: Path | None = None,
    detector: bool = False,
    align_sweeps: bool = True,
    progress: Progress | None = None,
    **options: Any,
) -> dict[str, object]:
    """Reconstructs a clip and scores its renderings.

    Args:
        clip: the log.
        method: reconstruction method.
        input_cameras: input cameras of the reconstruction; default: all, or as many as the method supports.
        target_cameras: cameras to score at all their frames; default: the input cameras.
        hold_out_every: hold out images N-1, 2N-1, ... of the input cameras, and sweeps taken with them; 0: none.
        hold_out_sweeps_every: hold out sweeps K, 2K, ...; 0: none.
        hold_out_sweeps: further sweeps to hold out, by index.
        via_grpc: render through a sensor server in this process over gRPC, or directly.
        device: that renders; see ``render.choose_device``.
        images_dir: folder for recorded (top) and rendered (bottom) images, PNG.
        detector: whether to compare what the camera detector finds in recorded and in rendered images.
        align_sweeps: whether to align the log by what its other sweeps and the images of input cameras that are not
            held out show (``logs.alignment``), for the method and for the comparison.
        progress: called with the stage and the approximate fraction done.
        options: passed to ``reconstruct``.

    Returns:
        what ``score_scene`` returns, with ``method`` and the ``seconds`` of each stage of the reconstruction.

    Raises:
        ReconstructError: an unknown method, camera or sweep, or a clip without the data that the method needs.
    """
    from nurec_sim.reconstruct import reconstruct

    report = progress or (lambda stage, fraction: None)
    cameras = list(clip.rig.cameras) if input_cameras is None else list(input_cameras)
    _check_cameras(clip, [*cameras, *(target_cameras or ())])
    held = hold_out(
        clip, cameras, images_every=hold_out_every, sweeps_every=hold_out_sweeps_every, sweeps=hold_out_sweeps
    )
    stages = _StageClock(_part(report, 0.0, 0.6))
    if align_sweeps:
        clip = with_aligned_sensors(clip, held.sweeps, stages, cameras, held.images)
    scene = reconstruct(
        without_images(clip, held), method, cameras=input_cameras, hold_out_sweeps=sorted(held.sweeps), progress=stages,
        align_sweeps=False, **options,
    )  # fmt: skip
    stages.stop()
    seconds = {f"reconstruct: {stage}": round(spent, 3) for stage, spent in stages.seconds.items()}
    seconds["reconstruct"] = round(sum(stages.seconds.values()), 3)
    figures = score_scene(
        clip, scene, held, target_cameras=target_cameras, via_grpc=via_grpc, device=device,
        images_dir=images_dir, detector=detector, progress=_part(report, 0.6, 1.0),
    )  # fmt: skip
    return {**figures, "method": method, "seconds": {**seconds, **figures["seconds"]}}


def score_scene(
    clip: Clip,
    scene: GaussianScene,
    held: HeldOut | None = None,
    *,
    target_cameras: Sequence[str] | None = None,
    via_grpc: bool = True,
    device: str = "auto",
    images_dir: Path | None = None,
    detector: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Score what a scene of a log renders.

    In a log without boxes, the actors that were found in its sweeps (``reconstruct.movers``) count as its boxes.

    Args:
        clip: the log.
        scene: its reconstruction.
        held: images and sweeps that the scene was not made from.
        target_cameras: cameras to compare with; the scene's input cameras if None.
        via_grpc: whether frames come over gRPC or from a renderer directly.
        device: that renders; see ``render.choose_device``.
        images_dir: folder for recorded (top) and rendered (bottom) images, PNG.
        detector: whether to compare what the camera detector finds in recorded and in rendered images.
        progress: called with the stage and the approximate fraction done.

    Returns:
        JSON-ready figures.

        - ``image``: ``psnr_db`` and ``ssim`` over all frames; under ``seen`` and ``unseen`` those of the frames that
          the scene was made from and of the others, with ``flip``, ``sharpness`` (spectral energy by octave, as a part
          of the recorded image's), ``region_psnr_db`` (labelled actors, background, around LiDAR points by range),
          ``camera_psnr_db``, ``holes`` (share of LiDAR points with alpha < 0.5, by range) and the ``worst`` frames; per
          camera the per-frame lists and ``floor``: copying the seen image nearest in time.
        - ``lidar``: of the sweeps held out (``lidar_scores.score_sweeps``), None if there are none.
        - ``free_space``: false obstacles beside the path (``lidar_scores.score_free_space``), None without LiDAR.
        - ``actors``: found actors against the log's boxes (``actor_scores.score_actors``), None without either.
        - ``detection``: ``detection.log.score_log_detections``, only with ``detector``.
        - ``road``: how off-road from Gaussians agrees with the log's map, None without a map.
        - ``seconds``, ``counts``, ``unknown``.

    Raises:
        ReconstructError: an unknown camera, or a scene of another log.
    """
    held, report = held or HeldOut(), progress or (lambda stage, fraction: None)
    clip = _as_made(clip, scene)
    found, recorded = score_actors(clip, scene), clip
    if not clip.tracks:
        # What moves in the log is in free space at other times, with a label or without.
        clip = with_tracks(clip, [track for track in scene.tracks if track.id.startswith(FOUND)])
    inputs = [camera for camera in scene.provenance.get("cameras", scene.rig.cameras) if camera in clip.rig.cameras]
    targets = inputs if target_cameras is None else list(target_cameras)
    _check_cameras(clip, targets)
    seconds = {}
    with sensing(scene, via_grpc, device) as sense:
        started = time.perf_counter()
        probe = _probe(scene, device)
        image = score_images(clip, inputs, targets, held, sense, probe, images_dir, _part(report, 0.0, 0.75))
        seconds["images"] = round(time.perf_counter() - started, 3)
        started = time.perf_counter()
        lidar = (
            score_sweeps(clip, scene.rig.lidars, sorted(held.sweeps), sense, _part(report, 0.75, 0.9))
            if held.sweeps
            else None
        )
        end = 0.95 if detector else 1.0
        free = score_free_space(clip, sense, _part(report, 0.9, end))
        seconds["lidar"] = round(time.perf_counter() - started, 3)
        detection = (
            score_log_detections(
                recorded, targets, held, sense, images_dir, lambda done: report("detector", end + (1 - end) * done)
            )
            if detector
            else None
        )
    return {
        "clip": clip.id,
        "scene": scene.id,
        "input_cameras": inputs,
        "target_cameras": targets,
        "held_out_images": {camera: sorted(indices) for camera, indices in held.images.items()},
        "held_out_sweeps": sorted(held.sweeps),
        "via": "grpc" if via_grpc else "local",
        "image": image,
        "lidar": lidar,
        "free_space": free,
        "road": score_road(scene),
        "actors": found,
        **({} if detection is None else {"detection": detection}),
        "seconds": seconds,
        # A method counts what it made; a fit, or an edit, may have changed it.
        "counts": dict(scene.provenance.get("counts", {}))
        | {"static": len(scene.static), "dynamic": len(scene.dynamic)},
        "unknown": list(scene.provenance.get("unknown", [])),
    }


def _check_cameras(clip: Clip, cameras: Sequence[str]) -> None:
    unknown = [camera for camera in cameras if camera not in clip.rig.cameras]
    if unknown:
        raise ReconstructError(f"clip {clip.id!r} has no camera {unknown}; have {list(clip.rig.cameras)}")


def _as_made(clip: Clip, scene: GaussianScene) -> Clip:
    """The log as the scene was made from it, its sweeps aligned if they were.

    Raises:
        ReconstructError: it is a scene of another log.
        ClipError: the scene's provenance is damaged.
    """
    _check_path(clip, scene, ALIGNED_PATH_M if FACT in scene.provenance else SAME_PATH_M)
    return aligned_as(clip, scene)


def _check_path(clip: Clip, scene: GaussianScene, within_m: float) -> None:
    """Poses of a scene of another log, or of another cut of it, would be scored as errors of the pictures."""
    times = clip.ego.t_us[(clip.ego.t_us >= scene.ego.start_us) & (clip.ego.t_us <= scene.ego.end_us)]
    if not len(times):
        raise ReconstructError(
            f"scene {scene.id!r} is of another time than clip {clip.id!r}: {scene.ego.start_us} to {scene.ego.end_us} "
            f"against {clip.ego.start_us} to {clip.ego.end_us} us"
        )
    apart = np.linalg.norm((scene.ego.at(times) - clip.ego.at(times))[:, :3, 3], axis=1).max()
    if apart > within_m:
        raise ReconstructError(f"scene {scene.id!r} was not made from clip {clip.id!r}: paths are {apart:.2f} m apart")


def _probe(scene: GaussianScene, device: str) -> Callable[[SensorRequest], CameraFrame]:
    """Renders alpha, which a server's clients do not get."""
    renderer = make_renderer(scene, device)
    return lambda request: renderer.render_camera(request, ("alpha",))


def _part(report: Progress, begin: float, end: float) -> Progress:
    """Maps the progress of a part to the whole."""
    return lambda stage, fraction: report(stage, begin + fraction * (end - begin))


class _StageClock:
    """Forwards progress, and accumulates the time per stage (its name up to a comma)."""

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


@contextlib.contextmanager
def sensing(scene: GaussianScene, via_grpc: bool, device: str) -> Iterator[Sense]:
    """A ``sense`` for a scene: through a server on a free local port, or a renderer in this process."""
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


def score_road(scene: GaussianScene) -> dict[str, object] | None:
    """How off-road from Gaussians agrees with the log's map (``metrics.road_agreement``); None without a map."""
    if scene.road_map is None or not scene.road_map.drivable:
        return None
    try:
        found = road_agreement(scene_offroad_grid(scene), scene.road_map, scene.ego, scene.rig.body)
    except (ReconstructError, ValueError) as error:  # no labelled road, or the car hardly moved
        return {"not_known": str(error)}
    return {name: None if value != value else value for name, value in dataclasses.asdict(found).items()}
